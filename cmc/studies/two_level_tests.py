"""Tests of a planner over a low level: success, contact force, penetration, gains, consistency."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import play
from cmc.learning.low_level import LowLevel, low_fields
from cmc.policies import PositiveNetwork
from cmc.robot.panda import FINGERTIP, JOINTS, inverse_kinematics
from cmc.studies.study import Array, Rows, Test, same
from cmc.studies.two_level import N, Policy, TwoLevelConfig
from cmc.theory.arrays import count

TEST_SEED = 900_000  # test worlds never share a stream with training
PUSH = 2.0  # force on the tip when consistency under pushes is measured, N
KEPT = ("reward", "success", "distance", "contact_force", "contact_force_max", "penetration")
AXES = ("x", "y", "z", "rx", "ry", "rz")


def judge(config: TwoLevelConfig, policy: Policy, seeds: int, test: Test) -> dict[str, Rows]:
    """One test of one policy; in the nominal one its consistency and its gains too."""
    found = play(
        config.make(seeds * test.number, TEST_SEED), config.planning(), *policy, seeds, KEPT
    )
    rows = figures(found)
    if test.change is not same:
        return {"tests": rows, "episodes": []}
    own = {key: 1e3 * value for key, value in consistency(config, policy[1], seeds).items()}
    own |= _gains(config, policy[1], seeds)
    for k, row in enumerate(rows):
        row |= {key: float(value[k]) for key, value in own.items()}
    near, far = 1e3 * found["distance"].min(0), 1e3 * found["distance"][-1]
    each = [
        {"seed": k, "episode": e, "nearest_mm": near[k, e], "final_mm": far[k, e]}
        for k, e in np.ndindex(near.shape)
    ]
    return {"tests": rows, "episodes": each}


def figures(found: Mapping[str, Array]) -> Rows:
    """Figures of each seed's test episodes from `KEPT` of every tick, (T, S, M); S seeds."""
    if not isinstance(found, Mapping) or not set(KEPT) <= set(found):
        raise ValueError(f"found: wanted arrays of {', '.join(KEPT)} by name")
    distance, deepest = found["distance"], found["penetration"].max(0)
    success, touched = found["success"][-1] > 0, (found["success"] > 0).any(0)
    columns: dict[str, Array] = {
        "success": success.mean(1),
        "touched": touched.mean(1),
        "passed_by": (touched & ~success).mean(1),
        "return": found["reward"].sum(0).mean(1),
        "nearest_mm": 1e3 * np.median(distance.min(0), axis=1),
        "final_mm": 1e3 * np.median(distance[-1], axis=1),
        "deepest_mm": 1e3 * deepest.max(1),
        "median_deepest_mm": 1e3 * np.median(deepest, axis=1),
    }
    for end, name in (("", "contact_force_max"), ("_50hz", "contact_force")):
        force = found[name]
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


def _gains(config: TwoLevelConfig, low: LowLevel, seeds: int) -> dict[str, Array]:
    """Slopes du/dy at rest, by a central difference, and what construction keeps them below.

    By seed, (seeds,) each; nothing without an actor, or in joint space.
    """
    if config.task.command == "joint" or low.actor is None:
        return {}
    seen, index, eps = np.zeros((seeds, 2 * N, 4 * N + 1)), np.arange(N), 1e-4
    seen[:, index, index], seen[:, N + index, index] = eps, -eps
    u = low.act(seen, explore=False)
    columns = {"slope": (u[:, index, index] - u[:, N + index, index]) / (2 * eps)}
    net = getattr(low.actor, "network", None)
    if isinstance(net, PositiveNetwork) and net.joint is not None:
        columns["cap"] = np.tile(config.slope_cap(), (seeds, 1))
    return {f"{key}_{axis}": v[:, i] for key, v in columns.items() for i, axis in enumerate(AXES)}


