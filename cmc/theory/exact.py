"""Exact certificates: the total Jacobian of the loop in (y, int z), nothing held constant.

With u = u0 + T_a(y) a, a = -sign(R) pi(z, I), z = T_y(y) (y - y_ref), I' = z, the Jacobian of the
loop contains d(T_a)/dy a and d(T_y)/dy (y - y_ref), which the frozen analysis drops. They are taken
here by central differences of the closed loop itself, so that nothing can be forgotten.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certificates import Certificate, Domain, common_metric
from cmc.theory.contraction import contraction_factor, contraction_rate

Array = NDArray[np.float64]
Field = Callable[[Array], Array]

_ROUNDS = 4
_CHECKS = 3000
_SUBSTEPS = 8


@dataclass(frozen=True)
class Region:
    """A box of latent signals, and of their integrals where the total Jacobian needs them.

    Attributes:
        y_low: Lower corner, (n,).
        y_high: Upper corner, (n,).
        integral: Largest |int z| per dimension, (n,) or one number; only exact certificates of
            plants with varying Jacobians use it.
        points: Grid points per axis.
    """

    y_low: ArrayLike
    y_high: ArrayLike
    integral: ArrayLike = 1.0
    points: int = 7

    def __post_init__(self) -> None:
        low, high = np.asarray(self.y_low, dtype=float), np.asarray(self.y_high, dtype=float)
        if low.ndim != 1 or low.shape != high.shape or not (low < high).all():
            raise ValueError(f"a region needs y_low < y_high, both (n,), got {low} and {high}")
        if self.points < 2:
            raise ValueError(f"a region needs at least 2 points per axis, got {self.points}")

    def grid(self) -> Array:
        """Grid of latent signals, (points, ..., points, n)."""
        low, high = np.asarray(self.y_low, dtype=float), np.asarray(self.y_high, dtype=float)
        axes = [np.linspace(a, b, self.points) for a, b in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def __str__(self) -> str:
        low, high = np.asarray(self.y_low, dtype=float), np.asarray(self.y_high, dtype=float)
        box = " x ".join(f"[{a:.3g}, {b:.3g}]" for a, b in zip(low, high, strict=True))
        return f"y in {box}"


def total_jacobian(field: Field, s: ArrayLike, step: float = 1e-5) -> Array:
    """Jacobian of a vector field (or of a step) by central differences, (..., m, m).

    Args:
        field: Maps (..., m) to (..., m).
        s: Points, (..., m).
        step: Half width of the difference; its error is of order step^2.
    """
    s = np.asarray(s, dtype=float)
    shift = step * np.eye(s.shape[-1])
    up, down = field(s[..., None, :] + shift), field(s[..., None, :] - shift)
    return np.swapaxes((up - down) / (2 * step), -1, -2)


def closed_loop(
    policy: Any,
    plant: Any,
    spaces: Callable[[Array], AuxiliarySpace],
    *,
    y_ref: ArrayLike = 0.0,
    h: float | None = None,
) -> Field:
    """Vector field of the loop in s = (y, int z), or with `h` its step from sample to sample.

    Args:
        policy: Has `pi(s)` on numpy arrays, or a torch module `network`; optionally `u0` and
            `normalise`, as `cmc.policies.ModularPolicy` has.
        plant: Has `n` and `f`.
        spaces: Transforms as a function of y.
        y_ref: Where the latent signal is to go, (n,).
        h: Sample time, s.

    Raises:
        TypeError: if the policy cannot be evaluated.
    """
    pi, n, goal = _evaluator(policy), plant.n, np.asarray(y_ref, dtype=float)
    u0 = np.asarray(getattr(policy, "u0", 0.0), dtype=float)
    normalise = bool(getattr(policy, "normalise", False))

    def signal(y: Array, space: AuxiliarySpace) -> Array:
        return space.to_z(y - goal)

    def command(z: Array, I: Array, space: AuxiliarySpace) -> Array:
        size = 1 / np.abs(space.gains) if normalise else 1.0
        # constraint_sign
        return u0 + space.to_u(-np.sign(space.gains) * size * pi(np.stack([z, I], axis=-1)))

    def field(s: Array) -> Array:
        y, I = s[..., :n], s[..., n:]
        space = spaces(y)
        z = signal(y, space)
        return np.concatenate([plant.f(y, command(z, I, space)), z], axis=-1)

    def step(s: Array) -> Array:
        assert h is not None
        y, I = s[..., :n], s[..., n:]
        space = spaces(y)
        z = signal(y, space)
        I = I + h * z
        u, dt = command(z, I, space), h / _SUBSTEPS
        for _ in range(_SUBSTEPS):
            a = plant.f(y, u)
            b = plant.f(y + dt / 2 * a, u)
            c = plant.f(y + dt / 2 * b, u)
            y = y + dt / 6 * (a + 2 * b + 2 * c + plant.f(y + dt * c, u))
        return np.concatenate([y, I], axis=-1)

    return field if h is None else step


def _evaluator(policy: Any) -> Callable[[Array], Array]:
    """The policy's networks as a function of numpy arrays, in double precision."""
    if hasattr(policy, "pi"):
        return policy.pi  # type: ignore[no-any-return]
    network = getattr(policy, "network", policy)
    if not (callable(network) and hasattr(network, "parameters")):
        raise TypeError(f"{type(policy).__name__} has neither pi(s) nor a network to evaluate")
    network = copy.deepcopy(network).double()
    like = next(network.parameters())

    def pi(s: Array) -> Array:
        flat = network(like.new_tensor(s.reshape(-1, *s.shape[-2:])))
        return flat.detach().numpy().reshape(s.shape[:-1])

    return pi


