from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov

from cmc.theory.certificates import circle_criterion
from cmc.theory.contraction import contraction_factor, contraction_rate
from cmc.theory.disturbance import (
    KINDS,
    peak_gain,
    random_disturbances,
    worst_constant,
    worst_signal,
)
from cmc.theory.reach import reach, shape_metric
from cmc.theory.robustness import ErrorBall, paper_channel, respond

PUSH = np.array([[1.0], [0.0]])  # a disturbance moves z, not its integral


def random_loop(rng, n=4):
    J = rng.normal(size=(n, n))
    return J - (np.linalg.eigvals(J).real.max() + rng.uniform(0.2, 1.0)) * np.eye(n)


def random_ball(rng, J, B):
    share = rng.uniform(0.1, 0.9) * -np.linalg.eigvals(J).real.max()
    root = rng.normal(size=J.shape)
    Q = root @ root.T + 0.1 * np.eye(len(J))
    metric = solve_continuous_lyapunov((J + share * np.eye(len(J))).T, -Q)
    metric = 0.5 * (metric + metric.T)
    return ErrorBall(metric, float(contraction_rate(J, metric)), B)


def tanh_loop(c, low, high):
    """z' = -c z - [low I + (high - low) tanh I], I' = z: slopes in [low, high]."""

    def rhs(t, s):
        z, total = s[..., 0], s[..., 1]
        pull = low * total + (high - low) * np.tanh(total)
        return np.stack([-c * z - pull, z], axis=-1)

    return rhs


def test_bound_contains_all_of_ten_thousand_disturbed_nonlinear_trajectories():
    rng, size = np.random.default_rng(0), 0.7
    times = np.linspace(0.0, 8.0, 321)
    rhs, ball = tanh_loop(2.0, 0.8, 2.4), ErrorBall.of(circle_criterion(2.0, 0.8, 2.4), PUSH)
    d = random_disturbances(rng, 320, 10_000, size, step=0.025)
    first, second = rng.normal(size=(2, 10_000, 2))
    second[:5000] = first[:5000]  # half of the pairs start together
    calm = respond(rhs, first, times, np.zeros((320, 1, 1)) * PUSH[:, 0] + np.zeros_like(first))
    disturbed = respond(rhs, second, times, d @ PUSH.T)
    distance = ball.distance(disturbed - calm)
    bound = ball.bound(times[:, None], distance[0], size)
    assert (distance <= bound * (1 + 1e-9) + 1e-12).all()
    euclidean = np.linalg.norm(disturbed - calm, axis=-1)
    assert (euclidean <= ball.euclidean_bound(times[:, None], distance[0], size) + 1e-12).all()
    output = np.abs(disturbed - calm)[..., 0]
    assert (
        output <= ball.output_bound([1.0, 0.0], times[:, None], distance[0], size) + 1e-12
    ).all()
    # a bound that nothing comes near would pass too: the worst of them uses a third of it
    late = distance[-1] / ball.radius(size)
    assert 0.3 < late.max() <= 1.0


def test_sampled_ball_contains_every_trajectory_and_settles_at_its_radius():
    rng, h = np.random.default_rng(1), 0.02
    phi = expm(random_loop(rng) * h)
    metric = np.eye(4)
    for _ in range(4000):  # the sum of (rho phi)^T^k (rho phi)^k: a Lyapunov metric by its series
        metric = np.eye(4) + (1.002 * phi).T @ metric @ (1.002 * phi)
    factor = float(contraction_factor(phi, metric))
    B = rng.normal(size=(4, 2))
    ball = ErrorBall(metric, -np.log(factor) / h, B, period=h)
    d = random_disturbances(rng, 400, 1000, 0.3, step=h, m=2)
    states = rng.normal(size=(1000, 4))
    start = ball.distance(states)
    for k in range(400):
        assert (ball.distance(states) <= ball.bound(k * h, start, 0.3) * (1 + 1e-9)).all()
        states = states @ phi.T + d[k] @ B.T
    assert ball.radius(0.3) == pytest.approx(ball.push(0.3) / (1 - factor), rel=1e-9)


def test_paper_form_is_the_chung_bound_and_never_below_the_metric_form():
    rng = np.random.default_rng(2)
    for _ in range(50):
        J, B = random_loop(rng), rng.normal(size=(4, 2))
        ball = random_ball(rng, J, B)
        low, high = np.linalg.eigvalsh(ball.metric)[[0, -1]]
        d_bar, t, start = np.linalg.norm(B, 2) * 0.4, 1.3, 2.0
        fading = np.exp(-ball.rate * t)
        expected = start / np.sqrt(low) * fading
        expected += d_bar / ball.rate * np.sqrt(high / low) * (1 - fading)
        assert ball.euclidean_bound(t, start, 0.4) == pytest.approx(expected)
        assert ball.bound(t, start, 0.4) / np.sqrt(low) <= expected * (1 + 1e-9)


