"""Certificates: what is proved about a loop, in which coordinates, and with which metric.

In the coordinates (z, int z) the loop z' = Lambda z + R a, a = pi(z, int z) has the Jacobian

    J = [[Lambda + R P, R Q], [I, 0]],    P = dpi/ds1, Q = dpi/ds2 (diagonal),

without any derivative of P or Q: nothing is ignored (`AuxiliarySpace.loop`). It is affine in
the slopes, so one metric that works at the corners of their intervals works for every slope in
between, constant or not. That is what the inequalities of theorem 2 (`eq_theorem2`) lack: they look
at one frozen time after another.

Rounding is part of the account: a rate is lowered by a bound on it before it is compared with 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, number
from cmc.theory.contraction import metric_factor, overshoot
from cmc.theory.metric_search import condition_metric, search_metric

Progress = Callable[[str], object]

SHARE = 0.9
"""Settling for this share of the largest provable rate keeps the metric well conditioned."""
# So many vertices are searched at once; more join where they turn out to be violated.
_AT_ONCE, _MORE, _ROUNDS = 40, 12, 12
_CHUNK = 1024


@dataclass(frozen=True)
class Certificate:
    """What is guaranteed about a loop, or why nothing is.

    "proof": a quadratic metric common to all corners of the slopes' intervals, for a plant whose
    Jacobians are constant, one action a signal, I_k = I_{k-1} + h z_k where sampled, and no command
    that is clipped. "points": a metric that fits the total Jacobian at all points of a box that
    were looked at, for trajectories that stay in the box. `ball` is a set that they do not leave.

    Attributes:
        holds: Whether contraction is shown, as far as `evidence` says.
        kind: "exact", of the total Jacobian, or "frozen", with the transforms held constant where
            they move: that never holds, because it proves nothing.
        domain: "continuous", or "sampled" with a zero-order hold.
        rate: Proved contraction rate, 1/s (NaN where nothing is proved; what each frozen instant
            would have where `kind` is "frozen").
        metric: M of the distance that shrinks, (m, m), or None; in (z, int z), or z alone where
            the policy does not use int z, and with y in place of z where a box was looked at.
        violated: The Jacobian (or step) that stands in the way, (m, m), or None.
        region: Where it holds, in words.
        reason: Why it holds, or does not and what would help, in words.
        refused: Whether the question could not be asked at all.
        evidence: "proof" or "points", as above: nothing is said about what lies between points.
        ball: Radius, in the metric, of the ball around the point of rest in which no command
            reaches the plant's limits. NaN where none was found; infinite without limits.
        rest: That point of rest in the metric's coordinates, (m,), or None.
    """

    holds: bool
    kind: str = "exact"
    domain: str = "continuous"
    rate: float = float("nan")
    metric: Array | None = None
    violated: Array | None = None
    region: str = "everywhere"
    reason: str = ""
    refused: bool = False
    evidence: str = "proof"
    ball: float = float("nan")
    rest: Array | None = None

    def __bool__(self) -> bool:
        return self.holds

    @property
    def overshoot(self) -> float:
        """Bound sqrt(cond(M)) on the transient in the metric's coordinates, or NaN."""
        return float("nan") if self.metric is None else float(overshoot(self.metric))

    def __str__(self) -> str:
        shown = "contracting" if self.evidence == "proof" else "contracting at the points tried"
        verdict = "refused" if self.refused else shown if self.holds else "not proved"
        line = f"{verdict} ({self.kind}, {self.domain}), {self.region}"
        if self.holds:
            line += f": rate {self.rate:.3g} 1/s, overshoot at most {self.overshoot:.3g}"
        return f"{line}. {self.reason}" if self.reason else line


