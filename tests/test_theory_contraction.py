"""Contraction: measured rates against known ones, metrics, transients, multipliers, simulation."""

import numpy as np
import pytest
from scipy.linalg import expm

from cmc import plants
from cmc.theory.contraction import (
    contraction_factor,
    contraction_rate,
    floquet_multipliers,
    lyapunov_metric,
    matrix_measure,
    metric_factor,
    overshoot,
    rate_from_cloud,
)
from cmc.theory.simulate import linear_flow, rk4

SHEARED = np.array([[-1.0, 8.0], [0.0, -1.5]])


def _cloud(A, times, starts):
    return np.stack([starts @ expm(A * t).T for t in times])


@pytest.mark.parametrize(
    ("A", "slowest"),
    [(SHEARED, 1.0), (np.array([[-0.5, 6.0], [-6.0, -0.5]]), 0.5), (np.diag([0.3, -2.0]), -0.3)],
)
def test_measured_rate_is_the_slowest_eigenvalue_and_its_bound_holds(A, slowest):
    times, rng = np.linspace(0, 12, 600), np.random.default_rng(0)
    decay = rate_from_cloud(times, _cloud(A, times, rng.normal(size=(20, 2))))
    assert decay.rate == pytest.approx(slowest, abs=0.05)
    assert decay.overshoot >= 1.0
    # rounding sets a floor under the ratio
    assert (decay.ratio <= decay.bound * (1 + 1e-9) + 1e-11).all()


def test_a_metric_removes_the_overshoot_of_a_pair():
    times = np.linspace(0, 5, 400)
    starts = np.array([[0.0, 1.0], [0.3, -1.0]])
    paths = _cloud(SHEARED, times, starts)
    plain = rate_from_cloud(times, paths)
    assert plain.overshoot > 1.5
    metric = lyapunov_metric(SHEARED, 0.9)
    seen = rate_from_cloud(times, paths, metric)
    assert seen.rate >= 0.9 - 1e-6
    assert seen.ratio.max() == 1.0
    assert plain.overshoot <= overshoot(metric)


def test_many_pairs_are_subsampled_and_bad_clouds_refused():
    times, rng = np.linspace(0, 2, 30), np.random.default_rng(1)
    paths = _cloud(-np.eye(2), times, rng.normal(size=(150, 2)))
    assert rate_from_cloud(times, paths).rate == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ValueError, match="same start"):
        rate_from_cloud(times, paths[:, [0, 0]])
    with pytest.raises(ValueError, match="paths needs finite"):
        rate_from_cloud(times, np.where(paths > 1, np.nan, paths))
    with pytest.raises(ValueError, match="paths needs shape"):
        rate_from_cloud(times, paths[:, 0])
    with pytest.raises(ValueError, match="increasing"):
        rate_from_cloud(times[::-1], paths)


def test_matrix_measures_are_the_derivative_of_the_norm():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(30, 3, 3))
    h = 1e-7
    for norm in (1, 2, np.inf):
        slope = (np.linalg.norm(np.eye(3) + h * A, norm, axis=(-2, -1)) - 1) / h
        np.testing.assert_allclose(matrix_measure(A, norm), slope, atol=1e-5)
    with pytest.raises(ValueError, match="1, 2 or infinity"):
        matrix_measure(A, 3)


def test_rate_in_a_metric_is_a_lower_bound_on_every_decay():
    rng = np.random.default_rng(3)
    for _ in range(20):
        A = rng.normal(size=(3, 3)) - 2.5 * np.eye(3)
        slowest = -np.linalg.eigvals(A).real.max()
        wanted = slowest - 0.2 * abs(slowest)
        metric = lyapunov_metric(A, wanted)
        rate = contraction_rate(A, metric)
        assert wanted - 1e-9 <= rate <= slowest + 1e-9
        assert contraction_factor(expm(0.3 * A), metric) <= np.exp(-0.3 * rate) + 1e-12
        growth = np.linalg.norm(linear_flow(A, np.linspace(0, 5, 101)), 2, axis=(1, 2))
        bound = overshoot(metric) * np.exp(-rate * np.linspace(0, 5, 101))
        assert (growth <= bound * (1 + 1e-9)).all()


