"""Exact certificates in a box: the total Jacobian of the loop in (y, int z), nothing held constant.

With u = u0 + T_a(y) a, a = -sign(R) pi(z, I), z = T_y(y) (y - y_ref), I' = z, the Jacobian of the
loop contains d(T_a)/dy a and d(T_y)/dy (y - y_ref), which the frozen analysis drops. They are taken
here by central differences of the simulated loop itself, so that nothing can be forgotten.

A metric that fits at all points of a box speaks of trajectories that stay in it. Which do is
answered by the metric too: a ball around the point of rest that fits into the box is never left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, count, filled
from cmc.theory.ball import ball_in_box, lowest
from cmc.theory.certificates import Certificate, Progress, common_metric, rates_in
from cmc.theory.identification import differences
from cmc.theory.metric_search import search_metric
from cmc.theory.simulate import Loop, Transforms
from cmc.theory.tracking import jumps

_ROUNDS = 6
_GRID = 1024
_CHECKS = 2048
_WORST = 40


@dataclass(frozen=True)
class Region:
    """A box of latent signals and of their integrals.

    Attributes:
        y_low: Lower corner, (n,).
        y_high: Upper corner, (n,).
        integral: Largest |int z| per dimension, (n,) or one number.
        points: Grid points per axis of y, as long as there are not more than 1024.
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
        filled("integral", self.integral, len(low), above=0.0)
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
    spaces: Transforms,
    region: Region,
    *,
    h: float | None = None,
    y_ref: ArrayLike = 0.0,
    progress: Progress | None = None,
) -> Certificate:
    """Exact certificate of one policy over a box of (y, int z); arguments as in `certify`.

    One metric is sought for the total Jacobians at some 3000 points, moved away from their mean by
    the share that 2048 others lie beyond them, then tried downhill from the worst (`lowest`); what
    fails joins them, a few rounds at most. The rate is that of the worst, less the margin that the
    descent leaves and what rounding may hide. The metric is in (y, int z), or in y alone where the
    policy does not use int z.
    """
    domain = "continuous" if h is None else "sampled"
    where = f"{region}, |int z| at most {np.asarray(region.integral).tolist()}"
    n = plant.n
    try:
        if jumps(spaces, *region.corners):
            raise ValueError(
                "T_y jumps inside the region (order or sign of its eigenvectors): track them along "
                "the path, or shrink the region"
            )
        look = _Looked(Loop(plant, policy, spaces, y_ref), region, h)
        answer, points, rates, margin = look.certificate(progress)
    except (ValueError, TypeError, np.linalg.LinAlgError) as error:
        return Certificate(False, "exact", domain, region=where, reason=str(error), refused=True)
    answer = replace(answer, evidence="points", region=where)
    worst, rate = int(np.argmin(rates)), float(rates.min()) - margin
    if answer.metric is None or not rate > 0:
        reason = (
            answer.reason if answer.metric is None else "metrics that fit the grid fail between"
        )
        if look.beyond > 0:
            reason += f" (Jacobians moved {100 * look.beyond:.2g} % outward for what lies between)"
        s = points[worst]
        reason += f", at y = {_text(s[:n])}, int z = {_text(s[n:])}{look.smaller()}"
        no = Certificate(False, "exact", domain, region=where, reason=reason, evidence="points")
        return replace(no, violated=look.at(s[None])[0])
    reason = (
        f"one metric at all {len(look.points) + len(points)} points of the box that were looked "
        f"at, their Jacobians moved {100 * look.beyond:.2g} % away from the mean, as far as fresh "
        "points were seen beyond them, while the trajectories stay in it"
    )
    answer = replace(answer, rate=min(answer.rate, rate), reason=reason)
    return ball_in_box(answer, look.loop, look.keep, look.low, look.high, h)


def shortfall(looked: Array, others: Array) -> float:
    """By what share the hull of matrices (N, m, m) falls short of others, from 1000 directions."""
    mean, size = looked.mean(axis=0), looked.std(axis=0)
    size = np.where(size > 1e-6 * np.abs(looked).max(), size, np.inf)
    ways = np.random.default_rng(4).normal(size=(mean.size, 1000))
    seen, beyond = (
        (((J - mean) / size).reshape(len(J), -1) @ ways).max(axis=0) for J in (looked, others)
    )
    return max(float(np.max(beyond / np.maximum(seen, 1e-300))) - 1.0, 0.0)


