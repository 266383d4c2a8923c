"""Ellipsoids that a disturbed loop never leaves, and the metric that makes them small.

The error ball adds up the worst decay and the worst push as if they met in one direction. Looking
at both together is sharper in the same metric. If for every Jacobian J of the loop

    J^T M + M J + a M + (s / a) M B B^T M <= 0,

then V = ||Theta (xi_1 - xi_0)||^2 obeys V' <= -a V + (a / s) ||d||^2, so that for ||d|| <= size

    V(t) <= e^{-a t} V(0) + (1 - e^{-a t}) size^2 / s.

The condition is affine in J: corners of the slopes are enough. (Boyd et al. 1994, section 6.1.3;
Abedor, Nagpal, Poolla 1996.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from cmc.theory.arrays import Array, checked, count
from cmc.theory.contraction import metric_factor


@dataclass(frozen=True)
class Ellipsoid:
    """Set of differences xi_1 - xi_0 that disturbances of size 1 cannot leave, from 0."""

    metric: Array
    """M, (n, n)."""
    reach: float
    """Radius in the metric, 1 / sqrt(s); infinite if the metric proves nothing."""
    decay: float
    """a in 1/s: squared distances fade at least so fast."""

    def distance(self, difference: ArrayLike) -> Array:
        """Length in the metric of differences (..., n)."""
        return np.linalg.norm(np.asarray(difference, float) @ metric_factor(self.metric).T, axis=-1)

    def bound(self, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest distance in the metric at `time` (s), from distance `start` at time 0."""
        fading = np.exp(-self.decay * np.asarray(time, float))
        squared = fading * np.square(start) + (1.0 - fading) * (size * self.reach) ** 2
        return np.sqrt(squared)

    def output_bound(self, row: ArrayLike, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest |row delta| at `time`; `row` is (n,)."""
        return _length(self.metric, row) * self.bound(time, start, size)


def _length(metric: Array, row: ArrayLike) -> float:
    """||Theta^{-T} row||: the largest |row delta| on the unit sphere of the metric."""
    return float(np.linalg.norm(np.linalg.solve(metric_factor(metric).T, np.asarray(row, float))))


def reach(
    jacobians: ArrayLike, metric: ArrayLike, channel: ArrayLike, *, samples: int = 40
) -> Ellipsoid:
    """Smallest ellipsoid of a given metric.

    Args:
        jacobians: corners of the loop's Jacobian, (V, n, n) or (n, n).
        metric: M, (n, n).
        channel: B, (n, m).
        samples: values of a that are tried.
    """
    J, M = checked("jacobians", jacobians, "... n n"), checked("metric", metric, "n n")
    J = J.reshape(-1, *J.shape[-2:])
    checked("jacobians", J, "V n n", n=len(M))
    theta, samples = metric_factor(M), count("samples", samples, 10_000)
    push = theta @ checked("channel", channel, "n m", n=len(M))
    local = theta @ J @ np.linalg.inv(theta)
    local = local + np.swapaxes(local, -1, -2)
    slowest = -float(np.linalg.eigvalsh(local)[:, -1].max())
    if slowest <= 0.0:
        return Ellipsoid(M, np.inf, 0.0)
    a = slowest * np.linspace(0.02, 0.98, samples)
    room = -(local + a[:, None, None, None] * np.eye(len(M)))  # (samples, V, n, n), positive
    # s push push^T / a <= room   if and only if   s push^T room^{-1} push <= a
    needed = push.T @ np.linalg.solve(room, np.broadcast_to(push, (*room.shape[:2], *push.shape)))
    s = a / np.linalg.eigvalsh(needed)[..., -1].max(axis=-1)
    best = int(np.argmax(s))
    return Ellipsoid(M, float(1.0 / np.sqrt(s[best])), float(a[best]))


def shape_metric(
    jacobians: ArrayLike,
    metric: ArrayLike,
    channel: ArrayLike,
    row: ArrayLike,
    *,
    rounds: int = 3,
    evaluations: int = 800,
) -> Ellipsoid:
    """Change a metric until the ellipsoid promises as little error of one signal as it can.

    A local search over the Cholesky factor (Nelder-Mead, restarted): what it returns is proved,
    because `reach` is, but a better metric may exist.

    Args:
        jacobians: corners of the loop's Jacobian, (V, n, n).
        metric: where to begin: one in which all corners contract.
        channel: B, (n, m).
        row: the signal, row xi, (n,).
        rounds: restarts.
        evaluations: of each round.

    Raises:
        ValueError: if the corners do not contract in `metric`.
    """
    M = checked("metric", metric, "n n")
    row = checked("row", row, "n", n=len(M))
    rounds, evaluations = count("rounds", rounds, 100), count("evaluations", evaluations)
    if not np.isfinite(reach(jacobians, M, channel, samples=12).reach):
        raise ValueError("the loop does not contract in the metric to begin with")
    corner = np.tril_indices(len(M))

    def candidate(x: Array) -> Array:
        L = np.zeros_like(M)
        L[corner] = x
        return L @ L.T

    def promise(x: Array) -> float:
        try:
            found = reach(jacobians, candidate(x), channel, samples=12)
            return float(np.log(_length(found.metric, row) * found.reach))
        except (ValueError, np.linalg.LinAlgError):
            return 1e9  # not positive definite to rounding

    scale = np.sqrt(np.trace(M))
    x = np.linalg.cholesky(M)[corner] / scale
    options = {"maxfev": evaluations, "adaptive": True, "xatol": 1e-4, "fatol": 1e-5}
    for _ in range(rounds):
        x = minimize(promise, x, method="Nelder-Mead", options=options).x
    return reach(jacobians, candidate(x), channel)
