"""Lesson 12: peg push, from one sub-goal step to two levels that learn side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
from cmc.fast import budget
from cmc.learning.state import single_thread
from cmc.studies.old import peg_push
from cmc.studies.old.two_level_parts import build

Array = NDArray[np.float64]
Show = Callable[[int, float, float], object]
STEP = 0.005
"""Largest sub-goal step along one axis, m."""
PLAN = np.array([(9.5, 4), (9.5, -3), (-5.1, -3), (3, -3), (3, -12.5), (0, -12.5)]) * 1e-3
"""A way to the target, tip (y, z) from the box's top, m: down, push the lid, enter, push, touch."""
LATENT = PUSH.gains.latent
CAP = float(peg_push.STUDY.slope_cap("ctd3")[0])
"""Largest slope of the learned, capped low level in translation, 1/(m/s^2)."""


def low_level(gain: Array, y: Array, integral: Array) -> Array:
    """Hand-tuned low level, u = tanh(g (y + integral of y))."""
    u: Array = np.tanh(gain * (y + integral))
    return u


def level(gain: float) -> float:
    """(K_d + g K2) dt of a translation axis: from 1 on y swings, from 2 on the command chatters."""
    return float((LATENT.K_d[0] + gain * LATENT.K2[0]) * PUSH.tick)


def one_step(gains: Sequence[float] = (0.0, 2.0, 20.0, 150.0), ticks: int = 20) -> dict[str, Any]:
    """The arm in free space is asked for a step of 5 mm along x, one world for each gain.

    Returns:
        `t` (ticks + 1,) s, `share` of the step covered (ticks + 1, gains), `u` (ticks, gains).
    """
    task = PegPush(replace(PUSH, scene="panda.xml", start_box=(0.0,) * 3), num=len(gains), seed=0)
    gain = np.array(gains, dtype=float)[:, None]
    task.reset()
    start = task.worlds.tip.copy()
    obs = task.set_subgoal(np.tile([STEP, 0, 0, 0, 0, 0], (task.num, 1)))
    share, commands = [np.zeros(task.num)], []
    for _ in range(ticks):
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        u = low_level(gain, y, integral)
        obs, *_ = task.step(u)
        commands.append(u[:, 0])
        share.append((task.worlds.tip - start)[:, 0] / STEP)
    return {
        "t": PUSH.tick * np.arange(ticks + 1),
        "share": np.array(share),
        "u": np.array(commands),
    }


def segment(gain: float, ticks: int = 20, integral: bool = True) -> dict[str, Any]:
    """One sub-goal step by the gains alone; the slider's picture.

    The reference acceleration K_p e + K_d e' + u is held over each tick, as on the arm.

    Args:
        gain: slope g of the low level.
        ticks: until the next sub-goal is due.
        integral: whether the low level also sees the integral of y.

    Returns:
        `t` (ms), `share` covered (percent), `u`, `due` (ms) and `text`.
    """
    dt, K_p, K_d = PUSH.tick, LATENT.K_p[0], LATENT.K_d[0]
    e, v, total = STEP, 0.0, 0.0
    errors, commands = [], []
    for _ in range(51):
        y = LATENT.K1[0] * e + LATENT.K2[0] * v  # mapping_pos
        total += dt * y
        u = float(np.tanh(gain * (y + (total if integral else 0.0))))
        errors.append(e)
        commands.append(u)
        held = -(K_p * e + K_d * v + u)  # 2nd_sys
        e, v = e + dt * v + 0.5 * dt**2 * held, v + dt * held
    share = 100.0 * (1.0 - np.array(errors) / STEP)
    verdict = "chatters" if level(gain) > 2.0 else "swings" if level(gain) > 1.0 else "calm"
    return {
        "t": 1e3 * dt * np.arange(51),
        "share": share,
        "u": np.array(commands),
        "due": 1e3 * dt * ticks,
        "text": f"{share[ticks]:.0f} % covered when due; "
        f"(K_d + g K2) dt = {level(gain):.2f}: {verdict}",
    }


