r"""The error ball of a contracting loop: how far a bounded disturbance can push it.

A loop xi' = g(xi, t) that contracts at `rate` beta in the constant metric M = Theta^T Theta, and
the same loop with a disturbance, xi' = g(xi, t) + B d, drift apart by at most

    ||Theta (xi_1 - xi_0)|| <= V(0) e^{-beta t} + sup ||Theta B d|| / beta (1 - e^{-beta t}).

Measured in the metric this needs no bounds of M. The paper's form (appendix "Robustness", after
theorem 2.4 of Tsukamoto, Chung, Slotine 2021) is the Euclidean consequence of it, and is looser:
V(0) / sqrt(m_low) e^{-beta t} + sup ||B d|| / beta sqrt(m_high / m_low) (1 - e^{-beta t}).
`reach` is sharper in the same metric, `peak_gain` is what can really happen to a linear loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.arrays import Array, checked, count, number
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
        try:
            number("rate", self.rate, above=0.0)
        except ValueError as error:
            raise ValueError(f"{error} 1/s: the loop does not contract") from None
        if self.period is not None:
            number("period", self.period, above=0.0)
        if not (isinstance(self.room, float) and self.room == np.inf):
            number("room", self.room, least=0.0)
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
        if not isinstance(certificate, Certificate):
            raise TypeError(f"certificate needs a Certificate, got {type(certificate).__name__}")
        if certificate.kind != "exact":
            raise ValueError("a frozen certificate proves nothing about two real trajectories")
        if not certificate.holds or certificate.metric is None:
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
        at_rest = isinstance(time, float) and time == np.inf
        time = checked("time", 1e300 if at_rest else time, least=0.0)
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
        return signal_length(self.metric, row) * self.bound(time, start, size)


def signal_length(metric: ArrayLike, row: ArrayLike) -> float:
    """||Theta^{-T} row||: the largest |row delta| on the unit sphere of the metric; row is (n,)."""
    theta = metric_factor(metric)
    return float(np.linalg.norm(np.linalg.solve(theta.T, checked("row", row, "n", n=len(theta)))))


def reach(
    jacobians: ArrayLike, metric: ArrayLike, channel: ArrayLike, *, samples: int = 40
) -> float:
    """Radius, in a metric, of an ellipsoid that disturbances ||d|| <= 1 cannot leave, from rest.

    The error ball adds up the worst decay and the worst push as if they met in one direction. If
    J^T M + M J + a M + (s / a) M B B^T M <= 0 for every Jacobian J of the loop, then
    V = ||Theta (xi_1 - xi_0)||^2 obeys V' <= -a V + (a / s) ||d||^2, so V(t) <= 1 / s. The
    condition is affine in J: corners of the slopes are enough. (Boyd et al. 1994, section 6.1.3;
    Abedor, Nagpal, Poolla 1996.)

    Corners of the Jacobian (V, n, n) or (n, n), M (n, n), B (n, m); `samples` is how many values of
    a are tried. Returns 1 / sqrt(s), infinite where the metric proves nothing.
    """
    M = checked("metric", metric, "n n")
    J = checked("jacobians", jacobians, "... n n", n=len(M)).reshape(-1, len(M), len(M))
    theta, samples = metric_factor(M), count("samples", samples, 10_000)
    push = theta @ checked("channel", channel, "n m", n=len(M))
    local = theta @ J @ np.linalg.inv(theta)
    local = local + np.swapaxes(local, -1, -2)
    slowest = -float(np.linalg.eigvalsh(local)[:, -1].max())
    if slowest <= 0.0:
        return np.inf
    a = slowest * np.linspace(0.02, 0.98, samples)
    room = -(local + a[:, None, None, None] * np.eye(len(M)))  # (samples, V, n, n), positive
    # s push push^T / a <= room   if and only if   s push^T room^{-1} push <= a
    needed = push.T @ np.linalg.solve(room, np.broadcast_to(push, (*room.shape[:2], *push.shape)))
    if not np.isfinite(needed).all():
        raise ValueError(f"channel needs entries whose squares are numbers, got {push.max():.3g}")
    s = a / np.linalg.eigvalsh(needed)[..., -1].max(axis=-1)
    return float(1.0 / np.sqrt(s.max()))


def peak_gain(jacobian: ArrayLike, channel: ArrayLike, row: ArrayLike) -> float:
    """Largest |row xi| that a disturbance ||d(t)|| <= 1 can ever cause in a linear loop, from rest.

    The integral of ||row e^{J t} B|| over t >= 0, by Gauss-Legendre panels; J (n, n) Hurwitz,
    B (n, m), row (n,).
    """
    J = checked("jacobian", jacobian, "n n")
    B, c = checked("channel", channel, "n m", n=len(J)), checked("row", row, "n", n=len(J))
    values, V = np.linalg.eig(J)
    slowest, turning = float(values.real.max()), float(np.abs(values.imag).max())
    if not slowest < 0.0:
        raise ValueError(f"the loop is not stable: largest real part {slowest:.3g} 1/s")
    end = 40.0 / -slowest
    if end * max(turning, 0.0) > 1e6:
        raise ValueError(f"the loop turns {end * turning / 6.28:.2g} times before it is at rest")
    edges = np.concatenate([[0.0], np.geomspace(1e-3 / np.abs(values).max(), end, 400)])
    if turning > 0.0:  # several panels to each half turn, because the length has kinks
        edges = np.union1d(edges, np.arange(0.0, end, 0.1 * np.pi / turning))
    nodes, weights = np.polynomial.legendre.leggauss(6)
    half = 0.5 * np.diff(edges)[:, None]
    t = edges[:-1, None] + half * (1.0 + nodes)
    if np.linalg.cond(V) > 1e6:  # nearly defective: the eigenvectors lose too many digits
        response = c @ expm(t[..., None, None] * J) @ B
    else:
        modes = (c @ V)[:, None] * np.linalg.solve(V, B)
        response = np.real(np.exp(t[..., None] * values) @ modes)
    return float((np.linalg.norm(response, axis=-1) * half * weights).sum())


def random_disturbances(
    rng: np.random.Generator, steps: int, batch: int, size: float, *, step: float, m: int = 1
) -> Array:
    """Bounded disturbances of four kinds in turn (`KINDS`), ||d(t)|| <= size, (steps, batch, m).

    Trajectory j is of kind KINDS[j % 4]: a constant; one that switches sign at random; a sine of
    random frequency (up to a tenth of the step rate, `step` in s) and phase; an independent draw at
    each step.
    """
    if not isinstance(rng, np.random.Generator):
        raise TypeError(f"rng needs a numpy Generator, got {type(rng).__name__}")
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
    course = np.ones((steps, batch))
    course = np.where(kind == 1, 1.0 - 2.0 * (switching.cumsum(axis=0) % 2), course)
    course = np.where(kind == 2, sine, course)
    course = np.where(kind == 3, rng.uniform(-1.0, 1.0, (steps, batch)), course)
    return course[..., None] * direction


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