def circle_criterion(c: float, k1: float, k2: float) -> Certificate:
    """Decide w'' + c w' + k(t) w = 0 with c constant and k anywhere in [k1, k2], w = int z.

    A common quadratic metric exists if and only if 0 < k1 and sqrt(k2) - sqrt(k1) < c. It can be
    written down: M = [[1, c/2], [c/2, c^2/2 + sqrt(k1 k2)]] in (z, int z). For a rate beta apply
    the same to e^{beta t} w, with damping c - 2 beta and stiffness k - beta c + beta^2.
    Here c = -(Lambda + R p) in 1/s; k1 and k2 are the ends of -R q in 1/s^2.
    """
    c, k1, k2 = number("c", c), number("k1", k1), number("k2", k2)
    if k1 > k2 or max(abs(c), abs(k1), abs(k2)) > 1e150:
        raise ValueError(f"c below 1e150 and k1 <= k2 are needed, got c {c}, k1 {k1}, k2 {k2}")
    corners = np.array([[[-c, -k], [1.0, 0.0]] for k in (k1, k2)])

    def shifted(beta: float) -> tuple[float, float, float]:
        offset = beta**2 - beta * c
        return c - 2 * beta, k1 + offset, k2 + offset

    def meets(c: float, soft: float, stiff: float) -> bool:
        return bool(c > 0 and soft > 0 and np.sqrt(stiff) - np.sqrt(soft) < c)

    if meets(c, k1, k2):
        low, high = 0.0, c / 2
        for _ in range(60):
            beta = (low + high) / 2
            low, high = (beta, high) if meets(*shifted(beta)) else (low, beta)
        beta = SHARE * low
        damping, soft, stiff = shifted(beta)
        mixed = damping**2 / 2 + np.sqrt(soft * stiff)
        # (w' + beta w, w) are the coordinates of e^{beta t} w
        shear = np.array([[1.0, beta], [0.0, 1.0]])
        metric = shear.T @ np.array([[1, damping / 2], [damping / 2, mixed]]) @ shear
        rate = float(rates_in(corners, metric).min())
        if rate > 0:
            return Certificate(True, rate=rate, metric=metric, reason="circle criterion")
    if k1 <= 0 or c <= 0:
        reason = f"damping {c:.4g} and stiffness from {k1:.4g} on need to be positive"
        return Certificate(False, violated=corners[0], reason=reason)
    gap, most = np.sqrt(k2) - np.sqrt(k1), (c + np.sqrt(k1)) ** 2
    reason = (
        f"sqrt(k2) - sqrt(k1) = {gap:.4g} is not below c = {c:.4g}: the stiffness may reach "
        f"{most:.4g}, and reaches {k2:.4g}"
    )
    return Certificate(False, violated=corners[1], reason=reason)


def corners(low: Array, high: Array) -> Array:
    """The corners of an interval of slopes (n, 2), (N, n, 2): one end alone where both agree."""
    ends = [np.unique(pair) for pair in np.stack([low, high], axis=-1).reshape(-1, 2)]
    return np.array(list(product(*ends))).reshape(-1, *low.shape)


