"""Contraction: rates in metrics against exact flows, transients, and what is refused."""

import numpy as np
import pytest
from scipy.linalg import expm

from cmc.theory.contraction import contraction_rate, lyapunov_metric, metric_factor, overshoot
from cmc.theory.simulate import linear_flow

SHEARED = np.array([[-1.0, 8.0], [0.0, -1.5]])


def test_the_rate_is_minus_the_derivative_of_the_norm():
    A, h = np.random.default_rng(2).normal(size=(30, 3, 3)), 1e-7
    growth = (np.linalg.norm(np.eye(3) + h * A, 2, axis=(-2, -1)) - 1) / h
    np.testing.assert_allclose(contraction_rate(A), -growth, atol=1e-5)


def test_rate_in_a_metric_is_a_lower_bound_on_every_decay():
    rng, t = np.random.default_rng(3), np.linspace(0, 5, 101)
    matrices = [SHEARED, *(rng.normal(size=(20, 3, 3)) - 2.5 * np.eye(3))]
    for A in matrices:
        slowest = -np.linalg.eigvals(A).real.max()
        wanted = slowest - 0.2 * abs(slowest)
        metric = lyapunov_metric(A, wanted)
        rate, theta = contraction_rate(A, metric), metric_factor(metric)
        assert wanted - 1e-9 <= rate <= slowest + 1e-9
        growth = np.linalg.norm(linear_flow(A, t), 2, axis=(1, 2))
        assert (growth <= overshoot(metric) * np.exp(-rate * t) * (1 + 1e-9)).all()
        step = theta @ expm(0.3 * A) @ np.linalg.inv(theta)
        assert np.linalg.norm(step, 2) <= np.exp(-0.3 * rate) + 1e-12
    # a sheared lag grows before it decays, and a metric bounds by how much
    assert np.linalg.norm(linear_flow(SHEARED, t), 2, axis=(1, 2)).max() > 2.0


def test_metric_factor():
    M = np.array([[2.0, 0.5], [0.5, 1.0]])
    theta = metric_factor(M)
    np.testing.assert_allclose(theta.T @ theta, M)
    assert theta[1, 0] == 0


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: metric_factor(-np.eye(2)), "positive definite"),
        (lambda: metric_factor([[1.0, 2.0], [0.0, 1.0]]), "symmetric"),
        (lambda: metric_factor([[1e-12, 2e-13], [0.0, 1e-12]]), "symmetric"),
        (lambda: metric_factor(np.ones(3)), "metric needs shape"),
        (lambda: contraction_rate([[np.nan, 0.3], [-0.2, -2]]), "J needs finite"),
        (lambda: contraction_rate(np.eye(3)[:2]), "J needs shape"),
        (lambda: contraction_rate(np.eye(3), np.eye(2)), r"metric needs shape \(\.\.\., 3, 3\)"),
        (lambda: overshoot([[np.nan]]), "metric needs finite"),
        (lambda: lyapunov_metric(np.diag([-1.0, 0.1])), "no metric contracts"),
        (lambda: lyapunov_metric(-np.eye(2), "fast"), "rate needs real numbers"),
        (lambda: linear_flow([["a"]], [0, 1]), "A needs real numbers"),
    ],
)
def test_bad_arguments_are_named(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()
