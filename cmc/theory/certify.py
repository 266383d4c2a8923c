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
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, filled, need, number
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.ball import ball_everywhere
from cmc.theory.certificates import Certificate, Progress, common_metric, corners, rates_in
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region, certify_exact, spread
from cmc.theory.identification import jacobian_fault
from cmc.theory.metric_search import search_metric
from cmc.theory.sampled import hold
from cmc.theory.simulate import Transforms, transforms_of
from cmc.theory.slopes import BlockLoop, compose_hierarchical, factor_of, inner, slope_interval

# Corner matrices of the whole loop are listed up to this many modes, 4^8 = 65536 of them.
_MOST_MODES = 8


def certify(
    policy: Any,
    plant: Any,
    *,
    region: Region | None = None,
    h: float | None = None,
    kind: str = "exact",
    transforms: AuxiliarySpace | Transforms | None = None,
    y_ref: ArrayLike = 0.0,
    progress: Progress | None = None,
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
        kind: "exact" or "frozen".
        transforms: T_y and T_a in place of `decompose`, fixed or as a function of y (..., n).
        y_ref: Where the latent signal is to go, (n,); its deviation is what the policy sees.
        progress: Called with a line of text as a long question goes on, such as `print`.

    Returns:
        A certificate. Whatever stands in the way (complex or defective modes, slopes that can
        vanish, a transform that jumps) is its `reason`, with what would help: which slope to lower
        or raise, and to what where that is known (as slopes act: behind the 1/|R_ii| of a policy
        that normalises). `refused` marks questions it cannot answer; a policy without slopes and
        without a region raises a TypeError.
    """
    if not (isinstance(kind, str) and kind in ("exact", "frozen")):
        raise ValueError(f"kind needs to be 'exact' or 'frozen', got {kind!r}")
    fits = all(hasattr(plant, name) for name in ("n", "f", "f_y", "f_u", "constant"))
    need(fits, "plant", "n, f, f_y, f_u and constant, as Plant has", plant)
    need(region is None or isinstance(region, Region), "region", "a Region or None", region)
    fits = progress is None or callable(progress)
    need(fits, "progress", "a function of a line of text", progress)
    y_ref = filled("y_ref", y_ref, plant.n)
    h = None if h is None else number("h", h, above=0.0)
    domain = "continuous" if h is None else "sampled"

    def refuse(reason: object) -> Certificate:
        return Certificate(False, domain=domain, reason=str(reason), refused=True)

    try:
        policy = inner(policy)
    except ValueError as error:
        return refuse(error)
    box = Region(plant.y_low, plant.y_high) if region is None else region
    if len(box.corners[0]) != plant.n:
        raise ValueError(f"region needs {plant.n} signals, got {len(box.corners[0])}")
    if fault := jacobian_fault(plant, *box.corners):
        return refuse(fault)
    try:
        spaces = transforms_of(plant, transforms, np.mean(box.corners, axis=0))
        centre = spaces(np.mean(box.corners, axis=0))
    except (ValueError, np.linalg.LinAlgError) as error:
        return refuse(f"{error}{_instead(plant, transforms)}")
    need(isinstance(centre, AuxiliarySpace), "transforms", "to return an AuxiliarySpace", centre)
    if (centre.gains == 0).any():
        return refuse("R has a zero on its diagonal: some action does not move its own signal")
    if callable(transforms) or not plant.constant:
        if kind == "frozen":
            return _frozen(policy, spaces, box, h)
        answer = certify_exact(policy, plant, spaces, box, h=h, y_ref=y_ref, progress=progress)
        if answer.refused:
            return replace(answer, reason=f"{answer.reason}{_instead(plant, transforms)}")
        return answer
    try:
        answer = _everywhere(policy, plant, centre, h, y_ref, progress)
    except TypeError:
        if region is None:
            raise
        answer = refuse("nothing bounds the slopes of the policy")
    except ValueError as error:
        answer = refuse(error)
    if answer.holds or region is None or "wrong way" in answer.reason:
        return answer
    inside = certify_exact(policy, plant, spaces, box, h=h, y_ref=y_ref, progress=progress)
    return replace(inside, reason=f"{inside.reason}. Not everywhere: {answer.reason}")


def _instead(plant: Any, transforms: Any) -> str:
    """Which other transforms fit the plant's box, as a clause, or ""."""
    if transforms is not None:
        return ""
    found = ", ".join(option.name for option in transforms_that_fit(plant) if option.possible)
    return f" (what fits: {found}; see combinations.transforms_that_fit)" if found else ""


def _everywhere(
    policy: Any,
    plant: Any,
    space: AuxiliarySpace,
    h: float | None,
    y_ref: ArrayLike,
    progress: Progress | None,
) -> Certificate:
    """All policies within the interval of the slopes, on a plant with constant Jacobians."""
    domain = "continuous" if h is None else "sampled"

    def no(reason: str, violated: Array | None = None) -> Certificate:
        return Certificate(False, domain=domain, violated=violated, reason=reason)

    low, high = slope_interval(policy, space.gains)
    if hasattr(policy, "slope_bounds"):
        for i in np.flatnonzero(factor_of(policy, space.gains) * space.gains < 0):
            return no(
                f"Dimension {i + 1}: the policy pushes the wrong way: it was told another sign of "
                f"R than the plant's R = {space.gains[i]:.4g} (`ModularPolicy(R=...)`)"
            )
    for i in np.flatnonzero((high * low <= 0)[:, 1] & ((low != 0) | (high != 0))[:, 1]):
        return no(
            f"Dimension {i + 1}: the slope in int z has no floor above 0 (tanh saturates), so no "
            "rate holds; a linear bypass (slope_min > 0) repairs it, or a region"
        )
    loop = BlockLoop(plant, space, low, high, h)
    metrics, rates = [], []
    for block in loop.blocks:
        part = loop.block(block)
        if not part.holds:
            where = f"Dimension{'s' * (len(block) > 1)} {' and '.join(str(i + 1) for i in block)}"
            return no(f"{where}: {part.reason}{_help(loop, block)}", part.violated)
        assert part.metric is not None
        metrics.append(part.metric)
        rates.append(part.rate)
    metric, rate = compose_hierarchical(metrics, rates, loop.couplings(), h=h)
    order = np.argsort(np.concatenate([loop.states(block) for block in loop.blocks]))
    metric = metric[np.ix_(order, order)]
    reason = "every dimension contracts, joined as a hierarchy"
    if space.n > _MOST_MODES:
        rate = min(rate, float(rates_in(loop.matrix(low)[None], metric, h, loop.slack)[0]))
    else:
        whole = loop.corners(range(space.n))
        found = common_metric(whole, h=h, slack=loop.slack, progress=progress)
        rate = float(rates_in(whole, metric, h, loop.slack).min())
        if found.holds and found.metric is not None:
            metric, rate = found.metric, found.rate
            reason = f"one metric for {len(whole)} corners of the slopes"
    if not rate > 0:
        return no("every dimension contracts, but rounding hides whether they do together")
    answer = Certificate(True, domain=domain, rate=rate, metric=metric, reason=reason)
    return ball_everywhere(answer, loop, policy, plant, y_ref)


def _help(loop: BlockLoop, block: list[int]) -> str:
    """What would make a block contract: its slopes (magnitudes) and where they would have to be."""
    if len(block) > 2 or loop.n > _MOST_MODES:
        return ""
    if len(block) == 1 and (bound := _bound(loop, block[0])):
        return f"; {bound}"
    turned = np.abs(loop.low) > np.abs(loop.high)
    floor, cap = np.where(turned, loop.high, loop.low), np.where(turned, loop.low, loop.high)
    tried, at = copy(loop), loop.states(block)

    def holds(share: float, times: float = 1.0) -> bool:
        """Whether slopes up to a share of the way from floor to cap, all `times` as large, fit."""
        ends = times * np.stack([floor, floor + share * (cap - floor)])
        tried.low, tried.high = ends.min(axis=0), ends.max(axis=0)
        inside = tried.corners(block)[:, at[:, None], at]
        return search_metric(inside, discrete=loop.h is not None)[0] is not None

    def most(test: Callable[[float], bool]) -> float:
        low, high = 0.0, 1.0
        for _ in range(6):
            middle = (low + high) / 2
            low, high = (middle, high) if test(middle) else (low, middle)
        return low

    if holds(0.0):
        caps = np.abs(floor + most(holds) * (cap - floor))[block]
        shown = " and ".join(f"({p:.3g}, {q:.3g})" for p, q in caps)
        return f"; lower the caps of the slopes in z and int z to {shown}"
    if (times := most(lambda x: holds(1.0, x))) > 0:
        return f"; lower all slopes to {times:.2g} times what they are"
    raised = next((x for x in (2.0, 5.0, 20.0) if holds(1.0, x)), None)
    return f"; raise all slopes to {raised:g} times what they are" if raised else ""


def _bound(loop: BlockLoop, i: int) -> str:
    """The bound that slopes of one dimension break whatever the metric, or ""."""
    h, R, Lambda = loop.h, loop.space.R[i, i], loop.space.Lambda[i, i]
    p, q = -R * np.stack([loop.low[i], loop.high[i]]).T  # loop gains, positive where they damp
    size, grows = abs(R), Lambda if h is None else Lambda - 1.0  # per second, or per sample
    if p.min() - grows <= 0 and q.min() >= 0:
        return (
            f"an open-loop growth of {Lambda:.4g} {'1/s' if h is None else 'a sample'} demands a "
            f"slope floor above {grows / size:.4g} in z, it is {p.min() / size:.4g}"
        )
    if q.min() <= 0:
        return ""
    if h is not None:
        most, reached = 1 + Lambda, p.max() + h / 2 * q.max()
        if reached >= most:
            return (
                f"at this sample time the caps need (slope in z) + h/2 (slope in int z) below "
                f"{most / size:.4g}, they reach {reached / size:.4g}: lower both to "
                f"{most / reached:.2g} times, or sample faster"
            )
        return ""
    damping = p.min() - Lambda
    most = (damping + np.sqrt(q.min())) ** 2
    if q.max() < most:
        return ""
    floor = Lambda + np.sqrt(q.max()) - np.sqrt(q.min())
    return (
        f"no quadratic metric fits all slopes: lower the cap of the slope in int z from "
        f"{q.max() / size:.4g} to below {most / size:.4g}, or raise the floor in z from "
        f"{p.min() / size:.4g} to above {floor / size:.4g}"
    )


def _frozen(policy: Any, spaces: Transforms, box: Region, h: float | None) -> Certificate:
    """What each instant would have: one metric for the corners at a few points, and no proof."""
    points = spread(*box.corners, 3)
    domain = "continuous" if h is None else "sampled"
    where = f"{box}, at {len(points)} points"
    try:
        space = spaces(points)
        vertices = []
        for k in range(len(points)):
            Lambda, R = space.Lambda[k], space.R[k]
            if h is not None:
                Lambda, R = hold(Lambda, R, h)
            here = replace(space, T_y=space.T_y[k], T_a=space.T_a[k], Lambda=Lambda, R=R)
            vertices.append(here.loop(corners(*slope_interval(policy, space.gains[k])), h))
        found = common_metric(np.concatenate(vertices), h=h)
    except (ValueError, np.linalg.LinAlgError) as error:
        return Certificate(False, "frozen", domain, region=where, reason=str(error), refused=True)
    reason = (
        f"every instant by itself contracts (rate {found.rate:.3g} 1/s), which proves nothing "
        "where the transforms move; kind='exact' does"
        if found.holds
        else found.reason
    )
    return replace(found, holds=False, kind="frozen", region=where, reason=reason)
