"""Tests of the two peg studies: success, contact force, penetration, gains, consistency."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv
from torch import nn

from cmc.learning.hierarchy import low_fields
from cmc.learning.low_level import Fixed, LowLevel, evaluate
from cmc.robot.panda import FINGERTIP, JOINTS, inverse_kinematics
from cmc.studies.old.two_level import TwoLevelStudy
from cmc.studies.old.two_level_parts import N

Array = NDArray[np.float64]
TEST_SEED = 900_000  # test worlds never share a stream with training
PUSH = 2.0
"""Force on the tip when consistency under pushes is measured, N."""


@dataclass(frozen=True)
class Episodes:
    """What test episodes showed; S seeds, M episodes each, T ticks.

    Attributes:
        success: at the last tick, (S, M). touched: at any tick, (S, M).
        total: sum of rewards, (S, M).
        distance: of the tip to the goal, smallest and at the end, (S, M) each, m.
        force: at the end of each tick, (T, S, M), N. force_max: over its physics steps, N.
        penetration: deepest of each episode, (S, M), m.
    """

    success: NDArray[np.bool_]
    touched: NDArray[np.bool_]
    total: Array
    nearest: Array
    final: Array
    force: Array
    force_max: Array
    penetration: Array


def run_episodes(
    study: TwoLevelStudy,
    planner: nn.Module,
    low: LowLevel,
    seeds: int,
    episodes: int,
    start: int = TEST_SEED,
) -> Episodes:
    """Run deterministic test episodes of all seeds side by side.

    Args:
        study: configuration.
        planner: sub-goals for (seeds, worlds, size).
        low: the low level.
        seeds: how many trained seeds S the networks hold.
        episodes: test episodes of each.
        start: seed of the first test world.
    """
    task = study.task_class(study.task, num=seeds * episodes, seed=start)
    planning = study.planning()
    obs = task.reset()
    shape = (seeds, episodes)
    total, deepest = np.zeros(task.num), np.zeros(task.num)
    nearest, touched = np.full(task.num, np.inf), np.zeros(task.num, dtype=bool)
    force, force_max = [], []
    fields = low_fields(task)
    for tick in range(study.task.ticks):
        if tick % study.task.horizon == 0:
            seen = planning.observe(task, obs).reshape(*shape, -1)
            aim = planning.subgoal(evaluate(planner, seen))
            obs = task.set_subgoal(aim.reshape(task.num, -1))
        u = low.act(task.select(obs, fields).reshape(*shape, -1), explore=False)
        obs, reward, _, _, info = task.step(u.reshape(task.num, -1))
        missing = task.select(obs, ("goal",)) - task.select(obs, ("position",))
        distance = np.sqrt((missing**2).sum(-1))
        total += reward
        nearest = np.minimum(nearest, distance)
        touched |= info["success"]
        deepest = np.maximum(deepest, info["penetration"])
        force.append(info["contact_force"].reshape(shape).astype(np.float32))
        force_max.append(info["contact_force_max"].reshape(shape).astype(np.float32))
    return Episodes(
        info["success"].reshape(shape),
        touched.reshape(shape),
        total.reshape(shape),
        nearest.reshape(shape),
        distance.reshape(shape),
        np.array(force),
        np.array(force_max),
        deepest.reshape(shape),
    )


def summary(found: Episodes, every: bool = False) -> dict[str, Any]:
    """Figures of test episodes, per seed where they differ; JSON.

    Args:
        found: the episodes.
        every: whether both distances to the goal of every episode are added, as `nearest_mm_all`
            and `final_mm_all`, lists by seed of lists, rounded to 0.01 mm.

    Returns:
        Shares of `success` (last tick) and of `touched` (any tick) with intervals over all
        episodes, `passed_by` (share that touched but was elsewhere at the last tick), `return`,
        medians of the distances `nearest_mm` and `final_mm`, shares of ticks by contact `force`,
        and the deepest `penetration_mm`.
    """
    shares = {}
    for rule, force in (("at_50_hz", found.force), ("largest", found.force_max)):
        shares[rule] = {
            "zero": float((force == 0).mean()),
            "below_1_N": float((force < 1).mean()),
            "below_5_N": float((force < 5).mean()),
            "largest_N": float(force.max()),
        }
    distances = {"nearest_mm": 1e3 * found.nearest, "final_mm": 1e3 * found.final}
    each = {f"{name}_all": mm.round(2).tolist() for name, mm in distances.items()}
    return {
        "episodes": found.success.shape[1],
        "success": found.success.mean(1).tolist(),
        "success_interval": interval(int(found.success.sum()), found.success.size),
        "touched": found.touched.mean(1).tolist(),
        "touched_interval": interval(int(found.touched.sum()), found.touched.size),
        "passed_by": (found.touched & ~found.success).mean(1).tolist(),
        "return": found.total.mean(1).tolist(),
        **{name: np.median(mm, axis=1).tolist() for name, mm in distances.items()},
        **(each if every else {}),
        "force": shares,
        "penetration_mm": (1e3 * found.penetration.max(1)).tolist(),
    }


def interval(hits: int, tries: int, level: float = 0.95) -> list[float]:
    """Clopper-Pearson interval of a share; exact, and blind to differences between seeds."""
    tail = (1 - level) / 2
    low = betaincinv(hits, tries - hits + 1, tail) if hits else 0.0
    high = betaincinv(hits + 1, tries - hits, 1 - tail) if hits < tries else 1.0
    return [float(low), float(high)]


def consistency(
    study: TwoLevelStudy, low: LowLevel, seeds: int, starts: int = 16
) -> dict[str, Array]:
    """Spread of the tip's displacement over one segment for one sub-goal, over starts and pushes.

    In free space (the task without its obstacles) every world starts an episode anew, is moved by a
    random sub-goal for one segment, so that it starts the next one elsewhere and in motion, and is
    then asked for a step of 5 mm along -x. Afterwards it goes back to where that step began and
    does it again while a force of `PUSH` newtons acts on the tip, in a direction drawn for each
    start uniformly on the sphere and fixed for the segment. Starts and pushes are the same for all
    seeds and methods. Sub-goals are not clamped here, so that the step is 5 mm everywhere.

    Returns:
        Over starts, per seed: `mean`, the displacement along the step, (seeds,), m; `mean_vector`,
        the displacement, (seeds, 3), m; `spread`, the root of the summed variances of the
        displacement, (seeds,), m; `pushed`, the root mean square distance between the ends of the
        segment with the push and without it from the same start, (seeds,), m.
    """
    free = _free_space(study)
    task = free.task_class(free.task, num=seeds * starts)
    task.seed([TEST_SEED + 1 + k for k in range(starts)] * seeds)
    rng = np.random.default_rng(TEST_SEED)
    low_end, high_end = np.array(study.task.subgoal_low), np.array(study.task.subgoal_high)
    task.reset()
    first = rng.uniform(low_end, high_end, (starts, len(low_end)))
    direction = rng.standard_normal((starts, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    obs = task.set_subgoal(np.tile(first, (seeds, 1)))
    _ticks(task, low, obs, seeds, free)
    start, before = task.snapshot(), task.worlds.tip.copy()
    ends = []
    for push in (None, np.tile(PUSH * direction, (seeds, 1))):
        task.restore(start)
        obs = task.set_subgoal(_step_in_x(task, free, -0.005))
        _ticks(task, low, obs, seeds, free, push)
        ends.append((task.worlds.tip - before).reshape(seeds, starts, 3))
    moved, pushed = ends
    return {
        "mean": -moved[..., 0].mean(1),
        "mean_vector": moved.mean(1),
        "spread": np.sqrt(moved.var(1).sum(-1)),
        "pushed": np.sqrt(((pushed - moved) ** 2).sum(-1).mean(1)),
    }


def _free_space(study: TwoLevelStudy) -> TwoLevelStudy:
    """The study without obstacles, and without bounds that would shorten a step near the edge."""
    bounds: dict[str, Any] = {}
    for name in ("subgoal", "workspace"):
        size = len(getattr(study.task, f"{name}_low"))
        bounds |= {f"{name}_low": (-1.0,) * size, f"{name}_high": (1.0,) * size}
    return replace(study, task=replace(study.task, scene="panda.xml", **bounds))


def _step_in_x(task: Any, study: TwoLevelStudy, length: float) -> Array:
    """Sub-goals that ask every world for a step in x, (worlds, size)."""
    config, tip = study.task, task.worlds.tip
    step = np.zeros((task.num, config.high_size))
    if config.command == "joint":
        tool, joints = FINGERTIP + config.peg.length, task.worlds.qpos[:, :JOINTS]
        for k, q in enumerate(joints):
            ends = [
                inverse_kinematics(x, tool=tool, q0=q) for x in (tip[k], tip[k] + [length, 0, 0])
            ]
            step[k] = ends[1] - ends[0]
        return step
    if not config.increments:
        step[:, :3] = tip
    step[:, 0] += length
    return step


def _ticks(
    task: Any,
    low: LowLevel,
    obs: Array,
    seeds: int,
    study: TwoLevelStudy,
    push: Array | None = None,
) -> None:
    """One segment; a push (worlds, 3), N, follows the tip."""
    for _ in range(study.task.horizon):
        if push is not None:
            task.worlds.push(push)
        seen = task.select(obs, low_fields(task)).reshape(seeds, task.num // seeds, -1)
        u = low.act(seen, explore=False)
        obs, *_ = task.step(u.reshape(task.num, -1))


def slope_at_rest(study: TwoLevelStudy, low: LowLevel, seeds: int, eps: float = 1e-4) -> Array:
    """Slope du/dy at rest of every dimension, (seeds, 6), by a central difference."""
    if study.task.command == "joint":
        raise ValueError("slopes in y: wanted a low level of the tip, got one of the joints")
    if isinstance(low, Fixed) and low.actor is None:
        return np.zeros((seeds, N))
    seen = np.zeros((seeds, 2 * N, 4 * N + 1))
    index = np.arange(N)
    seen[:, index, index], seen[:, N + index, index] = eps, -eps
    u = low.act(seen, explore=False)
    return (u[:, index, index] - u[:, N + index, index]) / (2 * eps)
