"""Saturated commands: the set a guarantee is left with, integral windup, and two remedies.

One dimension of the auxiliary space under zero-order hold::

    z' = lam z + r u,    u_k = clip(-(k1 z_k + k2 I_k), low, high)

`low` and `high` are what is left of the command around the value that holds z at rest at 0. A
clipped command has slope 0, so the loop then contracts no faster than the plant by itself and its
integral does not contract at all: with lam < 0 it recovers late (windup), with lam > 0 it may not
recover (`recoverable`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.contraction import metric_factor
from cmc.theory.sampled import hold_lag, sampled_matrix

Array = NDArray[np.float64]

ANTI_WINDUP = ("none", "clamp", "back")


@dataclass(frozen=True)
class SaturatedLoop:
    """One dimension with a clipped proportional-integral command.

    Raises:
        ValueError: if a value is not finite, the limits do not enclose 0, or r, the period or a
            slope is not positive.
    """

    lam: float = -1.0 / 0.0437
    """Eigenvalue of the mode, 1/s (peg touch: the x axis)."""
    r: float = 1.0 / 0.0437
    """Input gain R_ii, positive."""
    k1: float = 1.0
    """Slope on z."""
    k2: float = 20.0
    """Slope on the integral of z, 1/s."""
    low: float = -1.0
    """Smallest command, relative to the one that holds z = 0; negative."""
    high: float = 1.0
    """Largest command, relative to the one that holds z = 0; positive."""
    period: float = 0.01
    """Control period, s."""

    def __post_init__(self) -> None:
        for name in ("lam", "r", "k1", "k2", "low", "high", "period"):
            value = getattr(self, name)
            if not np.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value!r}")
            if name in ("r", "k1", "k2", "period") and not value > 0.0:
                raise ValueError(f"{name} must be positive, got {value!r}")
        if not self.low < 0.0 < self.high:
            raise ValueError(f"wanted low < 0 < high, got {self.low!r} and {self.high!r}")

    def transition(self) -> Array:
        """Matrix of one unclipped sample for the state (z_k, I_{k-1})."""
        return sampled_matrix(self.k1, self.k2, self.lam, self.r, self.period)

    def command_row(self) -> Array:
        """Row c of the unclipped command, u_k = c (z_k, I_{k-1}); I_k holds the new value."""
        return -np.array([self.k1 + self.k2 * self.period, self.k2])

    def unclipped_level(self, metric: ArrayLike) -> float:
        """Radius of the largest ball of the metric in which the command is not clipped.

        min(-low, high) / ||Theta^{-T} c||: the distance from 0 to the nearer limit. In a metric in
        which `transition` contracts, a start inside stays inside, so the guarantee of the
        unclipped loop holds there; disturbances must fit as well (V(0) + radius <= level).
        """
        length = float(np.linalg.norm(np.linalg.solve(metric_factor(metric).T, self.command_row())))
        return min(-self.low, self.high) / length

    def recoverable(self) -> tuple[float, float]:
        """Open interval of z from which *some* admissible command returns to 0.

        With lam > 0 it is r / lam * (low, high) mirrored: outside of it the mode grows even at full
        opposite command. With lam <= 0 it is the whole line.
        """
        if self.lam <= 0.0:
            return -np.inf, np.inf
        return -self.r * self.high / self.lam, -self.r * self.low / self.lam


def simulate_saturated(
    loop: SaturatedLoop,
    start: ArrayLike,
    steps: int,
    *,
    anti_windup: str = "none",
    integral: ArrayLike = 0.0,
) -> tuple[Array, Array, Array]:
    """Run a batch of clipped loops.

    Anti-windup: "clamp" holds the integral while the command is clipped and z pushes it further;
    "back" recomputes the integral so that the unclipped command equals the limit.

    Args:
        loop: the loop.
        start: z_0, (...).
        steps: number of samples.
        anti_windup: one of `ANTI_WINDUP`.
        integral: I_{-1}, broadcast against `start`.

    Returns:
        z (steps + 1, ...), unclipped commands (steps, ...) and integrals (steps, ...).

    Raises:
        ValueError: if the remedy is unknown or `steps` < 1.
    """
    if anti_windup not in ANTI_WINDUP:
        raise ValueError(f"wanted anti_windup in {ANTI_WINDUP}, got {anti_windup!r}")
    if steps < 1:
        raise ValueError(f"wanted at least 1 step, got {steps}")
    a, b = hold_lag(loop.lam, loop.r, loop.period)
    z, total = np.broadcast_arrays(np.asarray(start, float), np.asarray(integral, float))
    path = np.empty((steps + 1, *z.shape))
    raws, integrals = np.empty((steps, *z.shape)), np.empty((steps, *z.shape))
    path[0] = z
    for k in range(steps):
        longer = total + loop.period * z
        raw = -(loop.k1 * z + loop.k2 * longer)
        applied = np.clip(raw, loop.low, loop.high)
        if anti_windup == "clamp":
            further = (raw - applied) * z < 0.0  # a larger integral would push further out
            longer = np.where(further, total, longer)
        elif anti_windup == "back":
            longer = -(applied + loop.k1 * z) / loop.k2
        total = longer
        with np.errstate(over="ignore", invalid="ignore"):
            z = np.clip(a * z + b * applied, -1e12, 1e12)
        path[k + 1], raws[k], integrals[k] = z, raw, total
    return path, raws, integrals


def settling_time(path: Array, band: float, period: float) -> Array:
    """Time in s after which |z| stays within `band`; infinite if it never does.

    Args:
        path: (steps + 1, ...).
        band: positive.
        period: s.
    """
    outside = np.abs(path) > band
    last = path.shape[0] - 1 - np.argmax(outside[::-1], axis=0)
    settled = np.where(outside.any(axis=0), last + 1.0, 0.0) * period
    return np.where(outside[-1], np.inf, settled)


def overshoot(path: Array) -> Array:
    """How far z passes 0, as a share of |z_0|; `path` is (steps + 1, ...)."""
    sign = np.sign(path[0])
    return np.maximum(-(path * sign).min(axis=0), 0.0) / np.abs(path[0])