class _Looked:
    """Points of a box (y, int z), and the total Jacobians of a loop at them.

    What lies between is answered for by a margin: other points tell by which share the hull of the
    Jacobians may fall short (`beyond`), and all are moved away from their mean by as much. A metric
    that fits them then fits the enlarged hull.
    """

    def __init__(self, loop: Loop, region: Region, h: float | None) -> None:
        self.loop, self.h, (self.low, self.high) = loop, h, region.limits
        self.step, n, rng = 1e-6 * (self.high - self.low), loop.n, np.random.default_rng(0)
        grid = spread(self.low, self.high, min(region.points, int(_GRID ** (0.5 / n))))
        others = rng.uniform(self.low, self.high, (2, _CHECKS, 2 * n))
        points, self.keep = np.concatenate([grid, others[0]]), np.arange(2 * n)
        whole = self.at(points)
        if not whole[:, :n, n:].any():  # the command does not depend on int z
            self.keep = np.arange(n)
        at = self.keep[:, None], self.keep
        looked, fresh = whole[:, at[0], at[1]], self.at(others[1])
        self.beyond, self.mean = shortfall(looked, fresh), looked.mean(axis=0)
        self.points = np.concatenate([points, others[1]])
        self.jacobians = self.outward(np.concatenate([looked, fresh]))
        # how far off a difference may be: rounding of the loop, and of the solver under a hold
        size = (np.abs(whole) @ np.abs(points)[..., None]).max(axis=0)
        size = size + np.abs(self.move(points)).max(axis=0)[:, None]
        solved = 0.0 if h is None or loop.plant.constant else 1e-7
        self.slack = (4e-16 / self.step * size + solved * np.abs(whole).max(axis=0))[at]

    def move(self, s: Array) -> Array:
        """The right-hand side, or the next sample."""
        return self.loop.field(0.0, s) if self.h is None else self.loop.step(s, self.h)

    def at(self, s: Array) -> Array:
        """Total Jacobians (N, m, m) at states (N, 2n)."""
        J = differences(self.move, s, self.step)
        n, bad = self.loop.n, ~np.isfinite(J).all(axis=(1, 2))
        if bad.any():
            raise ValueError(f"the loop is not finite at y = {_text(s[np.argmax(bad), :n])}")
        if len(self.keep) == n and J[:, :n, n:].any():
            raise ValueError("the policy uses int z in a part of the box only")
        return J[:, self.keep[:, None], self.keep]

    def outward(self, J: Array) -> Array:
        """Jacobians moved away from their mean by the share that others may lie beyond them."""
        return np.asarray(self.mean + (1 + self.beyond) * (J - self.mean))

    def rates(self, metric: Array, s: Array) -> Array:
        """Rates in a metric at states (N, 2n), lowered by what rounding may hide, (N,)."""
        return rates_in(self.at(s), metric, self.h, self.slack)

    def certificate(self, progress: Progress | None) -> tuple[Certificate, Array, Array, float]:
        """The best answer, points it was tried at, their rates and a margin, or what resists it."""
        for turn in range(_ROUNDS):
            if progress is not None:
                progress(f"box, round {turn + 1}: Jacobians at {len(self.points)} points")
            found = common_metric(self.jacobians, h=self.h, slack=self.slack, progress=progress)
            if found.metric is None:
                assert found.violated is not None
                away = np.abs(self.jacobians - found.violated).max(axis=(1, 2))
                return found, self.points, away, 0.0
            worst = np.argsort(rates_in(self.jacobians, found.metric, self.h))[:_WORST]
            points, rates, margin = lowest(
                partial(self.rates, found.metric),
                self.points[worst],
                lambda s: np.clip(s, self.low, self.high),
                0.1 * (self.high - self.low),
            )
            if rates.min() - margin > 0.3 * found.rate:
                break
            new = points[np.argsort(rates)[:_WORST]]
            self.points = np.concatenate([self.points, new])
            self.jacobians = np.concatenate([self.jacobians, self.outward(self.at(new))])
        return found, points, rates, margin

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


def _text(vector: Array) -> str:
    return "[" + ", ".join(f"{x:.3g}" for x in vector) + "]"
