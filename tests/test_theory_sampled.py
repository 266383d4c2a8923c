"""Sampled control: the bound against the simulated step, delays against a finer grid."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import cont2discrete

from cmc.theory.sampled import LagLoop, hold_lag, largest_slope, sampled_margin, sampled_matrix


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


LOOPS = [
    LagLoop(),
    LagLoop(tau=0.01, gain=31.0, period=0.01, integral_time=0.05),
    LagLoop(tau=0.5, gain=2.0, period=0.02, integral_time=0.5),
]


def oversampled(loop, late, slope, noise, fine=10):
    """The loop on a grid ten times finer, one plain step at a time, from e = 1."""
    h = loop.period / fine
    lag, push, one = -1 / loop.tau, loop.gain / loop.tau, np.eye(1)
    a, b, *_ = cont2discrete((lag * one, push * one, one, 0.0 * one), h, method="zoh")
    error, integral, sent, out = np.ones(noise.shape[1:]), 0.0, [], []
    for i in range(len(noise) * fine):
        if i % fine == 0:
            out.append(error)
            seen = error + noise[i // fine]
            integral = integral + loop.period * seen
            command = -slope * (seen + integral / loop.integral_time)
        sent.append(command)
        acting = sent[i - late] if i >= late else 0.0
        error = float(a[0, 0]) * error + float(b[0, 0]) * acting
    return np.array(out)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("late", [0, 3, 10, 27])
def test_the_matrix_of_one_sample_is_the_loop_on_a_finer_grid(loop, late):
    slope = 0.4 / loop.gain
    matrix = loop.sample_matrix(late * loop.period / 10, slope)
    state, path = np.eye(len(matrix))[0], []
    for _ in range(60):
        path.append(state[0])
        state = matrix @ state
    expected = oversampled(loop, late, slope, np.zeros((60, 1)))[:, 0]
    np.testing.assert_allclose(path, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("loop", LOOPS)
def test_boundary_has_a_pole_on_the_unit_circle_and_none_outside_below_it(loop):
    delays = loop.period * np.array([0.0, 0.3, 1.0, 2.5, 7.2])
    for late, slope in zip(delays, loop.largest_gain(delays), strict=True):
        assert loop.spectral_radius(late, slope) == pytest.approx(1.0, abs=1e-7)
        for share in (0.3, 0.7, 0.99):
            assert loop.spectral_radius(late, share * slope) < 1.0
        assert loop.spectral_radius(late, 1.01 * slope) > 1.0
    share = 1.0 + loop.period / (2.0 * loop.integral_time)  # without delay: the sampled bound
    bound = 1.0 / np.tanh(loop.period / (2.0 * loop.tau)) / loop.gain
    assert loop.largest_gain(0.0) * share == pytest.approx(bound, rel=1e-9)
    assert (loop.class_gain(delays) <= loop.largest_gain(delays) * (1 + 1e-4)).all()


@pytest.mark.parametrize("late", [0.0, 0.013, 0.04])
def test_changing_slopes_inside_the_class_gain_never_diverge(late):
    loop, rng = LagLoop(), np.random.default_rng(0)
    top = float(loop.class_gain(late))
    low, high = loop.sample_matrix(late, 0.02 * top), loop.sample_matrix(late, 0.97 * top)
    states = rng.normal(size=(200, len(low)))
    start = np.abs(states).max()
    for _ in range(4000):
        which = rng.random(200) < 0.5
        states = np.where(which[:, None], states @ low.T, states @ high.T)
    assert np.abs(states).max() < 1e-6 * start


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: largest_slope(-0.01, 1.0, 0.01), "tau needs positive"),
        (lambda: sampled_margin(1.0, 1.0, 0.01, 1.0, 0.0), "h needs positive"),
        (lambda: largest_slope(0.01, 1.0, 0.01, ratio=1.0, k2=1.0), "ratio or k2, not both"),
        (lambda: largest_slope(0.01, 1.0, 0.01, k2=1e4), "leaves no room"),
        (lambda: largest_slope(0.01, 1.0, 0.01, ratio=-1.0), "ratio needs values of at least 0"),
        (lambda: LagLoop(tau=-1.0), "tau needs positive"),
        (lambda: LagLoop(period=float("nan")), "period needs finite"),
        (lambda: LagLoop(gain=[1.0, 2.0]), "gain needs a single number"),
        (lambda: LagLoop().largest_gain([0.01, -0.01]), "delay needs values of at least 0"),
        (lambda: LagLoop().sample_matrix(1e9, 1.0), "delay needs at most"),
        (lambda: LagLoop().spectral_radius(0.0, np.nan), "slope needs finite"),
    ],
)
def test_bad_loops_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