def test_each_promise_is_above_the_next_and_above_what_can_happen():
    rng = np.random.default_rng(3)
    for _ in range(40):
        J, B, row = random_loop(rng), rng.normal(size=(4, 2)), rng.normal(size=4)
        ball = random_ball(rng, J, B)
        ellipsoid = reach(J, ball.metric, B)
        peak = peak_gain(J, B, row)
        constant = np.linalg.norm(row @ np.linalg.solve(J, B))
        sharper = float(ellipsoid.output_bound(row, np.inf, 0.0, 1.0))
        promised = float(ball.output_bound(row, np.inf, 0.0, 1.0))
        slack = 1 + 1e-6
        assert constant <= peak * slack <= sharper * slack**2
        assert sharper <= promised * 1.002  # `reach` looks at a grid of decays


def test_ellipsoid_contains_loops_whose_slopes_change_and_shaping_it_makes_it_smaller():
    rng, size, row = np.random.default_rng(8), 0.7, [1.0, 0.0]
    corners = np.array([[[-2.0, -k], [1.0, 0.0]] for k in (0.8, 2.4)])
    found = circle_criterion(2.0, 0.8, 2.4)
    plain = reach(corners, found.metric, PUSH)
    shaped = shape_metric(corners, found.metric, PUSH, row)
    promise = [float(e.output_bound(row, np.inf, 0.0, size)) for e in (plain, shaped)]
    assert promise[1] < 0.9 * promise[0]
    assert promise[1] >= size * max(peak_gain(J, PUSH, row) for J in corners) * (1 - 1e-6)
    times = np.linspace(0.0, 8.0, 321)
    d = random_disturbances(rng, 320, 1000, size, step=0.025)
    first, second = rng.normal(size=(2, 1000, 2))
    rhs = tanh_loop(2.0, 0.8, 2.4)
    calm = respond(rhs, first, times, np.zeros((320, 1000, 2)))
    apart = respond(rhs, second, times, d @ PUSH.T) - calm
    for ellipsoid in (plain, shaped):
        distance = ellipsoid.distance(apart)
        assert (distance <= ellipsoid.bound(times[:, None], distance[0], size) * (1 + 1e-9)).all()
    with pytest.raises(ValueError, match="does not contract"):
        shape_metric(corners, np.eye(2), PUSH, row)


def test_worst_constant_disturbance_is_the_worst_of_many_and_is_where_the_loop_settles():
    rng = np.random.default_rng(4)
    J, B = random_loop(rng), rng.normal(size=(4, 2))
    ball = random_ball(rng, J, B)
    for metric in (None, ball.metric):
        size, d = worst_constant(J, B, metric)
        assert np.linalg.norm(d) == pytest.approx(1.0)
        angle = np.linspace(0, np.pi, 2001)
        others = -np.linalg.solve(J, B @ np.stack([np.cos(angle), np.sin(angle)])).T
        length = np.linalg.norm(others, axis=-1) if metric is None else ball.distance(others)
        assert size == pytest.approx(length.max(), rel=1e-5)
        assert size <= ball.radius(1.0) or metric is None
    rest = solve_ivp(lambda t, x: J @ x + B @ d, (0, 150), np.zeros(4), rtol=1e-9, atol=1e-12)
    assert ball.distance(rest.y[:, -1]) == pytest.approx(size, rel=1e-6)


