"""Sweeps: groups of seeds put together, processes of this machine, a Dask cluster."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_studies_two_level import small

from cmc import store
from cmc.studies import peg_maze, two_level_training
from cmc.studies.sweep import merge, sweep


def test_groups_of_seeds_give_what_one_job_gives(tmp_path: Path, monkeypatch) -> None:
    study = small(peg_maze.STUDY)
    monkeypatch.setattr(peg_maze, "train", partial(two_level_training.train, study))
    whole = sweep("peg_maze", ["ctd3"], range(3), out=tmp_path / "whole", steps=240)
    parts = sweep("peg_maze", ["ctd3"], range(3), group=2, out=tmp_path / "parts", steps=240)
    expected, record = store.load_checkpoint(whole[0])
    found, joined = store.load_checkpoint(parts[0])
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, atol=1e-4, err_msg=name)
    assert joined["seeds"] == record["seeds"] == [0, 1, 2]
    assert "--seeds 3 --group 2" in joined["command"]
    planner, _, _ = two_level_training.load(study, "ctd3", path=parts[0])
    assert len(planner.net.seeds) == 3
    other = two_level_training.train(study, "frozen", [3], steps=240, out=tmp_path / "other")
    with pytest.raises(store.CheckpointError, match="method differs"):
        merge([whole[0], other], tmp_path / "wrong.safetensors")
    short = two_level_training.train(study, "ctd3", [3], steps=120, out=tmp_path / "short")
    with pytest.raises(store.CheckpointError, match="other policies are kept"):
        merge([whole[0], short], tmp_path / "wrong.safetensors")


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_two_workers_train_what_one_process_trains(backend, tmp_path: Path) -> None:
    if backend == "dask":
        pytest.importorskip("distributed")
    options = {"group": 1, "steps": 160}
    found = sweep("peg_maze", ["control"], [0, 5], jobs=2, backend=backend, out=tmp_path, **options)
    expected = peg_maze.train("control", [5], steps=160, out=tmp_path / "here")
    one, both = (store.load_checkpoint(path)[0] for path in (expected, found[0]))
    for name, value in one.items():
        part = both[name][:, 1:] if name == "rewards" else both[name][len(value) :]
        np.testing.assert_allclose(part, value, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": ["sac"]}, "unknown method 'sac'"),
        ({"study": "peg_pull"}, "unknown study 'peg_pull'"),
        ({"seeds": []}, "seeds: wanted at least 1, got 0"),
        ({"jobs": 0}, "jobs: wanted at least 1, got 0"),
        ({"group": 0}, "group: wanted at least 1, got 0"),
        ({"backend": "slurm"}, "wanted 'loky' or 'dask', got 'slurm'"),
    ],
)
def test_wrong_requests_train_nothing(change, message, tmp_path: Path) -> None:
    request = {"study": "peg_maze", "names": ["control"], "seeds": [0], "out": tmp_path} | change
    with pytest.raises(ValueError, match=message):
        sweep(**request)
    assert not list(tmp_path.iterdir())
