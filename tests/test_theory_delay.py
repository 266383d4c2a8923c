"""The delayed loop against a finer grid, and its edges against each other."""

import numpy as np
import pytest
from scipy.signal import cont2discrete

from cmc.theory.delay import LagLoop

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


@pytest.mark.parametrize("late", [0.0, 0.025])
def test_noise_gain_is_the_standard_deviation_of_a_long_simulation(late):
    loop, noise = LagLoop(), np.random.default_rng(1).normal(size=(1500, 300))
    path = oversampled(loop, round(10 * late / loop.period), 1.0, noise)
    assert path[300:].std() == pytest.approx(loop.noise_gain(late, 1.0), rel=0.02)


def test_disturbance_gain_is_reached_by_its_own_worst_signal():
    loop, slope, late = LagLoop(), 1.0, 0.02
    matrix = loop.sample_matrix(late, slope)
    entry = np.zeros(len(matrix))
    entry[0] = loop.gain * (1 - np.exp(-loop.period / loop.tau))
    impulse = []
    state = entry
    for _ in range(3000):
        impulse.append(state[0])
        state = matrix @ state
    worst = np.sign(impulse)[::-1]
    state = np.zeros(len(matrix))
    for d in worst:
        state = matrix @ state + entry * d
    assert state[0] == pytest.approx(loop.disturbance_gain(late, slope), rel=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LagLoop(tau=-1.0), "tau needs positive"),
        (lambda: LagLoop(period=float("nan")), "period needs finite"),
        (lambda: LagLoop(gain=[1.0, 2.0]), "gain needs a single number"),
        (lambda: LagLoop().largest_gain([0.01, -0.01]), "delay needs values of at least 0"),
        (lambda: LagLoop().sample_matrix(1e9, 1.0), "delay needs at most"),
        (lambda: LagLoop().spectral_radius(0.0, np.nan), "slope needs finite"),
        (lambda: LagLoop().noise_gain(0.05, 50.0), r"not stable.*stable below 1\."),
        (lambda: LagLoop().disturbance_gain(0.05, 50.0), "not stable"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