def test_peak_gain_of_a_lag_and_of_two_lags_in_closed_form():
    assert peak_gain([[-3.0]], [[2.0]], [1.0]) == pytest.approx(2.0 / 3.0, rel=1e-9)
    # an oscillator's impulse response e^{-a t} sin(w t) / w has the absolute integral below
    a, w = 0.1, 2.0
    J = np.array([[0.0, 1.0], [-(a**2 + w**2), -2 * a]])
    expected = 1 / (a**2 + w**2) / np.tanh(np.pi * a / (2 * w))
    assert peak_gain([[-1.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [1.0, 0.0]) == pytest.approx(1.0)
    assert peak_gain(J, [[0.0], [1.0]], [1.0, 0.0]) == pytest.approx(expected, rel=1e-4)


def test_worst_signal_reaches_the_peak():
    rng = np.random.default_rng(5)
    J, B, row = random_loop(rng), rng.normal(size=(4, 2)), rng.normal(size=4)
    times = np.linspace(0.0, 60.0, 6001)
    signal, reach = worst_signal(J, B, row, times)
    assert np.linalg.norm(signal, axis=-1).max() == pytest.approx(1.0)
    path = respond(lambda t, s: s @ J.T, np.zeros((1, 4)), times, (signal @ B.T)[:, None])
    assert path[-1, 0] @ row == pytest.approx(peak_gain(J, B, row), rel=1e-3)
    assert reach[-1] == pytest.approx(peak_gain(J, B, row), rel=1e-3)
    assert (np.diff(reach) >= 0).all()


def test_random_disturbances_are_bounded_and_of_four_kinds():
    d = random_disturbances(np.random.default_rng(6), 300, 40, 0.5, step=0.01, m=3)
    norm = np.linalg.norm(d, axis=-1)
    assert norm.max() == pytest.approx(0.5)
    kinds = {kind: d[:, i::4] for i, kind in enumerate(KINDS)}
    assert (kinds["constant"] == kinds["constant"][:1]).all()
    assert np.allclose(np.linalg.norm(kinds["switching"], axis=-1), 0.5)
    assert (np.diff(kinds["switching"], axis=0) != 0).any(axis=(0, 2)).mean() > 0.5
    assert np.abs(np.diff(kinds["sine"], axis=0)).max() < 0.5 * 2 * np.pi * 0.1 * 1.01
    white = kinds["white"][..., 0] / kinds["white"][0, :, 0]
    assert abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 0.2


def test_paper_channel_follows_from_the_chain_rule():
    rng = np.random.default_rng(7)
    T_y, T_a, p = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=2)
    d, eps = rng.normal(size=2), 1e-6
    # u = T_a pi(T_y y): when y moves by eps d, u moves by eps times the lower half
    moved = T_a @ (np.tanh(p * (T_y @ (eps * d))))
    np.testing.assert_allclose(paper_channel(T_y, T_a, p) @ d, [*d, *(moved / eps)], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.eye(2), 0.0), "does not contract"),
        ((np.eye(2), np.nan), "does not contract"),
        ((-np.eye(2), 1.0), "positive definite"),
        ((np.ones((2, 3)), 1.0), "shape"),
        ((np.array([[1.0, 0.5], [0.0, 1.0]]), 1.0), "symmetric"),
        ((np.eye(2), 1.0, np.ones((3, 1))), "channel"),
        ((np.eye(2), 1.0, None, -1.0), "period"),
    ],
)
def test_a_ball_of_nonsense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ErrorBall(*arguments)


def test_unstable_loops_and_wrong_sizes_are_refused():
    for call in (
        lambda: worst_constant(np.eye(2), np.eye(2)),
        lambda: peak_gain(np.zeros((2, 2)), np.eye(2), [1.0, 0.0]),
    ):
        with pytest.raises(ValueError, match="not stable"):
            call()
    with pytest.raises(ValueError, match="at least 0"):
        ErrorBall(np.eye(2), 1.0).push(-1.0)
    with pytest.raises(TypeError, match="row needs real numbers"):
        shape_metric(-np.eye(2), np.eye(2), np.eye(2), "abc")
    with pytest.raises(ValueError, match="channel needs shape"):
        peak_gain(-np.eye(2), np.eye(3), [1.0, 0.0])
    with pytest.raises(ValueError, match="one per step"):
        respond(lambda t, s: -s, np.zeros((1, 2)), [0.0, 1.0, 2.0], np.zeros((3, 1, 2)))
    with pytest.raises(ValueError, match="steps needs"):
        random_disturbances(np.random.default_rng(0), 0, 1, 1.0, step=0.1)


def test_ball_of_a_certificate_takes_its_metric_and_its_rate():
    found = circle_criterion(2.0, 0.8, 2.4)
    ball = ErrorBall.of(found, PUSH)
    assert ball.fits(1e9)
    boxed = ErrorBall.of(replace(found, evidence="points", ball=2.0), PUSH)
    edge = 2.0 / boxed.radius(1.0)
    assert boxed.fits(0.99 * edge)
    assert not boxed.fits(1.01 * edge)
    np.testing.assert_allclose(ball.metric, found.metric)
    assert ball.rate == found.rate > 0
    with pytest.raises(ValueError, match="without a certificate"):
        ErrorBall.of(circle_criterion(0.1, 0.8, 2.4))
    with pytest.raises(ValueError, match="frozen"):
        ErrorBall.of(replace(found, kind="frozen"))
    with pytest.raises(ValueError, match="does not go with"):
        ErrorBall.of(found, period=0.01)
