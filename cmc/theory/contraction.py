"""Contraction: how fast trajectories forget where they started, measured and derived.

A system contracts at `rate` > 0 if the distance of any two trajectories obeys

    d(t) <= overshoot e^{-rate t} d(0).

Measured: `rate_from_cloud` fits the two numbers to simulated trajectories.
Derived: `contraction_rate` reads the rate off the differential dynamics in a metric, which also
bounds the overshoot by sqrt(cond(M)). The first sees what happened, the second what must happen.
(appendix A; Lohmiller and Slotine, Automatica 34, 1998.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_lyapunov

from cmc.theory.arrays import Array, checked, count, number

_MAX_PAIRS = 4000


@dataclass(frozen=True)
class Decay:
    """d(t) <= overshoot e^{-rate t} d(0), fitted to trajectories.

    Attributes:
        rate: Contraction rate, 1/s; negative where the distance grows.
        overshoot: Smallest constant, at least 1, for which the bound holds at every sample.
        ratio: Largest distance at each time over the initial one, (T,).
        times: The times of the samples, s, (T,).
    """

    rate: float
    overshoot: float
    ratio: Array
    times: Array

    @property
    def bound(self) -> Array:
        """The fitted bound overshoot e^{-rate t} at `times`, (T,)."""
        return self.overshoot * np.exp(-self.rate * (self.times - self.times[0]))


def rate_from_cloud(times: ArrayLike, paths: ArrayLike, metric: ArrayLike | None = None) -> Decay:
    """Fit rate and overshoot to the worst pair of a cloud of trajectories.

    The ratio d_ij(t) / d_ij(0) is taken over all pairs (a fixed random 4000 of them if there are
    more), its largest value at each time is replaced by its monotone envelope, so that a distance
    that swings through zero does not count as small, and the log of that is fitted by a line over
    the second half of the decay. The overshoot then makes the bound hold at every sample.

    Args:
        times: Increasing times, s, (T,) with T >= 3.
        paths: Trajectories, (T, N, n) with N >= 2.
        metric: Positive definite M of the distance, (n, n); identity by default.

    Raises:
        ValueError: for wrong shapes, values that are not finite, or equal starts.
    """
    times = checked("times", times, "time")
    if len(times) < 3 or not (np.diff(times) > 0).all():
        raise ValueError("times needs at least 3 increasing values")
    paths = checked("paths", paths, "time N n", time=len(times))
    if paths.shape[1] < 2:
        raise ValueError(f"paths needs shape ({len(times)}, N >= 2, n), got {paths.shape}")
    i, j = np.triu_indices(paths.shape[1], 1)
    if len(i) > _MAX_PAIRS:
        keep = np.random.default_rng(0).choice(len(i), _MAX_PAIRS, replace=False)
        i, j = i[keep], j[keep]
    difference = paths[:, i] - paths[:, j]
    if metric is not None:
        difference = difference @ metric_factor(metric).T
    distance = np.linalg.norm(difference, axis=-1)
    if (distance[0] == 0).any():
        raise ValueError("two trajectories have the same start; their distance says nothing")
    return _fit(times, (distance / distance[0]).max(axis=1))


def _fit(times: Array, ratio: Array) -> Decay:
    growing = int(np.argmax(ratio)) > len(ratio) // 2
    envelope = np.maximum.accumulate(ratio) if growing else np.maximum.accumulate(ratio[::-1])[::-1]
    # below the floor the difference of two nearly equal numbers is rounding, not distance
    usable = envelope > 1e-11
    last = int(usable.sum())
    if last < 3:
        raise ValueError("the distance vanishes within two samples: sample more finely")
    late = slice(last // 2, last) if last >= 6 else slice(0, last)
    rate = -float(np.polyfit(times[late], np.log(envelope[late]), 1)[0])
    scaled = ratio[:last] * np.exp(rate * (times[:last] - times[0]))
    return Decay(rate=rate, overshoot=float(scaled.max()), ratio=ratio, times=times)


def metric_factor(metric: ArrayLike) -> Array:
    """Upper triangular Theta with M = Theta^T Theta, (..., n, n).

    Raises:
        ValueError: if the metric is not symmetric positive definite.
    """
    metric = checked("metric", metric, "... n n")
    flipped = np.swapaxes(metric, -1, -2)
    if not np.allclose(metric, flipped, rtol=1e-6):
        raise ValueError("a metric needs to be symmetric")
    try:
        factor = np.linalg.cholesky((metric + flipped) / 2)
        return np.asarray(np.swapaxes(factor, -1, -2), dtype=np.float64)
    except np.linalg.LinAlgError:
        lowest = float(np.linalg.eigvalsh((metric + flipped) / 2).min())
        raise ValueError(
            f"a metric needs to be positive definite; its smallest eigenvalue is {lowest:.3g}"
        ) from None


def matrix_measure(J: ArrayLike, norm: float = 2) -> Array:
    """Logarithmic norm mu(J) = lim (||I + h J|| - 1) / h, (...,), 1/s.

    The fastest growth of any distance in that norm: mu_2 is the largest eigenvalue of the symmetric
    part, mu_inf and mu_1 sum the absolute values off the diagonal along rows and columns.

    Raises:
        ValueError: if `norm` is not 1, 2 or infinity.
    """
    J = checked("J", J, "... n n")
    if norm == 2:
        rate = np.linalg.eigvalsh((J + np.swapaxes(J, -1, -2)) / 2)[..., -1]
        return np.asarray(rate, dtype=np.float64)
    if norm not in (1, np.inf):
        raise ValueError(f"norm needs to be 1, 2 or infinity, got {norm}")
    diagonal = np.diagonal(J, axis1=-2, axis2=-1)
    off = np.abs(J).sum(axis=-1 if norm == np.inf else -2) - np.abs(diagonal)
    return (diagonal + off).max(axis=-1)


def contraction_rate(
    J: ArrayLike, metric: ArrayLike | None = None, metric_dot: ArrayLike | None = None
) -> Array:
    """Rate that the differential dynamics have in a metric, (...,), 1/s.

    The largest beta with J^T M + M J + M' <= -2 beta M, that is -mu_2 of the generalised Jacobian
    (Theta' + Theta J) Theta^-1 with M = Theta^T Theta.

    Args:
        J: Jacobians, (..., n, n).
        metric: M, (..., n, n); identity by default.
        metric_dot: Derivative of M along the trajectory, (..., n, n); zero by default.

    Raises:
        ValueError: if the metric is not symmetric positive definite.
    """
    J = checked("J", J, "... n n")
    if metric is None:
        return -matrix_measure(J)
    theta = metric_factor(metric)
    inverse = np.linalg.inv(theta)
    generalised = theta @ J @ inverse
    if metric_dot is not None:
        moving = checked("metric_dot", metric_dot, "... n n", n=J.shape[-1])
        turn = np.swapaxes(inverse, -1, -2) @ moving @ inverse
        generalised = generalised + turn / 2
    return -matrix_measure(generalised)


def contraction_factor(transition: ArrayLike, metric: ArrayLike) -> Array:
    """Factor by which one step of a sampled loop shrinks distances in a metric, (...,).

    The spectral norm of Theta Phi Theta^-1: below 1 the step contracts.
    """
    theta = metric_factor(metric)
    return np.linalg.norm(
        theta @ checked("transition", transition, "... n n") @ np.linalg.inv(theta),
        2,
        axis=(-2, -1),
    )


def lyapunov_metric(J: ArrayLike, rate: float = 0.0) -> Array:
    """Metric in which a constant Jacobian contracts faster than `rate`, (n, n).

    Solves (J + rate I)^T M + M (J + rate I) = -I, scaled to a smallest eigenvalue of 1.

    Raises:
        ValueError: if some eigenvalue of J has a real part of -rate or more.
    """
    J, rate = checked("J", J, "n n"), number("rate", rate)
    slowest = float(np.linalg.eigvals(J).real.max())
    if slowest >= -rate:
        raise ValueError(
            f"no metric contracts at {rate:g} 1/s: an eigenvalue has real part {slowest:.4g} 1/s"
        )
    shifted = J + rate * np.eye(len(J))
    metric = solve_continuous_lyapunov(shifted.T, -np.eye(len(J)))
    metric = (metric + metric.T) / 2
    return metric / np.linalg.eigvalsh(metric)[0]


def overshoot(metric: ArrayLike) -> Array:
    """Bound on the Euclidean transient that a metric allows: sqrt(cond(M)), (...,)."""
    return np.sqrt(np.linalg.cond(checked("metric", metric, "... n n")))


def floquet_multipliers(jacobian: Callable[[float], Array], period: float, n: int = 2) -> Array:
    """Eigenvalues of the map over one period of s' = J(t) s, complex, (n,), largest first.

    A periodic linear system decays exactly if all of them lie inside the unit circle; eigenvalues
    of J at single instants decide nothing.

    Args:
        jacobian: J(t), (n, n), with the given period.
        period: Period, s.
        n: Size of J.
    """
    period, n = number("period", period, above=0.0), count("n", n, 100)
    checked("jacobian(0)", jacobian(0.0), "n n", n=n)

    def variational(t: float, flat: Array) -> Array:
        return (jacobian(t) @ flat.reshape(n, n)).ravel()

    end = solve_ivp(variational, (0.0, period), np.eye(n).ravel(), rtol=1e-10, atol=1e-12)
    multipliers = np.linalg.eigvals(end.y[:, -1].reshape(n, n)).astype(complex)
    return multipliers[np.argsort(-np.abs(multipliers))]
