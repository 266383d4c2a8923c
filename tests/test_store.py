"""Files are written whole or not at all, and only our own are read."""

from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from cmc import store

RECORD = {"study": "peg_touch", "method": "cppo", "seeds": [0, 1]}
TENSORS = {
    "w": np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(3, 4),
    "step": np.array([7], dtype=np.int64),
}


def test_checkpoint_round_trip_is_exact(tmp_path: Path) -> None:
    path = store.save_checkpoint(tmp_path / "deep" / "a.safetensors", TENSORS, RECORD)
    tensors, record = store.load_checkpoint(path, study="peg_touch", method="cppo")
    assert record == RECORD
    assert tensors.keys() == TENSORS.keys()
    for name, array in TENSORS.items():
        assert tensors[name].dtype == array.dtype
        np.testing.assert_array_equal(tensors[name], array)


@pytest.mark.parametrize(("key", "value"), [("study", "peg_push"), ("method", "ppo")])
def test_a_checkpoint_of_something_else_is_refused(tmp_path: Path, key: str, value: str) -> None:
    path = store.save_checkpoint(tmp_path / "a.safetensors", TENSORS, RECORD)
    with pytest.raises(store.CheckpointError, match=f"wanted a checkpoint of {key} '{value}'"):
        store.load_checkpoint(path, **{key: value})


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    good = store.save_checkpoint(tmp_path / "a.safetensors", TENSORS, RECORD).read_bytes()
    from safetensors.numpy import save

    bad = {
        "truncated": good[: len(good) // 2],
        "empty": b"",
        "pickled": pickle.dumps(TENSORS),
        "text": b"not a checkpoint at all, only words",
    }
    for name, data in bad.items():
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(store.CheckpointError, match="not a complete safetensors file"):
            store.load_checkpoint(path)
    (tmp_path / "foreign").write_bytes(save(TENSORS))
    with pytest.raises(store.CheckpointError, match="wanted a file of format"):
        store.load_checkpoint(tmp_path / "foreign")
    with pytest.raises(store.CheckpointError, match="no checkpoint at"):
        store.load_checkpoint(tmp_path / "missing")


def test_arrays_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'w' is not finite"):
        store.save_checkpoint(tmp_path / "a", {"w": np.array([1.0, np.nan])}, RECORD)
    with pytest.raises(ValueError, match="lacks \\['study'\\]"):
        store.save_checkpoint(tmp_path / "a", TENSORS, {"method": "ppo"})
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_earlier_file(tmp_path: Path, monkeypatch) -> None:
    path = store.save_checkpoint(tmp_path / "a.safetensors", TENSORS, RECORD)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
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


def test_a_result_is_its_file_or_empty() -> None:
    assert store.result("peg_maze")["study"] == "peg_maze"
    assert store.result("nothing") == {}


def test_an_unknown_asset_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="no asset 'results/nothing.json'"):
        store.asset("results", "nothing.json")
