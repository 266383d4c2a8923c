"""Lesson 06, second half: a two-link arm whose latent model is made of gains, or learned.

The task-space controller asks for p = x_d'' + K_d e' + K_p e + u, so that with the right masses
e'' + K_d e' + K_p e + u = 0 and A y' + B y + u = 0 hold whatever the pose. With wrong masses the
gains no longer tell the whole latent model, and data have to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import expm

from cmc.policies import ModularPolicy, PositiveNetwork, as_numpy
from cmc.robot.two_link import TwoLinkArm, simulate
from cmc.theory.composite import CompositeModel, composite
from cmc.theory.identification import LatentFit, fit_latent

Array = NDArray[np.float64]
Policy = Callable[[Array], Array]

ARM = TwoLinkArm()
K_P, K_D = 40.0, 20.0
DT = 0.005  # s, one control step
WEIGHT = 0.8  # weights are drawn from 0 to this
SLOPES = (15.0, 90.0)  # caps of the policy: signal, integral (1/s)
CENTER, RADIUS, TURN = np.array([0.45, 0.05]), 0.08, 2.0  # m, m, rad/s


def circle(t: float) -> tuple[Array, Array, Array]:
    """Target on a circle: position, velocity, acceleration, (2,) each."""
    c, s = np.cos(TURN * t), np.sin(TURN * t)
    arm = RADIUS * np.array([c, s])
    return CENTER + arm, TURN * RADIUS * np.array([-s, c]), -(TURN**2) * arm


def believed(mass_error: float) -> TwoLinkArm:
    """The arm the controller believes in: masses off by a share, -0.3 for 30 % too light."""
    return TwoLinkArm(masses=(ARM.masses[0] * (1 + mass_error), ARM.masses[1] * (1 + mass_error)))


def tracking(policy: Policy, starts: Array, mass_error: float = 0.0, seconds: float = 2.5) -> dict:
    """Follow the circle from several starts; u = policy(s), s = (y, integral of y) (B, 2, 2).

    Returns:
        t (T,), tip (T, B, 2), e and y (T, B, 2), u (T, B, 2), and `y_model`: the latent model
        made of the gains, driven by the same u.
    """
    model, controller = composite([K_P, K_P], [K_D, K_D]), believed(mass_error)
    t = np.arange(0.0, seconds + DT / 2, DT)
    log: dict[str, list[Array]] = {"y": [], "u": [], "e": []}
    integral = np.zeros_like(starts)

    def torque(time: float, q: Array, dq: Array) -> Array:
        x_d, v_d, a_d = circle(time)
        e = x_d - ARM.position(q)
        e_dot = v_d - np.einsum("...ij,...j->...i", ARM.jacobian(q), dq)
        y = model.y(e, e_dot)
        integral[...] += DT * y
        u = policy(np.stack([y, integral], axis=-1))
        for name, value in (("y", y), ("u", u), ("e", e)):
            log[name].append(value)
        return controller.task_torque(q, dq, a_d + K_D * e_dot + K_P * e + u)

    q, _ = simulate(ARM, torque, ARM.reach(starts), np.zeros_like(starts), np.append(t, t[-1] + DT))
    out = {name: np.array(values) for name, values in log.items()}
    return out | {
        "t": t,
        "tip": ARM.position(q[:-1]),
        "y_model": predict(model, out["y"], out["u"]),
    }


def predict(model: CompositeModel, y: Array, u: Array) -> Array:
    """Latent model made of gains, run from y[0] under the recorded, held u, (T, ..., n)."""
    decay = np.exp(-model.latent_rate * DT)
    out = np.empty_like(y)
    out[0] = y[0]
    for k in range(1, len(y)):
        out[k] = decay * out[k - 1] - (1 - decay) / model.B_lat * u[k - 1]  # LTI, held u
    return out


def no_policy(s: Array) -> Array:
    """No learned part, u = 0."""
    return np.zeros(s.shape[:-1])


def positive_policy(seed: int, sign: float = 1.0) -> Policy:
    """An untrained positive network behind the sign rule; `sign` -1 breaks the rule.

    No biases, so that u = 0 at s = 0; slopes are capped, so that the held torque stays stable.
    """
    model = composite([K_P, K_P], [K_D, K_D])
    network = PositiveNetwork(
        2, hidden=(16, 16), seeds=None, bias=False, slope_max=SLOPES, dtype=torch.float64
    )
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(WEIGHT * torch.rand(parameter.shape, generator=generator))
    run = as_numpy(ModularPolicy(network, R=sign * model.f_u))
    return lambda s: np.asarray(run(s.reshape(*s.shape[:-2], -1)), dtype=float)


def ring_of_starts(number: int = 8, distance: float = 0.06) -> Array:
    """Tip positions around the first target, (number, 2), m."""
    angles = np.linspace(0.0, 2 * np.pi, number, endpoint=False)
    return circle(0.0)[0] + distance * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def excite(mass_error: float, count: int, noise: float = 0.0, seed: int = 0) -> dict:
    """Transitions (y, u, y_next) near one pose; commands are held for 20 ms, torques for 1 ms."""
    rng = np.random.default_rng(seed)
    model, controller = composite([K_P, K_P], [K_D, K_D]), believed(mass_error)
    x_d = CENTER
    starts = x_d + 0.01 * rng.normal(size=(count, 2))
    u = 3.0 * rng.normal(size=(count, 2))
    q = ARM.reach(starts)
    push = 0.05 * rng.normal(size=(count, 2, 1))
    dq = np.asarray(np.linalg.solve(ARM.jacobian(q), push)[..., 0], dtype=float)

    def latent(q: Array, dq: Array) -> tuple[Array, Array, Array]:
        e = x_d - ARM.position(q)
        e_dot = -np.einsum("...ij,...j->...i", ARM.jacobian(q), dq)
        return e, e_dot, model.y(e, e_dot)

    def torque(time: float, q: Array, dq: Array) -> Array:
        e, e_dot, _ = latent(q, dq)
        return controller.task_torque(q, dq, K_D * e_dot + K_P * e + u)

    path = simulate(ARM, torque, q, dq, 1e-3 * np.arange(21))
    after = latent(path[0][-1], path[1][-1])[2]
    before = latent(q, dq)[2]
    y, y_next = (v + noise * rng.normal(size=v.shape) for v in (before, after))
    return {"y": y, "u": u, "y_next": y_next, "dt": 0.02}


def learn(mass_error: float, count: int = 2000, noise: float = 0.0, seed: int = 0) -> LatentFit:
    """Learn f_y and f_u of the arm under its controller from random transitions."""
    return fit_latent(**excite(mass_error, count, noise=noise, seed=seed))


def model_errors(mass_error: float, count: int = 1000) -> dict[str, Any]:
    """Unexplained share of the change of y over 20 ms on fresh data, rms: three models.

    "gains" is the model made of gains, "gains and a constant" adds the best constant, "learned" is
    the fit.
    """
    model, fit = composite([K_P, K_P], [K_D, K_D]), learn(mass_error)
    fresh = excite(mass_error, count, seed=99)
    y, u, dt = fresh["y"], fresh["u"], fresh["dt"]
    decay = np.exp(-model.latent_rate * dt)
    by_gains = decay * y - (1 - decay) / model.B_lat * u
    n = 2
    generator = np.zeros((2 * n + 1, 2 * n + 1))
    generator[:n] = np.column_stack([fit.f_y, fit.f_u, fit.f_0])
    learned = np.column_stack([y, u, np.ones(len(y))]) @ expm(generator * dt)[:n].T
    change = fresh["y_next"] - y

    def share(error: Array) -> float:
        return float(np.sqrt(np.mean(error**2) / np.mean(change**2)))

    return {
        "gains": share(fresh["y_next"] - by_gains),
        "gains and a constant": share(
            fresh["y_next"] - by_gains - np.mean(fresh["y_next"] - by_gains, axis=0)
        ),
        "learned": share(fresh["y_next"] - learned),
        "fit": fit,
        "model": model,
    }
