"""Tests of a planner over a low level: success, contact force, penetration, gains, consistency."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import low_fields, play
from cmc.learning.low_level import Fixed, LowLevel
from cmc.policies import PositiveNetwork
from cmc.robot.panda import FINGERTIP, JOINTS, inverse_kinematics
from cmc.studies.study import Rows, Test, same
from cmc.studies.two_level import TwoLevelConfig
from cmc.studies.two_level_arms import N, Policy

Array = NDArray[np.float64]
TEST_SEED = 900_000  # test worlds never share a stream with training
PUSH = 2.0
"""Force on the tip when consistency under pushes is measured, N."""
KEPT = (
    "reward",
    "success",
    "distance",
    "contact_force",
    "contact_force_max",
    "penetration",
)
AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Episodes:
    """What test episodes showed; S seeds, M episodes each, T ticks.

    Attributes:
        success: at the last tick, (S, M). touched: at any tick, (S, M).
        total: sum of rewards, (S, M).
        nearest, final: distance of the tip to the goal, smallest and at the end, (S, M), m.
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
    config: TwoLevelConfig, policy: Policy, seeds: int, episodes: int, start: int = TEST_SEED
) -> Episodes:
    """Run deterministic test episodes of all seeds side by side.

    Args:
        config: of the study, as the method runs it.
        policy: planner and low level.
        seeds: how many trained seeds S the networks hold.
        episodes: test episodes of each.
        start: seed of the first test world.
    """
    task = config.make(seeds * episodes, start)
    found = play(task, config.planning(), *policy, seeds, KEPT)
    success, distance = found["success"].astype(bool), found["distance"]
    return Episodes(
        success[-1],
        np.any(success, axis=0),
        found["reward"].sum(0),
        distance.min(0),
        distance[-1],
        found["contact_force"],
        found["contact_force_max"],
        found["penetration"].max(0),
    )


def figures(found: Episodes) -> Rows:
    """Figures of each seed's test episodes; the columns of `cmc.results`."""
    success, touched = found.success, found.touched
    columns: dict[str, Array] = {
        "success": success.mean(1),
        "touched": touched.mean(1),
        "passed_by": (touched & ~success).mean(1),
        "return": found.total.mean(1),
        "nearest_mm": 1e3 * np.median(found.nearest, axis=1),
        "final_mm": 1e3 * np.median(found.final, axis=1),
        "deepest_mm": 1e3 * found.penetration.max(1),
        "median_deepest_mm": 1e3 * np.median(found.penetration, axis=1),
    }
    for end, force in (("", found.force_max), ("_50hz", found.force)):
        columns |= {
            f"no_contact{end}": (force == 0).mean((0, 2)),
            f"below_1_N{end}": (force < 1).mean((0, 2)),
            f"below_5_N{end}": (force < 5).mean((0, 2)),
            f"largest_N{end}": force.max((0, 2)),
        }
    seeds, count = success.shape
    return [
        {"seed": k, "episodes": count, **{key: float(v[k]) for key, v in columns.items()}}
        for k in range(seeds)
    ]


def judge(config: TwoLevelConfig, policy: Policy, seeds: int, test: Test) -> dict[str, Rows]:
    """One test of one policy; in the nominal one its consistency and its gains too."""
    found = run_episodes(config, policy, seeds, test.number)
    rows = figures(found)
    if test.change is same:
        moved = consistency(config, policy[1], seeds)
        for k, row in enumerate(rows):
            row |= {key: 1e3 * float(value[k]) for key, value in moved.items()}
            row |= _gains(config, policy[1], seeds, k)
    near, far = 1e3 * found.nearest, 1e3 * found.final
    each = [
        {"seed": k, "episode": e, "nearest_mm": near[k, e], "final_mm": far[k, e]}
        for k, e in np.ndindex(near.shape)
    ]
    return {"tests": rows, "episodes": each if test.change is same else []}


def _gains(config: TwoLevelConfig, low: LowLevel, seeds: int, k: int) -> dict[str, float]:
    """Slopes at rest of one seed, and what construction keeps them below."""
    actor = getattr(low, "actor", None)
    if config.task.command == "joint" or actor is None:
        return {}
    slopes = slope_at_rest(config, low, seeds)[k]
    found = {f"slope_{axis}": float(slope) for axis, slope in zip(AXES, slopes, strict=True)}
    net = getattr(actor, "network", None)
    if isinstance(net, PositiveNetwork) and net.joint is not None:
        cap = zip(AXES, config.slope_cap(), strict=True)
        found |= {f"cap_{axis}": float(value) for axis, value in cap}
    return found


