"""Learned latent signals: what the slopes promise, certificates, and what learning gains."""

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_are

from cmc.policies import PositiveNetwork
from cmc.policies.latent_signal import LatentSignal, Trial, improve
from cmc.robot.two_link import TwoLinkArm
from cmc.theory.certificates import rates_in
from cmc.theory.composite import certify_latent, composite
from cmc.theory.identification import differences
from cmc.theory.simulate import flow

KP, KD = 4.0, 5.0
SIGNAL = {"slope_min": [2.0, 0.5], "slope_max": [6.0, 2.0]}


def policy(n=2, low=(0.2, 0.1), high=(0.8, 0.3), seed=0):
    torch.manual_seed(seed)
    return PositiveNetwork(
        n, hidden=(8,), bias=False, slope_min=low, slope_max=high, dtype=torch.float64
    )


def loop(signal, pi, kp=KP, kd=KD):
    """d/dt (e, e', I) for arrays (..., 3 n), axis by axis (e_1, e_1', I_1, ...)."""

    def rhs(_, s):
        x = torch.as_tensor(s.reshape(*s.shape[:-1], -1, 3))
        with torch.no_grad():
            y = signal(x[..., 0], x[..., 1])
            u = pi(torch.stack([y, x[..., 2]], dim=-1))
        p = kp * x[..., 0] + kd * x[..., 1] + u
        return torch.stack([x[..., 1], -p, y], dim=-1).numpy().reshape(s.shape)

    return rhs


def test_the_composition_contracts_at_the_promised_rate_whatever_was_learned():
    signal = LatentSignal(1, **SIGNAL)
    assert signal(torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)) == 0
    rate = signal.composition_rate[0]
    assert rate >= 2.0 / 2.0 - 1e-9

    def rhs(t, e):  # solve phi(e, e') = y(t) for e' by bisection
        y, low, high = np.sin(3 * t), np.full_like(e, -60.0), np.full_like(e, 60.0)
        for _ in range(60):
            middle = (low + high) / 2
            with torch.no_grad():
                over = signal(torch.as_tensor(e), torch.as_tensor(middle)).numpy() > y
            low, high = np.where(over, low, middle), np.where(over, middle, high)
        return (low + high) / 2

    t = np.linspace(0, 2, 21)
    e = flow(rhs, [[3.0], [-1.0], [0.5]], t, tol=1e-6)[..., 0]
    apart = np.abs(np.diff(e, axis=1))
    assert (apart <= apart[0] * np.exp(-rate * t)[:, None] * (1 + 1e-4)).all()


@pytest.mark.parametrize("h", [None, 0.02])
def test_certificates_bound_every_jacobian_of_the_loop(h):
    signal, pi = LatentSignal(2, **SIGNAL), policy()
    answer = certify_latent(signal, pi, KP, KD, h=h)
    assert answer, str(answer)
    rhs, s = loop(signal, pi), np.random.default_rng(0).normal(size=(300, 6)) * 3

    def step(x):
        """One sample, the command held, I_k = I_{k-1} + h y_k."""
        parts = torch.as_tensor(x.reshape(*x.shape[:-1], 2, 3))
        e, e_dot, I = parts.unbind(-1)
        with torch.no_grad():
            y = signal(e, e_dot)
            I = I + h * y
            p = KP * e + KD * e_dot + pi(torch.stack([y, I], dim=-1))
        after = torch.stack([e + h * e_dot - h * h / 2 * p, e_dot - h * p, I], dim=-1)
        return after.numpy().reshape(x.shape)

    J = differences((lambda x: rhs(0, x)) if h is None else step, s)
    assert rates_in(J, answer.metric, h).min() >= answer.rate - 1e-5


