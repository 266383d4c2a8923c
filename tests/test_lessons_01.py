"""Lesson 01: what its text says is what its cells compute."""

import numpy as np
import pytest
from lesson import run
from scipy.linalg import expm


@pytest.fixture(scope="module")
def space():
    return run("01", solved=True).space


def test_a_push_breaks_lyapunovs_function_and_leaves_the_distances_alone(space):
    calm, pushed = space["pushed"](0.0), space["pushed"](0.5)
    assert (np.diff(calm["V"], axis=0) <= 1e-9).all()
    assert np.diff(pushed["V"], axis=0).max() > 0.01
    np.testing.assert_allclose(calm["apart"], pushed["apart"], atol=1e-6)
    rest = -np.linalg.solve(space["J"], 0.5 * space["draft"])  # f_y y + push = 0
    np.testing.assert_allclose(pushed["end"], np.tile(rest, (8, 1)), atol=0.05)


def test_the_fitted_line_is_a_fit_to_the_worst_pair(space):
    worst, t, line = space["worst"], space["t"], space["line"]
    late = space["late"]
    np.testing.assert_allclose(
        np.log(worst[late]), np.polyval(line, t[: len(worst)][late]), atol=0.05
    )
    assert -line[0] == pytest.approx(space["slowest"], rel=0.05)
    assert space["in_plain"] < space["slowest"]


@pytest.mark.parametrize("h", [-6.0, 0.0, 4.0])
@pytest.mark.parametrize("share", [0.1, 0.8, 0.98])
def test_the_ellipse_of_the_metric_shrinks_into_itself(space, h, share):
    J_h, M = space["lens"](h, share)
    np.testing.assert_allclose(
        np.sort(np.linalg.eigvals(J_h)), np.sort(np.linalg.eigvals(space["J"])), atol=1e-8
    )
    beta = share * space["slowest"]
    assert np.linalg.eigvalsh(J_h.T @ M + M @ J_h + 2 * beta * M).max() <= 1e-8
    for after in (0.1, 1.0, 4.0):
        data = space["lean"](h, share, after)
        size = np.einsum("ki,ij,kj->k", data["ball_t"], M, data["ball_t"])
        assert size.max() <= np.exp(-2 * beta * after) + 1e-9  # inside, at the rate
    assert (data["worst"] <= data["proved"] + 1e-9).all()
    assert (data["worst"] <= data["plain"] * (1 + 1e-9)).all()
    np.testing.assert_allclose(data["worst"][5], np.linalg.norm(expm(J_h * data["t"][5]), 2))


def test_a_leaning_plant_bulges_first(space):
    assert space["lean"](4.0, 0.8, 0.4)["worst"].max() > 1.5
    circle = np.linalg.norm(space["lean"](4.0, 0.8, 0.4)["circle_t"], axis=-1)
    assert circle.max() > 1.2


def test_pendulums_forget_their_start_at_least_as_fast_as_proved(space):
    for damping in (0.5, 1.0, 2.0):
        data = space["swing"](damping, 0.6, 9)
        assert np.isfinite(data["paths"]).all()
        if np.abs(data["angle"]).max() <= 1.2 and np.isfinite(data["proved"]):
            assert (data["worst"] <= data["bound"] + 1e-8).all()
    assert np.isnan(space["swing"](0.2, 0.0, 3)["proved"])


def test_the_cycle_attracts_across_and_not_along(space):
    # period of Van der Pol's oscillator at mu = 1, and Liouville: the product of the multipliers is
    # exp of the integral of the trace 1 - y_1^2 over one turn
    assert space["period"] == pytest.approx(6.66329, abs=1e-3)
    assert space["along"] == pytest.approx(1.0, abs=1e-3)
    turn = np.linspace(0, space["period"], 2001)
    cycle = space["flow"](space["van_der_pol"], space["start"], turn)
    wanted = np.exp(np.trapezoid(1 - cycle[:, 0] ** 2, turn))
    assert space["along"] * space["across"] == pytest.approx(wanted, rel=0.02)
