"""Hand a policy and a plant to the theory and be told what is guaranteed, where, and how strongly.

Two roads, and every answer says which one was taken:

* from the policy's slope bounds alone. The loop splits into one 2 x 2 problem per dimension (circle
  criterion or corner matrices) that a hierarchical metric joins. It holds for every policy within
  the bounds. It is exact where the plant's Jacobians are constant, and frozen elsewhere;
* from the total Jacobian of the loop in (y, int z), the derivatives of T_y and T_a included, over a
  box. It is exact for this one policy, at every point that was looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import (
    Certificate,
    Domain,
    Kind,
    best_conditioned,
    circle_criterion,
    common_metric,
    compose_hierarchical,
    loop_jacobian,
    rate_in,
)
from cmc.theory.exact import Region, certify_exact
from cmc.theory.sampled import hold_lag

Array = NDArray[np.float64]
# Beyond this many corner matrices the hierarchical metric is taken as it is.
_MOST_CORNERS = 600

Transforms = Callable[[Array], AuxiliarySpace]


def certify(
    policy: Any,
    plant: Any,
    *,
    region: Region | None = None,
    h: float | None = None,
    kind: Kind | None = None,
    transforms: AuxiliarySpace | Transforms | None = None,
    y_ref: ArrayLike = 0.0,
) -> Certificate:
    """Say what is guaranteed about a policy on a plant.

    Args:
        policy: Has `slope_bounds() -> (lower, upper)`, magnitudes of the slopes before the sign
            rule, ([seeds,] n, 2). Exact certificates of plants with varying Jacobians evaluate it:
            `pi(s)` on numpy arrays (..., n, 2), or a torch module `network`.
        plant: Has `n`, `f`, `f_y`, `f_u`, `hold`, bounds `y_low`, `y_high`, and `constant`.
        region: Box that is looked at, on its grid; the plant's own bounds by default.
        h: Sample time of a zero-order hold, s; continuous control without it.
        kind: "exact", "frozen", or None for exact where the plant's Jacobians are constant and
            frozen elsewhere.
        transforms: T_y and T_a in place of `decompose`, fixed or as a function of y (..., n).
        y_ref: Where the latent signal is to go, (n,); its deviation is what the policy sees.

    Returns:
        A certificate. Whatever stands in the way (complex or defective modes, slopes that can
        vanish, a transform that jumps) is its `reason`; `refused` marks questions it cannot answer.

    Raises:
        TypeError: if the policy has no `slope_bounds`.
        ValueError: if shapes do not fit or `kind` is unknown.
    """
    if kind not in (None, "exact", "frozen"):
        raise ValueError(f"kind needs to be 'exact', 'frozen' or None, got {kind!r}")
    lower, upper = _slopes(policy, plant.n)
    region = Region(plant.y_low, plant.y_high) if region is None else region
    spaces = _as_function(transforms, plant)
    constant = plant.constant and not callable(transforms)
    kind = kind or ("exact" if constant else "frozen")
    domain: Domain = "continuous" if h is None else "sampled"
    points = region.grid()
    looked = "everywhere" if constant else f"{region}, at {points[..., 0].size} grid points"
    if constant:
        points = points[(0,) * plant.n][None]
    try:
        space = spaces(points)
    except (ValueError, np.linalg.LinAlgError) as error:
        return Certificate(False, kind, domain, region=looked, reason=str(error), refused=True)
    if kind == "exact" and not constant:
        return certify_exact(policy, plant, spaces, region, h=h, y_ref=y_ref)
    if getattr(policy, "normalise", False):
        # the policy divides by R_ii: its slopes are loop gains already
        R = space.R / np.abs(space.gains)[..., None, :]
        space = replace(space, R=R)
    if _triangular(space):
        answer = _by_dimension(space, lower, upper, h, kind)
    else:
        answer = _all_at_once(space, lower, upper, h, kind)
    return replace(answer, region=looked, evidence="proof" if constant else "points")


def _slopes(policy: Any, n: int) -> tuple[Array, Array]:
    """Slope magnitudes (n, 2); with an axis of seeds the interval that covers all of them."""
    if not hasattr(policy, "slope_bounds"):
        raise TypeError(f"{type(policy).__name__} has no slope_bounds(): nothing bounds its slopes")
    lower, upper = (np.asarray(bound, dtype=float) for bound in policy.slope_bounds())
    lower, upper = lower.reshape(-1, n, 2).min(axis=0), upper.reshape(-1, n, 2).max(axis=0)
    if not np.isfinite([lower, upper]).all() or (lower < 0).any() or (lower > upper).any():
        raise ValueError(f"slope bounds need 0 <= lower <= upper, got {lower} and {upper}")
    return lower, upper


def _as_function(transforms: AuxiliarySpace | Transforms | None, plant: Any) -> Transforms:
    if callable(transforms):
        return transforms
    fixed = transforms

    def spaces(y: Array) -> AuxiliarySpace:
        u = plant.hold(y)
        f_y, f_u = plant.f_y(y, u), plant.f_u(y, u)
        if fixed is None:
            return decompose(f_y, f_u)
        return AuxiliarySpace.from_transforms(fixed.T_y, fixed.T_a, f_y, f_u)

    return spaces


def _triangular(space: AuxiliarySpace) -> bool:
    """Whether Lambda is diagonal and R upper triangular, to rounding."""
    off = space.Lambda - space.Lambda * np.eye(space.n)
    below = np.tril(space.R, -1)
    scale_L, scale_R = np.abs(space.Lambda).max(), np.abs(space.R).max()
    return bool(np.abs(off).max() <= 1e-9 * scale_L and np.abs(below).max() <= 1e-9 * scale_R)


def _hull(values: Array) -> Array:
    """Smallest and largest value over all points, (2,), or (1,) where they agree."""
    low, high = float(values.min()), float(values.max())
    return np.array([low, high] if high - low > 1e-12 * max(abs(low), abs(high)) else [high])


def _corners(*axes: Array) -> list[Array]:
    """All combinations of the ends of several intervals, one array per interval."""
    return [np.array(column) for column in zip(*product(*axes), strict=True)]


def _by_dimension(
    space: AuxiliarySpace, lower: Array, upper: Array, h: float | None, kind: Kind
) -> Certificate:
    """One 2 x 2 problem per dimension, joined by a hierarchical metric."""
    n, blocks = space.n, []
    domain: Domain = "continuous" if h is None else "sampled"
    for i in range(n):
        weak = _floor_missing(space, lower[i], i)
        block = weak or _one_dimension(
            space.eigenvalues[..., i], np.abs(space.gains[..., i]), lower[i], upper[i], h, kind
        )
        if not (isinstance(block, Certificate) and block.holds):
            reason = block if isinstance(block, str) else block.reason
            violated = None if isinstance(block, str) else block.violated
            reason = f"Dimension {i + 1}: {reason}"
            return Certificate(False, kind, domain, violated=violated, reason=reason)
        blocks.append(block)
    couplings = {
        (i, j): _coupling(space, i, j, lower[j], upper[j], h)
        for i in range(n)
        for j in range(i + 1, n)
    }
    metrics = [block.metric for block in blocks if block.metric is not None]
    metric, rate = compose_hierarchical(metrics, [b.rate for b in blocks], couplings, h=h)
    # blocks are ordered (z_1, I_1, z_2, I_2, ...), certificates (z_1, ..., z_n, I_1, ..., I_n)
    order = np.arange(2 * n).reshape(n, 2).T.ravel()
    metric = metric[np.ix_(order, order)]
    vertices = _all_corners(space, lower, upper, h)
    if vertices is not None:
        # the hierarchy proves contraction; among all metrics that do, take a well conditioned one
        metric = best_conditioned(vertices, metric, 0.9 * rate, h)
        rate = rate_in(vertices, metric, h)
    reason = "every dimension contracts, joined as a hierarchy"
    return Certificate(True, kind, domain, rate=rate, metric=metric, reason=reason)


def _all_corners(
    space: AuxiliarySpace, lower: Array, upper: Array, h: float | None
) -> Array | None:
    """Corner matrices of the whole loop, (V, 2n, 2n); None where they are too many."""
    n, drift, drive = space.n, space.eigenvalues, space.R
    if h is not None:
        drift, drive = hold_lag(drift, np.ones_like(drift), h)[0], _held_drive(space, h)
    upper_right = np.triu_indices(n)
    drive = drive * np.sign(space.gains)[..., None, :]  # the sign rule, once for all
    axes = [_hull(drift[..., i]) for i in range(n)]
    axes += [_hull(drive[..., i, j]) for i, j in zip(*upper_right, strict=True)]
    axes += [np.unique([a, b]) for a, b in zip(lower.ravel(), upper.ravel(), strict=True)]
    if np.prod([len(axis) for axis in axes]) > _MOST_CORNERS:
        return None
    corners = np.array(list(product(*axes)))
    count = len(corners)
    L, R = np.zeros((count, n, n)), np.zeros((count, n, n))
    L[:, range(n), range(n)] = corners[:, :n]
    R[:, upper_right[0], upper_right[1]] = corners[:, n : n + len(upper_right[0])]
    k1, k2 = np.moveaxis(corners[:, -2 * n :].reshape(count, n, 2), -1, 0)
    if h is None:
        return loop_jacobian(L, R, -k1, -k2)
    step = loop_jacobian(L, R, -(k1 + h * k2), -k2)
    step[:, n:, :n], step[:, n:, n:] = h * np.eye(n), np.eye(n)
    return step


def _held_drive(space: AuxiliarySpace, h: float) -> Array:
    """R as it acts over one hold: row i is driven through its own lag, (..., n, n)."""
    Lambda = np.broadcast_to(space.eigenvalues[..., :, None], space.R.shape)
    return hold_lag(Lambda, space.R, h)[1]


def _floor_missing(space: AuxiliarySpace, lower: Array, i: int) -> str:
    """What is wrong with the lower ends of the slopes, or an empty string."""
    grow, gain = float(space.eigenvalues[..., i].max()), float(np.abs(space.gains[..., i]).min())
    if lower[1] <= 0:
        return (
            "the slope in int z has no floor above 0 (tanh saturates), so no rate holds; "
            "a linear bypass (slope_min > 0) repairs it"
        )
    if grow - gain * lower[0] >= 0:
        return f"Lambda = {grow:.4g} 1/s demands a slope floor above {grow / gain:.4g} in z"
    return ""


def _one_dimension(
    Lambda: Array, gain: Array, lower: Array, upper: Array, h: float | None, kind: Kind
) -> Certificate:
    """Certificate of one dimension in (z_i, int z_i) for slopes in a box."""
    slopes = [np.unique([lower[j], upper[j]]) for j in (0, 1)]
    if h is not None:
        phi, G = hold_lag(Lambda, gain, h)
        # affine in each of phi, G, k1, k2 alone: the corners span the rest
        f, g, k1, k2 = _corners(_hull(phi), _hull(G), *slopes)
        rows = np.stack([f - g * (k1 + h * k2), -g * k2], axis=-1)
        below = np.broadcast_to([h, 1.0], rows.shape)
        return common_metric(np.stack([rows, below], axis=-2), h=h, kind=kind)
    L, g, k1, k2 = _corners(_hull(Lambda), _hull(gain), *slopes)
    c, k = g * k1 - L, g * k2
    if np.ptp(c) <= 1e-12 * np.abs(c).max():
        return circle_criterion(float(c[0]), float(k.min()), float(k.max()), kind=kind)
    # the interval of stiffness does not depend on the sign of the damping's corner
    rows = np.stack([-c, -k], axis=-1)
    below = np.broadcast_to([1.0, 0.0], rows.shape)
    return common_metric(np.stack([rows, below], axis=-2), kind=kind)


def _coupling(
    space: AuxiliarySpace, i: int, j: int, lower: Array, upper: Array, h: float | None
) -> Array:
    """Corners of the block through which dimension j drives dimension i, (V, 2, 2)."""
    drive = space.R[..., i, j]
    if h is not None:
        drive = hold_lag(space.eigenvalues[..., i], drive, h)[1]
    r, k1, k2 = _corners(_hull(drive), *(np.unique([lower[m], upper[m]]) for m in (0, 1)))
    top = np.stack([r * (k1 + (h or 0.0) * k2), r * k2], axis=-1)
    return np.stack([top, np.zeros_like(top)], axis=-2)


def _all_at_once(
    space: AuxiliarySpace, lower: Array, upper: Array, h: float | None, kind: Kind
) -> Certificate:
    """One metric for all corners of the slopes, where the transforms leave no hierarchy."""
    if h is not None:
        reason = "sampled control needs a diagonal Lambda and an upper triangular R"
        return Certificate(False, kind, "sampled", reason=reason, refused=True)
    n = space.n
    sign = -np.sign(space.gains).reshape(-1, 1, n)
    Lambda, R = (m.reshape(-1, 1, n, n) for m in (space.Lambda, space.R))
    ends = [np.unique(pair) for pair in np.stack([lower, upper], -1).reshape(2 * n, 2)]
    slopes = np.array(list(product(*ends))).reshape(-1, n, 2)
    J = loop_jacobian(Lambda, R, sign * slopes[..., 0], sign * slopes[..., 1])
    return common_metric(J.reshape(-1, 2 * n, 2 * n), kind=kind)
