"""Exact certificates: the total Jacobian of the loop in (y, int z), nothing held constant.

With u = u0 + T_a(y) a, a = -sign(R) pi(z, I), z = T_y(y) (y - y_ref), I' = z, the Jacobian of the
loop contains d(T_a)/dy a and d(T_y)/dy (y - y_ref), which the frozen analysis drops. They are taken
here by central differences of the simulated loop itself, so that nothing can be forgotten.

A metric that fits at all points of a box speaks of trajectories that stay in it. Which do is
answered by the metric too: a ball around the point of rest that fits into the box is never left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, count
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.ball import ball_in_box
from cmc.theory.certificates import Certificate, Progress, common_metric, rates_in
from cmc.theory.identification import differences
from cmc.theory.metric_search import search_metric
from cmc.theory.simulate import Loop
from cmc.theory.tracking import jumps

_ROUNDS = 5
_GRID = 1024
_CHECKS = 2048


@dataclass(frozen=True)
class Region:
    """A box of latent signals and of their integrals.

    Attributes:
        y_low: Lower corner, (n,).
        y_high: Upper corner, (n,).
        integral: Largest |int z| per dimension, (n,) or one number.
        points: Grid points per axis of y, as long as there are not more than 1024.

    Raises:
        ValueError: if the corners are no box.
    """

    y_low: ArrayLike
    y_high: ArrayLike
    integral: ArrayLike = 1.0
    points: int = 7

    def __post_init__(self) -> None:
        low = checked("y_low", self.y_low, "n")
        high = checked("y_high", self.y_high, "n", n=len(low))
        if not (low < high).all():
            raise ValueError(f"y_high needs values above y_low, (n,) both, got {low} and {high}")
        reach = checked("integral", self.integral, above=0.0)
        if reach.shape not in ((), low.shape):
            raise ValueError(f"integral needs one number or ({len(low)},), got shape {reach.shape}")
        if count("points", self.points, 101) < 2:
            raise ValueError("points needs at least 2 points per axis, got 1")

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lower and upper corner in y, (n,) each."""
        return np.asarray(self.y_low, dtype=float), np.asarray(self.y_high, dtype=float)

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper corner in (y, int z), (2n,) each."""
        low, high = self.corners
        reach = np.broadcast_to(np.asarray(self.integral, dtype=float), low.shape)
        return np.concatenate([low, -reach]), np.concatenate([high, reach])

    def __str__(self) -> str:
        box = " x ".join(f"[{a:.3g}, {b:.3g}]" for a, b in zip(*self.corners, strict=True))
        return f"y in {box}"


def spread(low: Array, high: Array, points: int) -> Array:
    """A grid of at most 1024 points (N, m); corners and random ones where it would have more."""
    m = len(low)
    if points**m <= _GRID:
        axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, m)
    unit = np.random.default_rng(0).random((_GRID, m))
    if m <= 8:
        ends = np.stack(np.meshgrid(*[[0.0, 1.0]] * m, indexing="ij"), axis=-1).reshape(-1, m)
        unit = np.concatenate([ends, unit, np.full((1, m), 0.5)])
    return np.asarray(low + unit * (high - low))


def certify_exact(
    policy: Any,
    plant: Any,
    spaces: Callable[[Array], AuxiliarySpace],
    region: Region,
    *,
    h: float | None = None,
    y_ref: ArrayLike = 0.0,
    progress: Progress | None = None,
) -> Certificate:
    """Exact certificate of one policy over a box of (y, int z); arguments as in `certify`.

    One metric is sought for the total Jacobians at 1024 points or so, then tried at 2048 others and
    around the worst of all; what fails joins the vertices, a few rounds at most. The metric is in
    (y, int z), or in y alone where the policy does not use int z.
    """
    domain = "continuous" if h is None else "sampled"
    where = f"{region}, |int z| at most {np.asarray(region.integral).tolist()}"
    n, (low, high) = plant.n, region.limits
    try:
        if jumps(spaces, *region.corners):
            raise ValueError(
                "T_y jumps inside the region (order or sign of its eigenvectors): track them along "
                "the path, or shrink the region"
            )
        loop = Loop(plant, policy, spaces, y_ref)
        keep = np.arange(2 * n if _integrates(loop, low, high) else n)
        look = _Looked(loop, keep, low, high, h, min(region.points, int(_GRID ** (1 / (2 * n)))))
        answer, rates, points, jacobians = look.certificate(progress)
        answer = replace(answer, evidence="points")
    except (ValueError, TypeError, np.linalg.LinAlgError) as error:
        return Certificate(False, "exact", domain, region=where, reason=str(error), refused=True)
    if answer.metric is None or rates.min() <= 0:
        k = int(np.argmin(rates))
        reason = "metrics that fit the grid fail between" if answer.metric is not None else ""
        at = f", at y = {_text(points[k, :n])}, int z = {_text(points[k, n:])}"
        reason = (reason or answer.reason) + at + look.smaller()
        no = Certificate(False, "exact", domain, region=where, reason=reason, evidence="points")
        return replace(no, violated=jacobians[k])
    rate, seen = min(answer.rate, float(rates.min())), len(look.points) + len(points)
    reason = f"one metric at all {seen} points of the box that were looked at, while the "
    answer = replace(answer, rate=rate, region=where, reason=f"{reason}trajectories stay in it")
    return ball_in_box(answer, loop, keep, low, high, h)


class _Looked:
    """Points of a box (y, int z), and the total Jacobians of a loop at them."""

    def __init__(
        self, loop: Loop, keep: Array, low: Array, high: Array, h: float | None, points: int
    ) -> None:
        self.keep, self.low, self.high, self.h = keep, low, high, h
        self.move: Callable[[Array], Array] = (
            (lambda x: loop.field(0.0, x)) if h is None else (lambda x: loop.step(x, h))
        )
        self.points = spread(low, high, points)
        self.jacobians = self.at(self.points)

    def at(self, s: Array) -> Array:
        J = differences(self.move, s, 1e-6 * (self.high - self.low))
        J = J[:, self.keep[:, None], self.keep]
        bad = ~np.isfinite(J).all(axis=(1, 2))
        if bad.any():
            where = _text(s[np.flatnonzero(bad)[0], : len(self.low) // 2])
            raise ValueError(f"the loop is not finite at y = {where}")
        return J

    def certificate(self, progress: Progress | None) -> tuple[Certificate, Array, Array, Array]:
        """The best answer; rates, points and Jacobians that it was tried at, or what resists it."""
        rng, low, high = np.random.default_rng(0), self.low, self.high
        for turn in range(_ROUNDS):
            if progress is not None:
                progress(f"box, round {turn + 1}: Jacobians at {len(self.points)} points")
            answer = common_metric(self.jacobians, h=self.h, progress=progress)
            if answer.metric is None:
                assert answer.violated is not None
                away = np.abs(self.jacobians - answer.violated).max(axis=(1, 2))
                return answer, away, self.points, self.jacobians
            worst = np.argsort(rates_in(self.jacobians, answer.metric, self.h))[:64]
            near = self.points[worst]
            around = near + rng.normal(size=(8, *near.shape)) * 0.05 * (high - low)
            others = rng.uniform(low, high, (_CHECKS, len(low)))
            tried = np.clip(np.concatenate([others, around.reshape(-1, len(low))]), low, high)
            checks = self.at(tried)
            rates = rates_in(checks, answer.metric, self.h)
            if rates.min() > 0.3 * answer.rate or turn == _ROUNDS - 1:
                break
            worst = np.argsort(rates)[:20]
            self.points = np.concatenate([self.points, tried[worst]])
            self.jacobians = np.concatenate([self.jacobians, checks[worst]])
        return answer, rates, tried, checks

    def smaller(self) -> str:
        """Whether the points in the middle of the box alone have a metric, as a clause."""
        away = np.abs(self.points - (self.low + self.high) / 2) / (self.high - self.low)
        for part in (2, 4, 8):
            inside = (away <= 0.5 / part).all(axis=1)
            if not inside.any():
                break
            if search_metric(self.jacobians[inside], discrete=self.h is not None)[0] is not None:
                return f"; at its {inside.sum()} points within 1/{part} of the box one metric fits"
        return ""


def _integrates(loop: Loop, low: Array, high: Array) -> bool:
    """Whether the command depends on int z at all."""
    s = np.random.default_rng(1).uniform(low, high, (64, len(low)))
    other = s.copy()
    other[:, loop.n :] *= -0.37
    return bool((loop.field(0.0, s) != loop.field(0.0, other)).any())


def _text(vector: Array) -> str:
    return "[" + ", ".join(f"{x:.3g}" for x in vector) + "]"
