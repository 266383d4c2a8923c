"""Two-level training: exact resume after a kill, what is kept, and what is refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from cmc import store
from cmc.learning.hierarchy import HierarchyConfig
from cmc.studies import (
    peg_maze,
    peg_push,
    two_level,
    two_level_evaluation,
    two_level_results,
)
from cmc.studies.two_level_training import load, marks, train

SMALL = HierarchyConfig(worlds=2, samples=80, high_updates=4, low_updates=4, warm_up=80)


def small(study: two_level.TwoLevelStudy) -> two_level.TwoLevelStudy:
    tiny = {"planner_hidden": (16,), "low_hidden": (8,), "snapshot_every": 120}
    return replace(
        study,
        hierarchy=SMALL,
        planner=replace(study.planner, critic_hidden=(16,), batch=16),
        low=replace(study.low, critic_hidden=(16,), batch=16, critic_head_start=0),
        task=replace(study.task, ticks=60),
        joint_task=study.joint_task and replace(study.joint_task, ticks=60),
        joint_hidden=(8,),
        latent=replace(study.latent, batch=8),
        ppo=replace(study.ppo, critic_hidden=(8,), epochs=2, minibatches=2),
        **tiny,
    )


def weights(path: Path) -> dict[str, np.ndarray]:
    return store.load_checkpoint(path)[0]


EVERY = [(peg_maze.STUDY, name) for name in peg_maze.STUDY.methods]
SOME = [(peg_push.STUDY, name) for name in ("ctd3", "td3_corrected", "ppo_control")]


@pytest.mark.parametrize(("study", "name"), EVERY + SOME, ids=lambda x: getattr(x, "name", x))
def test_every_method_trains_and_loads(study, name: str, tmp_path: Path) -> None:
    study = small(study)
    path = train(study, name, [0, 3], steps=240, out=tmp_path)
    assert marks(study, name, path) == [120, 240]
    planner, low, record = load(study, name, path=path)
    assert record["seeds"] == [0, 3]
    found = two_level_evaluation.run_episodes(study.of(name), planner, low, seeds=2, episodes=2)
    figures = two_level_evaluation.summary(found)
    assert np.isfinite(figures["return"]).all()
    assert figures["force"]["largest"]["below_5_N"] <= 1.0
    trained = weights(path)
    moved = [
        not np.array_equal(trained[key], trained[key.replace("00000240", "00000120")])
        for key in trained
        if key.startswith("00000240.low.")
    ]
    learns = study.method(name).low in ("latent", "critic", "hiro")
    assert any(moved) == learns


def test_a_run_that_was_stopped_ends_with_the_same_weights(tmp_path: Path) -> None:
    study = small(peg_maze.STUDY)
    for name in ("ctd3", "td3_corrected", "hiro", "ppo_control"):
        whole = train(study, name, [1, 2], steps=360, out=tmp_path / "whole")
        train(study, name, [1, 2], steps=240, out=tmp_path / "parts")
        parts = train(study, name, [1, 2], steps=360, out=tmp_path / "parts")
        expected = weights(whole)
        for key, value in weights(parts).items():
            np.testing.assert_array_equal(value, expected[key], err_msg=f"{name} {key}")


@pytest.mark.parametrize("study", [peg_maze.STUDY, peg_push.STUDY], ids=lambda s: s.name)
@pytest.mark.parametrize("how", ["in the callback", signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_is_saved_within_an_episode(study, how, tmp_path: Path) -> None:
    study, steps = small(study), 360
    whole = train(study, "ctd3", [1, 2], steps=steps, out=tmp_path / "whole")

    def stop(row: dict[str, Any]) -> None:
        if row["steps"] == 160:  # the second of three segments
            if isinstance(how, str):
                raise KeyboardInterrupt
            os.kill(os.getpid(), how)

    with pytest.raises(KeyboardInterrupt):
        train(study, "ctd3", [1, 2], steps=steps, out=tmp_path / "parts", callback=stop)
    rows: list[int] = []
    parts = train(
        study,
        "ctd3",
        [1, 2],
        steps=steps,
        out=tmp_path / "parts",
        callback=lambda row: rows.append(row["steps"]),
    )
    assert rows[0] == 200
    expected = weights(whole)
    for key, value in weights(parts).items():
        np.testing.assert_array_equal(value, expected[key], err_msg=key)


def test_a_killed_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    program = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from test_studies_two_level import *\n"
        "import cmc.studies.two_level_training as training\n"
        "training.SAVE_EVERY = 0.0\n"
        f"train(small(peg_maze.STUDY), 'ctd3', [0], steps=720, out={str(tmp_path / 'killed')!r})"
    )
    root = Path(__file__).resolve().parent.parent
    process = subprocess.Popen([sys.executable, "-c", program], cwd=root)
    state = tmp_path / "killed" / "ctd3_state.safetensors"
    while not state.exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(float(np.random.default_rng().uniform(0.0, 0.4)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    study = small(peg_maze.STUDY)
    resumed = train(study, "ctd3", [0], steps=720, out=tmp_path / "killed")
    whole = train(study, "ctd3", [0], steps=720, out=tmp_path / "whole")
    expected = weights(whole)
    for key, value in weights(resumed).items():
        np.testing.assert_array_equal(value, expected[key], err_msg=key)


def test_bad_requests_are_named(tmp_path: Path) -> None:
    study = small(peg_maze.STUDY)
    with pytest.raises(ValueError, match="unknown method 'sac'"):
        train(study, "sac", [0], out=tmp_path)
    with pytest.raises(ValueError, match="unknown method 'hiro'"):
        train(small(peg_push.STUDY), "hiro", [0], out=tmp_path)
    with pytest.raises(ValueError, match="at least one, got none"):
        train(study, "frozen", [], out=tmp_path)
    with pytest.raises(ValueError, match="two segments for each of 9 minibatches, got 6"):
        train(replace(study, ppo=replace(study.ppo, minibatches=9)), "ppo_control", [0])
    path = train(study, "frozen", [0], steps=120, out=tmp_path)
    with pytest.raises(store.CheckpointError, match="study 'peg_push'"):
        load(small(peg_push.STUDY), "frozen", path=path)
    with pytest.raises(store.CheckpointError, match="do not fit"):
        load(replace(study, planner_hidden=(24,)), "frozen", path=path)
    with pytest.raises(store.CheckpointError, match="configuration"):
        train(replace(study, cap=1.0), "frozen", [0], steps=240, out=tmp_path)
    with pytest.raises(ValueError, match="wanted one of \\[120\\]"):
        load(study, "frozen", 90, path=path)


def test_a_full_disk_keeps_the_earlier_checkpoint(tmp_path: Path, monkeypatch) -> None:
    study = small(peg_maze.STUDY)
    path = train(study, "frozen", [0], steps=120, out=tmp_path)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        train(study, "frozen", [0], steps=240, out=tmp_path)
    assert path.read_bytes() == before
    monkeypatch.undo()
    train(study, "frozen", [0], steps=240, out=tmp_path)


def test_constrained_slopes_stay_below_the_cap_while_learning(tmp_path: Path) -> None:
    study = small(peg_push.STUDY)
    path = train(study, "ctd3", [0, 1], steps=480, out=tmp_path)
    _, low, _ = load(study, "ctd3", path=path)
    slopes = two_level_evaluation.slope_at_rest(study, low, seeds=2)
    assert (slopes > 0).all()
    assert (slopes <= study.slope_cap() * (1 + 1e-4)).all()


@pytest.mark.parametrize("name", ["control", "hiro"])
def test_figures_by_kept_policy_go_on_where_they_stopped(name: str, tmp_path: Path) -> None:
    study = small(peg_maze.STUDY)
    train(study, name, [0, 1], steps=240, out=tmp_path)
    seen: list[str] = []

    def stop(done: int, total: int, what: str) -> None:
        seen.append(what)
        if done == 1 and len(seen) == 2:
            raise KeyboardInterrupt

    options = {"trajectories": 10, "folder": tmp_path / "tests", "checkpoints": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        two_level_results.evaluate(study, [name], progress=stop, **options)
    kept = store.read_json(tmp_path / "tests" / f"{name}.json")["tests"]
    answer = two_level_results.evaluate(study, **options)
    assert list(answer["methods"]) == [name]
    found = answer["methods"][name]
    assert [test["episodes"] for test in found["tests"]] == [2, 10]
    assert found["tests"][:1] == kept
    assert "gains" not in found["final"]
    assert len(found["training"]["step"]) == len(found["training"]["reward"])
    mean = np.mean([test["force"]["largest"]["zero"] for test in found["tests"]])
    assert found["force_over_tests"]["largest"]["zero"] == pytest.approx(mean)
    part = np.array(found["final"]["consistency_mm"]["mean"]) / 5.0
    if name == "control":  # without action the gains alone decide, whatever was learned
        assert part[0] == pytest.approx(part[1], rel=0.02)
        assert 0.2 < part[0] < 0.8
    assert np.isfinite(part).all()


@pytest.mark.parametrize(("hits", "tries"), [(0, 10), (3, 10), (10, 10), (490, 500)])
def test_the_ends_of_an_interval_leave_a_fortieth_on_each_side(hits: int, tries: int) -> None:
    low, high = two_level_evaluation.interval(hits, tries)
    assert 0.0 <= low <= hits / tries <= high <= 1.0
    if hits:
        assert binom.sf(hits - 1, tries, low) == pytest.approx(0.025)
    if hits < tries:
        assert binom.cdf(hits, tries, high) == pytest.approx(0.025)
