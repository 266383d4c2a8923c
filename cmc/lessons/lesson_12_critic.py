"""Lesson 12: what a low level's critic can know, and three ways to a gradient, without a robot.

Everything here happens in the latent model that the push gains make, e'' + K_d e' + K_p e + u = 0
on each axis, in free space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cmc.envs.peg_push import PUSH
from cmc.fast import budget
from cmc.learning.latent import LatentModel
from cmc.learning.low_level import CriticLow, LowLevel, Segment
from cmc.learning.state import single_thread
from cmc.lessons.lesson_12 import LATENT, low_level
from cmc.studies.old import peg_push
from cmc.studies.old.two_level_evaluation import slope_at_rest
from cmc.studies.old.two_level_parts import build_low

Array = NDArray[np.float64]
Act = Callable[[Array], Array]
WAYS = {
    "td3": "free weights, plain critic",
    "ctd3_paper": "positive weights, plain critic (the paper's)",
    "td3_corrected": "free weights, corrected critic",
    "ctd3": "positive weights and cap, through the model",
}
"""Low levels that `three_ways` trains, by method of the study."""
MODEL = LatentModel(
    LATENT.K_p,
    LATENT.K_d,
    LATENT.K1,
    LATENT.K2,
    np.array(PUSH.u_limit),
    np.zeros(6),
    np.repeat([1.0, 0.0], 3),
    PUSH.tick,
)
_MOTION, _PUSH = MODEL.transition()


def free_run(act: Act, e: Array, v: Array, integral: Array | None = None, first: int = 0) -> Array:
    """Errors (ticks + 1, ..., 6) of the rest of a segment in free space.

    Args:
        act: maps (y, integral of y, e, tip velocity, time to go) (..., 25) to actions (..., 6).
        e: errors (..., 6) at the first tick.
        v: their rates e'.
        integral: of y before the first tick; 0 if None.
        first: ticks of the segment that have passed.
    """
    integral = np.zeros_like(e) if integral is None else integral
    errors = [e]
    for k in range(first, PUSH.horizon):
        seen, integral = observe(e, v, integral, k)
        e, v = advance(e, v, act(seen))
        errors.append(e)
    return np.array(errors)


def observe(e: Array, v: Array, integral: Array, k: int) -> tuple[Array, Array]:
    """What a low level sees at tick k of a segment (..., 25), and the new integral."""
    y = LATENT.K1 * e + LATENT.K2 * v  # mapping_pos
    integral = integral + MODEL.tick * MODEL.integrates * y
    left = np.full((*e.shape[:-1], 1), (PUSH.horizon - k) * PUSH.tick)
    return np.concatenate([y, integral, e, -v, left], axis=-1), integral


def advance(e: Array, v: Array, u: Array) -> tuple[Array, Array]:
    """One tick of the model with u held."""
    step = np.einsum("...nj,nij->...ni", np.stack([e, v], -1), _MOTION) + _PUSH * u[..., None]
    return step[..., 0], step[..., 1]


def _gain(slope: float) -> Act:
    return lambda seen: low_level(np.array(slope), seen[..., :6], seen[..., 6:12])


def _axis(x: Array) -> Array:
    """Values of one axis (...) as arrays (..., 6), at rest in the others."""
    return np.concatenate([x[..., None], np.zeros((*x.shape, 5))], axis=-1)


def twins(offset: float = 0.001, slope: float = 20.0) -> dict[str, Any]:
    """Two starts with y = 0: the tip 1 mm short of the sub-goal, and 1 mm past it.

    Both have e' = -(K1 / K2) e, so the low level sees the same signals at every tick.

    Args:
        offset: distance from the sub-goal, m.
        slope: gain of the low level.

    Returns:
        `t` ms, `e` (T, 2) mm, `y` (T, 2) m/s^2, `value`: returns (2,) in mm ticks, and `slope`:
        the effect of the first action on them (2,), in mm ticks for each unit.
    """
    e = _axis(np.array([offset, -offset]))
    v = -LATENT.K1 / LATENT.K2 * e
    act = _gain(slope)
    path = free_run(act, e, v)
    signals, rate, total = [], v, np.zeros_like(e)
    for k in range(PUSH.horizon):
        seen, total = observe(e, rate, total, k)
        signals.append(seen[:, 0])
        e, rate = advance(e, rate, act(seen))
    start = _axis(np.array([offset, -offset]))
    return {
        "t": 1e3 * PUSH.tick * np.arange(PUSH.horizon + 1),
        "e": 1e3 * path[..., 0],
        "y": np.array(signals),
        "value": 1e3 * _value(path[..., :1]),
        "slope": 1e3 * action_slope(act, start, v, axes=(0,))[..., 0],
    }


def _value(path: Array) -> Array:
    """Return of a segment from its errors (ticks + 1, ..., n): minus the summed distances."""
    value: Array = -np.linalg.norm(path[1:], axis=-1).sum(0)
    return value


def action_slope(
    act: Act,
    e: Array,
    v: Array,
    integral: Array | None = None,
    first: int = 0,
    axes: Sequence[int] = (0, 1, 2),
    delta: float = 0.05,
) -> Array:
    """Slope d return / d u of the present action, (..., axes), in m ticks: exact, by the model."""
    slopes = []
    before = np.zeros_like(e) if integral is None else integral
    for axis in axes:
        values = []
        for sign in (1.0, -1.0):
            seen, total = observe(e, v, before, first)
            u = act(seen)
            u[..., axis] += sign * delta
            following = advance(e, v, u)
            rest = free_run(act, *following, total, first + 1)
            values.append(-np.linalg.norm(rest[..., :3], axis=-1).sum(0))
        slopes.append((values[0] - values[1]) / (2 * delta))
    return np.stack(slopes, axis=-1)


def plane(size: int = 61, slope: float = 20.0) -> dict[str, Any]:
    """Returns of a segment, and the effect of its first action, over error and velocity.

    Returns:
        `e` (size,) mm, `v` (size,) mm/s, velocity of the tip; `value` (size, size), mm ticks, and
        `gain` (size, size), the effect of one unit of the first action, mm ticks, rows by velocity;
        `y_zero` (size,) mm/s: the velocity at which y = 0.
    """
    e, speed = np.linspace(-0.006, 0.006, size), np.linspace(-0.1, 0.1, size)
    E, V = (_axis(part) for part in np.meshgrid(e, -speed))
    act = _gain(slope)
    return {
        "e": 1e3 * e,
        "v": 1e3 * speed,
        "value": 1e3 * _value(free_run(act, E, V)[..., :1]),
        "gain": 1e3 * action_slope(act, E, V, axes=(0,))[..., 0],
        "y_zero": 1e3 * LATENT.K1[0] / LATENT.K2[0] * e,
    }


def three_ways(segments: int | None = None, seeds: Sequence[int] = (0, 1)) -> dict[str, Any]:
    """Train the low levels of `WAYS` on random sub-goals in the free-space model.

    Each is the study's own, with its own exploration and its own number of updates.

    Args:
        segments: of each of 8 worlds; 160, or 8 in fast mode.
        seeds: one training each.

    Returns:
        `ticks` (K,), environment steps of each seed at which the others are known; and by
        method a dictionary with `covered` (K, seeds): share of a 5 mm step in 20 ticks, `offset`
        (K, seeds): largest |u| at y = 0, `slope` (K, seeds): smallest slope at rest in
        translation; and for those with a critic `agreement` (seeds,): share of visited states
        and axes in which dQ/du has the sign of the exact effect, after training.
    """
    count = budget(160, 8) if segments is None else segments
    marks = sorted({0, *np.linspace(0, count, 9).astype(int).tolist()})
    answer: dict[str, Any] = {}
    with single_thread():
        for name in WAYS:
            answer[name] = _train(name, list(seeds), count, marks)
    worlds = peg_push.STUDY.hierarchy.worlds
    return {"ticks": PUSH.horizon * worlds * np.array(marks), **answer}


def ways_table(found: dict[str, Any]) -> str:
    """Markdown: what `three_ways` found at its end."""
    head = (
        f"After {found['ticks'][-1]:,} steps of each seed:\n\n| low level | covers of a 5 mm step "
        "| action at $y = 0$ | smallest slope at rest | $dQ/du$ has the right sign |\n"
        "|---|---|---|---|---|\n"
    )
    rows = []
    for name, title in WAYS.items():
        way = found[name]
        signs = f"{np.mean(way['agreement']):.0%}" if "agreement" in way else "no critic"
        covered = " to ".join(f"{f(way['covered'][-1]):.0%}" for f in (np.min, np.max))
        rows.append(
            f"| {title} | {covered} | {way['offset'][-1].max():.2f} "
            f"| {way['slope'][-1].min():.2f} | {signs} |"
        )
    return head + "\n".join(rows)


def _train(name: str, seeds: list[int], count: int, marks: list[int]) -> dict[str, Array]:
    study, low = peg_push.STUDY, build_low(peg_push.STUDY, name, seeds)
    worlds, rate = study.hierarchy.worlds, 4 if name == "ctd3" else study.hierarchy.low_updates
    shape = (len(seeds), worlds, 6)
    rng, v = np.random.default_rng(0), np.zeros(shape)
    log: dict[str, list[Array]] = {"covered": [], "offset": [], "slope": []}
    due, last = 0.0, None
    for number in range(count + 1):
        if number in marks:
            for key, value in _figures(low, len(seeds)).items():
                log[key].append(value)
        if number == count:
            break
        e = rng.uniform(study.task.subgoal_low, study.task.subgoal_high, shape)
        last, v = _segment(low, e, v)
        low.record(last)
        due += PUSH.horizon * worlds * rate / study.hierarchy.samples
        while due >= 1.0:
            low.update()
            due -= 1.0
    found = {key: np.array(rows) for key, rows in log.items()}
    if isinstance(low, CriticLow) and last is not None:
        found["agreement"] = agreement(low, last)
    return found


def _segment(low: LowLevel, e: Array, v: Array) -> tuple[Segment, Array]:
    """One segment with exploration from errors and rates (seeds, worlds, 6), and the last rates."""
    total, views, actions, far, turned = np.zeros_like(e), [], [], [], []
    for k in range(PUSH.horizon):
        seen, total = observe(e, v, total, k)
        u = low.act(seen, explore=True)
        e, v = advance(e, v, u)
        views.append(seen)
        actions.append(u)
        far.append(-np.linalg.norm(e[..., :3], axis=-1))
        turned.append(-np.linalg.norm(e[..., 3:], axis=-1))
    views.append(observe(e, v, total, PUSH.horizon)[0])
    tracking = {"translation": np.array(far), "rotation": np.array(turned)}
    none = np.zeros_like(tracking["rotation"])
    return Segment(np.array(views), np.array(actions), tracking, none), v


def _figures(low: LowLevel, seeds: int) -> dict[str, Array]:
    e = np.zeros((seeds, 1, 6))
    e[..., 0] = 0.005
    path = free_run(lambda seen: low.act(seen, False), e, np.zeros_like(e))
    rest = low.act(np.zeros((seeds, 1, 25)), explore=False)
    slope = slope_at_rest(peg_push.STUDY, low, seeds)[:, :3]
    return {
        "covered": 1.0 - path[-1, :, 0, 0] / 0.005,
        "offset": np.abs(rest[:, 0]).max(-1),
        "slope": slope.min(-1),
    }


def agreement(low: CriticLow, segment: Segment, every: int = 3) -> Array:
    """How often the critic's dQ/du has the sign of the exact effect, (seeds,), in translation."""
    hits: list[Array] = []

    def act(seen: Array) -> Array:
        return low.act(seen, explore=False)

    for k in range(0, PUSH.horizon - 1, every):
        seen = segment.observation[k]
        y, total, e, speed = (seen[..., 6 * i : 6 * i + 6] for i in range(4))
        before = total - MODEL.tick * MODEL.integrates * y
        exact = action_slope(act, e, -speed, before, k)
        view = torch.from_numpy(seen[..., : low.size].astype(np.float32))
        u = torch.from_numpy(act(seen).astype(np.float32)).requires_grad_()
        value = low.agent.values(low.agent.critics, view, u)[:, 0].sum()
        (slope,) = torch.autograd.grad(value, u)
        hits.append(np.sign(slope.numpy()[..., :3]) == np.sign(exact))
    found: Array = np.mean(hits, axis=(0, 2, 3))
    return found
