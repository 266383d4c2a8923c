r"""The error ball of a contracting loop: how far a bounded disturbance can push it.

A loop xi' = g(xi, t) that contracts at `rate` beta in the constant metric M = Theta^T Theta, and
the same loop with a disturbance, xi' = g(xi, t) + B d, drift apart by at most

    ||Theta (xi_1 - xi_0)|| <= V(0) e^{-beta t} + sup ||Theta B d|| / beta (1 - e^{-beta t}).

Measured in the metric this needs no bounds of M; the paper's form (appendix "Robustness", after
theorem 2.4 of Tsukamoto, Chung, Slotine 2021) is the Euclidean consequence of it, and is looser.
`cmc.theory.disturbance` holds what a disturbance can do at worst, for comparison.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.certificates import Certificate
from cmc.theory.contraction import metric_factor
from cmc.theory.simulate import rk4

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorBall:
    """What a metric and a rate promise about a disturbed loop.

    Raises:
        ValueError: if the metric is not symmetric positive definite, the rate or the period is not
            positive, or the shapes do not fit.
    """

    metric: Array
    """M, (n, n), symmetric positive definite."""
    rate: float
    """beta in 1/s: J^T M + M J <= -2 beta M for every Jacobian J of the loop. For a sampled loop:
    Phi^T M Phi <= e^{-2 beta period} M."""
    channel: Array | None = None
    """B, (n, m): how the disturbance enters; the identity by default."""
    period: float | None = None
    """Control period in s of a sampled loop xi_{k+1} = Phi(xi_k) + B d_k; None means continuous."""
    room: float = np.inf
    """Largest distance in the metric at which it is known to hold: a certificate's `ball`."""
    theta: Array = field(init=False, repr=False)
    """Theta, (n, n), upper triangular, M = Theta^T Theta."""

    def __post_init__(self) -> None:
        metric = np.asarray(self.metric, float)
        if metric.ndim != 2:
            raise ValueError(f"wanted a metric of shape (n, n), got {metric.shape}")
        theta = metric_factor(metric)
        if not (np.isfinite(self.rate) and self.rate > 0.0):
            raise ValueError(
                f"wanted a rate > 0 1/s, got {self.rate!r}: the loop does not contract"
            )
        if self.period is not None and not self.period > 0.0:
            raise ValueError(f"wanted a period > 0 s, got {self.period!r}")
        channel = np.eye(len(metric)) if self.channel is None else np.asarray(self.channel, float)
        if channel.ndim != 2 or len(channel) != len(metric):
            raise ValueError(f"wanted a channel of shape ({len(metric)}, m), got {channel.shape}")
        object.__setattr__(self, "metric", metric)
        object.__setattr__(self, "channel", channel)
        object.__setattr__(self, "theta", theta)

    @classmethod
    def of(
        cls, certificate: Certificate, channel: ArrayLike | None = None, period: float | None = None
    ) -> ErrorBall:
        """Ball of a certified loop, while both trajectories stay in the certificate's region.

        A certificate of a box holds in the box: `fits` says whether the ball around rest does.

        Args:
            certificate: one that holds and is exact: its metric and rate are used.
            channel: B, (n, m).
            period: control period in s, for a certificate of a sampled loop.

        Raises:
            ValueError: if nothing is proved, or the period does not go with the domain.
        """
        if not certificate.holds or certificate.metric is None:
            raise ValueError(f"no error ball without a certificate: {certificate}")
        if certificate.kind != "exact":
            raise ValueError("a frozen certificate proves nothing about two real trajectories")
        if (certificate.domain == "sampled") != (period is not None):
            raise ValueError(f"domain {certificate.domain!r} does not go with period {period!r}")
        pushed = None if channel is None else np.asarray(channel, float)
        room = np.inf if certificate.evidence == "proof" else np.nan_to_num(certificate.ball)
        return cls(certificate.metric, certificate.rate, pushed, period, float(room))

    def distance(self, difference: ArrayLike) -> Array:
        """Length in the metric, ||Theta delta||, of differences (..., n)."""
        return np.linalg.norm(np.asarray(difference, float) @ self.theta.T, axis=-1)

    def push(self, size: float) -> float:
        """Return sup ||Theta B d|| over ||d|| <= size: a speed, or a jump per sample."""
        if not size >= 0.0:
            raise ValueError(f"wanted a disturbance size of at least 0, got {size!r}")
        return float(np.linalg.norm(self.theta @ np.asarray(self.channel), 2)) * size

    def growth(self, time: ArrayLike) -> Array:
        """(1 - e^{-beta t}) / beta; in a sampled loop (1 - rho^k) / (1 - rho), k = t / period."""
        settled = -np.expm1(-self.rate * np.asarray(time, float))
        if self.period is None:
            return settled / self.rate
        return settled / -np.expm1(-self.rate * self.period)

    def bound(self, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest distance in the metric at `time`.

        Args:
            time: s, broadcast against `start`.
            start: V(0), the distance of the two starts in the metric (`distance`).
            size: sup ||d||.
        """
        decay = np.exp(-self.rate * np.asarray(time, float))
        return np.asarray(start, float) * decay + self.push(size) * self.growth(time)

    def radius(self, size: float) -> float:
        """Radius of the ball in the metric, the limit of `bound`."""
        return float(self.bound(np.inf, 0.0, size))

    def fits(self, size: float) -> bool:
        """Whether the ball around rest stays where the certificate holds."""
        return self.radius(size) <= self.room

    def output_bound(self, row: ArrayLike, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest |row delta| at `time`: by Cauchy-Schwarz ||Theta^{-T} row|| times `bound`.

        This is the sharp translation for one signal; `row` has shape (n,).
        """
        length = np.linalg.norm(np.linalg.solve(self.theta.T, np.asarray(row, float)))
        return float(length) * self.bound(time, start, size)

    def euclidean_bound(self, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """The paper's inequality for ||xi_1 - xi_0||.

            V(0) / sqrt(m_low) e^{-beta t} + (d_bar / beta) sqrt(m_high / m_low) (1 - e^{-beta t})

        with d_bar = sup ||B d||. `start` is V(0) in the metric.
        """
        low, high = np.linalg.eigvalsh(self.metric)[[0, -1]]
        d_bar = float(np.linalg.norm(np.asarray(self.channel), 2)) * size
        decay = np.exp(-self.rate * np.asarray(time, float))
        transient = np.asarray(start, float) / np.sqrt(low) * decay
        return transient + d_bar * np.sqrt(high / low) * self.growth(time)


def paper_channel(T_y: ArrayLike, T_a: ArrayLike, slope: ArrayLike) -> Array:
    """The paper's disturbance d_bar = [d; T_a dpi/ds1 T_y d] as a channel [I; T_a P T_y].

    In the coordinates (y, u) a disturbance also moves the command, because du follows dy. In the
    coordinates (z, int z) used here it enters as [T_y; 0], with no slope in it.

    Args:
        T_y: (n, n).
        T_a: (n, n).
        slope: dpi/ds1, (n,) diagonal or (n, n).
    """
    P = np.asarray(slope, float)
    P = np.diag(P) if P.ndim == 1 else P
    lifted = np.asarray(T_a, float) @ P @ np.asarray(T_y, float)
    return np.vstack([np.eye(len(P)), lifted])


def respond(
    rhs: Callable[[float, Array], Array],
    start: ArrayLike,
    times: ArrayLike,
    disturbance: ArrayLike,
) -> Array:
    """Integrate s' = rhs(t, s) + w for many disturbances at once, w held over each step.

    Args:
        rhs: right-hand side of the undisturbed loop, (batch, n) to (batch, n).
        start: initial states, (batch, n) or (n,).
        times: increasing times in s, (steps + 1,); one Runge-Kutta step of order 4 between two.
        disturbance: w = B d, (steps, batch, n).

    Returns:
        The path, (steps + 1, batch, n).

    Raises:
        ValueError: if the disturbance does not have one entry per step.
    """
    t, pushes = np.asarray(times, float), np.asarray(disturbance, float)
    if len(pushes) != len(t) - 1:
        raise ValueError(f"wanted {len(t) - 1} disturbances, one per step, got {len(pushes)}")
    path = np.empty((len(t), *pushes.shape[1:]))
    path[0] = np.asarray(start, float)
    for k, w in enumerate(pushes):

        def pushed(at: float, s: Array, w: Array = w) -> Array:
            return rhs(at, s) + w

        path[k + 1] = rk4(pushed, path[k], t[k : k + 2])[-1]
    return path
