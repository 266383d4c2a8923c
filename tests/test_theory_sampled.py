"""Sampled control: the closed-form bound against eigenvalues of the simulated step."""

import numpy as np
import pytest
from scipy.linalg import expm

from cmc.theory.sampled import hold_lag, largest_slope, sampled_margin, sampled_matrix


def _samples(size, seed):
    rng = np.random.default_rng(seed)
    tau, K, h = 10 ** rng.uniform(-2.5, 0, size), 10 ** rng.uniform(-1, 1.5, size), None
    h = tau * 10 ** rng.uniform(-1.5, 1.0, size)
    top = 1 / (np.tanh(h / (2 * tau)) * K)
    k1 = rng.uniform(-1.3, 1.3, size) * top
    k2 = rng.uniform(-0.3, 2.0, size) * top / h
    return k1, k2, tau, K, h


def _simulated_step(k1, k2, tau, K, h):
    """The loop as code would run it, column by column: measure, integrate, hold."""
    columns = []
    for e, I in ((1.0, 0.0), (0.0, 1.0)):
        I_new = I + h * e
        u = -(k1 * e + k2 * I_new)
        columns.append([K * u + (e - K * u) * np.exp(-h / tau), I_new])
    return np.array(columns).T


def test_bound_agrees_with_the_eigenvalues_of_the_simulated_loop():
    k1, k2, tau, K, h = _samples(4000, 0)
    margin = sampled_margin(k1, k2, tau, K, h)
    steps = np.stack([_simulated_step(*row) for row in zip(k1, k2, tau, K, h, strict=True)])
    radius = np.abs(np.linalg.eigvals(steps)).max(axis=-1)
    clear = np.abs(margin) > 1e-9
    np.testing.assert_array_equal((margin > 0)[clear], (radius < 1)[clear])
    assert 0.2 < np.mean(margin > 0) < 0.8


def test_step_matrix_is_the_simulated_step_and_batches():
    k1, k2, tau, K, h = _samples(50, 1)
    for row in zip(k1, k2, tau, K, h, strict=True):
        a, b, t, gain, sample = row
        step = sampled_matrix(a, b, -1 / t, gain / t, sample)
        np.testing.assert_allclose(step, _simulated_step(*row), rtol=1e-9, atol=1e-12)
    batch = sampled_matrix(k1, k2, -1 / tau, K / tau, 0.01)
    assert batch.shape == (50, 2, 2)
    np.testing.assert_array_equal(
        batch[7], sampled_matrix(k1[7], k2[7], -1 / tau[7], K[7] / tau[7], 0.01)
    )


@pytest.mark.parametrize("Lambda", [-3.0, 0.0, 1e-14, 0.8])
def test_hold_agrees_with_the_matrix_exponential(Lambda):
    phi, G = hold_lag(Lambda, 2.0, 0.3)
    block = expm(0.3 * np.array([[Lambda, 2.0], [0.0, 0.0]]))
    np.testing.assert_allclose([phi, G], block[0], rtol=1e-12)


def test_other_quadratures_are_decided_differently():
    """The bound belongs to I_k = I_{k-1} + h e_k: forward Euler disagrees on a good part."""
    k1, k2, tau, K, h = _samples(4000, 2)
    k1, k2 = np.abs(k1), np.abs(k2)
    phi = np.exp(-h / tau)
    G = K * (1 - phi)
    forward = np.empty((len(k1), 2, 2))
    forward[:, 0, 0], forward[:, 0, 1] = phi - G * k1, -G * k2
    forward[:, 1, 0], forward[:, 1, 1] = h, 1.0
    stable = np.abs(np.linalg.eigvals(forward)).max(-1) < 1
    differ = np.mean(stable != (sampled_margin(k1, k2, tau, K, h) > 0))
    assert differ > 0.1


def test_largest_slope_is_the_edge():
    _, _, tau, K, h = _samples(500, 3)
    for keywords, second in (
        ({"ratio": 2.0}, lambda limit: 2.0 * limit),
        ({"k2": 0.05 / (K * h)}, lambda limit: 0.05 / (K * h)),
    ):
        limit = largest_slope(tau, K, h, **keywords)
        k2 = second(limit)
        inside = sampled_margin(limit * 0.999, k2 * 0.999, tau, K, h)
        outside = sampled_margin(limit * 1.001, k2 * 1.001, tau, K, h)
        assert (inside > 0).all()
        assert (outside < 0).all()


def test_known_limits():
    # (1 + phi) / (1 - phi) for a unit gain, and the peg's force loop at K = 31
    assert largest_slope(0.01, 1.0, 0.001) == pytest.approx(20.0, abs=0.05)
    assert largest_slope(0.01, 1.0, 0.010) == pytest.approx(2.16, abs=0.005)
    assert largest_slope(0.0437, 1.0, 0.005) == pytest.approx(17.5, abs=0.05)
    np.testing.assert_allclose(
        largest_slope(0.01, 31.0, np.array([0.002, 0.01, 0.02])), [0.324, 0.070, 0.042], atol=6e-4
    )


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="tau needs positive"):
        largest_slope(-0.01, 1.0, 0.01)
    with pytest.raises(ValueError, match="h needs positive"):
        sampled_margin(1.0, 1.0, 0.01, 1.0, 0.0)
    with pytest.raises(ValueError, match="ratio or k2, not both"):
        largest_slope(0.01, 1.0, 0.01, ratio=1.0, k2=1.0)
    with pytest.raises(ValueError, match="leaves no room"):
        largest_slope(0.01, 1.0, 0.01, k2=1e4)
    with pytest.raises(ValueError, match="ratio needs values of at least 0"):
        largest_slope(0.01, 1.0, 0.01, ratio=-1.0)
