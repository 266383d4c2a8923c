"""Hand a policy and a plant to the theory and be told what is guaranteed, where, and how strongly.

Three roads, and every answer says which one was taken:

* everywhere, from the interval of the policy's slopes, where the plant's Jacobians are constant:
  one small problem for each block of the transformed plant (one mode, or a complex pair), joined as
  a hierarchy, and then one metric for all corners. It holds for every policy within the interval;
* in a box, from the total Jacobian of the loop (`cmc.theory.exact`), where they are not, or where
  the slopes have no floor;
* frozen, on request: the transforms held where they move. It never holds: it proves nothing.

Each asks first whether the question is the right one: as many commands as signals, Jacobians that
belong to f, a policy with one action a signal that was told the plant's own sign of R, slopes that
are within the bounds it states. Command limits are outside of all three; `Certificate.ball` says
from where on they are never reached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.action import factor_of, inner, slope_interval
from cmc.theory.arrays import Array, number
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.ball import ball_everywhere
from cmc.theory.certificates import Certificate, common_metric, rate_in
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region, certify_exact
from cmc.theory.hierarchy import BlockLoop, compose_hierarchical
from cmc.theory.jacobians import jacobian_fault, require_square
from cmc.theory.sampled import hold
from cmc.theory.simulate import transforms_of

Transforms = Callable[[Array], AuxiliarySpace]
# Corner matrices of the whole loop are listed up to this many modes, 4^8 = 65536 of them.
_MOST_MODES = 8


def certify(
    policy: Any,
    plant: Any,
    *,
    region: Region | None = None,
    h: float | None = None,
    kind: str | None = None,
    transforms: AuxiliarySpace | Transforms | None = None,
    y_ref: ArrayLike = 0.0,
) -> Certificate:
    """Say what is guaranteed about a policy on a plant.

    Args:
        policy: Signed slopes (n, 2), or anything with `slope_bounds() -> (lower, upper)`,
            magnitudes before the sign rule, ([seeds,] n, 2); in a box any policy that
            `cmc.theory.simulate.closed_loop` takes.
        plant: Has `n`, `f`, `f_y`, `f_u`, `constant`, bounds `y_low`, `y_high`, and limits
            `u_low`, `u_high`.
        region: Box that is looked at where nothing is proved everywhere; the plant's own bounds by
            default where its Jacobians vary.
        h: Sample time of a zero-order hold, s; continuous control without it.
        kind: "exact" (the default) or "frozen".
        transforms: T_y and T_a in place of `decompose`, fixed or as a function of y (..., n).
        y_ref: Where the latent signal is to go, (n,); its deviation is what the policy sees.

    Returns:
        A certificate. Whatever stands in the way (complex or defective modes, slopes that can
        vanish, a transform that jumps) is its `reason`; `refused` marks questions it cannot answer.

    Raises:
        TypeError: if the policy has no slopes and no region is given.
        ValueError: if shapes do not fit or `kind` is unknown.
    """
    if kind not in (None, "exact", "frozen"):
        raise ValueError(f"kind needs to be 'exact', 'frozen' or None, got {kind!r}")
    require_square(plant)
    try:
        policy = inner(policy)
    except ValueError as error:
        return Certificate(False, reason=str(error), refused=True)
    h = None if h is None else number("h", h, above=0.0)
    box = Region(plant.y_low, plant.y_high) if region is None else region
    box.check(plant.n)

    def refuse(reason: object) -> Certificate:
        return Certificate(
            False, domain="continuous" if h is None else "sampled", reason=str(reason), refused=True
        )

    if fault := jacobian_fault(plant, *box.corners):
        return refuse(fault)
    try:
        spaces = transforms_of(plant, transforms, np.mean(box.corners, axis=0))
        centre = spaces(np.mean(box.corners, axis=0))
    except (ValueError, np.linalg.LinAlgError) as error:
        return refuse(f"{error}{_instead(plant, transforms)}")
    if (centre.gains == 0).any():
        return refuse("R has a zero on its diagonal: some action does not move its own signal")
    if kind == "frozen" and (callable(transforms) or not plant.constant):
        return _frozen(policy, spaces, box, h)
    if callable(transforms) or not plant.constant:
        answer = certify_exact(policy, plant, spaces, box, h=h, y_ref=y_ref)
        if answer.refused:
            return replace(answer, reason=f"{answer.reason}{_instead(plant, transforms)}")
        return answer
    try:
        answer = _everywhere(policy, plant, centre, h, y_ref)
    except TypeError:
        if region is None:
            raise
        answer = refuse("nothing bounds the slopes of the policy")
    except ValueError as error:
        answer = refuse(error)
    if answer.holds or region is None or "wrong way" in answer.reason:
        return answer
    inside = certify_exact(policy, plant, spaces, box, h=h, y_ref=y_ref)
    return replace(inside, reason=f"{inside.reason}. Not everywhere: {answer.reason}")


def _instead(plant: Any, transforms: Any) -> str:
    """Which other transforms fit the plant's box, as a clause, or ""."""
    if transforms is not None:
        return ""
    found = [option.name for option in transforms_that_fit(plant) if option.possible]
    if not found:
        return ""
    return f" (what fits: {', '.join(found)}; see combinations.transforms_that_fit)"


