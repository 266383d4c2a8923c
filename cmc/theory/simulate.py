"""Fixed-step simulation of a plant, alone or in a loop with integral action.

Everything is batched: a cloud of trajectories costs one call. The fixed step keeps pairs of
trajectories comparable sample by sample, which the measured rates of `contraction` rely on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Dynamics(Protocol):
    """Anything with y' = f(y, u, t), `cmc.plants` among them."""

    n: int

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Time derivative, (..., n)."""


@dataclass(frozen=True)
class Path:
    """A simulated loop.

    Attributes:
        times: (T,), s.
        y: Latent signal, (T, ..., n).
        u: Command applied from each time on, (T, ..., n).
        integral: Integral of the policy's signal, (T, ..., n).
    """

    times: Array
    y: Array
    u: Array
    integral: Array


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


def simulate_loop(
    plant: Dynamics,
    command: Callable[[Array, Array], Array],
    start: ArrayLike,
    times: ArrayLike,
    *,
    signal: Callable[[Array], Array] | None = None,
    h: float | None = None,
    integral: ArrayLike = 0.0,
) -> Path:
    """Simulate u = command(y, I) with I = int signal(y) dt around a plant.

    Continuous by default. With a sample time `h` the command is held between samples and the
    integral is I_k = I_{k-1} + h z_k, the new value included; `times` then sets the steps of the
    integrator and every one must fit into a hold: h a multiple of the (uniform) step.

    Args:
        plant: Has `f(y, u, t)`.
        command: Maps y and I, each (..., n), to u (..., n).
        start: Initial y, (..., n).
        times: Increasing, uniform where `h` is given, s, (T,).
        signal: What is integrated, z(y); y itself by default.
        h: Sample time of the zero-order hold, s; continuous without it.
        integral: Initial I, broadcast to the shape of y.

    Raises:
        ValueError: if `h` is not a multiple of the step, or shapes do not fit.
    """
    signal = (lambda y: y) if signal is None else signal
    times, y0 = np.asarray(times, dtype=float), np.array(start, dtype=float)
    if y0.ndim == 0 or y0.shape[-1] != plant.n:
        raise ValueError(f"start needs shape (..., {plant.n}), got {y0.shape}")
    I0 = np.broadcast_to(np.asarray(integral, dtype=float), y0.shape).copy()
    if h is not None:
        return _sampled(plant, command, y0, times, signal, h, I0)
    n = plant.n

    def rhs(t: float, s: Array) -> Array:
        y, I = s[..., :n], s[..., n:]
        return np.concatenate([plant.f(y, command(y, I), t), signal(y)], axis=-1)

    path = rk4(rhs, np.concatenate([y0, I0], axis=-1), times)
    y, I = path[..., :n], path[..., n:]
    u = np.stack([np.broadcast_to(command(a, b), y0.shape) for a, b in zip(y, I, strict=True)])
    return Path(times, y, u, I)


def _sampled(
    plant: Dynamics,
    command: Callable[[Array, Array], Array],
    y: Array,
    times: Array,
    signal: Callable[[Array], Array],
    h: float,
    I: Array,
) -> Path:
    step = float(times[1] - times[0])
    per_hold = round(h / step)
    if per_hold < 1 or not np.allclose(np.diff(times), step) or abs(per_hold * step - h) > 1e-9 * h:
        raise ValueError(f"h = {h} s needs to be a multiple of the uniform step {step} s of times")
    shape = (len(times), *y.shape)
    ys, us, Is = np.empty(shape), np.empty(shape), np.empty(shape)
    u = np.zeros_like(y)
    for k, t in enumerate(times):
        if k % per_hold == 0:
            I = I + h * signal(y)
            u = np.broadcast_to(command(y, I), y.shape)
        ys[k], us[k], Is[k] = y, u, I
        if k + 1 < len(times):
            y = _rk4_step(lambda at, s, u=u: plant.f(s, u, at), float(t), y, step)  # type: ignore[misc]
    return Path(times, ys, us, Is)
