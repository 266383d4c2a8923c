"""Files are written whole or not at all, and only our own are read."""

from __future__ import annotations

import errno
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cmc import store

RECORD = {"study": "peg_touch", "method": "cppo", "seeds": [0, 1]}
TENSORS = {
    "w": np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(3, 4),
    "step": np.array([7], dtype=np.int64),
}


def test_a_round_trip_is_exact_and_another_study_or_method_refused(tmp_path: Path) -> None:
    path = store.save_checkpoint(tmp_path / "deep" / "a.safetensors", TENSORS, RECORD)
    tensors, record = store.load_checkpoint(path, study="peg_touch", method="cppo")
    assert record == RECORD
    assert tensors.keys() == TENSORS.keys()
    for name, array in TENSORS.items():
        assert tensors[name].dtype == array.dtype
        np.testing.assert_array_equal(tensors[name], array)
    for key, value in (("study", "peg_push"), ("method", "ppo")):
        with pytest.raises(store.CheckpointError, match=f"a checkpoint of {key} '{value}'"):
            store.load_checkpoint(path, **{key: value})


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    from safetensors.numpy import save

    bad = {"empty": b"", "pickled": pickle.dumps(TENSORS), "text": b"only words, no checkpoint"}
    for name, data in bad.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(store.CheckpointError, match="not a complete safetensors file"):
            store.load_checkpoint(tmp_path / name)
    header = {"format": "cmc-checkpoint-1", "record": json.dumps(RECORD)}
    for extra in ({}, {"digest": "0" * 64}):  # nothing is read that was not written here
        (tmp_path / "other").write_bytes(save(TENSORS, metadata={**header, **extra}))
        with pytest.raises(store.CheckpointError, match="not what was written"):
            store.load_checkpoint(tmp_path / "other")
    (tmp_path / "foreign").write_bytes(save(TENSORS))
    with pytest.raises(store.CheckpointError, match="wanted a file of format"):
        store.load_checkpoint(tmp_path / "foreign")
    with pytest.raises(store.CheckpointError, match="no checkpoint at"):
        store.load_checkpoint(tmp_path / "missing")


def test_every_single_damage_is_a_checkpoint_error(tmp_path: Path) -> None:
    path = store.save_checkpoint(tmp_path / "a.safetensors", TENSORS, RECORD)
    good = path.read_bytes()
    for k in range(len(good)):  # a flipped bit anywhere, and an end anywhere
        flipped = bytearray(good)
        flipped[k] ^= 1 << k % 8
        for data in (bytes(flipped), good[:k]):
            path.write_bytes(data)
            try:
                tensors, record = store.load_checkpoint(path)
            except store.CheckpointError:
                continue
            assert record == RECORD  # what is read is what was written, if it is read at all
            for name, array in TENSORS.items():
                np.testing.assert_array_equal(tensors[name], array)


def test_files_are_as_open_as_the_umask_says(tmp_path: Path) -> None:
    for mask, wanted in ((0o077, 0o600), (0o022, 0o644)):
        before = os.umask(mask)
        try:
            path = store.write_json(tmp_path / "a.json", {})
        finally:
            os.umask(before)
        assert path.stat().st_mode & 0o777 == wanted


def test_what_a_killed_process_left_is_removed_by_the_next(tmp_path: Path) -> None:
    code = (
        "import os, sys; from cmc import store\n"
        "store.write_atomic(sys.argv[1], lambda file: (file.write(b'half'), file.flush(), "
        "os.kill(os.getpid(), 9)))"
    )
    path = tmp_path / "a.json"
    subprocess.run([sys.executable, "-c", code, path], check=False)
    assert len(list(tmp_path.iterdir())) == 1  # the half-written one
    store.write_json(path, {})
    assert list(tmp_path.iterdir()) == [path]


def test_a_writer_at_work_keeps_its_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    store.write_atomic(path, lambda file: store.write_json(path, {"inner": 1}) and file.write(b"2"))
    assert path.read_bytes() == b"2"


def test_arrays_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    for bad in (np.array([1.0, np.nan]), np.array(["a"]), np.array([1j]), None, [1.0]):
        with pytest.raises(ValueError, match="'w' is not finite"):
            store.save_checkpoint(tmp_path / "a", {"w": bad}, RECORD)
    with pytest.raises(ValueError, match="lacks \\['study'\\]"):
        store.save_checkpoint(tmp_path / "a", TENSORS, {"method": "ppo"})
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_earlier_file(tmp_path: Path, monkeypatch) -> None:
    path = store.save_checkpoint(tmp_path / "a.safetensors", TENSORS, RECORD)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: .*a\.safetensors"):
        store.save_checkpoint(path, TENSORS, {**RECORD, "seeds": [9]})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_json_is_checked_both_ways(tmp_path: Path) -> None:
    path = store.write_json(tmp_path / "r.json", {"share": 0.25, "seeds": [1, 2]})
    assert store.read_json(path) == {"share": 0.25, "seeds": [1, 2]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        store.write_json(path, {"share": float("nan")})
    assert store.read_json(path)["share"] == 0.25
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match="wanted a JSON object, found list"):
        store.read_json(path)
    path.write_text("{")
    with pytest.raises(ValueError, match="is not JSON"):
        store.read_json(path)


def test_provenance_names_command_seeds_and_versions() -> None:
    record = store.provenance("python -m cmc train x", [0, 1])
    assert record["command"] == "python -m cmc train x"
    assert record["seeds"] == [0, 1]
    assert record["versions"]["numpy"] == np.__version__
    assert record["commit"]


def test_an_unknown_asset_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="no asset 'results/nothing.json'"):
        store.asset("results", "nothing.json")


def test_only_a_process_is_asked_whether_it_is_alive(tmp_path: Path) -> None:
    assert store.alive(os.getpid())
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert not store.alive(ended.pid)
    assert not store.alive(10**30)  # more than the system can count
    for bad in (0, -1, True, 2.0, "1", None):
        with pytest.raises(ValueError, match="pid: wanted the number of a process"):
            store.alive(bad)  # type: ignore[arg-type]
    own = f".a.json.{store._HOST}-"
    for pid in ("0", "9" * 30):  # no process: what it left is removed
        (tmp_path / f"{own}{pid}-x.tmp").touch()
    path = store.write_json(tmp_path / "a.json", {})
    assert list(tmp_path.iterdir()) == [path]