def consistency(
    config: TwoLevelConfig, low: LowLevel, seeds: int, starts: int = 16
) -> dict[str, Array]:
    """Spread of the tip's displacement over one segment for one sub-goal, over starts and pushes.

    In free space (the task without its obstacles) every world starts an episode anew, is moved by a
    random sub-goal for one segment, so that it starts the next one elsewhere and in motion, and is
    then asked for a step of 5 mm along -x. Afterwards it goes back to where that step began and
    does it again while a force of `PUSH` newtons acts on the tip, in a direction drawn for each
    start uniformly on the sphere and fixed for the segment. Starts and pushes are the same for all
    seeds and methods. Sub-goals are not clamped here, so that the step is 5 mm everywhere.

    Returns:
        Over starts, by seed, (seeds,) each, m: `moved_mm`, the mean displacement along the step,
        and `moved_x_mm`, ... in x, y, z; `starts_mm`, the root of the summed variances of the
        displacement; `push_mm`, the root mean square distance between the ends of the segment with
        the push and without it from the same start. (Names are those of the columns, in mm.)
    """
    free = _free_space(config)
    task = free.make(seeds * starts)
    task.seed([TEST_SEED + 1 + k for k in range(starts)] * seeds)
    rng = np.random.default_rng(TEST_SEED)
    low_end, high_end = np.array(config.task.subgoal_low), np.array(config.task.subgoal_high)
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
    mean = moved.mean(1)
    return {
        "moved_mm": -mean[:, 0],
        **{f"moved_{axis}_mm": mean[:, i] for i, axis in enumerate("xyz")},
        "starts_mm": np.sqrt(moved.var(1).sum(-1)),
        "push_mm": np.sqrt(((pushed - moved) ** 2).sum(-1).mean(1)),
    }


def _free_space(config: TwoLevelConfig) -> TwoLevelConfig:
    """No obstacles, and no bounds that would shorten a step near the edge."""
    bounds: dict[str, Any] = {}
    for name in ("subgoal", "workspace"):
        size = len(getattr(config.task, f"{name}_low"))
        bounds |= {f"{name}_low": (-1.0,) * size, f"{name}_high": (1.0,) * size}
    return replace(config, task=replace(config.task, scene="panda.xml", **bounds))


def _step_in_x(task: PandaTask, config: TwoLevelConfig, length: float) -> Array:
    """Sub-goals that ask every world for a step in x, (worlds, size)."""
    asked, tip = config.task, task.worlds.tip
    step = np.zeros((task.num, asked.high_size))
    if asked.command == "joint":
        tool, joints = FINGERTIP + asked.peg.length, task.worlds.qpos[:, :JOINTS]
        for k, q in enumerate(joints):
            ends = [
                inverse_kinematics(x, tool=tool, q0=q) for x in (tip[k], tip[k] + [length, 0, 0])
            ]
            step[k] = ends[1] - ends[0]
        return step
    if not asked.increments:
        step[:, :3] = tip
    step[:, 0] += length
    return step


def _ticks(
    task: PandaTask,
    low: LowLevel,
    obs: Array,
    seeds: int,
    config: TwoLevelConfig,
    push: Array | None = None,
) -> None:
    """One segment; a push (worlds, 3), N, follows the tip."""
    for _ in range(config.task.horizon):
        if push is not None:
            task.worlds.push(push)
        seen = task.select(obs, low_fields(task)).reshape(seeds, task.num // seeds, -1)
        u = low.act(seen, explore=False)
        obs, *_ = task.step(u.reshape(task.num, -1))


def slope_at_rest(config: TwoLevelConfig, low: LowLevel, seeds: int, eps: float = 1e-4) -> Array:
    """Slope du/dy at rest of every dimension, (seeds, 6), by a central difference."""
    if config.task.command == "joint":
        raise ValueError("slopes in y: wanted a low level of the tip, got one of the joints")
    if isinstance(low, Fixed) and low.actor is None:
        return np.zeros((seeds, N))
    seen = np.zeros((seeds, 2 * N, 4 * N + 1))
    index = np.arange(N)
    seen[:, index, index], seen[:, N + index, index] = eps, -eps
    u = low.act(seen, explore=False)
    return (u[:, index, index] - u[:, N + index, index]) / (2 * eps)


def motion(config: TwoLevelConfig, policy: Policy, episode: int) -> dict[str, Any]:
    """Run one test episode of one seed and record it.

    Returns:
        `model` (MuJoCo), `t` (T + 1,), `qpos` (T + 1, nq), `tip` (T + 1, 3), `force` (T + 1, 3),
        N, on the peg, `distance` (T + 1,) to the goal, m, `markers` (name to (3,) or (T + 1, 3)),
        `success` at the end and `touched` at any tick, and `text`.
    """
    task, start = config.make(1), config.make(1)
    for each in (task, start):
        each.seed([TEST_SEED + episode])
    start.reset()
    kept = (*KEPT, "tip", "target", "qpos", "force", "observation")
    found = {k: v[:, 0, 0] for k, v in play(task, config.planning(), *policy, 1, kept).items()}
    goal = found["observation"][-1, task.layout["goal"]]
    first = {"tip": start.worlds.tip, "qpos": start.worlds.qpos, "force": start.worlds.force}
    first |= {"target": start.target, "distance": np.linalg.norm(goal - start.worlds.tip, axis=-1)}
    frames = {name: np.concatenate([value, found[name]]) for name, value in first.items()}
    markers = {"goal": goal}
    if config.task.command == "pose":
        markers["sub-goal"] = frames.pop("target")
    success, touched = bool(found["success"][-1]), bool(found["success"].any())
    said = "in the goal" if success else "it touched the goal and left it" if touched else "missed"
    end, most = 1e3 * found["distance"][-1], found["contact_force_max"].max()
    return {
        "model": task.worlds.model,
        "t": config.task.tick * np.arange(1 + config.task.ticks),
        **{name: frames[name] for name in ("qpos", "tip", "force", "distance")},
        "markers": markers,
        "success": success,
        "touched": touched,
        "text": f"the tip ends {end:.2f} mm from the goal ({said}), largest force {most:.1f} N",
    }
