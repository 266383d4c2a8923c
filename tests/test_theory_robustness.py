"""Error balls, ellipsoids and the metric of a model, against simulation and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import expm, solve_continuous_lyapunov

from cmc.theory.certificates import circle_criterion
from cmc.theory.contraction import contraction_rate
from cmc.theory.robustness import KINDS, ErrorBall, nominal_metric, random_disturbances
from cmc.theory.simulate import linear_flow

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


def tanh_loop(s):
    """z' = -2 z - [0.8 I + 1.6 tanh I], I' = z: slopes in [0.8, 2.4]."""
    z, total = s[..., 0], s[..., 1]
    return np.stack([-2.0 * z - 0.8 * total - 1.6 * np.tanh(total), z], axis=-1)


def respond(start, times, pushes):
    """Path of `tanh_loop` under pushes (steps, batch, 2), each held over its step."""
    path, h = [start], times[1] - times[0]
    for w in pushes:  # Runge and Kutta, order 4
        s = path[-1]
        a = tanh_loop(s) + w
        b = tanh_loop(s + h / 2 * a) + w
        c = tanh_loop(s + h / 2 * b) + w
        path.append(s + h / 6 * (a + 2 * b + 2 * c + tanh_loop(s + h * c) + w))
    return np.array(path)


@pytest.fixture(scope="module")
def disturbed():
    """2,000 pairs of trajectories, one of each disturbed; half of the pairs start together."""
    rng, times = np.random.default_rng(0), np.linspace(0.0, 8.0, 321)
    d = random_disturbances(rng, 320, 2000, 0.7, step=0.025)
    first, second = rng.normal(size=(2, 2000, 2))
    second[:1000] = first[:1000]
    return times, respond(second, times, d @ PUSH.T) - respond(first, times, 0 * d @ PUSH.T)


def test_bounds_contain_all_disturbed_nonlinear_trajectories(disturbed):
    times, apart = disturbed
    found, size, row = circle_criterion(2.0, 0.8, 2.4), 0.7, [1.0, 0.0]
    ball, t, slack = ErrorBall.of(found, PUSH), times[:, None], 1 + 1e-9
    distance = ball.distance(apart)
    assert (distance <= ball.bound(t, distance[0], size) * slack + 1e-12).all()
    low, high = np.linalg.eigvalsh(ball.metric)[[0, -1]]  # the paper's form, never below
    paper = distance[0] / np.sqrt(low) * np.exp(-ball.rate * t)
    paper = paper + size * np.sqrt(high / low) / ball.rate * (1 - np.exp(-ball.rate * t))
    assert (ball.bound(t, distance[0], size) / np.sqrt(low) <= paper * slack).all()
    assert (np.linalg.norm(apart, axis=-1) <= paper + 1e-12).all()
    assert (np.abs(apart[..., 0]) <= ball.output_bound(row, t, distance[0], size) + 1e-12).all()
    # a bound that nothing comes near would pass too: the worst of them uses a third of it
    assert 0.3 < distance[-1].max() / ball.radius(size) <= 1.0


def test_sampled_ball_contains_every_trajectory_and_settles_at_its_radius():
    rng, h = np.random.default_rng(1), 0.02
    phi = expm(random_loop(rng) * h)
    metric = np.eye(4)
    for _ in range(4000):  # the sum of (rho phi)^T^k (rho phi)^k: a Lyapunov metric by its series
        metric = np.eye(4) + (1.002 * phi).T @ metric @ (1.002 * phi)
    theta = np.linalg.cholesky(metric).T
    factor = float(np.linalg.norm(theta @ phi @ np.linalg.inv(theta), 2))
    B = rng.normal(size=(4, 2))
    ball = ErrorBall(metric, -np.log(factor) / h, B, period=h)
    d = random_disturbances(rng, 400, 1000, 0.3, step=h, m=2)
    states = rng.normal(size=(1000, 4))
    start = ball.distance(states)
    for k in range(400):
        assert (ball.distance(states) <= ball.bound(k * h, start, 0.3) * (1 + 1e-9)).all()
        states = states @ phi.T + d[k] @ B.T
    push = 0.3 * np.linalg.norm(ball.theta @ B, 2)
    assert ball.radius(0.3) == pytest.approx(push / (1 - factor), rel=1e-9)


def test_the_promise_is_above_what_a_disturbance_can_cause():
    rng = np.random.default_rng(3)
    for _ in range(40):
        J, B, row = random_loop(rng), rng.normal(size=(4, 2)), rng.normal(size=4)
        ball = random_ball(rng, J, B)
        t = np.linspace(0.0, 20.0, 2001)
        weights = np.linalg.norm(row @ linear_flow(J, t) @ B, axis=-1)
        constant = np.linalg.norm(row @ np.linalg.solve(J, B))
        worst = trapezoid(weights, t)  # of ||row e^{J t} B||: what can really happen
        promised = float(ball.output_bound(row, np.inf, 0.0, 1.0))
        assert constant <= worst * 1.02 <= promised * 1.04


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


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_nominal_metric_solves_the_lyapunov_equation_and_judges_real_loops(share):
    rng = np.random.default_rng(4)
    J = np.stack([random_loop(rng) for _ in range(20)])
    for loop, metric in zip(J, nominal_metric(J, share=share), strict=True):
        b = share * -np.linalg.eigvals(loop).real.max()
        expected = solve_continuous_lyapunov((loop + b * np.eye(4)).T, -np.eye(4))
        np.testing.assert_allclose(metric, expected, rtol=1e-7, atol=1e-9)
        assert contraction_rate(loop, metric) >= b
        # a real loop that contracts in the model's metric is stable, at least at its rate there
        real = loop + rng.normal(size=(300, 4, 4)) * rng.uniform(0, 0.5, (300, 1, 1))
        rate = contraction_rate(real, metric)
        assert (rate <= -np.linalg.eigvals(real).real.max(axis=-1) + 1e-9).all()
        # and it does where the error is smaller, in the metric, than the model's own rate
        theta = np.linalg.cholesky(metric).T
        size = np.linalg.norm(theta @ (real - loop) @ np.linalg.inv(theta), 2, axis=(-2, -1))
        small = (
            loop + (real - loop) * (0.999 * contraction_rate(loop, metric) / size)[:, None, None]
        )
        assert (contraction_rate(small, metric) > 0).all()


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


EYE, FOUND = np.eye(2), circle_criterion(2.0, 0.8, 2.4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ErrorBall(EYE, 0.0), "rate needs"),
        (lambda: ErrorBall(EYE, np.nan), "rate needs finite"),
        (lambda: ErrorBall(EYE, 1.0, room=np.nan), "room needs"),
        (lambda: ErrorBall(-EYE, 1.0), "positive definite"),
        (lambda: ErrorBall(np.ones((2, 3)), 1.0), "metric needs shape"),
        (lambda: ErrorBall([[1.0, 0.5], [0.0, 1.0]], 1.0), "symmetric"),
        (lambda: ErrorBall(EYE, 1.0, np.ones((3, 1))), "channel"),
        (lambda: ErrorBall(EYE, 1.0, None, -1.0), "period"),
        (lambda: ErrorBall(EYE, 1.0).radius(-1.0), "size needs"),
        (lambda: ErrorBall(EYE, 1.0).bound(-1.0, 0.0, 1.0), "time needs"),
        (lambda: ErrorBall.of(circle_criterion(0.1, 0.8, 2.4)), "without a certificate"),
        (lambda: ErrorBall.of(FOUND, period=0.01), "does not go with"),
        (lambda: ErrorBall.of(replace(FOUND, kind="frozen")), "without a certificate"),
        (lambda: ErrorBall(EYE, 1.0).output_bound("abc", 0.0, 0.0, 1.0), "row needs real numbers"),
        (lambda: ErrorBall.of(EYE), "certificate needs a Certificate"),
        (lambda: random_disturbances(np.random.default_rng(0), 0, 1, 1.0, step=0.1), "steps needs"),
        (lambda: nominal_metric(EYE), "stable loops"),
        (lambda: nominal_metric(-EYE, share=1.0), "share"),
        (lambda: nominal_metric(np.full((2, 2), np.nan)), "jacobian needs finite"),
    ],
)
def test_bad_arguments_are_named(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
