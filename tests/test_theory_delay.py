import numpy as np
import pytest
from scipy.signal import cont2discrete

from cmc.theory.delay import (
    LagLoop,
    class_gain,
    decays,
    largest_gain,
    loop_response,
    sample_matrix,
    simulate,
    spectral_radius,
)
from cmc.theory.noise import disturbance_gain, noise_gain

LOOPS = [
    LagLoop(),
    LagLoop(tau=0.01, gain=31.0, period=0.01, integral_time=0.05),
    LagLoop(tau=0.5, gain=2.0, period=0.02, integral_time=0.5),
]


def oversampled(loop, fraction_of, late, slope, steps):
    """The same loop on a grid `fraction_of` times finer, one plain step at a time."""
    h = loop.period / fraction_of
    lag, push, one = -1 / loop.tau, loop.gain / loop.tau, np.eye(1)
    system = (lag * one, push * one, one, 0.0 * one)
    a, b, *_ = cont2discrete(system, h, method="zoh")
    error, integral, sent, out = 1.0, 0.0, [], []
    for i in range(steps * fraction_of):
        if i % fraction_of == 0:
            out.append(error)
            integral += loop.period * error
            command = -slope * (error + integral / loop.integral_time)
        sent.append(command)
        acting = sent[i - late] if i >= late else 0.0
        error = float(a[0, 0]) * error + float(b[0, 0]) * acting
    return np.array(out)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("late", [0, 3, 10, 27])
def test_simulation_agrees_with_a_finer_grid(loop, late):
    slope = 0.4 / loop.gain
    path = np.array(list(simulate(loop, late * loop.period / 10, slope, 60)))
    np.testing.assert_allclose(path, oversampled(loop, 10, late, slope, 60), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("late", [0.0, 0.004, 0.01, 0.0317])
def test_matrix_of_one_sample_reproduces_the_simulation(late):
    loop, slope = LOOPS[0], 1.3
    matrix = sample_matrix(loop, late, slope)
    state = np.zeros(len(matrix))
    state[0] = 1.0
    for error in simulate(loop, late, slope, 50):
        assert float(error) == pytest.approx(state[0], rel=1e-9, abs=1e-12)
        state = matrix @ state


@pytest.mark.parametrize("loop", LOOPS)
def test_boundary_has_a_pole_on_the_unit_circle_and_none_outside_below_it(loop):
    delays = loop.period * np.array([0.0, 0.3, 1.0, 2.5, 7.2])
    for late, slope in zip(delays, largest_gain(loop, delays), strict=True):
        assert spectral_radius(loop, late, slope) == pytest.approx(1.0, abs=1e-7)
        assert spectral_radius(loop, late, 0.99 * slope) < 1.0
        assert spectral_radius(loop, late, 1.01 * slope) > 1.0


@pytest.mark.parametrize("loop", LOOPS)
def test_without_delay_the_boundary_is_the_sampled_data_bound(loop):
    share = 1.0 + loop.period / (2.0 * loop.integral_time)
    bound = 1.0 / np.tanh(loop.period / (2.0 * loop.tau)) / loop.gain
    assert largest_gain(loop, 0.0) * share == pytest.approx(bound, rel=1e-9)


def test_loop_response_is_the_discrete_fourier_transform_of_the_impulse_response():
    loop, late = LagLoop(integral_time=0.03), 0.0234
    angle = 0.7
    # One proportional pulse through the exact lag: 1 / (z - a) and the delay, summed as a series
    a, b_new, b_old = loop.weights(late)
    k = np.arange(4000)
    weights = np.where(k == 0, b_new, b_old + a * b_new) * a ** np.maximum(k - 1, 0)
    series = (weights * np.exp(-1j * angle * (k + 1 + 2))).sum()
    controller = 1 + loop.period / loop.integral_time / (1 - np.exp(-1j * angle))
    assert loop_response(loop, late, angle) == pytest.approx(controller * series, rel=1e-9)


def test_measured_boundary_lies_within_one_cell_of_the_predicted_one():
    loop, delays, slopes = LagLoop(), np.linspace(0.0, 0.1, 40), np.geomspace(0.3, 12.0, 40)
    measured = decays(loop, delays, slopes[:, None]).sum(axis=0)
    predicted = (slopes[:, None] < largest_gain(loop, delays)).sum(axis=0)
    assert (np.abs(measured - predicted) <= 1).all()


@pytest.mark.parametrize("late", [0.0, 0.013, 0.04])
def test_changing_slopes_inside_the_class_gain_never_diverge(late):
    loop, rng = LagLoop(), np.random.default_rng(0)
    top = float(class_gain(loop, late))
    low, high = sample_matrix(loop, late, 0.02 * top), sample_matrix(loop, late, 0.97 * top)
    states = rng.normal(size=(200, len(low)))
    start = np.abs(states).max()
    for _ in range(4000):
        which = rng.random(200) < 0.5
        states = np.where(which[:, None], states @ low.T, states @ high.T)
    assert np.abs(states).max() < 1e-6 * start


def test_saturating_policy_has_the_same_boundary_but_keeps_a_bounded_oscillation():
    loop, late = LagLoop(), 0.05
    edge = float(largest_gain(loop, late))
    slopes = edge * np.array([0.9, 1.2])
    assert decays(loop, late, slopes, limit=1.0).tolist() == [True, False]
    path = np.array(list(simulate(loop, late, slopes, 2000, limit=1.0)))
    assert 0.05 < np.abs(path[-200:, 1]).max() < 1.0


@pytest.mark.parametrize("late", [0.0, 0.025])
def test_noise_gain_is_the_standard_deviation_of_a_long_simulation(late):
    loop, slope, rng = LagLoop(), 1.0, np.random.default_rng(1)
    noise = rng.normal(size=(3000, 100))
    path = np.array(list(simulate(loop, late, np.full(100, slope), 3000, noise=noise)))
    assert path[600:].std() == pytest.approx(noise_gain(loop, late, slope), rel=0.02)


def test_disturbance_gain_is_reached_by_its_own_worst_signal():
    loop, slope, late = LagLoop(), 1.0, 0.02
    matrix = sample_matrix(loop, late, slope)
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
    assert state[0] == pytest.approx(disturbance_gain(loop, late, slope), rel=1e-9)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="tau must be finite and positive"):
        LagLoop(tau=-1.0)
    with pytest.raises(ValueError, match="period"):
        LagLoop(period=float("nan"))
    with pytest.raises(ValueError, match="at least 0 s"):
        largest_gain(LagLoop(), [0.01, -0.01])
    with pytest.raises(ValueError, match="limit > 0"):
        list(simulate(LagLoop(), 0.0, 1.0, 10, limit=0.0))
    for gain in (noise_gain, disturbance_gain):
        with pytest.raises(ValueError, match="not stable"):
            gain(LagLoop(), 0.05, 50.0)
