"""Callbacks of lesson 04: what the prose claims is what they return."""

import numpy as np
import pytest

from cmc.lessons import lesson_04


def test_each_repair_mends_one_half_of_the_printed_formula():
    printed = lesson_04.printed_formula()
    diagonal = {k: np.abs(m * (1 - np.eye(2))).max() == 0.0 for k, m in printed["Lambda"].items()}
    triangular = {k: m[1, 0] == 0.0 for k, m in printed["R"].items()}
    assert list(diagonal.values()) == [False, True, False, True]
    assert list(triangular.values()) == [False, False, True, True]


def test_more_damping_is_slower_beyond_two():
    damping, rate = lesson_04.decay_against_damping()
    roots = np.array([np.roots([1.0, d, 1.0]).real.max() for d in damping])
    np.testing.assert_allclose(rate, -roots, rtol=1e-6)
    assert np.all(np.diff(rate[damping > 2.1]) < 0.0)
    assert 0.05 < lesson_04.oscillating_share(5000) < 0.5


def test_floor_is_where_the_loop_begins_to_decay():
    sizes, worst, floor = lesson_04.floor_scan()
    assert (worst[sizes < 0.99 * floor] > 0.0).all()
    assert (worst[sizes > 1.01 * floor] < 0.0).all()


@pytest.mark.parametrize("turns", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("crossing", [0.0, 1.5, 2.0])
def test_tracked_signals_never_jump(turns, crossing):
    out = lesson_04.tracking(turns, crossing)
    assert np.abs(np.diff(out["followed"], axis=0)).max() < 0.05
    if turns >= 1.0:
        assert out["jumps"] > 0
    assert str(out["jumps"]) in out["text"]
    # crossing eigenvalues each follow one smooth curve
    assert np.abs(np.diff(out["eigenvalues"], n=2, axis=0)).max() < 1e-3


def test_half_a_turn_flips_the_sign():
    out = lesson_04.tracking(1.0, 0.0)
    np.testing.assert_allclose(out["followed"][-1], -out["followed"][0], atol=1e-9)


def test_lapack_needs_tracking():
    swapped, flipped = lesson_04.lapack_jumps(number=2000)
    assert 0.005 < swapped < 0.2
    assert 0.005 < flipped < 0.3


def test_matrices_explain_what_they_cannot_show():
    good = lesson_04.matrices(-2.0, 1.0, 0.5, -1.0)
    np.testing.assert_allclose(np.diag(good["Lambda"]), np.sort(good["eig"].real)[::-1])
    assert good["axes"].shape == (2, 2, 2)
    pair = lesson_04.matrices(-2.0, 1.0, -1.5, -1.0)
    assert "complex pair" in pair["text"]
    assert np.isnan(pair["R"]).all()
    assert "repeated" in lesson_04.matrices(-1.0, 1.0, 0.0, -1.0)["text"]


def test_schur_stays_well_conditioned():
    out = lesson_04.near_defective()
    assert out["eigenvectors"].max() > 1e5
    np.testing.assert_allclose(out["schur"], 1.0)


def test_moving_action_is_unstable_where_the_frozen_verdict_is_not():
    y_1, true = lesson_04.moving_action()
    # J = [[-1 + 15 cos(3 y_1), 0], [15 sin(3 y_1), -1]]
    np.testing.assert_allclose(true, np.maximum(15.0 * np.cos(3.0 * y_1), 0.0) - 1.0, atol=1e-5)


def test_rates_are_positive_numbers():
    assert all(rate > 0.0 for rate in lesson_04.control_rates((2, 3)).values())
