"""Lesson 10: what its cells define, against the library and against what the text says."""

import mujoco
import numpy as np
import pytest
from lesson import lesson
from numpy_control import Compiled

from cmc.robot.osc import MAZE_GAINS, ControlLaw, Gains
from cmc.robot.panda import load_scene

HERE = lesson("10")
FREE = HERE["FREE"]
SCENE = load_scene(history=1)


def states(number=5):
    """Simulated states of the arm in motion, with what `sense` finds."""
    rng = np.random.default_rng(0)
    for _ in range(number):
        model, data = HERE["world"](FREE)
        data.qpos[:7] += 0.2 * rng.normal(size=7)
        data.qvel[:7] = 0.3 * rng.normal(size=7)
        yield model, data, HERE["sense"](model, data), rng.normal(size=6)


@pytest.mark.parametrize(
    ("cell", "law"),
    [
        ("force", {"form": "force"}),
        ("acceleration", {"form": "acceleration"}),
        ("blocks", {"form": "force", "split": True}),
    ],
)
def test_the_cells_torques_are_the_librarys(cell, law):
    for _, data, s, p in states():
        controller = Compiled(SCENE, MAZE_GAINS, ControlLaw(**law, pivot_floor=1e-12))
        qn = HERE["READY"] - s.q - 2.0 * s.qd
        np.testing.assert_allclose(HERE[cell](s, p, qn), controller.torque_for(data, p), atol=1e-6)


def test_the_cells_error_is_the_librarys_to_first_order():
    model, data, s, _ = next(states(1))
    data.qpos[:7] = HERE["world"](FREE)[1].qpos[:7] + 1e-4
    s = HERE["sense"](model, data)
    goal = np.array(FREE) + 0.01
    error, _ = Compiled(SCENE, MAZE_GAINS).look(data, goal)
    np.testing.assert_allclose(HERE["pose_error"](s, goal), error, atol=1e-9)


def test_the_cells_kinematics_are_the_scenes():
    model, data, *_ = next(states(1))
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 7)):
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        found, hand = HERE["hand"](q), data.body("hand")
        np.testing.assert_allclose(found[:3, 3], hand.xpos, atol=1e-12)
        np.testing.assert_allclose(found[:3, :3], hand.xmat.reshape(3, 3), atol=1e-12)


def test_transposed_jacobian_alone_fails_under_the_hold_only():
    every, held = (HERE["spring"](n)[-1] for n in (1, 10))
    assert every < 5 < 20 < held


@pytest.mark.parametrize("form", ["force", "acceleration"])
def test_gains_alone_predict_the_arm(form):
    run = HERE["motion"](lambda t: (0.43, -0.02, 0.05), form=HERE[form])
    model = HERE["model_of_gains"](MAZE_GAINS, run["e"][0, :3], run["u"][:, :3])
    assert np.abs(run["e"][:, :3] - model).max() < 0.005 * 0.01


def test_prediction_approaches_the_continuous_solution():
    found = HERE["model_of_gains"](MAZE_GAINS, np.array([0.01, 0, 0]), np.zeros((40, 3)))
    p, q = np.sort(np.roots([1, 20, 40]).real)
    t = 0.02 * np.arange(40)
    exact = 0.01 * (p * np.exp(q * t) - q * np.exp(p * t)) / (p - q)
    np.testing.assert_allclose(found[:, 0], exact, atol=3e-4)  # 50 Hz costs 3 %


@pytest.mark.parametrize("form", ["force", "acceleration"])
def test_null_space_needs_its_posture_term(form):
    push, stiff = np.array([1.0, 0, -1.0, 0, 0, 0, 0]), Gains(200.0, 40.0, 200.0, 40.0)
    turned = []
    for pull in ((1.0, 2.0), (0.0, 0.0)):
        run = HERE["motion"](
            lambda t: FREE, 1.5, form=HERE[form], gains=stiff, pull=pull, kick=push
        )
        assert np.linalg.norm(run["e"][:, :3], axis=1).max() < 2e-3
        turned.append(np.abs(run["qpos"][-1, :7] - run["qpos"][0, :7]).max())
    assert turned[1] > 2.5 * turned[0]


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("limit", [0.2, 1.0])
def test_pressing_force_is_mass_times_acceleration(axis, limit):
    run = press(axis, limit)
    assert np.linalg.norm(run["force"][-1]) == pytest.approx(run["formula"], rel=0.1)
    assert run["force"][-1] @ np.array(HERE["WALL"][axis][1]) < 0  # the wall pushes back


def press(axis, limit=1.0, **options):
    return HERE["press"](axis, limit, **options)


def test_softness_needs_the_spring_and_the_limits():
    spring, soft = HERE["SPRING"], {"clip": 0.005}
    largest = {
        "both": press("x", 0.2, peg=spring, **soft)["peak"].max(),
        "limits": press("x", 0.2, **soft)["peak"].max(),
        "none": press("x")["peak"].max(),
        "none, y": press("y")["peak"].max(),
    }
    assert largest["both"] < 1.0 < 3.0 < largest["limits"] < largest["none"] < largest["none, y"]
    assert round(largest["both"], 1) == 0.8  # the two ends that the last table of the lesson names
    assert round(largest["none, y"]) == 47
    leaning = press("x", peg=spring)
    assert np.linalg.norm(leaning["force"][-1]) > 1.5


def test_slider_shows_refusal_and_chatter():
    refused = HERE["response"](40.0, 5.0, 20.0, 10.0, 0.0)
    assert "12.6" in refused["title"]
    assert np.isnan(refused["x"]).all()
    fine = HERE["response"](40.0, 20.0, 20.0, 10.0, 5.0)
    assert abs(fine["x"][-1]) < 0.1
    for axis in "xz":
        np.testing.assert_allclose(fine[axis], fine[f"{axis}_model"], atol=0.1)
    wild = HERE["response"](40.0, 20.0, 55.0, 10.0, 0.0)
    assert "chatter" in wild["title"]
    assert (wild["u"][-5:] * wild["u"][-6:-1] < 0).all()  # the command flips at every tick
