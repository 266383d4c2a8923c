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

from cmc.theory.arrays import Array, checked
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.ball import ball_in_box
from cmc.theory.certificates import Certificate, Domain, common_metric, rates_in
from cmc.theory.jacobians import differences
from cmc.theory.simulate import Loop
from cmc.theory.tracking import jumps

total_jacobian = differences

Transforms = Callable[[Array], AuxiliarySpace]

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
            raise ValueError(f"a region needs y_low < y_high, both (n,), got {low} and {high}")
        reach = checked("integral", self.integral, above=0.0)
        if reach.shape not in ((), low.shape):
            raise ValueError(f"integral needs one number or ({len(low)},), got {reach.shape}")
        if not 2 <= self.points <= 101:
            raise ValueError(f"points needs 2 to 101 points per axis, got {self.points}")

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

    def check(self, n: int) -> None:
        """Refuse another number of signals than `n`."""
        if len(self.corners[0]) != n:
            raise ValueError(f"region needs {n} signals, got {len(self.corners[0])}")

    def grid(self, points: int | None = None) -> Array:
        """Latent signals, (N, n): a grid where it has at most 1024 points, else spread evenly."""
        return _spread(*self.corners, self.points if points is None else points)

    def __str__(self) -> str:
        box = " x ".join(f"[{a:.3g}, {b:.3g}]" for a, b in zip(*self.corners, strict=True))
        return f"y in {box}"


def _spread(low: Array, high: Array, points: int) -> Array:
    """A grid of at most 1024 points; corners and random points where it would have more."""
    m = len(low)
    if points**m <= _GRID:
        axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, m)
    unit = np.random.default_rng(0).random((_GRID, m))
    if m <= 8:
        ends = np.stack(np.meshgrid(*[[0.0, 1.0]] * m, indexing="ij"), axis=-1).reshape(-1, m)
        unit = np.concatenate([ends, unit, np.full((1, m), 0.5)])
    return np.asarray(low + unit * (high - low))


def closed_loop(
    policy: Any,
    plant: Any,
    spaces: Transforms,
    *,
    y_ref: ArrayLike = 0.0,
    h: float | None = None,
) -> Callable[[Array], Array]:
    """Vector field of `cmc.theory.simulate.Loop` in (y, int z), or with `h` its step."""
    loop = Loop(plant, policy, spaces, y_ref)
    return (lambda s: loop.field(0.0, s)) if h is None else (lambda s: loop.step(s, h))


def certify_exact(
    policy: Any,
    plant: Any,
    spaces: Transforms,
    region: Region,
    *,
    h: float | None = None,
    y_ref: ArrayLike = 0.0,
) -> Certificate:
    """Exact certificate of one policy over a box of (y, int z).

    One metric is sought for the total Jacobians at 1024 points or so, then tried at 2048 others and
    around the worst of all; what fails joins the vertices, a few rounds at most.

    Args:
        policy: As in `cmc.theory.simulate.closed_loop`.
        plant: As there.
        spaces: Transforms as a function of y.
        region: The box.
        h: Sample time, s; continuous without it.
        y_ref: Where the latent signal is to go, (n,).

    Returns:
        A certificate whose metric is in (y, int z), or in y alone where the policy does not use
        int z; refused where the policy cannot be evaluated or a transform jumps.
    """
    domain: Domain = "continuous" if h is None else "sampled"
    where = f"{region}, |int z| at most {np.asarray(region.integral).tolist()}"

    def refuse(reason: object) -> Certificate:
        return Certificate(False, "exact", domain, region=where, reason=str(reason), refused=True)

    n, (low, high) = plant.n, region.limits
    step, rng = 1e-6 * (high - low), np.random.default_rng(0)
    try:
        if jumps(spaces, *region.corners):
            return refuse(
                "T_y jumps inside the region (order or sign of its eigenvectors): track them along "
                "the path, or shrink the region"
            )
        loop = Loop(plant, policy, spaces, y_ref)
        keep = slice(2 * n) if _integrates(loop, low, high) else slice(n)

        def jacobians(s: Array) -> Array:
            move = (lambda x: loop.field(0.0, x)) if h is None else (lambda x: loop.step(x, h))
            J = differences(move, s, step)[:, keep, keep]
            if not np.isfinite(J).all():
                bad = s[np.flatnonzero(~np.isfinite(J).all(axis=(1, 2)))[0], :n]
                raise ValueError(f"the loop is not finite at y = {bad}")
            return J

        points = _spread(low, high, min(region.points, int(_GRID ** (1 / (2 * n)))))
        vertices, answer = jacobians(points), None
        for _ in range(_ROUNDS):
            answer = common_metric(vertices, h=h)
            if answer.metric is None:
                break
            near = points[np.argsort(rates_in(vertices, answer.metric, h))[:64]]
            around = near + rng.normal(size=(8, *near.shape)) * 0.05 * (high - low)
            tried = np.concatenate(
                [rng.uniform(low, high, (_CHECKS, 2 * n)), around.reshape(-1, 2 * n)]
            )
            tried = np.clip(tried, low, high)
            checks = jacobians(tried)
            rates = rates_in(checks, answer.metric, h)
            if rates.min() > 0.3 * answer.rate:
                break
            worst = np.argsort(rates)[:20]
            points = np.concatenate([points, tried[worst]])
            vertices = np.concatenate([vertices, checks[worst]])
    except (ValueError, TypeError, np.linalg.LinAlgError) as error:
        return refuse(error)
    if answer is None or answer.metric is None or rates.min() <= 0:
        assert answer is not None
        reason = (
            answer.reason if answer.metric is None else "metrics that fit the grid fail between"
        )
        violated = answer.violated if answer.metric is None else checks[int(np.argmin(rates))]
        return Certificate(
            False,
            "exact",
            domain,
            violated=violated,
            region=where,
            reason=reason,
            evidence="points",
        )
    answer = replace(
        answer,
        kind="exact",
        rate=min(answer.rate, float(rates.min())),
        region=where,
        reason=f"one metric at all {len(vertices) + len(checks)} points of the box that were "
        "looked at, while the trajectories stay in it",
        evidence="points",
    )
    return ball_in_box(answer, loop, np.arange(2 * n)[keep], low, high, h)


def _integrates(loop: Loop, low: Array, high: Array) -> bool:
    """Whether the command depends on int z at all."""
    s = np.random.default_rng(1).uniform(low, high, (64, len(low)))
    other = s.copy()
    other[:, loop.n :] *= -0.37
    return bool((loop.field(0.0, s) != loop.field(0.0, other)).any())
