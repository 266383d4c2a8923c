"""Lesson 01, contraction: parameters in, arrays out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cmc import plants
from cmc.theory.certificates import circle_criterion
from cmc.theory.contraction import (
    contraction_rate,
    floquet_multipliers,
    lyapunov_metric,
    matrix_measure,
    overshoot,
    rate_from_cloud,
)
from cmc.theory.simulate import rk4

Array = NDArray[np.float64]
Plane = dict[str, Any]

# The running example's slow mode decays at 0.634 1/s; this metric of it proves a bit less.
_RATE = 0.3


def circle_of_starts(number: int, radius: float, center: Any = (0.0, 0.0)) -> Array:
    """Starting points on a circle, (number, 2)."""
    angle = 2 * np.pi * np.arange(number) / number
    return np.asarray(center, dtype=float) + radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def shifted(push: float) -> Plane:
    """The coupled lags under an unknown constant push, seen by Lyapunov and by contraction.

    Args:
        push: Size of the unknown command, along (0.3, 1).

    Returns:
        `t` (m,), `paths` (m, 8, 2), `V` (m, 8) the Lyapunov function of the unpushed system,
        `distance` (m, 7) to the first trajectory, `rest` (1, 2) the shifted equilibrium.
    """
    plant = plants.get("coupled_lags")
    u = push * np.array([0.3, 1.0])
    t = np.linspace(0, 8, 241)
    rest = -np.linalg.solve(plant.f_y(np.zeros(2), u), plant.f(np.zeros(2), u))
    paths = rk4(lambda _, y: plant.f(y, u), circle_of_starts(8, 2.0), t)
    M = lyapunov_metric(plant.f_y(np.zeros(2), u), _RATE)
    V = np.einsum("tni,ij,tnj->tn", paths, M, paths)
    distance = np.linalg.norm(paths[:, 1:] - paths[:, :1], axis=-1)
    text = f"V ends at {V[-1].max():.3g}; the largest distance ends at {distance[-1].max():.2g}"
    return {"t": t, "paths": paths, "V": V, "distance": distance, "rest": rest[None], "text": text}


def sheared(shear: float, wanted: float = 0.8) -> Plane:
    """Two fixed modes, -1 and -1.5 1/s, whose eigenvectors lean on each other.

    The metric is diag(1, d) with the smallest d >= 1 that proves `wanted`: the symmetric part of
    [[-1, shear/sqrt(d)], [0, -1.5]] is at most -wanted if d = shear^2 / (4 (1 - wanted)
    (1.5 - wanted)).

    Args:
        shear: Entry (1, 2) of the matrix, 1/s; the eigenvalues do not depend on it.
        wanted: Rate that the metric has to prove, below 1 1/s.

    Returns:
        `t`; `growth` (m,), the worst growth ||e^{A t}|| of a distance; `euclid` (m,), its bound
        from the matrix measure; `metric` (m,), its bound from a metric; `paths` (m, 24, 2);
        `ball` (k, 2), the unit circle of the metric; the two rates and the bound of the overshoot.
    """
    A = np.array([[-1.0, shear], [0.0, -1.5]])
    t = np.linspace(0, 6, 181)
    step = expm(A * t[1])
    powers = [np.eye(2)]
    for _ in t[1:]:
        powers.append(step @ powers[-1])
    flow = np.stack(powers)
    M = np.diag([1.0, max(1.0, shear**2 / (4 * (1 - wanted) * (1.5 - wanted)))])
    rate, euclid = float(contraction_rate(A, M)), float(-matrix_measure(A))
    bound = float(overshoot(M))
    directions = circle_of_starts(97, 1.0)
    growth = np.linalg.norm(flow, 2, axis=(-2, -1))
    return {
        "t": t,
        "growth": growth,
        "euclid": np.clip(np.exp(-euclid * t), 1e-4, 1e4),
        "metric": bound * np.exp(-rate * t),
        "paths": np.einsum("tij,nj->tni", flow, circle_of_starts(24, 1.0)),
        "ball": directions / np.sqrt(np.diag(M)),
        "text": f"rate in the plain distance {euclid:.2f} 1/s, in the metric {rate:.2f} 1/s; "
        f"the distance grows at most {growth.max():.2f}-fold, the metric allows {bound:.2f}",
        "rate": rate,
        "euclid_rate": euclid,
        "peak": float(growth.max()),
        "bound": bound,
    }


def pushed_pendulum(damping: float, torque: float, number: int = 21) -> Plane:
    """Pendulums with different starts under one periodic torque.

    Args:
        damping: Damping over inertia, 1/s.
        torque: Amplitude of the torque over the inertia, with cos(2 t), rad/s^2.
        number: Number of starts.

    Returns:
        `t`, `angle` (m, number), `paths` (m, number, 2), `ratio` (m,) the largest distance over the
        initial one, the fitted `rate` in 1/s and `overshoot`, and `proved`, the rate that one
        metric proves as long as every angle stays within 1.2 rad (NaN if none does).
    """
    plant = plants.Pendulum(damping=damping, stiffness=1.0)
    t = np.linspace(0, 20, 301)
    rng = np.random.default_rng(1)
    starts = rng.uniform([-1.0, -0.6], [1.0, 0.6], (number, 2))

    def rhs(time: float, y: Array) -> Array:
        return plant.f(y, np.array([0.0, torque * np.cos(2 * time)]), time)

    paths = rk4(rhs, starts, t)
    measured = rate_from_cloud(t, paths)
    proof = circle_criterion(damping, float(np.cos(1.2)), 1.0)
    said = f"{proof.rate:.2f} 1/s" if proof else "none"
    return {
        "t": t,
        "angle": paths[..., 0],
        "paths": paths,
        "ratio": np.maximum(measured.ratio, 1e-12),
        "rate": measured.rate,
        "overshoot": measured.overshoot,
        "proved": proof.rate,
        "text": f"measured rate {measured.rate:.2f} 1/s; proved for angles up to 1.2 rad: {said}",
    }


def van_der_pol_cycle(mu: float = 1.0, number: int = 12) -> Plane:
    """Van der Pol's oscillator: trajectories, their distances, and one turn of the limit cycle.

    Args:
        mu: Strength of the nonlinear damping, 1/s.
        number: Number of starts.

    Returns:
        `t`, `paths` (m, number, 2), `distance` (m, number - 1) to the first trajectory, `cycle`
        (k, 2), its `period` in s and the two `multipliers` of one turn.
    """
    plant = plants.VanDerPol(mu=mu)
    still = np.zeros(2)
    t = np.linspace(0, 25, 501)
    paths = rk4(lambda _, y: plant.f(y, still), circle_of_starts(number, 2.2), t)
    distance = np.linalg.norm(paths[:, 1:] - paths[:, :1], axis=-1)
    # two upward crossings of y1 = 0 late on one trajectory enclose one turn
    times = np.linspace(0, 40, 2001)
    path = rk4(lambda _, y: plant.f(y, still), [2.0, 0.0], times)
    up = np.nonzero((path[:-1, 0] < 0) & (path[1:, 0] >= 0))[0][-2:]
    share = path[up, 0] / (path[up, 0] - path[up + 1, 0])
    start, end = times[up] + share * times[1]
    first, period = path[up[0]] * (1 - share[0]) + path[up[0] + 1] * share[0], float(end - start)
    turn = np.linspace(0, period, 401)
    cycle = rk4(lambda _, y: plant.f(y, still), first, turn)

    def jacobian(time: float) -> Array:
        y = np.array([np.interp(time, turn, cycle[:, i]) for i in (0, 1)])
        return plant.f_y(y, still)

    multipliers = floquet_multipliers(jacobian, period).real
    return {
        "t": t,
        "paths": paths,
        "distance": distance,
        "cycle": cycle,
        "period": period,
        "multipliers": multipliers,
    }


def as_control_system(plant: plants.Plant) -> Any:
    """The plant without command as a nonlinear system of the `control` package."""
    import control

    def update(_: float, y: Array, u: Array, params: dict[str, Any]) -> Array:
        return plant.f(np.asarray(y), np.zeros(2))

    return control.nlsys(update, None, states=2, inputs=0, name=plant.name)
