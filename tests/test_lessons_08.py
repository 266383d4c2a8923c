"""Callbacks of lesson 08: what the prose claims is what they return."""

import numpy as np
import pytest

from cmc.lessons import lesson_08


@pytest.mark.parametrize("stiffness", [5.0, 15.0, 31.0, 62.0])
@pytest.mark.parametrize("factor", [0.5, 1.6])
@pytest.mark.parametrize("lags", [0.5, 1.0])
def test_touches_settle_where_the_margin_is_positive(stiffness, factor, lags):
    out = lesson_08.touch(stiffness, factor, lags, num=8)
    assert out["e_f"].shape == (60, 8)
    last = np.abs(out["e_f"][-10:]).max(axis=0)
    if abs(out["margin"]) > 0.05:
        assert np.all(last < 0.5) == (out["margin"] > 0)
        assert ("unstable" in out["text"]) == (out["margin"] < 0)


def test_the_first_figure_shows_two_stable_surfaces_and_one_that_rattles():
    signs = [lesson_08.touch(K, factor=2.0, num=4)["margin"] > 0 for K in (8.0, 15.0, 31.0)]
    assert signs == [True, True, False]


def test_the_command_does_not_move_the_force_in_the_air():
    run = lesson_08.one_touch()
    air = run["f"] == 0
    assert air[0].all()
    assert (run["R_22"][air] == 0).all()
    assert (run["R_22"][~air] > 0).all()
    assert abs(run["f"][-1, 0] + 2.0) < 0.05


def test_the_secant_is_often_wrong():
    found = lesson_08.secant_error(4000)
    assert 0.6 < found["wrong sign"] < 0.67


def test_the_transform_costs_force_on_a_slope():
    flat, steep = lesson_08.slope_coupling(0.001), lesson_08.slope_coupling(0.1)
    assert flat["auxiliary_peak"] < 2 * flat["identity_peak"] + 0.01
    assert steep["auxiliary_peak"] > 3 * steep["identity_peak"]


def test_the_best_return_leaves_the_stable_gains_when_stiff_surfaces_are_rare():
    paper, rare = lesson_08.landscape(31.0, points=13), lesson_08.landscape(10.0, 0.02, points=13)
    assert paper["best"] < paper["edge_31"] < rare["best"]
    assert paper["unstable"] == 0.0 < rare["unstable"]


def test_the_plane_changes_sign_along_one_over_stiffness():
    plane = lesson_08.stiffness_and_gain(60)
    stable = plane["margin"] > 0
    edge = np.array([plane["factor"][column].max() for column in stable.T])
    inside = edge < plane["factor"][-1]
    product = edge[inside] * plane["stiffness"][inside]
    assert np.ptp(product) < 0.12 * product.mean()