def _everywhere(
    policy: Any, plant: Any, space: AuxiliarySpace, h: float | None, y_ref: ArrayLike
) -> Certificate:
    """All policies within the interval of the slopes, on a plant with constant Jacobians."""
    domain = "continuous" if h is None else "sampled"

    def no(reason: str, violated: Array | None = None) -> Certificate:
        return Certificate(False, domain=domain, violated=violated, reason=reason)  # type: ignore[arg-type]

    low, high = slope_interval(policy, space.gains)
    if told := _wrong_sign(policy, space):
        return no(told)
    loop = BlockLoop(plant, space, low, high, h)
    for i in range(space.n):
        if high[i, 1] * low[i, 1] <= 0 and (low[i, 1] != 0 or high[i, 1] != 0):
            return no(
                f"Dimension {i + 1}: the slope in int z has no floor above 0 (tanh saturates), so "
                "no rate holds; a linear bypass (slope_min > 0) repairs it, or a region"
            )
    metrics, rates = [], []
    for block in loop.blocks:
        part = loop.block(block)
        if not part.holds:
            names = " and ".join(str(i + 1) for i in block)
            where = f"Dimension{'s' * (len(block) > 1)} {names}"
            return no(f"{where}: {_hint(loop, block) or part.reason}", part.violated)
        assert part.metric is not None
        metrics.append(part.metric)
        rates.append(part.rate)
    metric, rate = compose_hierarchical(metrics, rates, loop.couplings(), h=h)
    order = np.argsort(np.concatenate([loop.states(block) for block in loop.blocks]))
    metric, reason = (
        metric[np.ix_(order, order)],
        "every dimension contracts, joined as a hierarchy",
    )
    if space.n > _MOST_MODES:
        doubt = rate - rate_in(loop.matrix(low)[None], metric, h, loop.slack)
        rate = min(rate, rate - doubt) if doubt > 0 else rate
    else:
        corners = loop.corners(range(space.n))
        found = common_metric(corners, h=h, slack=loop.slack)
        rate = rate_in(corners, metric, h, loop.slack)
        if found.holds and found.metric is not None:
            metric, rate = found.metric, found.rate
            reason = f"one metric for {len(corners)} corners of the slopes"
    if not rate > 0:
        return no("every dimension contracts, but rounding hides whether they do together")
    answer = Certificate(True, domain=domain, rate=rate, metric=metric, reason=reason)  # type: ignore[arg-type]
    return ball_everywhere(answer, policy, plant, space, (low, high), loop.keep, h, y_ref)


def _wrong_sign(policy: Any, space: AuxiliarySpace) -> str:
    """What a policy that was told another sign of R than the plant's should hear, or ""."""
    if not hasattr(policy, "slope_bounds"):
        return ""
    wrong = np.flatnonzero(factor_of(policy, space.gains) * space.gains < 0)
    if not len(wrong):
        return ""
    i = int(wrong[0])
    return (
        f"Dimension {i + 1}: the policy pushes the wrong way: it was told another sign of R than "
        f"the plant's R = {space.gains[i]:.4g} (`ModularPolicy(R=...)`)"
    )


def _hint(loop: BlockLoop, block: list[int]) -> str:
    """Which slope to lower or raise, for one dimension in continuous time; else ""."""
    if loop.h is not None or len(block) > 1:
        return ""
    i = block[0]
    R, Lambda = loop.R[i, i], loop.Lambda[i, i]
    p, q = -R * np.stack([loop.low[i], loop.high[i]]).T  # loop gains, positive where they damp
    if p.min() - Lambda <= 0 and q.min() >= 0:
        return f"Lambda = {Lambda:.4g} 1/s demands a slope floor above {Lambda / abs(R):.4g} in z"
    if q.min() > 0:
        most = (p.min() - Lambda + np.sqrt(q.min())) ** 2 / abs(R)
        if q.max() / abs(R) >= most:
            return (
                f"no quadratic metric fits all slopes: the cap of the slope in int z, "
                f"{q.max() / abs(R):.4g}, would have to be below {most:.4g}, or the floor in z "
                "higher"
            )
    return ""


def _frozen(policy: Any, spaces: Transforms, box: Region, h: float | None) -> Certificate:
    """What each instant would have: one metric for the corners at a few points, and no proof."""
    points = box.grid(3)
    domain = "continuous" if h is None else "sampled"
    where = f"{box}, at {len(points)} points"
    try:
        space = spaces(points)
        vertices = []
        for k in range(len(points)):
            Lambda, R = space.Lambda[k], space.R[k]
            if h is not None:
                Lambda, R = hold(Lambda, R, h)
            low, high = slope_interval(policy, space.gains[k])
            ends = [np.unique(pair) for pair in np.stack([low, high], -1).reshape(-1, 2)]
            slopes = np.array(list(product(*ends))).reshape(-1, space.n, 2)
            here = replace(space, T_y=space.T_y[k], T_a=space.T_a[k], Lambda=Lambda, R=R)
            if h is None:
                vertices.append(here.loop(slopes))
                continue
            slopes[..., 0] += h * slopes[..., 1]
            step = here.loop(slopes)
            step[:, space.n :] = np.hstack([h * np.eye(space.n), np.eye(space.n)])
            vertices.append(step)
        found = common_metric(np.concatenate(vertices), h=h)
    except (ValueError, np.linalg.LinAlgError) as error:
        return Certificate(False, "frozen", domain, region=where, reason=str(error), refused=True)  # type: ignore[arg-type]
    reason = (
        f"every instant by itself contracts (rate {found.rate:.3g} 1/s), which proves nothing "
        "where the transforms move; kind='exact' does"
        if found.holds
        else found.reason
    )
    return replace(found, holds=False, kind="frozen", region=where, reason=reason)