def test_the_hand_made_signal_is_the_case_of_constant_slopes():
    model = composite([KP, KP], [KD, KD])
    answer = certify_latent(model, policy(), KP, KD)
    assert answer
    wild = certify_latent(LatentSignal(2, slope_min=0.01, slope_max=500.0), policy(), KP, KD)
    assert not wild
    assert wild.reason.startswith("axis 1")
    with pytest.raises(ValueError, match="slope_min needs positive"):
        LatentSignal(2, slope_min=[0.0, 1.0], slope_max=[1.0, 2.0])


def test_the_two_link_arm_keeps_the_promise():
    """The arm's task-space law makes e'' = -p exactly, so the certificate is about the arm."""
    arm, goal = TwoLinkArm(), np.array([0.3, 0.4])
    signal, pi = LatentSignal(2, **SIGNAL), policy()
    answer = certify_latent(signal, pi, KP, KD)
    model = loop(signal, pi)

    def errors(s):
        q, dq, I = s[..., :2], s[..., 2:4], s[..., 4:]
        e = goal - arm.position(q)
        e_dot = -(arm.jacobian(q) @ dq[..., None])[..., 0]
        return np.stack([e, e_dot, I], axis=-1).reshape(*s.shape[:-1], 6)

    def rhs(t, s):
        x = errors(s)
        rate = model(t, x).reshape(*s.shape[:-1], 2, 3)
        q, dq = s[..., :2], s[..., 2:4]
        ddq = arm.acceleration(q, dq, arm.task_torque(q, dq, -rate[..., 1]))
        return np.concatenate([dq, ddq, rate[..., 2]], axis=-1)

    tips = goal + 0.05 * np.array([[1, 0], [0, 1], [-1, 1], [0, -1]])
    start = np.concatenate([arm.reach(tips), np.zeros((4, 4))], axis=-1)
    t = np.linspace(0, 3, 31)
    x = errors(flow(rhs, start, t))
    theta = np.linalg.cholesky(answer.metric).T
    apart = np.linalg.norm((x[:, 1:] - x[:, :-1]) @ theta.T, axis=-1)
    assert (apart <= apart[0] * np.exp(-answer.rate * t)[:, None] * (1 + 1e-3)).all()
    assert np.linalg.norm(x[-1].reshape(4, 2, 3)[..., 0], axis=-1).max() < 0.01


def test_learning_the_signal_recovers_most_of_what_the_hand_made_one_costs():
    """Cost int e^2 + .01 p^2: hand-made, learned, and the optimum, which Riccati's equation has."""
    starts = np.array([[[1.0, 0.0]], [[-1.0, 0.5]]])
    trial = Trial(starts, effort=0.01, duration=4.0, steps=60)
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    P = solve_continuous_are(A, B, np.diag([1.0, 0.0]), [[0.01]])
    best = trial.optimum()
    # a sum from the left end of each step counts h/2 of the first e^2 too much
    exact = np.mean([s[0] @ P @ s[0] for s in starts]) + 4.0 / 60 / 2
    assert best == pytest.approx(exact, rel=0.02)
    costs = []
    model = composite(1.0, 2.5)
    hand = lambda e, e_dot: float(model.K1) * e + float(model.K2) * e_dot  # noqa: E731
    for signal in (hand, LatentSignal(1, slope_min=[0.2, 0.05], slope_max=3.0, hidden=(8,))):
        pi = policy(1, low=(0.1, 0.0), high=(20.0, 1e-6))
        found = improve(signal, pi, (1.0, 2.5), trial, updates=60, rate=0.05)
        assert found[-1] < found[0]
        costs.append(found[-1])
    assert best < costs[1] < costs[0]
    assert costs[1] - best < 0.6 * (costs[0] - best)


def test_the_least_cost_counts_what_is_priced():
    """With twice the command priced the optimum is that of four times the effort."""
    starts = [[[1.0, 0.0]]]
    double = Trial(starts, 0.01, 2.0, 20, priced=lambda e, e_dot, p: 2 * p).optimum()
    assert double == pytest.approx(Trial(starts, 0.04, 2.0, 20).optimum(), rel=1e-4)
