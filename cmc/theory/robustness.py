r"""The error ball of a contracting loop: how far a bounded disturbance can push it.

A loop xi' = g(xi, t) that contracts at `rate` beta in the constant metric M = Theta^T Theta, and
the same loop with a disturbance, xi' = g(xi, t) + B d, drift apart by at most

    ||Theta (xi_1 - xi_0)|| <= V(0) e^{-beta t} + sup ||Theta B d|| / beta (1 - e^{-beta t}).

Measured in the metric this needs no bounds of M. The paper's form (appendix "Robustness", after
theorem 2.4 of Tsukamoto, Chung, Slotine 2021) is the Euclidean consequence of it, and is looser:
V(0) / sqrt(m_low) e^{-beta t} + sup ||B d|| / beta sqrt(m_high / m_low) (1 - e^{-beta t}).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, count, need, number
from cmc.theory.certificates import Certificate
from cmc.theory.contraction import metric_factor

KINDS = ("constant", "switching", "sine", "white")


@dataclass(frozen=True)
class ErrorBall:
    """What a metric and a rate promise about a disturbed loop.

    Attributes:
        metric: M, (n, n), symmetric positive definite.
        rate: beta in 1/s: J^T M + M J <= -2 beta M for every Jacobian J of the loop; for a sampled
            loop Phi^T M Phi <= e^{-2 beta period} M.
        channel: B, (n, m): how the disturbance enters; the identity by default.
        period: Control period in s of a sampled loop xi_{k+1} = Phi(xi_k) + B d_k, or None.
        room: Largest distance in the metric at which it is known to hold: a certificate's `ball`.
    """

    metric: Array
    rate: float
    channel: Array | None = None
    period: float | None = None
    room: float = np.inf

    def __post_init__(self) -> None:
        metric = checked("metric", self.metric, "n n")
        metric_factor(metric)
        n, channel = len(metric), self.channel
        number("rate", self.rate, above=0.0)
        if self.period is not None:
            number("period", self.period, above=0.0)
        checked("room", self.room, "", least=0.0, finite=False)
        channel = np.eye(n) if channel is None else checked("channel", channel, "n m", n=n)
        object.__setattr__(self, "metric", metric)
        object.__setattr__(self, "channel", channel)

    @classmethod
    def of(
        cls, certificate: Certificate, channel: ArrayLike | None = None, period: float | None = None
    ) -> ErrorBall:
        """Ball of a certified loop, while both trajectories stay in the certificate's region.

        A certificate of a box holds in the box: `fits` says whether the ball around rest does.
        B is (n, m); a period (s) goes with a certificate of a sampled loop.
        """
        need(isinstance(certificate, Certificate), "certificate", "a Certificate", certificate)
        if not certificate.holds or certificate.metric is None or certificate.kind == "frozen":
            raise ValueError(f"no error ball without a certificate: {certificate}")
        if (certificate.domain == "sampled") != (period is not None):
            raise ValueError(f"domain {certificate.domain!r} does not go with period {period!r}")
        room = np.inf if certificate.evidence == "proof" else np.nan_to_num(certificate.ball)
        return cls(certificate.metric, certificate.rate, channel, period, float(room))  # type: ignore[arg-type]

    @property
    def theta(self) -> Array:
        """Theta, (n, n), upper triangular, M = Theta^T Theta."""
        return metric_factor(self.metric)

    def distance(self, difference: ArrayLike) -> Array:
        """Length in the metric, ||Theta delta||, of differences (..., n)."""
        difference = checked("difference", difference, "... n", n=len(self.metric))
        return np.linalg.norm(difference @ self.theta.T, axis=-1)

    def bound(self, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest distance in the metric at `time` (s), from V(0) = `start`, for ||d|| <= `size`.

        In a sampled loop (1 - e^{-beta t}) / beta is (1 - rho^k) / (1 - rho), rho = e^{-beta h}.
        """
        time = checked("time", time, least=0.0, finite=False)
        start, size = checked("start", start, least=0.0), number("size", size, least=0.0)
        push, rate = np.linalg.norm(self.theta @ self.channel, 2) * size, self.rate  # type: ignore[operator]
        settled = -np.expm1(-rate * time)
        each = rate if self.period is None else -np.expm1(-rate * self.period)
        return np.asarray(start * np.exp(-rate * time) + push * settled / each)

    def radius(self, size: float) -> float:
        """Radius of the ball in the metric, the limit of `bound`."""
        return float(self.bound(np.inf, 0.0, size))

    def fits(self, size: float) -> bool:
        """Whether the ball around rest stays where the certificate holds."""
        return self.radius(size) <= self.room

    def output_bound(self, row: ArrayLike, time: ArrayLike, start: ArrayLike, size: float) -> Array:
        """Largest |row delta| at `time`: ||Theta^{-T} row|| times `bound`; `row` is (n,)."""
        row = checked("row", row, "n", n=len(self.metric))
        length = np.linalg.norm(np.linalg.solve(self.theta.T, row))  # on the metric's unit sphere
        return np.asarray(length * self.bound(time, start, size))


