"""Solve differential equations for a whole batch at once: adaptive, fixed step, and linear ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.arrays import Array, checked

_MOST_STEPS = 100_000
# Dormand and Prince 1980: y + h sum b_i k_i of order 5; _E is its difference to order 4.
_A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_C = (0.2, 0.3, 0.8, 8 / 9, 1.0, 1.0)
_E = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


def flow(
    rhs: Callable[[float, Array], Array], start: ArrayLike, t: ArrayLike, *, tol: float = 1e-8
) -> Array:
    """Solve s' = rhs(t, s) by Dormand and Prince's adaptive method, one step size for the batch.

    Args:
        rhs: Right-hand side, (..., n) to (..., n).
        start: States at t[0], (..., n).
        t: Increasing times at which the states are wanted, s, (time,).
        tol: Largest error of a step, relative to the largest size of that signal so far.

    Returns:
        States, (time, ..., n).

    Raises:
        ValueError: If times do not increase, the start is not finite, or the states explode or
            are so stiff that more than 100,000 steps would be needed.
    """
    times, s = checked("t", t, "time"), checked("start", start, "... n").copy()
    if len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError(f"t needs at least 2 increasing values, got {times}")
    path = np.empty((len(times), *s.shape))
    path[0], now, steps = s, float(times[0]), 0
    batch, first = tuple(range(s.ndim - 1)), rhs(now, s)
    largest = np.abs(s).max(axis=batch, initial=0.0)
    speed = np.abs(first).max(axis=batch, initial=0.0)
    # a first step that moves nothing by more than a hundredth of the whole state
    step = float(times[1] - times[0])
    step = min(step, 0.01 * float(largest.max() / max(speed.max(), 1e-300)) or step)
    for i, end in enumerate(times[1:], 1):
        while now < end:
            h, k = min(step, end - now), [first]
            with np.errstate(over="ignore", invalid="ignore"):
                for row, c in zip(_A, _C, strict=True):
                    new = s + h * sum(a * d for a, d in zip(row, k, strict=True) if a)
                    k.append(rhs(now + c * h, new))
                error = h * sum(e * d for e, d in zip(_E, k, strict=True) if e)
                size = np.maximum(largest, np.abs(new).max(axis=batch, initial=0.0))
                size = np.maximum(size, 1e-6 * size.max()) + 1e-300
                worst = float(np.max(np.abs(error) / (tol * size), initial=0.0))
            if worst <= 1.0:
                now = float(end) if h == end - now else now + h
                s, first, largest = new, k[-1], size
            elif steps > _MOST_STEPS or h < 1e-13 * max(abs(now), end - times[0]):
                raise ValueError(f"the states explode or are too stiff to follow at t = {now:.6g}")
            steps += 1
            if h == step or worst > 1.0:  # not where the end of the interval cut the step short
                step = h * float(np.clip(0.9 * max(worst, 1e-9) ** -0.2, 0.1, 5.0))
                step = step if np.isfinite(worst) else 0.1 * h
        path[i] = s
    return path


def rk4(rhs: Callable[[float, Array], Array], start: ArrayLike, times: ArrayLike) -> Array:
    """Integrate s' = rhs(t, s) with one classical Runge-Kutta step between neighbouring times.

    Args:
        rhs: Right-hand side, (..., n) to (..., n).
        start: Initial states, (..., n).
        times: Increasing times, s, (T,).

    Returns:
        States at `times`, (T, ..., n).

    Raises:
        ValueError: if times do not increase or the start is not finite.
    """
    times, s = np.asarray(times, dtype=float), np.array(start, dtype=float)
    if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
        raise ValueError("times needs at least 2 increasing values")
    if not np.isfinite(s).all():
        raise ValueError("start needs finite values")
    path = np.empty((len(times), *s.shape))
    path[0] = s
    for i, (t, h) in enumerate(zip(times[:-1], np.diff(times), strict=True)):
        path[i + 1] = s = _rk4_step(rhs, float(t), s, float(h))
    return path


def _rk4_step(rhs: Callable[[float, Array], Array], t: float, s: Array, h: float) -> Array:
    a = rhs(t, s)
    b = rhs(t + h / 2, s + h / 2 * a)
    c = rhs(t + h / 2, s + h / 2 * b)
    d = rhs(t + h, s + h * c)
    new: Array = s + h / 6 * (a + 2 * b + 2 * c + d)
    return new


def linear_flow(A: ArrayLike, t: ArrayLike, start: ArrayLike | None = None) -> Array:
    """Solve x' = A x exactly: x(t) = e^(A (t - t_0)) x(t_0).

    Args:
        A: (n, n), 1/s.
        t: Times, s, (time,).
        start: States at t[0], (..., n); without them the maps themselves are returned.

    Returns:
        States (time, ..., n), or maps e^(A (t - t_0)), (time, n, n).
    """
    A, times = checked("A", A, "n n"), checked("t", t, "time")
    maps = expm(A * (times - times[0])[:, None, None])
    if start is None:
        return np.asarray(maps)
    return np.einsum("tij,...j->t...i", maps, checked("start", start, "... n", n=len(A)))
