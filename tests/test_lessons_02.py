"""Callbacks of lesson 02: what the prose claims is what they return."""

import numpy as np
import pytest

from cmc.lessons import lesson_02, linear_loop


def test_no_naive_loop_decays_and_every_explicit_one_does():
    assert (lesson_02.random_verdicts("identity", 2000) > 0.0).all()
    assert (lesson_02.random_verdicts("explicit", 2000) < 0.0).all()


def test_flow_solves_the_linear_equation():
    J, t = np.array([[-1.0, 2.0], [-2.0, -1.0]]), np.linspace(0.0, 2.0, 9)
    x = linear_loop.flow(J, linear_loop.circle(5), t)
    rotation = np.array([[np.cos(4.0), np.sin(4.0)], [-np.sin(4.0), np.cos(4.0)]])
    np.testing.assert_allclose(x[-1], np.exp(-2.0) * linear_loop.circle(5) @ rotation.T)
    np.testing.assert_allclose(linear_loop.growth(J, t), np.exp(-t))


@pytest.mark.parametrize("transforms", lesson_02.TRANSFORMS)
@pytest.mark.parametrize("crossing", [0.0, 0.55, 0.6, 1.5])
def test_coordinates(transforms, crossing):
    out = lesson_02.coordinates(crossing, 1.0, 0.5, transforms)
    assert out["y"].shape == (300, 12)
    assert out["eig"].dtype == complex
    assert out["worst"] == pytest.approx(out["eig"].real.max())
    decays = transforms == "explicit" or crossing < 0.57
    assert (out["worst"] < 0.0) == decays
    assert ("decays" in out["text"]) == decays
    with pytest.raises(ValueError, match="identity"):
        lesson_02.coordinates(crossing, 1.0, 0.5, "other")


def test_transient_is_monotone_in_z_and_bounded_in_y():
    for shear in (0.0, 4.0):
        out = lesson_02.transient(shear)
        assert (np.diff(out["z"]) < 0.0).all()
        assert (out["y"] <= out["bound"] + 1e-12).all()
    assert out["peak"] > 2.0


def test_only_the_proofs_reading_is_a_bound():
    out = lesson_02.rate_readings()
    assert (out["distance"] <= out["proof"] + 1e-12).all()
    assert (out["distance"][5:] > out["text"][5:]).all()
    assert 0.0 < lesson_02.theorem1_share(4000) < 0.2


def test_turning_frame_against_a_simulation():
    speed, shear, h = 2.0, 1.5, 1e-3
    S = np.array([[1.0, shear], [0.0, 1.0]])

    def f_y(t):
        c, s = np.cos(speed * t), np.sin(speed * t)
        V = np.array([[c, -s], [s, c]]) @ S
        return V @ np.diag([-1.0, -10.0]) @ np.linalg.inv(V)

    y = S.copy()  # columns: unit vectors of z at time 0
    for k in range(4000):
        y = y + h * f_y((k + 0.5) * h) @ (y + 0.5 * h * f_y(k * h) @ y)
    c, s = np.cos(4.0 * speed), np.sin(4.0 * speed)
    V_end = np.array([[c, -s], [s, c]]) @ S
    measured = np.linalg.norm(np.linalg.inv(V_end) @ y, ord=2)
    out = lesson_02.turning_frame(speed, shear)
    assert measured == pytest.approx(out["moving"][-1], rel=1e-3)
    assert out["exact"] > 0.0
    assert lesson_02.turning_frame(0.0, shear)["exact"] == pytest.approx(-1.0)


def test_frames_that_settle_and_that_fade():
    assert lesson_02.stopping_frame().settled == pytest.approx(2.0, abs=0.01)
    path, motion = lesson_02.pendulum_frame()
    assert np.abs(path[-1]).max() < 1e-4
    assert (motion.norm > 0.0).all()
    assert motion.norm[-1] < 1e-8 * motion.bound