def certify_exact(
    policy: Any,
    plant: Any,
    spaces: Callable[[Array], AuxiliarySpace],
    region: Region,
    *,
    h: float | None = None,
    y_ref: ArrayLike = 0.0,
) -> Certificate:
    """Exact certificate of one policy over a box of (y, int z).

    One metric is sought for the total Jacobians on a grid, then tried at 3000 random points between
    them; the worst of those join the vertices until none is left, a few rounds at most.

    Args:
        policy: As in `closed_loop`.
        plant: As in `closed_loop`.
        spaces: Transforms as a function of y.
        region: Region with `grid()` and `integral`.
        h: Sample time, s; continuous without it.
        y_ref: Where the latent signal is to go, (n,).

    Returns:
        A certificate whose metric is in (y, int z); refused where the policy cannot be evaluated
        or a transform jumps.
    """
    domain: Domain = "continuous" if h is None else "sampled"
    where = f"{region}, |int z| at most {np.asarray(region.integral).tolist()}"

    def refuse(reason: str) -> Certificate:
        return Certificate(False, "exact", domain, region=where, reason=reason, refused=True)

    try:
        field = closed_loop(policy, plant, spaces, y_ref=y_ref, h=h)
    except TypeError as error:
        return refuse(str(error))
    if _jumps(spaces, region.grid()):
        return refuse(
            "T_y jumps inside the region (order or sign of its eigenvectors): track them along "
            "the path, or shrink the region"
        )
    n, rng = plant.n, np.random.default_rng(0)
    low, high = _bounds(region, n)
    try:
        vertices = total_jacobian(field, _coarse(low, high, region.points))
        checks = total_jacobian(field, rng.uniform(low, high, (_CHECKS, 2 * n)))
    except (ValueError, np.linalg.LinAlgError) as error:
        return refuse(str(error))
    return replace(_cutting_planes(vertices, checks, h), region=where)


def _cutting_planes(vertices: Array, checks: Array, h: float | None) -> Certificate:
    """Find a metric for the vertices, try it on the checks, add the worst, repeat."""
    answer = common_metric(vertices, h=h)
    for _ in range(_ROUNDS):
        if answer.metric is None:
            return answer
        if h is None:
            rates = contraction_rate(checks, answer.metric)
        else:
            rates = -np.log(contraction_factor(checks, answer.metric)) / h
        if rates.min() > 0:
            total = len(vertices) + len(checks)
            return Certificate(
                True,
                "exact",
                answer.domain,
                rate=min(answer.rate, float(rates.min())),
                metric=answer.metric,
                reason=f"one metric at all {total} points of the box that were looked at, "
                "while the trajectories stay in it",
                evidence="points",
            )
        worst = np.argsort(rates)[:20]
        vertices = np.concatenate([vertices, checks[worst]])
        answer = common_metric(vertices, h=h)
    return Certificate(
        False,
        "exact",
        answer.domain,
        violated=checks[int(np.argmin(rates))],
        reason="metrics that fit the grid fail between its points",
    )


def _bounds(region: Region, n: int) -> tuple[Array, Array]:
    """Corners of the box in (y, int z), (2n,) each."""
    reach = np.broadcast_to(np.asarray(region.integral, dtype=float), (n,))
    low = np.concatenate([np.asarray(region.y_low, dtype=float), -reach])
    return low, np.concatenate([np.asarray(region.y_high, dtype=float), reach])


def _coarse(low: Array, high: Array, points: int) -> Array:
    """Grid over (y, int z): `points` per axis of y, three per integral, (N, 2n)."""
    n = len(low) // 2
    counts = [points] * n + [3] * n
    axes = [np.linspace(a, b, k) for a, b, k in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2 * n)


def _jumps(spaces: Callable[[Array], AuxiliarySpace], grid: Array) -> bool:
    """Whether neighbouring points of the grid disagree about an eigenvector by more than 60 deg."""
    V = np.linalg.inv(spaces(grid).T_y)
    V = V / np.linalg.norm(V, axis=-2, keepdims=True)
    for axis in range(grid.ndim - 1):
        ahead = np.take(V, range(1, grid.shape[axis]), axis)
        behind = np.take(V, range(grid.shape[axis] - 1), axis)
        if ((ahead * behind).sum(axis=-2) < 0.5).any():
            return True
    return False
