"""Lesson 11: the peg maze, two levels at two rates, from a blocked path to a relabeled sub-goal."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import low_fields
from cmc.learning.latent import LatentLow
from cmc.learning.low_level import Fixed, LowLevel, latent_policy
from cmc.policies import LinearNetwork
from cmc.robot.panda import load_scene
from cmc.studies.old import peg_maze, peg_maze_stiff
from cmc.studies.old.two_level_parts import build_low
from cmc.studies.old.two_level_training import marks

Array = NDArray[np.float64]
STUDIES = {"soft": peg_maze.STUDY, "stiff": peg_maze_stiff.STUDY}
AXES = {"x": 0, "y": 1, "z": 2}
MM = 1e3


def obstacles(points: int = 24) -> list[Array]:
    """Outlines of walls and posts from above, (points, 2) each, mm."""
    model = load_scene("peg_maze.xml")
    circle = np.linspace(0.0, 2 * np.pi, points)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], dtype=float)
    found = []
    for k in range(model.ngeom):
        name, size = model.geom(k).name, model.geom_size[k]
        if name.startswith("wall"):
            found.append(MM * (model.geom_pos[k, :2] + corners * size[:2]))
        elif name.startswith("post"):
            ring = size[0] * np.stack([np.cos(circle), np.sin(circle)], axis=-1)
            found.append(MM * (model.geom_pos[k, :2] + ring))
    return found


def straight(regime: str = "soft", worlds: int = 8) -> dict[str, Array]:
    """The goal itself as sub-goal, all episode long, under a hand-tuned low level.

    Returns:
        `t` (T,), `tip` (T, worlds, 2), `distance` (T, worlds) to the goal, both mm, `goal`
        (worlds, 2), mm, and `force` (T, worlds), the largest of each tick, N.
    """
    study = STUDIES[regime]
    task = study.task_class(study.task, num=worlds, seed=1)
    low, obs = build_low(study, "gain", [0]), task.reset()
    goal = task.select(obs, ("goal",))
    rows: dict[str, list[Array]] = {"tip": [], "distance": [], "force": []}
    for tick in range(study.task.ticks):
        if tick % study.task.horizon == 0:
            obs = task.set_subgoal(goal)
        obs, info = _tick(task, low, obs)
        rows["tip"].append(MM * task.worlds.tip[:, :2])
        rows["distance"].append(-MM * info["reward_terms"]["distance"])
        rows["force"].append(info["contact_force_max"])
    time = study.task.tick * np.arange(1, study.task.ticks + 1)
    answer = {"t": time, "goal": MM * goal[:, :2]}
    return answer | {k: np.array(v, dtype=float) for k, v in rows.items()}


def _tick(task: PandaTask, low: LowLevel, obs: Array) -> tuple[Array, dict[str, Any]]:
    """One tick of all worlds under a low level of one seed, without exploration."""
    u = low.act(task.select(obs, low_fields(task))[None], explore=False)[0]
    obs, *_, info = task.step(u)
    return obs, info


# -- the gain ------------------------------------------------------------------------------------


def cap(regime: str = "soft") -> dict[str, float]:
    """Slopes du/dy of the translation: caps of the learned and of other low levels, and chatter."""
    study = STUDIES[regime]
    latent, tick = study.task.gains.latent, study.task.tick
    levels = {"cap": study.latent.cap, "others": study.cap, "chatter": 2.0}
    return {
        name: float((level / tick - latent.K_d[0]) / latent.K2[0]) for name, level in levels.items()
    }


def costs(gains: Array | None = None, length: float = 0.005) -> dict[str, Array]:
    """Mean |e| over a segment, as a share of the step, against the slope, by regime.

    The model is that of the learner: gains, a held action, a saturation.
    """
    gain = np.linspace(0.0, 60.0, 121) if gains is None else gains
    answer = {"gain": gain}
    for regime in STUDIES:
        error = np.abs(_model_step(regime, gain, 0, length)["e"])
        answer[regime] = error[1:].mean(axis=0) / length
    return answer


def _model_step(regime: str, gain: Array, axis: int, length: float) -> dict[str, Array]:
    """Free motion of the latent model from rest: `e`, `u` (T + 1, gains) in m and m/s^2."""
    low = _latent_low(regime)
    model, horizon = low.model, low.horizon
    motion, push = (part[axis] for part in model.transition())
    limit = model.action[axis]
    state = np.stack([np.full(gain.shape, length), np.zeros(gain.shape)])
    errors, actions = [], []
    for _ in range(horizon + 1):
        y = model.K1[axis] * state[0] + model.K2[axis] * state[1]  # mapping_pos
        a = np.tanh(gain / limit * y)
        errors.append(state[0])
        actions.append(limit * a)
        state = motion @ state + push[:, None] * a
    return {"e": np.array(errors), "u": np.array(actions)}


@lru_cache(maxsize=2)
def _latent_low(regime: str) -> LatentLow:
    low = build_low(STUDIES[regime], "ctd3", [0])
    assert isinstance(low, LatentLow)
    return low


def gain_step(gain: float = 10.0, axis: str = "x", regime: str = "soft") -> dict[str, Any]:
    """A step of 5 mm with u = limit tanh(gain y / limit), on the arm and in the latent model.

    Returns `t`, `arm` and `model`, the error (mm), `u` (m/s^2), and the pressing force `press` (N)
    that the model predicts where a wall stands `behind` mm before the sub-goal.
    """
    k, low = AXES[axis], _latent_low(regime)
    limit, model = low.model.action[k], low.model
    actor = latent_policy(LinearNetwork(np.r_[[[gain / limit] * 2] * 3, np.zeros((3, 2))]))
    step = arm_step(Fixed(actor), axis, regime)
    predicted = _model_step(regime, np.array([gain]), k, 0.005)
    behind = np.linspace(0.0, 0.005, 51)
    u = limit * np.tanh(gain * model.K1[k] * behind / limit)
    press = model.mass[k] * (model.K_p[k] * behind + u)
    level = (model.K_d[k] + gain * model.K2[k]) * model.tick
    left = abs(step["e"][-1]) / 5.0
    return {
        "t": step["t"],
        "arm": step["e"],
        "u": step["u"],
        "model": MM * predicted["e"][:, 0],
        "behind": MM * behind,
        "press": press,
        "text": f"{left:.0%} left after 0.4 s; (K_d + g K2) dt = {level:.2f}",
        "force": f"presses with up to {press[-1]:.2f} N",
    }


def arm_step(
    low: LowLevel, axis: str = "x", regime: str = "soft", split: bool = True
) -> dict[str, Array]:
    """A step of 5 mm on the arm, in free space: `t`, `e` (mm) and `u` (m/s^2), (T + 1,).

    Args:
        low: a low level of one seed.
        axis: "x", "y" or "z", along which the tip steps, in negative direction.
        regime: "soft" or "stiff".
        split: separate inertia for translation and rotation, as in the studies, or the full one.
    """
    task, k = _free_task(regime, split), AXES[axis]
    task.seed(0)
    task.reset()
    first, step = task.worlds.tip.copy(), np.zeros(3)
    step[k] = -0.005
    obs = task.set_subgoal(first + step)
    errors, actions = [], []
    for _ in range(task.config.horizon + 1):
        u = low.act(task.select(obs, low_fields(task))[None], explore=False)[0]
        errors.append(MM * float(first[0, k] + step[k] - task.worlds.tip[0, k]))
        actions.append(float(u[0, k]) * task.config.u_limit[k])
        obs, *_ = task.step(u)
    return {
        "t": task.config.tick * np.arange(len(errors)),
        "e": -np.array(errors),
        "u": -np.array(actions),
    }


@lru_cache(maxsize=4)
def _free_task(regime: str, split: bool) -> PandaTask:
    study = STUDIES[regime]
    law = replace(study.task.law, split=split)
    return study.task_class(replace(study.task, scene="panda.xml", law=law), num=1, seed=0)


def kept(name: str = "ctd3") -> list[int]:
    """Environment steps of the policies that are shipped for a method of the soft regime."""
    return marks(STUDIES["soft"], name)


def episode(name: str = "ctd3", step: int | None = None, seed: int = 0) -> dict[str, Any]:
    """A recorded test episode of a shipped policy, with its path from above in mm."""
    run = peg_maze.motion(name, seed, step=step)
    return run | {"path": MM * run["tip"][:, :2], "aim": MM * run["markers"]["sub-goal"][:, :2]}
