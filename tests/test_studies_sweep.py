"""Sweeps: groups of seeds train side by side as they would together, and end with their parent."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cmc import store, studies
from cmc.studies.runner import train
from cmc.studies.sweep import sweep


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_a_sweep_in_groups_is_the_training_of_all(tmp_path: Path, backend: str) -> None:
    pytest.importorskip("distributed" if backend == "dask" else "joblib")
    study = studies.get("peg_touch")
    options: Any = {"length": 32, "group": 1, "jobs": 2, "backend": backend}
    (path,) = sweep("peg_touch", ["cppo"], [0, 4], out=tmp_path / "sweep", **options)
    at_once = store.load_checkpoint(train(study, "cppo", [0, 4], length=32, out=tmp_path))[0]
    for key, found in store.load_checkpoint(path)[0].items():
        np.testing.assert_allclose(found, at_once[key], rtol=1e-4, atol=1e-6)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="reads /proc")
def test_a_killed_sweep_leaves_no_process(tmp_path: Path) -> None:
    mark = f"SWEEP_OF_A_TEST={tmp_path.name}".encode()

    def of_the_sweep() -> list[Path]:
        found = []
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if mark in (entry / "environ").read_bytes():
                    found.append(entry)
        return found

    command = ["train", "peg_touch", "--method", "cppo", "--seeds", "2", "--group", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "cmc", *command, "--jobs", "2", "--out", str(tmp_path)],
        env={**os.environ, "SWEEP_OF_A_TEST": tmp_path.name},
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 120
    while len(list(tmp_path.glob("parts/*/*state*"))) < 2:
        assert time.monotonic() < deadline, "the trainings did not begin"
        time.sleep(0.2)
    process.kill()
    process.wait()
    while of_the_sweep() and time.monotonic() < deadline:
        time.sleep(0.2)
    assert of_the_sweep() == []
