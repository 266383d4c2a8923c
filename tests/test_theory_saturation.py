import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from cmc.theory.contraction import contraction_factor, metric_factor
from cmc.theory.saturation import (
    ANTI_WINDUP,
    SaturatedLoop,
    overshoot,
    settling_time,
    simulate_saturated,
)

STABLE = SaturatedLoop()
UNSTABLE = SaturatedLoop(lam=2.0, r=1.0, k1=6.0, k2=4.0, low=-1.0, high=1.5)


def test_without_reaching_a_limit_every_remedy_leaves_the_linear_loop_alone():
    for remedy in ANTI_WINDUP:
        path, raw, integral = simulate_saturated(STABLE, 1e-3, 50, anti_windup=remedy)
        state = np.array([1e-3, 0.0])
        for k in range(50):
            assert raw[k] == pytest.approx(STABLE.command_row() @ state, rel=1e-12)
            state = STABLE.transition() @ state
            assert path[k + 1] == pytest.approx(state[0], abs=1e-15)
            assert integral[k] == pytest.approx(state[1], abs=1e-15)


@pytest.mark.parametrize("loop", [STABLE, UNSTABLE])
def test_starts_inside_the_unclipped_ball_are_never_clipped_and_the_ball_is_the_largest(loop):
    phi = loop.transition()
    metric = solve_discrete_lyapunov(phi.T, np.eye(2))
    assert contraction_factor(phi, metric) < 1
    level = loop.unclipped_level(metric)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(10_000, 2))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    inside = level * rng.random((10_000, 1)) ** 0.5 * direction
    states = inside @ np.linalg.inv(metric_factor(metric)).T
    path, raw, _ = simulate_saturated(loop, states[:, 0], 600, integral=states[:, 1])
    assert ((raw >= loop.low) & (raw <= loop.high)).all()
    assert np.abs(path[-1]).max() < 1e-2 * np.abs(path[0]).max()
    # towards the nearer limit, one per cent further out is clipped at once
    row = loop.command_row() * (1 if loop.high < -loop.low else -1)
    edge = np.linalg.solve(metric, row)
    edge *= 1.01 * level / np.sqrt(edge @ metric @ edge)
    _, raw, _ = simulate_saturated(loop, edge[0], 1, integral=edge[1])
    assert raw[0] < loop.low or raw[0] > loop.high


def test_an_unstable_mode_is_lost_outside_of_the_recoverable_interval_and_not_inside():
    low, high = UNSTABLE.recoverable()
    assert (low, high) == pytest.approx((-0.75, 0.5))
    starts = np.array([low - 0.01, low + 0.05, high - 0.05, high + 0.01])
    path, _, _ = simulate_saturated(UNSTABLE, starts, 2000, anti_windup="clamp")
    assert (np.abs(path[-1]) < 1e-3).tolist() == [False, True, True, False]
    # full opposite command is the best there is: at the edge it only holds the mode
    a, b = np.exp(2.0 * 0.01), (np.exp(2.0 * 0.01) - 1) / 2.0
    assert a * high + b * UNSTABLE.low == pytest.approx(high)
    assert STABLE.recoverable() == (-np.inf, np.inf)


def test_anti_windup_shortens_recovery_and_lowers_the_overshoot():
    starts = np.linspace(2.5, 8.0, 10)
    late, far = {}, {}
    loop = SaturatedLoop(k1=0.5, k2=20.0)
    for remedy in ANTI_WINDUP:
        path, raw, _ = simulate_saturated(loop, starts, 3000, anti_windup=remedy)
        assert (raw[0] < loop.low).all()
        late[remedy] = settling_time(path, 0.02, loop.period)
        far[remedy] = overshoot(path)
    assert np.isfinite(late["none"]).all()
    for remedy in ("clamp", "back"):
        assert (late[remedy] < late["none"]).all()
        assert (far[remedy] < 0.8 * far["none"]).all()


def test_settling_and_overshoot_of_known_paths():
    path = np.array([[1.0, 1.0, -2.0], [-0.5, 0.5, 1.0], [0.01, 0.2, 0.0], [0.0, 0.2, 0.0]])
    np.testing.assert_allclose(settling_time(path, 0.1, 0.5), [1.0, np.inf, 1.0])
    np.testing.assert_allclose(overshoot(path), [0.5, 0.0, 0.5])


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="k2 must be positive"):
        SaturatedLoop(k2=0.0)
    with pytest.raises(ValueError, match="low < 0 < high"):
        SaturatedLoop(low=0.1)
    with pytest.raises(ValueError, match="finite"):
        SaturatedLoop(lam=np.inf)
    with pytest.raises(ValueError, match="anti_windup"):
        simulate_saturated(STABLE, 1.0, 5, anti_windup="magic")
    with pytest.raises(ValueError, match="step"):
        simulate_saturated(STABLE, 1.0, 0)