def plan(gains: Sequence[float] = (0.0, 20.0, CAP), seed: int = 0) -> dict[str, Any]:
    """The scripted plan in the task itself, one world for each gain, all from the same start.

    Returns:
        `t` (T,), `tip` (T, gains, 3), `qpos`, `target` (T, gains, 3), `distance` to the target
        (T, gains), m, `force` (T, gains, 3), N, `success` (gains,), `total`, the returns, `model`.
    """
    num, task = len(gains), PegPush(PUSH, num=len(gains), seed=0)
    task.seed([seed] * num)
    gain, stage = np.array(gains, dtype=float)[:, None], np.zeros(num, dtype=int)
    obs, rows, total = task.reset(), [], np.zeros(num)
    for k in range(PUSH.ticks):
        if k % PUSH.horizon == 0:
            tip = task.worlds.tip - BOX_TOP
            near = np.abs(tip[:, 1:] - PLAN[stage]).max(-1) < 0.7e-3
            stage = np.minimum(stage + near, len(PLAN) - 1)
            step = np.column_stack([-tip[:, 0], PLAN[stage] - tip[:, 1:]])
            obs = task.set_subgoal(np.hstack([step, -task.worlds.rotation()]))
        now = (task.worlds.tip, task.worlds.qpos, task.target, task.worlds.force)
        rows.append([part.copy() for part in now])
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        obs, reward, _, _, info = task.step(low_level(gain, y, integral))
        total += reward
    tips, qpos, target, force = (np.array(part) for part in zip(*rows, strict=True))
    goal = obs[0, task.layout["goal"]]
    return {
        "t": PUSH.tick * np.arange(len(tips)),
        "tip": tips,
        "qpos": qpos,
        "target": target,
        "force": force,
        "distance": np.linalg.norm(goal - tips, axis=-1),
        "success": info["success"],
        "total": total,
        "model": task.worlds.model,
    }


def live_training(
    show: Show | None = None,
    names: tuple[str, str] = ("ctd3", "control"),
    steps: int | None = None,
    warm_up: int = 960,
) -> dict[str, Any]:
    """Train two methods of the study side by side, segment by segment, one seed each.

    Args:
        show: called after each segment with the environment steps and both rewards a tick, times
            the ticks of an episode, averaged over the last segments.
        names: two methods.
        steps: environment steps of each; 12,000, or 1600 in fast mode.
        warm_up: steps with random sub-goals, fewer than the study's.

    Returns:
        `step` (K,) and, by method, rewards of each segment as a return (K,); `ticks` of an episode,
        `worlds`, `warm_up`.
    """
    wanted = budget(12_000, 1600) if steps is None else steps
    study = peg_push.STUDY
    study = replace(study, hierarchy=replace(study.hierarchy, warm_up=warm_up))
    trainers = {name: build(study, name, [0]) for name in names}
    rewards: dict[str, list[float]] = {name: [] for name in names}
    marks: list[int] = []
    first = trainers[names[0]]
    with single_thread():
        while first.steps < wanted:
            for name, trainer in trainers.items():
                rewards[name].append(PUSH.ticks * float(trainer.segment().mean()))
            marks.append(first.steps)
            if show is not None:
                show(first.steps, *(float(np.mean(rewards[name][-10:])) for name in names))
    counts = {"ticks": PUSH.ticks, "worlds": study.hierarchy.worlds, "warm_up": warm_up}
    return {"step": np.array(marks), **{n: np.array(r) for n, r in rewards.items()}, **counts}


def live_sentence(run: dict[str, Any]) -> str:
    """Markdown: how little a live training is, from what it ran."""
    steps, full = int(run["step"][-1]), peg_push.STUDY.steps
    episodes = steps / run["ticks"]
    return (
        f"That was {steps:,} steps, {steps / full:.2%} of a full training of {full:,}; "
        f"{run['worlds']} worlds in {episodes:.1f} episodes in all, the first {run['warm_up']:,} "
        "steps with random sub-goals. **This is far too short to say anything about either "
        "method**: the curves show where in an episode the worlds are, more than what was learned."
    )
