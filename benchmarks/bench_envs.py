"""Panda environments: a whole tick against raw physics of the same scene, in the same run.

A tick is controller, ten 2 ms physics steps, observation, rewards and contact logging; the
reference is `mj_step(model, data, 10)` with a constant torque. One core, CPU time, best of several
repeats that take turns. `share` rows give raw speed reached by control at every physics step.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import mujoco
import numpy as np

from benchmarks import best
from cmc.envs.panda_task import PandaTask
from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze, PegMazeEnv
from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush, PegPushEnv
from cmc.robot.panda import LOWER, UPPER

CASES = {"maze": (PegMaze, STIFF), "maze_soft": (PegMaze, SOFT), "push": (PegPush, PUSH)}


def run() -> Iterator[dict[str, str | float]]:
    """Rows: ratio to raw physics per tick (below 1 for `share` rows: raw speed reached)."""
    yield _first()
    for name, (task, config) in CASES.items():
        every = replace(config, hold=False)
        cost = _best(
            {
                "raw": _raw(task(config)),
                "one": _ticks(task(config, 1)),
                "gym": _gym(name),
                "many": _ticks(task(config, 32)),
                "shared": _ticks(task(config, 32, threads=os.cpu_count() or 1)),
                "every": _ticks(task(every, 1)),
                "every_many": _ticks(task(every, 32)),
            }
        )
        raw, many = cost["raw"], 32 * cost["raw"]
        yield {"name": f"{name}: one world", "ratio": cost["one"] / raw, "us": 1e6 * cost["one"]}
        yield {"name": f"{name}: through gymnasium", "ratio": cost["gym"] / raw}
        yield {"name": f"{name}: 32 worlds, each", "ratio": cost["many"] / many}
        yield {"name": f"{name}: same, threads, CPU time", "ratio": cost["shared"] / many}
        yield {"name": f"{name}: control at every step, share", "ratio": raw / cost["every"]}
        yield {"name": f"{name}: same, 32 worlds, share", "ratio": many / cost["every_many"]}
    yield _plan()
    for name, (task, config) in {**CASES, "maze_joint": (PegMaze, JOINT)}.items():
        yield {"name": f"{name}: 10^5 random ticks", **_drive(task(config, 32, seed=0))}


def _best(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    return best(calls, number=20, repeats=50)


def _first() -> dict[str, str | float]:
    """CPU seconds of a fresh process that does one tick, against one that imports MuJoCo only."""
    imports = "import mujoco, numpy as np"
    tick = (
        f"{imports}; from cmc.envs.peg_maze import STIFF, PegMaze; "
        "PegMaze(STIFF).step(np.zeros((1, 6)))"
    )
    seconds = {imports: np.inf, tick: np.inf}
    for _ in range(3):
        for code in seconds:
            before = os.times()
            subprocess.run([sys.executable, "-c", code], check=True)
            after = os.times()
            used = after.children_user + after.children_system
            used -= before.children_user + before.children_system
            seconds[code] = min(seconds[code], used)
    ratio = seconds[tick] / seconds[imports]
    return {"name": "first tick of a process, cache warm", "ratio": ratio, "s": seconds[tick]}


def _raw(task: PandaTask) -> Callable[[], object]:
    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    data.qpos[:] = task.worlds.qpos[0]
    mujoco.mj_forward(model, data)
    data.ctrl[:] = data.qfrc_bias[:7]
    return lambda: mujoco.mj_step(model, data, 10)


def _ticks(task: PandaTask) -> Callable[[], object]:
    u = np.zeros((task.num, task.config.low_size))
    return lambda: task.step(u)


def _gym(name: str) -> Callable[[], object]:
    if name == "push":
        env: PegPushEnv | PegMazeEnv = PegPushEnv(action_mode="low")
    else:
        env = PegMazeEnv("soft" if name == "maze_soft" else "stiff", action_mode="low")
    env.reset(seed=0)
    u = np.zeros(env.action_space.shape or (), dtype=np.float32)
    return lambda: env.step(u)


PLAN = 1e-3 * np.array([(9.5, 4), (9.5, -3), (-5.1, -3), (3, -3), (3, -12.5), (0, -12.5)])


def _plan(ticks: int = 300) -> dict[str, str | float]:
    """Peg push while it is being solved, contacts included: the same torques, replayed raw."""
    task = PegPush(PUSH, 1, seed=0)
    task.reset()
    start, stage, moves, torques = task.snapshot(), 0, [], []
    obs = task.set_subgoal(np.zeros((1, 6)))
    for k in range(ticks):
        if k % PUSH.horizon == 0:
            tip = (task.worlds.tip - BOX_TOP)[0]
            stage = min(stage + int(np.abs(tip[1:] - PLAN[stage]).max() < 7e-4), len(PLAN) - 1)
            goal = np.array([[-tip[0], *(PLAN[stage] - tip[1:]), 0.0, 0.0, 0.0]])
            obs = task.set_subgoal(goal)
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        u = np.tanh(5.0 * (y + integral))
        obs = task.step(u)[0]
        moves.append((goal if k % PUSH.horizon == 0 else None, u))
        torques.append(task.worlds.data[0].ctrl.copy())
    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION

    def whole() -> None:
        task.restore(start)
        for goal, u in moves:
            if goal is not None:
                task.set_subgoal(goal)
            task.step(u)

    def raw() -> None:
        mujoco.mj_setState(model, data, start["physics"][0], kind)
        for torque in torques:
            data.ctrl[:] = torque
            mujoco.mj_step(model, data, 10)

    cost = best({"whole": whole, "raw": raw}, repeats=15)
    us = 1e6 * cost["raw"] / ticks
    return {"name": "push: while solving it", "ratio": cost["whole"] / cost["raw"], "raw_us": us}


def _drive(task: PandaTask) -> dict[str, float]:
    """10^5 ticks under random sub-goals and actions: nothing may blow up."""
    c, rng = task.config, np.random.default_rng(0)
    margin, away, soft = np.inf, 0.0, []
    ticks = 100_000 // task.num
    start = time.process_time()
    for k in range(ticks):
        if task.due.any():
            task.set_subgoal(rng.uniform(c.subgoal_low, c.subgoal_high, (task.num, c.high_size)))
        obs, _, _, truncated, info = task.step(rng.uniform(-1, 1, (task.num, c.low_size)))
        if not np.isfinite(obs).all():
            raise RuntimeError(f"tick {k}: an observation is not finite")
        q = task.worlds.qpos[:, :7]
        margin = min(margin, float(np.minimum(q - LOWER, UPPER - q).min()))
        away = max(away, float(np.linalg.norm(task.worlds.tip - c.start, axis=-1).max()))
        soft.append(info["contact_force_max"] < 1.0)
        if truncated.any():
            task.reset(truncated)
    seconds = time.process_time() - start
    raw = _best({"raw": _raw(task)})["raw"]
    return {
        "ratio": seconds / (ticks * task.num) / raw,
        "joint_margin_rad": margin,
        "farthest_tip_m": away,
        "share_below_1N": float(np.mean(soft)),
    }