def consistency(
    config: TwoLevelConfig, low: LowLevel, seeds: int, starts: int = 16
) -> dict[str, Array]:
    """Spread of the tip's displacement over one segment for one sub-goal, over starts and pushes.

    In free space every world is moved by a random sub-goal for one segment, so that it starts the
    next one elsewhere and in motion, and is then asked for a step of 5 mm along -x. It goes back to
    where that step began and does it again while a force of `PUSH` newtons acts on the tip, in a
    direction drawn for each start uniformly on the sphere and fixed for the segment. Starts and
    pushes are the same for all seeds and methods; no sub-goal is clamped.

    Returns, by seed (seeds,) and in m (names are those of the columns, in mm): `moved_mm`, the mean
    displacement along the step, and `moved_x_mm`, ... in x, y, z; `starts_mm`, the root of the
    summed variances of the displacement over starts; `push_mm`, the root mean square distance
    between the segment's ends with the push and without it.
    """
    for name, value, kind in (("config", config, TwoLevelConfig), ("low", low, LowLevel)):
        if not isinstance(value, kind):
            raise ValueError(f"{name}: wanted a {kind.__name__}, got {value!r}")
    bounds: dict[str, Any] = {}  # none that would shorten a step near the edge
    for name in ("subgoal", "workspace"):
        size = len(getattr(config.task, f"{name}_low"))
        bounds |= {f"{name}_low": (-1.0,) * size, f"{name}_high": (1.0,) * size}
    free = replace(config, task=replace(config.task, scene="panda.xml", **bounds))
    task, rng = (
        free.make(count("seeds", seeds) * count("starts", starts)),
        np.random.default_rng(TEST_SEED),
    )
    task.seed([TEST_SEED + 1 + k for k in range(starts)] * seeds)
    task.reset()
    ends = np.array(config.task.subgoal_low), np.array(config.task.subgoal_high)
    first = rng.uniform(*ends, (starts, len(ends[0])))
    direction = rng.standard_normal((starts, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    _segment(task, low, np.tile(first, (seeds, 1)), seeds)
    start, before = task.snapshot(), task.worlds.tip.copy()
    moved = []
    for push in (None, np.tile(PUSH * direction, (seeds, 1))):
        task.restore(start)
        _segment(task, low, _step_in_x(task, -0.005), seeds, push)
        moved.append((task.worlds.tip - before).reshape(seeds, starts, 3))
    alone, pushed = moved
    mean = alone.mean(1)
    return {
        "moved_mm": -mean[:, 0],
        **{f"moved_{axis}_mm": mean[:, i] for i, axis in enumerate("xyz")},
        "starts_mm": np.sqrt(alone.var(1).sum(-1)),
        "push_mm": np.sqrt(((pushed - alone) ** 2).sum(-1).mean(1)),
    }


def _step_in_x(task: PandaTask, length: float) -> Array:
    """Sub-goals that ask every world for a step in x, (worlds, size)."""
    asked, tip = task.config, task.worlds.tip
    step = np.zeros((task.num, asked.high_size))
    if asked.command == "joint":
        tool = FINGERTIP + asked.peg.length
        for k, q in enumerate(task.worlds.qpos[:, :JOINTS]):
            here, there = (
                inverse_kinematics(tip[k] + [x, 0, 0], tool=tool, q0=q) for x in (0.0, length)
            )
            step[k] = there - here
        return step
    if not asked.increments:
        step[:, :3] = tip
    step[:, 0] += length
    return step


def _segment(
    task: PandaTask, low: LowLevel, aim: Array, seeds: int, push: Array | None = None
) -> None:
    """The ticks of one sub-goal; a push (worlds, 3), N, follows the tip."""
    obs = task.set_subgoal(aim)
    for _ in range(task.config.horizon):
        if push is not None:
            task.worlds.push(push)
        seen = task.select(obs, low_fields(task)).reshape(seeds, task.num // seeds, -1)
        obs, *_ = task.step(low.act(seen, explore=False).reshape(task.num, -1))


def motion(config: TwoLevelConfig, policy: Policy, episode: int) -> dict[str, Any]:
    """One test episode of one seed, recorded.

    `model` (MuJoCo), `t` (T + 1,), `qpos` (T + 1, nq), `tip` (T + 1, 3), `force` (T + 1, 3), N, on
    the peg, `distance` (T + 1,) to the goal, m, `markers` (name to (3,) or (T + 1, 3)),
    `success` and `touched` (at the end, at any tick), and `text`.
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
    target, markers = frames.pop("target"), {"goal": goal}
    if config.task.command == "pose":
        markers["sub-goal"] = target
    success, touched = bool(found["success"][-1]), bool(found["success"].any())
    said = "in the goal" if success else "it touched the goal and left it" if touched else "missed"
    end, most = 1e3 * found["distance"][-1], found["contact_force_max"].max()
    text = f"the tip ends {end:.2f} mm from the goal ({said}), largest force {most:.1f} N"
    t = config.task.tick * np.arange(1 + config.task.ticks)
    known = {"markers": markers, "success": success, "touched": touched, "text": text}
    return {"model": task.worlds.model, "t": t, **frames, **known}