def common_metric(
    vertices: ArrayLike,
    *,
    h: float | None = None,
    slack: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Look for one metric in which every vertex, and so every matrix in their hull, contracts.

    Args:
        vertices: Jacobians, (V, m, m), 1/s; with `h` the steps of a sampled loop.
        h: Sample time, s, where the vertices are steps.
        slack: How far off each entry of a vertex may be, (m, m).
        progress: Called with a line of text in each round, such as `print`.
    """
    vertices = checked("vertices", vertices, "V m m")
    h = None if h is None else number("h", h, above=0.0)
    domain, hull = "continuous" if h is None else "sampled", "the hull of the vertices"
    count = len(vertices)
    active = np.unique(np.linspace(0, count - 1, min(_AT_ONCE, count)).astype(int))
    best: tuple[float, Array] | None = None
    for turn in range(_ROUNDS):
        if progress is not None:
            so_far = f", rate {best[0]:.3g} 1/s so far" if best else ""
            progress(f"round {turn + 1}: one metric for {len(active)} of {count} vertices{so_far}")
        metric, aim, worst = _of_few(vertices[active], h)
        if metric is None:
            break
        rates = rates_in(vertices, metric, h, slack)
        rate = float(rates.min())
        if rate > 0 and (best is None or rate > best[0]):
            best = rate, metric
        if rate >= 0.7 * aim or len(active) == count:
            break
        active = np.union1d(active, np.argsort(rates)[:_MORE])
    if best is not None:
        reason = f"one metric for {count} vertices"
        rate, metric = best
        return Certificate(True, "exact", domain, rate, metric, region=hull, reason=reason)
    resists = vertices[active[worst] if metric is None else int(np.argmin(rates))]
    reason = _why_not(resists, h)
    return Certificate(False, "exact", domain, violated=resists, region=hull, reason=reason)


def _of_few(vertices: Array, h: float | None) -> tuple[Array | None, float, int]:
    """A well conditioned metric near the largest rate, that rate, and the vertex that resists."""

    def faster(rate: float) -> Array:
        """Vertices that decay where the given ones decay at `rate`."""
        if h is None:
            return vertices + rate * np.eye(vertices.shape[-1])
        return np.asarray(vertices * np.exp(rate * h))

    metric, worst = search_metric(vertices, discrete=h is not None)
    if metric is None:
        return None, float("nan"), worst
    eigenvalues = np.linalg.eigvals(vertices)
    high = float(-eigenvalues.real.max())
    if h is not None:
        high = float(-np.log(max(np.abs(eigenvalues).max(), 1e-3)) / h)
    low = max(float(rates_in(vertices, metric, h).min()), 0.0)
    for _ in range(8):
        if high < 1.03 * low:
            break
        middle = (low + high) / 2
        ahead, _ = search_metric(faster(middle), discrete=h is not None)
        if ahead is None:
            high = middle
        else:
            metric, low = ahead, max(middle, float(rates_in(vertices, ahead, h).min()))
    aim = SHARE * low
    try:
        return condition_metric(faster(aim), metric, discrete=h is not None), aim, worst
    except (np.linalg.LinAlgError, ValueError):  # too ill conditioned to be improved
        return metric, aim, worst


def rates_in(
    vertices: ArrayLike, metric: ArrayLike, h: float | None = None, slack: ArrayLike | None = None
) -> Array:
    """Rates of the vertices (V, m, m) in a metric, lowered by a bound on rounding, (V,), 1/s.

    With `h` (s) the vertices are the steps of a sampled loop; `slack` as in `common_metric`.
    """
    theta = metric_factor(metric)
    vertices = checked("vertices", vertices, "V m m", m=len(theta))
    h = None if h is None else number("h", h, above=0.0)
    n = len(theta)
    off = 0.0 if slack is None else checked("slack", slack, "n n", n=n, least=0.0)
    inverse = np.linalg.inv(theta)
    rates = np.empty(len(vertices))
    for start in range(0, len(vertices), _CHUNK):
        J = vertices[start : start + _CHUNK]
        loose = 4e-16 * J.shape[-1] * np.abs(J) + off
        doubt = np.linalg.norm(np.abs(theta) @ loose @ np.abs(inverse), axis=(-2, -1))
        local = theta @ J @ inverse
        if h is None:
            growth = np.linalg.eigvalsh((local + np.swapaxes(local, -1, -2)) / 2)[:, -1] + doubt
            rates[start : start + _CHUNK] = -growth
        else:
            factor = np.linalg.norm(local, 2, axis=(-2, -1)) + doubt
            rates[start : start + _CHUNK] = -np.log(np.maximum(factor, 1e-300)) / h
    return rates


def _why_not(worst: Array, h: float | None) -> str:
    eigenvalues = np.linalg.eigvals(worst)
    if h is not None and np.abs(eigenvalues).max() >= 1:
        return f"a vertex is unstable: spectral radius {np.abs(eigenvalues).max():.4g}"
    if h is None and eigenvalues.real.max() >= 0:
        return f"a vertex is unstable: eigenvalue real part {eigenvalues.real.max():.4g} 1/s"
    return "every vertex decays by itself, but no quadratic metric fits them all"
