"""Lesson 11: the low level learns through its model, and both levels learn for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.fast import budget
from cmc.learning.latent import LatentLow
from cmc.learning.low_level import Fixed, Segment, evaluate, set_gain
from cmc.learning.state import single_thread
from cmc.lessons.lesson_11 import MM, STUDIES
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.studies.old.two_level import TwoLevelStudy
from cmc.studies.old.two_level_parts import build, build_low

Array = NDArray[np.float64]
Show = Callable[..., object]


def learn_low(
    force_weight: float = 0.0,
    start: float = 0.05,
    show: Show | None = None,
    updates: int | None = None,
    regime: str = "stiff",
) -> dict[str, Any]:
    """Let the low level learn through the latent model alone: no planner, no simulator.

    Args:
        force_weight: price of a newton beyond the threshold of 1 N.
        start: slope that learning starts from, as a share of the cap.
        show: called with the update and the slope in x as a share of its cap.
        updates: Adam steps; fewer in fast mode.
        regime: "soft" or "stiff".

    Returns:
        `update` (U,), `share` (U, 3): bounds on the slopes in x, y, z over the cap; `y` (m/s^2),
        `before` and `after`: actions (y, 3) in m/s^2; `press`: force (3,), N, with which the model
        leans on a wall 5 mm before the sub-goal; `level`: action (3,) at which that is 1 N, m/s^2;
        `low`, and `seen`, what it was before.
    """
    study = STUDIES[regime]
    rates = replace(study.latent, force_weight=force_weight, rate=2e-2, batch=32, blocked=0.4)
    low, seen = (_starting(replace(study, latent=rates), start) for _ in range(2))
    low.record(_starts(np.random.default_rng(0)))
    count = (budget(200, 90) if force_weight else budget(60, 30)) if updates is None else updates
    share, limit, net = [], study.slope_cap("ctd3")[:3], _net(low)
    with single_thread():
        for k in range(count + 1):
            share.append(net.slope_bounds()[1][0, :3, 0] / limit)
            if show is not None:
                show(k, float(share[-1][0]))
            if k < count:
                low.update()
    y, largest = np.linspace(-0.1, 0.1, 81), study.task.u_limit[0]
    model = low.model
    pull, mass = 0.005 * model.K_p[:3], model.mass[:3]
    full = largest * _actions(low.actor, 0.005 * model.K1[:1])[0]
    return {
        "update": np.arange(count + 1),
        "share": np.array(share),
        "y": y,
        "before": largest * _actions(seen.actor, y),
        "after": largest * _actions(low.actor, y),
        "press": mass * (pull + full),
        "level": low.config.force_limit / mass - pull,
        "low": Fixed(low.actor),
        "seen": Fixed(seen.actor),
    }


def _starting(study: TwoLevelStudy, start: float) -> LatentLow:
    low = build_low(study, "ctd3", [0])
    assert isinstance(low, LatentLow)
    set_gain(_net(low), start * study.slope_cap("ctd3"))
    return low


def _net(low: Any) -> PositiveNetwork:
    actor = low.actor
    assert isinstance(actor, ModularPolicy)
    assert isinstance(actor.network, PositiveNetwork)
    return actor.network


def _actions(actor: Any, y: Array) -> Array:
    """Actions (y, 3) of the translation axes for the same y in each, without an integral."""
    seen = np.zeros((1, len(y), 12))
    seen[0, :, :6] = y[:, None]
    return evaluate(actor, seen)[0, :, :3]


def _starts(rng: np.random.Generator, number: int = 1024) -> Segment:
    """Segments that begin up to 5 mm and 0.1 rad from their sub-goal, at some speed."""
    first = np.zeros((1, 1, number, 25))
    size = np.repeat([0.005, 0.1], 3)
    first[..., 12:18] = rng.uniform(-size, size, (number, 6))
    first[..., 18:24] = 2.0 * size * rng.standard_normal((number, 6))
    return Segment(first, np.zeros(0), {}, np.zeros(0))


def train_both(show: Show | None = None, steps: int | None = None, seed: int = 0) -> dict[str, Any]:
    """Train planner and low level together for a while, and a planner without a low level.

    Args:
        show: called after every segment with the steps and both mean distances, mm.
        steps: environment steps; 12,800, or 1600 in fast mode.
        seed: of both.

    Returns:
        `step` (K,), mean distance to the goal by method (K,), mm, and `share`, (K,): the slope in
        x over its cap.
    """
    count = budget(12_800, 1600) if steps is None else steps
    study = STUDIES["soft"]
    short = replace(study, hierarchy=replace(study.hierarchy, warm_up=count // 4))
    trainers = {name: build(short, name, [seed]) for name in ("ctd3", "control")}
    found: dict[str, list[float]] = {"step": [], "ctd3": [], "control": [], "share": []}
    with single_thread():
        while trainers["ctd3"].steps < count:
            for name, trainer in trainers.items():
                found[name].append(-MM * float(trainer.segment()[0]))
            found["step"].append(trainers["ctd3"].steps)
            bound = _net(trainers["ctd3"].low).slope_bounds()[1][0, 0, 0]
            found["share"].append(float(bound / study.slope_cap("ctd3")[0]))
            if show is not None:
                show(found["step"][-1], found["ctd3"][-1], found["control"][-1])
    return {name: np.array(values) for name, values in found.items()}
