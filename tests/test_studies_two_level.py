"""Studies of a planner over a low level: methods train, are resumed, loaded and tested; figures."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from small_studies import small

from cmc import store
from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
from cmc.learning.low_level import LowLevel
from cmc.robot import panda
from cmc.studies import peg_maze, peg_push, two_level_tests
from cmc.studies.peg_push import TIME_CONSTANT, scaled
from cmc.studies.runner import load, marks_of, train
from cmc.studies.study import Test
from cmc.studies.two_level import TwoLevelConfig
from cmc.studies.two_level_tests import consistency, figures, judge

MAZE, PUSHING = small(peg_maze.STUDY), small(peg_push.STUDY)
EVERY = [(MAZE, name) for name in MAZE.methods]
SOME = [(PUSHING, name) for name in ("ctd3", "td3_corrected", "ppo_control")]
LEARNS = ("ctd3", "td3", "hiro")
ADAPTED = (
    "ctd3_short",
    "ctd3_plain_view",
    "ctd3_no_bursts",
    "ctd3_no_pull",
    "ctd3_tuned",
    "ctd3_averaged",
)


def same_weights(one: Path, other: Path) -> None:
    found, expected = (store.load_checkpoint(path)[0] for path in (one, other))
    assert expected.keys() == found.keys()
    for key, value in found.items():
        np.testing.assert_array_equal(value, expected[key], err_msg=key)


@pytest.mark.parametrize(("study", "name"), EVERY + SOME, ids=lambda x: getattr(x, "name", x))
def test_every_method_trains_loads_and_is_tested(study, name: str, tmp_path: Path) -> None:
    path = train(study, name, [0, 3], length=240, out=tmp_path)
    trained = store.load_checkpoint(path)[0]
    assert marks_of(trained) == [120, 240]
    moved = [
        not np.array_equal(trained[key], trained[key.replace("00000240", "00000120")])
        for key in trained
        if key.startswith("00000240.low.")
    ]
    assert any(moved) == name.startswith(LEARNS)
    if name in ADAPTED:
        return  # the same networks as `ctd3`
    found = load(study, name, path=path)
    assert found.seeds == [0, 3]
    tables = judge(study.config_of(name), found.policy, 2, Test("nominal", 2))
    for row in tables["tests"]:
        assert np.isfinite([v for v in row.values() if v is not None]).all()
        assert row["no_contact"] <= row["below_1_N"] <= row["below_5_N"] <= 1.0
        assert row["below_1_N"] <= row["below_1_N_50hz"]  # a tick's largest is at least its last
        for axis in ("x", "rz"):
            assert row.get(f"slope_{axis}", 0.0) <= row.get(f"cap_{axis}", np.inf) * (1 + 1e-3)
    assert ("cap_x" in row) == (name in ("ctd3", "ctd3_tuned", "frozen", "frozen_tuned"))
    assert len(tables["episodes"]) == 4


@pytest.mark.parametrize("name", ["ctd3", "td3_corrected", "hiro", "ppo_control"])
def test_a_run_in_parts_ends_with_the_same_weights(name: str, tmp_path: Path) -> None:
    whole = train(MAZE, name, [1, 2], length=360, out=tmp_path / "whole")
    train(MAZE, name, [1, 2], length=240, out=tmp_path / "parts")
    same_weights(train(MAZE, name, [1, 2], length=360, out=tmp_path / "parts"), whole)


def test_a_killed_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    program = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from test_studies_two_level import *\n"
        "from cmc.studies import runner\n"
        "runner.SAVE_EVERY = 0.0\n"
        f"train(MAZE, 'ctd3', [0], length=720, out={str(tmp_path / 'killed')!r})"
    )
    root = Path(__file__).resolve().parent.parent
    process = subprocess.Popen([sys.executable, "-c", program], cwd=root)
    state = tmp_path / "killed" / "ctd3_state.safetensors"
    while not state.exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(float(np.random.default_rng().uniform(0.0, 0.4)))
    process.send_signal(signal.SIGKILL)
    process.wait()
    resumed = train(MAZE, "ctd3", [0], length=720, out=tmp_path / "killed")
    same_weights(resumed, train(MAZE, "ctd3", [0], length=720, out=tmp_path / "whole"))


def test_one_seed_of_a_run_acts_as_it_does_among_others(tmp_path: Path) -> None:
    path = train(PUSHING, "ctd3", [0, 3], length=120, out=tmp_path)
    observation = np.random.default_rng(0).normal(size=(2, 5, 25))
    _, both = load(PUSHING, "ctd3", path=path).policy
    for seed in range(2):
        _, alone = load(PUSHING, "ctd3", seed=seed, path=path).policy
        own = alone.act(observation[seed : seed + 1], explore=False)
        np.testing.assert_allclose(own[0], both.act(observation, explore=False)[seed], atol=1e-6)


def test_bad_requests_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown method 'hiro'"):
        train(PUSHING, "hiro", [0], out=tmp_path)
    few = MAZE.variant("peg_maze", "", ppo=replace(MAZE.config.ppo, minibatches=9))
    with pytest.raises(ValueError, match="2 steps for each of 9 minibatches, got 6"):
        train(few, "ppo_control", [0], out=tmp_path)
    path = train(MAZE, "frozen", [0], length=120, out=tmp_path)
    with pytest.raises(store.CheckpointError, match="study 'peg_push'"):
        load(PUSHING, "frozen", path=path)
    with pytest.raises(store.CheckpointError, match="shape of net"):
        load(MAZE.variant("peg_maze", "", planner_hidden=(24,)), "frozen", path=path)


# -- contact of changed stiffness --------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.4, 1.0, 4.0])
def test_only_the_time_constant_of_what_touches_changes(scale: float) -> None:
    tasks = [kind(PUSH, 1) for kind in (PegPush, scaled(scale))]
    # what the engine uses when the peg is 0.05 mm inside the box's top
    stiffness = []
    for model in (task.worlds.model for task in tasks):
        data, tip = mujoco.MjData(model), BOX_TOP + [0.012, 0.0135, -5e-5]
        data.qpos[:7] = panda.inverse_kinematics(tip, tool=panda.FINGERTIP + PUSH.peg.length)
        mujoco.mj_forward(model, data)
        touching = data.efc_type == mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL
        assert touching.any()
        stiffness.append(data.efc_KBIP[touching][0, :2])
    np.testing.assert_allclose(stiffness[1] / stiffness[0], [scale**-2, 1 / scale], rtol=1e-9)
    nominal, changed = (task.worlds.model for task in tasks)
    for name in ("peg", "lid", "obstacle", "base", "side_left", "stop"):
        np.testing.assert_array_equal(nominal.geom(name).solref, [TIME_CONSTANT, 1.0])
        np.testing.assert_allclose(changed.geom(name).solref, [scale * TIME_CONSTANT, 1.0])
    changed.geom_solref[:] = nominal.geom_solref
    buffers = [np.zeros(mujoco.mj_sizeModel(model), np.uint8) for model in (nominal, changed)]
    for model, buffer in zip((nominal, changed), buffers, strict=True):
        mujoco.mj_saveModel(model, None, buffer)
    np.testing.assert_array_equal(*buffers)


def test_a_time_constant_that_the_engine_would_raise_is_refused() -> None:
    for scale in (0.39, 0.0, -1.0):
        with pytest.raises(ValueError, match="two physics steps, 4 ms"):
            scaled(scale)
    with pytest.raises(ValueError, match="scale needs finite"):
        scaled(np.nan)


# -- figures -----------------------------------------------------------------------------------


def test_an_episode_that_touches_and_leaves_has_passed_by() -> None:
    """Two ticks of four episodes of one seed."""
    last = np.array([0.0001, 0.0104, 0.0312344, 0.02])
    force = np.array([[0.0, 0.5, 3.0, 7.0]] * 2)
    found = {
        "success": np.array([[[False, True, True, True]], [[True, False, False, False]]]),
        "distance": np.array([[[1.0, 0.0002, 0.0003, 0.015]], [last]]),
        "reward": np.array([[[-1.0, -2.0, -3.0, -4.0]]] * 2),
        "penetration": np.array([[[0.0, 1e-4, 2e-4, 5e-4]], [[0.0, 0.0, 0.0, 4e-4]]]),
        "contact_force": force[:, None],
        "contact_force_max": 2 * force[:, None],
    }
    (row,) = figures(found)
    assert row["passed_by"] == 0.75
    assert (row["success"], row["touched"], row["return"]) == (0.25, 1.0, -5.0)
    assert (row["final_mm"], row["nearest_mm"]) == pytest.approx((15.2, 0.25))
    assert (row["deepest_mm"], row["median_deepest_mm"]) == pytest.approx((0.5, 0.15))
    assert (row["no_contact"], row["below_1_N"], row["below_5_N"]) == (0.25, 0.25, 0.5)
    assert (row["below_1_N_50hz"], row["largest_N_50hz"], row["largest_N"]) == (0.5, 7.0, 14.0)


def test_the_slope_at_rest_is_the_gain_that_was_set() -> None:
    config: TwoLevelConfig = PUSHING.config
    (row,) = judge(config, PUSHING.build("gain", [0]).acting(), 1, Test("nominal", 1))["tests"]
    slopes = [row[f"slope_{axis}"] for axis in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose(slopes, np.minimum(20.0, 0.99 * config.slope_cap()), rtol=1e-3)
    assert "cap_x" not in row  # nothing but the hand keeps it there
    (row,) = judge(config, PUSHING.build("control", [0]).acting(), 1, Test("nominal", 1))["tests"]
    assert "slope_x" not in row


# -- how consistent a low level is, over starts and pushes -----------------------------------------


class Linear(LowLevel):
    """u = clip(gain y): one gain for each seed."""

    def __init__(self, *gains: float) -> None:
        super().__init__(None)
        self.gains = np.array(gains)[:, None, None]

    def act(self, observation, explore):
        return np.clip(self.gains * observation[..., :6], -1.0, 1.0)


@pytest.mark.parametrize("study", [peg_push.STUDY, peg_maze.STUDY], ids=lambda s: s.name)
def test_a_higher_gain_resists_pushes_and_starts(study) -> None:
    found = consistency(study.config, Linear(0.0, 20.0, 0.0), seeds=3, starts=8)
    for values in found.values():
        np.testing.assert_allclose(values[0], values[2], rtol=1e-9)  # the same worlds
    assert found["moved_mm"][1] > found["moved_mm"][0]
    assert found["push_mm"][1] < found["push_mm"][0]
    np.testing.assert_allclose(-found["moved_x_mm"], found["moved_mm"])


def test_a_step_is_five_millimeters_wherever_it_starts() -> None:
    """Near the edge of the maze's box a clamped step would be shorter; here the spread is small."""
    found = consistency(peg_maze.STUDY.config, Linear(50.0), seeds=1, starts=16)
    assert found["moved_mm"][0] > 0.003
    assert found["starts_mm"][0] < 0.001


def test_the_spread_without_action_is_what_the_push_does_to_the_gains_alone(monkeypatch) -> None:
    """Without action the loop is nearly linear, so that the effect scales with the force."""
    spreads = []
    for force in (0.0, 0.2, 0.4):
        monkeypatch.setattr(two_level_tests, "PUSH", force)
        spreads.append(consistency(peg_push.STUDY.config, Linear(0.0), 1, 4)["push_mm"][0])
    assert spreads[0] < 1e-12
    assert spreads[2] / spreads[1] == pytest.approx(2.0, rel=0.02)
