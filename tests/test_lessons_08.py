"""Lesson 08: what the prose claims is what its cells compute."""

import numpy as np
import pytest
from lesson import lesson, run

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.plants import Peg


@pytest.fixture(scope="module")
def demo():
    return lesson("08")


@pytest.fixture(scope="module")
def whole():
    return run("08")


@pytest.mark.parametrize("undo", [False, True])
def test_a_touch_of_the_lesson_is_one_of_the_environment(demo, undo):
    starts = demo["draw_starts"](6, seed=3)
    peg = Peg(K_sur=20.0, surface_sin=0.1, surface_cos=-0.05)
    found = demo["touch"](peg, starts, demo["gains"], undo_slope=undo)
    fixed = dict(zip(("x0", "z0", "x_d", "f_d"), starts, strict=True))
    fixed |= {"K_sur": 20.0, "surface_sin": 0.1, "surface_cos": -0.05}
    envs = PegTouchVectorEnv(6, interface="auxiliary" if undo else "identity", horizon=60)
    envs.reset(seed=0, options={"parameters": fixed})
    for k in range(59):
        np.testing.assert_allclose(envs.error.T, found[:2, k], atol=1e-9)
        s = np.stack([envs.signal, envs.integral], axis=-1)
        envs.step(-(demo["gains"] * s).sum(axis=-1))


@pytest.mark.parametrize("stiffness", [5.0, 15.0, 31.0, 62.0])
@pytest.mark.parametrize("factor", [0.5, 1.6])
@pytest.mark.parametrize("lags", [0.5, 1.0])
def test_touches_settle_where_less_than_the_limit_is_used(demo, stiffness, factor, lags):
    used = demo["share_used"](stiffness, factor, lags * demo["tau_z"])
    peg = Peg(0.0437 * lags, 0.01 * lags, stiffness)
    e_f = demo["touch"](peg, demo["draw_starts"](8), demo["scaled"](factor), steps=80)[1]
    if abs(used - 1) > 0.06:
        assert np.all(np.abs(e_f[-10:]) < 0.5) == (used < 1)


def test_the_first_figure_and_the_price_of_a_smaller_gain(demo, whole):
    def settled(K, factor):
        e_f = demo["touch"](Peg(K_sur=K), demo["draw_starts"](20), demo["scaled"](factor))[1]
        return demo["settling"](e_f)

    assert settled(8.0, 2.0) == pytest.approx(0.06)
    assert np.isinf(settled(31.0, 2.0))
    assert settled(31.0, 0.3) < settled(31.0, 1.0) < np.inf
    assert settled(3.0, 0.3) > 2 * settled(3.0, 1.0)
    assert "31 N/m  inf ms" in whole.text


def test_the_offset_makes_the_overshoot_and_the_integral_adds_to_it(whole):
    peak = whole.space["peak"]
    for K in (8.0, 31.0):
        full, offset_gone = peak(K), peak(K, offset=0.0)
        assert full - offset_gone > 4 * (full - peak(K, integral=0.0))
        assert full - offset_gone > 4 * (full - peak(K, on_surface=True))
        assert full > peak(K, integral=0.0)
    assert peak(8.0) > 2 * 2.0
    assert peak(8.0, offset=0.0) < 1.1 * 2.0
    assert np.sum(whole.space["R_22"] == 0) == 1


def test_the_transform_helps_uphill_and_hurts_downhill(whole):
    lines = [line.split() for line in whole.text.splitlines() if line.startswith("mostly")]
    peaks = {(row[1], "T_y = I" if "=" in row else "T_y"): float(row[-7]) for row in lines}
    rms = {(row[1], "T_y = I" if "=" in row else "T_y"): float(row[-2]) for row in lines}
    for found in (peaks, rms):
        assert found["rising", "T_y"] < 0.6 * found["rising", "T_y = I"]
        assert found["falling", "T_y"] > 1.5 * found["falling", "T_y = I"]


def test_the_secant_has_the_wrong_sign_and_leaves_a_corner(whole):
    assert 0.6 < whole.space["wrong"] < 0.67
    assert 5.0 < np.median(whole.space["off"]) < 8.0
    # the loops stay triangular: the eigenvalues do not move
    T_y, exact = whole.space["T_y"][:200], whole.space["exact"][:200]
    values = np.linalg.eigvals(T_y @ exact @ np.linalg.inv(T_y))
    np.testing.assert_allclose(np.sort(values), [[-100.0, -1 / 0.0437]] * 200, rtol=1e-6)


def test_the_best_average_leaves_the_stable_gains_when_stiff_surfaces_are_rare(whole):
    space = whole.space

    def rattles(rare):
        weights = space["weights"](rare)
        best = space["factors"][np.argmax(space["returns"] @ weights)]
        return weights[space["share_used"](space["stiffness"], best) > 1].sum()

    assert rattles(21 / 31) == 0.0
    assert rattles(0.02) > 0.01
    np.testing.assert_allclose(space["weights"](21 / 31), 1 / 31)
    np.testing.assert_allclose([space["weights"](r).sum() for r in (0.0, 0.1, 0.6)], 1.0)


def test_the_explorers_say_where_the_dot_stands(whole):
    for log_factor in (-1.0, 1.5):
        for shift in (1.0, 2.0):
            shown = whole.space["landscape"](0.02, log_factor, shift)
            assert ("rattles" in shown["text"]) == (log_factor > shown["edge"])
    shown = whole.space["on_the_map"](31, 1.0, 1.0)
    below = shown["here"][0][1] < np.interp(31, shown["K"], shown["limit"])
    assert ("unstable" in shown["text"]) == (not below)
