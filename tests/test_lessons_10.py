"""Lesson 10: the bench and its pictures, against what the text says about them."""

import numpy as np
import pytest

from cmc import exercises
from cmc.lessons import lesson_10, panda_bench
from cmc.robot.task_space import ControlLaw


def test_simulator_and_table_agree():
    assert max(lesson_10.kinematics_check(50).values()) < 1e-12


def test_transposed_jacobian_alone_fails_under_the_hold_only():
    held, every = (np.abs(lesson_10.literal(e)["e"][-1, :3]).max() for e in (False, True))
    assert every < 0.005 < 0.02 < held


@pytest.mark.parametrize("form", ["force", "acceleration"])
def test_gains_alone_predict_the_arm(form):
    run = lesson_10.step(
        panda_bench.Setup("panda.xml", lesson_10.FREE.start, law=ControlLaw(form=form))
    )
    assert np.abs(run["e"][:, :3] - run["e_model"]).max() < 0.005 * 0.01
    assert np.abs(run["y"][:, :3] - run["y_model"]).max() < 0.005 * np.abs(run["y"]).max()


def test_prediction_approaches_the_continuous_solution():
    out = lesson_10.predict(panda_bench.MAZE_GAINS, np.array([0.01, 0, 0]), np.zeros((40, 6)))
    p, q = np.sort(np.roots([1, 20, 40]).real)
    t = 0.02 * np.arange(40)
    exact = 0.01 * (p * np.exp(q * t) - q * np.exp(p * t)) / (p - q)
    np.testing.assert_allclose(out["e_model"][:, 0], exact, atol=3e-4)  # 50 Hz costs 3 %


@pytest.mark.parametrize("form", ["force", "acceleration"])
def test_null_space_needs_its_posture_term(form):
    held, loose = (lesson_10.null_space(form, p, seconds=1.5) for p in (True, False))
    for run in (held, loose):
        assert np.linalg.norm(run["e"][:, :3], axis=1).max() < 2e-3
    assert np.abs(loose["joints"][-1]).max() > 2.5 * np.abs(held["joints"][-1]).max()


def test_only_the_inertia_keeps_the_posture_torque_from_the_tip():
    sizes = [float(np.linalg.norm(a)) for a in lesson_10.posture_torques().values()]
    assert max(sizes[:2]) < 1e-12
    assert 1e-4 < sizes[2] < sizes[3]


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("limit", [0.2, 1.0])
def test_pressing_force_is_mass_times_acceleration(axis, limit):
    run = lesson_10.press(axis, limit=limit)
    assert run["pressing"] == pytest.approx(run["predicted"], rel=0.1)
    towards = np.array(lesson_10.WALL[axis][1])
    assert run["force"][-1] @ towards < 0  # the wall pushes back


def test_softness_needs_the_spring_and_the_limits():
    runs = lesson_10.regimes("x")
    assert runs["spring, limits"]["impact"] < 1.0
    assert runs["rigid, limits"]["impact"] > 3.0
    assert runs["spring, no limits"]["pressing"] > 1.5
    assert runs["rigid, no limits"]["impact"] > 10.0


def test_impacts_follow_their_formulas():
    hit = lesson_10.impacts(4)
    np.testing.assert_allclose(hit["rigid"], hit["slope"] * hit["speed"], rtol=0.15)
    np.testing.assert_allclose(hit["spring"], hit["spring_model"], rtol=0.25)


def test_slider_shows_refusal_and_chatter():
    refused = lesson_10.response(40.0, 5.0, 20.0, 10.0, 0.0)
    assert "12.6" in refused["text"]
    assert np.isnan(refused["e"]).all()
    fine = lesson_10.response(40.0, 20.0, 20.0, 10.0, 5.0)
    assert fine["e"].shape == (40, 2)
    assert np.abs(fine["e"][-1]).max() < 0.1
    np.testing.assert_allclose(fine["e"][:, 0], fine["model"], atol=0.1)
    wild = lesson_10.response(40.0, 20.0, 55.0, 10.0, 0.0)["u"][-6:]
    assert (wild[1:] * wild[:-1] < 0).all()  # the command changes sign at every tick
    still = lesson_10.response(40.0, 20.0, 0.0, 0.0, 0.0)
    assert np.isfinite(still["e"]).all()


@pytest.mark.parametrize("soft", [False, True])
def test_waypoints_lead_through_the_maze_without_contact(soft):
    run = lesson_10.maze_run(soft)
    assert run["peak"].max() == 0.0
    assert np.linalg.norm(run["tip"][-1] - lesson_10.WAYPOINTS[-1]) < 5e-4


def test_exercise_refuses_the_transposed_jacobian():
    exercises.check("10-torque", lambda M, J, h, d, p: M @ np.linalg.pinv(J) @ (p - d) + h)
    for wrong in (
        lambda M, J, h, d, p: J.T @ p + h,
        lambda M, J, h, d, p: M @ np.linalg.pinv(J) @ p + h,
        lambda M, J, h, d, p: np.zeros(6),
    ):
        with pytest.raises(AssertionError, match="Not yet"):
            exercises.check("10-torque", wrong)
