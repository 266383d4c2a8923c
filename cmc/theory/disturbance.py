"""Disturbances: the worst ones for a linear loop, exactly, and bounded random ones.

The error ball of `cmc.theory.robustness` is an upper bound. What is here says how much of it can
be reached: `worst_constant` (a matrix norm) and `peak_gain` (the worst signal of all, an integral).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.arrays import Array, checked, count, number
from cmc.theory.contraction import metric_factor

KINDS = ("constant", "switching", "sine", "white")


def checked_stable(jacobian: ArrayLike) -> tuple[Array, float]:
    """Return J as a finite Hurwitz matrix, and its largest real part in 1/s.

    Raises:
        ValueError: if it is not square, not finite or not stable.
    """
    J = checked("jacobian", jacobian, "n n")
    abscissa = float(np.linalg.eigvals(J).real.max())
    if not abscissa < 0.0:
        raise ValueError(f"the loop is not stable: largest real part {abscissa:.3g} 1/s")
    return J, abscissa


def _impulse_response(J: Array, channel: ArrayLike, row: ArrayLike, times: Array) -> Array:
    """Rows row e^{J t} B at many times, (..., m)."""
    B, c = checked("channel", channel, "n m", n=len(J)), checked("row", row, "n", n=len(J))
    values, V = np.linalg.eig(J)
    if np.linalg.cond(V) > 1e6:  # nearly defective: the eigenvectors lose too many digits
        slow: Array = c @ expm(times[..., None, None] * J) @ B
        return slow
    modes = (c @ V)[:, None] * np.linalg.solve(V, B)
    return np.real(np.exp(times[..., None] * values) @ modes)


def worst_constant(
    jacobian: ArrayLike, channel: ArrayLike, metric: ArrayLike | None = None
) -> tuple[float, Array]:
    """The constant disturbance of size 1 that displaces a linear loop most, exactly.

    At rest 0 = J xi + B d, so the displacement is -J^{-1} B d, and the largest one is a singular
    value.

    Args:
        jacobian: J, (n, n), Hurwitz.
        channel: B, (n, m).
        metric: measure the displacement in this metric; Euclidean by default.

    Returns:
        The largest displacement per unit of disturbance, and the disturbance (m,) that causes it.

    Raises:
        ValueError: if the loop is not stable.
    """
    J, _ = checked_stable(jacobian)
    theta = np.eye(len(J)) if metric is None else metric_factor(metric)
    _, sizes, directions = np.linalg.svd(
        -theta @ np.linalg.solve(J, checked("channel", channel, "n m", n=len(J)))
    )
    return float(sizes[0]), directions[0]


def worst_signal(
    jacobian: ArrayLike, channel: ArrayLike, row: ArrayLike, times: ArrayLike
) -> tuple[Array, Array]:
    """The disturbance ||d(t)|| <= 1 that makes row xi largest at the last of `times`.

    d(t) points along B^T e^{J^T (T - t)} row^T, and what it reaches is the integral of the length
    of that vector. Evaluated at the middle of each step and held, as in `robustness.respond`.

    Returns:
        Disturbances (steps, m) for the steps between `times` (steps + 1,), and the exact reach
        |row xi(t_k)| of the worst signal aimed at each of `times`, (steps + 1,).
    """
    J, _ = checked_stable(jacobian)
    t = checked("times", times, "time")
    middle = 0.5 * (t[1:] + t[:-1])
    weight = _impulse_response(J, channel, row, t[-1] - middle)
    length = np.linalg.norm(weight, axis=-1, keepdims=True)
    signal = np.divide(weight, length, out=np.zeros_like(weight), where=length > 0.0)
    elapsed = _impulse_response(J, channel, row, middle - t[0])
    reach = np.cumsum(np.linalg.norm(elapsed, axis=-1) * np.diff(t))
    return signal, np.concatenate([[0.0], reach])


def peak_gain(jacobian: ArrayLike, channel: ArrayLike, row: ArrayLike) -> float:
    """Largest |row xi| that any disturbance ||d(t)|| <= 1 can ever cause, from rest.

    The integral of ||row e^{J t} B|| over t >= 0, by Gauss-Legendre panels.

    Args:
        jacobian: J, (n, n), Hurwitz.
        channel: B, (n, m).
        row: (n,).

    Raises:
        ValueError: if the loop is not stable.
    """
    J, abscissa = checked_stable(jacobian)
    values = np.linalg.eigvals(J)
    end, turning = 40.0 / -abscissa, float(np.abs(values.imag).max())
    edges = np.concatenate([[0.0], np.geomspace(1e-3 / np.abs(values).max(), end, 400)])
    if turning > 0.0:  # several panels to each half turn, because the length has kinks
        edges = np.union1d(edges, np.arange(0.0, end, 0.1 * np.pi / turning))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    half = 0.5 * np.diff(edges)[:, None]
    t = edges[:-1, None] + half * (1.0 + nodes)
    length = np.linalg.norm(_impulse_response(J, channel, row, t), axis=-1)
    return float((length * half * weights).sum())


def random_disturbances(
    rng: np.random.Generator, steps: int, batch: int, size: float, *, step: float, m: int = 1
) -> Array:
    """Bounded disturbances of four kinds in turn (`KINDS`), each with ||d(t)|| <= size.

    Trajectory j is of kind KINDS[j % 4]: a constant; one that switches sign at random; a sine of
    random frequency (up to a tenth of the step rate) and phase; an independent draw at each step.

    Args:
        rng: source of randomness.
        steps: number of time steps.
        batch: number of trajectories.
        size: bound on the norm.
        step: s.
        m: dimension of the disturbance.

    Returns:
        Array (steps, batch, m).
    """
    steps, batch, m = count("steps", steps), count("batch", batch), count("m", m)
    size, step = number("size", size, least=0.0), number("step", step, above=0.0)
    direction = rng.normal(size=(batch, m))
    direction *= size / np.linalg.norm(direction, axis=-1, keepdims=True)
    kind = np.arange(batch) % len(KINDS)
    t = step * np.arange(steps)[:, None]
    course = np.ones((steps, batch))
    switching = rng.random((steps, batch)) < rng.uniform(0.001, 0.2, batch)
    frequency = 10.0 ** rng.uniform(-1.0, np.log10(0.1 / step), batch)
    sine = np.sin(2.0 * np.pi * (frequency * t + rng.random(batch)))
    course = np.where(kind == 1, 1.0 - 2.0 * (switching.cumsum(axis=0) % 2), course)
    course = np.where(kind == 2, sine, course)
    course = np.where(kind == 3, rng.uniform(-1.0, 1.0, (steps, batch)), course)
    return course[..., None] * direction