def random_disturbances(
    rng: np.random.Generator, steps: int, batch: int, size: float, *, step: float, m: int = 1
) -> Array:
    """Bounded disturbances of four kinds in turn (`KINDS`), ||d(t)|| <= size, (steps, batch, m).

    Trajectory j is of kind KINDS[j % 4]: a constant; one that switches sign at random; a sine of
    random frequency (up to a tenth of the step rate, `step` in s) and phase; an independent draw at
    each step.
    """
    need(isinstance(rng, np.random.Generator), "rng", "a numpy Generator", rng)
    steps, batch, m = count("steps", steps), count("batch", batch), count("m", m, 1000)
    size, step = number("size", size, least=0.0), number("step", step, above=0.0)
    if steps * batch * m > 10**9:
        raise ValueError(f"steps x batch x m needs at most 1e9 numbers, got {steps * batch * m}")
    direction = rng.normal(size=(batch, m))
    direction *= size / np.linalg.norm(direction, axis=-1, keepdims=True)
    kind = np.arange(batch) % len(KINDS)
    t = step * np.arange(steps)[:, None]
    switching = rng.random((steps, batch)) < rng.uniform(0.001, 0.2, batch)
    fastest = np.log10(0.1 / step)
    frequency = 10.0 ** rng.uniform(min(-1.0, fastest), fastest, batch)
    sine = np.sin(2.0 * np.pi * (frequency * t + rng.random(batch)))
    turned, white = 1.0 - 2.0 * (switching.cumsum(axis=0) % 2), rng.uniform(-1, 1, (steps, batch))
    return np.choose(kind, [np.ones(batch), turned, sine, white])[..., None] * direction


def nominal_metric(jacobian: ArrayLike, *, share: float = 0.5) -> Array:
    """Metric in which linear loops (..., n, n) contract at a share of their own decay rates.

    Solves (J + b I)^T M + M (J + b I) = -I with b = share * |max Re lambda|: the model's metric, in
    which a real loop is then tested. A share near 1 makes a metric that fits this loop alone; a
    share near 0, in [0, 1), one that is blind to the slow modes. J is Hurwitz.
    """
    J, share = checked("jacobian", jacobian, "... n n"), number("share", share, least=0.0)
    if not share < 1.0:
        raise ValueError(f"share needs a value in [0, 1), got {share!r}")
    slowest = np.linalg.eigvals(J).real.max(axis=-1)
    if not (slowest < 0.0).all():
        raise ValueError(f"jacobian needs stable loops, got a real part of {slowest.max():.3g} 1/s")
    n, eye = J.shape[-1], np.eye(J.shape[-1])
    shifted = np.swapaxes(J - share * slowest[..., None, None] * eye, -1, -2)
    # (J^T kron I + I kron J^T) vec(M) = -vec(I), for the whole batch at once
    both = np.einsum("...ij,kl->...ikjl", shifted, eye)
    both = both + np.einsum("ij,...kl->...ikjl", eye, shifted)
    right = np.broadcast_to(-eye.reshape(-1, 1), (*J.shape[:-2], n * n, 1))
    metric = np.linalg.solve(both.reshape(*J.shape[:-2], n * n, n * n), right).reshape(J.shape)
    return 0.5 * (metric + np.swapaxes(metric, -1, -2))