def test_rate_in_a_moving_metric():
    """M(t) = e^{2 a t} I measures a rate a lower than M = I does."""
    J = -2.0 * np.eye(2)
    assert contraction_rate(J, np.eye(2), 2 * 0.7 * np.eye(2)) == pytest.approx(1.3)
    assert contraction_rate(J) == pytest.approx(2.0)


def test_metric_factor_and_its_refusals():
    M = np.array([[2.0, 0.5], [0.5, 1.0]])
    theta = metric_factor(M)
    np.testing.assert_allclose(theta.T @ theta, M)
    assert theta[1, 0] == 0
    for bad, message in (
        (-np.eye(2), "positive definite"),
        ([[1.0, 2.0], [0.0, 1.0]], "symmetric"),
        (np.ones(3), "shape"),
    ):
        with pytest.raises(ValueError, match=message):
            metric_factor(bad)
    with pytest.raises(ValueError, match="no metric contracts"):
        lyapunov_metric(np.diag([-1.0, 0.1]))


def test_bounded_transient_of_a_sheared_lag():
    growth = np.linalg.norm(linear_flow(SHEARED, np.linspace(0, 5, 101)), 2, axis=(1, 2))
    assert growth.max() > 2.0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: contraction_rate([[np.nan, 0.3], [-0.2, -2]]), "J needs finite"),
        (lambda: contraction_rate(np.eye(3)[:2]), "J needs shape"),
        (lambda: contraction_factor(np.eye(2) * np.inf, np.eye(2)), "transition needs finite"),
        (lambda: overshoot([[np.nan]]), "metric needs finite"),
        (lambda: floquet_multipliers(lambda t: -np.eye(2), np.inf), "period needs finite"),
        (lambda: floquet_multipliers(lambda t: -np.eye(3), 1.0), r"jacobian\(0\) needs shape"),
        (lambda: rate_from_cloud([0, 1, 2], [["a"]]), "paths needs real numbers"),
    ],
)
def test_bad_arguments_are_named(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def test_floquet_multipliers():
    # constant matrix: e^{lambda T}
    A = np.array([[-0.3, 1.0], [-1.0, -0.3]])
    found = floquet_multipliers(lambda t: A, 2.0)
    np.testing.assert_allclose(np.abs(found), np.exp(-0.6), rtol=1e-7)
    loop = plants.loop("floquet")
    found = floquet_multipliers(lambda t: loop.jacobian(t, np.zeros(2)), loop.period)
    np.testing.assert_allclose(found, [-1.263, -0.579], atol=5e-4)


def test_rk4_is_fourth_order_and_batched():
    plant = plants.get("van_der_pol")
    start = np.array([[2.0, 0.0], [0.1, -1.0]])
    fine = rk4(lambda t, y: plant.f(y, 0 * y, t), start, np.linspace(0, 2, 801))[-1]
    errors = [
        np.abs(rk4(lambda t, y: plant.f(y, 0 * y, t), start, np.linspace(0, 2, k + 1))[-1] - fine)
        for k in (50, 100)
    ]
    assert 10 < errors[0].max() / errors[1].max() < 25
    with pytest.raises(ValueError, match="increasing"):
        rk4(lambda t, y: y, start, [0.0])
    with pytest.raises(ValueError, match="finite"):
        rk4(lambda t, y: y, [np.nan], [0.0, 1.0])


def test_van_der_pol_does_not_contract_and_the_two_attractor_loop_neither():
    times = np.linspace(0, 40, 1600)
    plant = plants.get("van_der_pol")
    path = rk4(lambda t, y: plant.f(y, 0 * y), [[2.0, 0.0], [0.0, 2.0]], times)
    assert rate_from_cloud(times, path).rate < 0.02
    loop = plants.loop("two_attractors")
    times = np.linspace(0, 300, 3000)
    path = rk4(loop.rhs, [[0.0, 0.0], [0.0, 6.0]], times)
    assert rate_from_cloud(times, path).rate < 0.02
