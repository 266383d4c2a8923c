"""How hard the peg touches: tracking, pressing and impact of the maze's regimes, measured.

`python -m cmc evaluate softness` computes the table: a row for each regime, for each ingredient of
the soft one alone, and for what else was tried. The low level is fixed, odd and increasing,
u = b tanh(20 (y + integral of y) / b), rotations at a tenth of it. Two formulas explain the figures
(m_eff is what a contact along one axis feels, 1 / (J M^-1 J^T)_ii):

- pressing:  m_eff (K_p e + u): limited by the error limit and by the bound on u, not by the spring;
- impact:    about m_eff v / tau for a rigid peg (tau: a few ms of contact), v sqrt(k m_eff) for one
  on a spring: limited by the spring, and by the speed that the limits allow.

Either limit alone leaves the other term, so the soft regime needs both.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, repeat
from typing import Any

import mujoco
import numpy as np
import pandas as pd

from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.envs.peg_maze import SOFT, STIFF, PegMaze
from cmc.envs.vector import Array
from cmc.studies.study import changed

SLOPE = 20.0 * np.array([1.0] * 3 + [0.1] * 3)  # du/dy of the fixed low level at zero, our choice
WALLS = {  # axis: where the tip starts, and the sub-goal behind the wall
    "x": ((0.4290, -0.0190, 0.008), (0.4000, -0.0190, 0.008)),
    "y": ((0.4180, -0.0150, 0.008), (0.4180, -0.0300, 0.008)),
}


def low_level(config: PandaTaskConfig, y: Array, integral: Array) -> Array:
    """The fixed low level, in units of the bound b."""
    return np.tanh(SLOPE * (y + integral) / np.array(config.u_limit))


def _drive(task: PandaTask, aims: Iterable[Array | None]) -> Iterator[dict[str, Any]]:
    """What each tick tells, under the fixed low level and these sub-goals (None: keep)."""
    obs = task.reset()
    for aim in aims:
        if aim is not None:
            obs = task.set_subgoal(aim)
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        obs, *_, info = task.step(low_level(task.config, y, integral))
        yield info


def measure(config: PandaTaskConfig, worlds: int = 32, ticks: int = 1200) -> dict[str, float]:
    """One row: tracking, pressing and impact on two walls, and a random high level."""
    found = tracking(config) | _wander(config, worlds, ticks)
    return found | {k: v for axis in WALLS for k, v in press(config, axis).items()}


def tracking(config: PandaTaskConfig) -> dict[str, float]:
    """Share of a 5 mm step in each of six directions that is left after 0.4 s in free space."""
    ends = {f"{name}_low": (-1.0,) * 3 for name in ("subgoal", "workspace")}
    ends |= {name.replace("low", "high"): (1.0,) * 3 for name in ends}
    task = PegMaze(replace(config, scene="panda.xml", start_joints=0.0, **ends), 6, seed=0)  # type: ignore[arg-type]
    target = np.array(config.start) + 0.005 * np.vstack([np.eye(3), -np.eye(3)])
    list(_drive(task, chain([target], repeat(None, config.horizon - 1))))
    left = np.linalg.norm(target - task.worlds.tip, axis=-1) / 0.005
    return {"left_worst": float(left.max()), "left_mean": float(left.mean())}


def press(config: PandaTaskConfig, axis: str) -> dict[str, float]:
    """Drive into a wall and lean on it for 4 s."""
    start, beyond = WALLS[axis]
    task, i = PegMaze(replace(config, start=start, start_joints=0.0), 1, seed=0), "xyz".index(axis)
    speeds, now, peaks = [], [], []
    for info in _drive(task, chain([np.array([beyond])], repeat(None, 199))):
        speeds.append(abs(float(task.worlds.signals[0, 6 + i])))
        now.append(float(info["contact_force"][0]))
        peaks.append(float(info["contact_force_max"][0]))
    touched = int(np.argmax(np.array(peaks) > 0))
    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    data.qpos[:] = task.worlds.qpos[0]
    mujoco.mj_forward(model, data)
    jac, solved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jac, None, model.site("tip_nominal").id)
    mujoco.mj_solveM(model, data, solved, jac)
    return {
        f"speed_{axis}": speeds[max(touched - 1, 0)],
        f"impact_{axis}_N": max(peaks[touched : touched + 20]),
        f"press_{axis}_N": float(np.mean(now[-100:])),
        f"mass_{axis}_kg": float(1.0 / (solved @ jac.T)[i, i]),
    }


def _wander(config: PandaTaskConfig, worlds: int, ticks: int) -> dict[str, float]:
    """A random high level, with forces counted at 50 Hz and as maximum over the physics steps."""
    task, rng = PegMaze(config, worlds, seed=0), np.random.default_rng(0)
    ends, shape = (config.subgoal_low, config.subgoal_high), (worlds, config.high_size)
    aims = (rng.uniform(*ends, shape) if k % config.horizon == 0 else None for k in range(ticks))
    now, peaks = [], []
    for info in _drive(task, aims):
        now.append(info["contact_force"])
        peaks.append(info["contact_force_max"])
        if len(peaks) % config.ticks == 0:
            task.reset()
    found = {"force_999_N": float(np.quantile(peaks, 0.999)), "largest_N": float(np.max(peaks))}
    for end, force in (("_50hz", np.array(now)), ("", np.array(peaks))):
        found[f"no_contact{end}"] = float((force == 0).mean())
        found[f"below_1_N{end}"] = float((force < 1).mean())
    return found


soft = lambda **changes: changed(**changes)(SOFT)  # noqa: E731
CONFIGS = {
    "stiff": STIFF,
    "soft": SOFT,
    "spring alone": replace(STIFF, peg=SOFT.peg),
    "limits alone": replace(SOFT, peg=STIFF.peg),
    "spring 50 N/m": soft(peg={"stiffness": 50.0, "damping": 4.0}),
    **{f"spring {k} N/m": soft(peg={"stiffness": float(k)}) for k in (100, 200, 400)},
    **{f"damping {d} N s/m": soft(peg={"damping": float(d)}) for d in (2, 16)},
    "peg of 10 g": soft(peg={"mass": 0.01}),
    "error limit 3 mm": soft(law={"error_limit": 0.003}),
    "error limit 4 mm": soft(law={"error_limit": 0.004}),
    "action 0.15 m/s^2": soft(u_limit=(0.15, 0.15, 0.15, 1.0, 1.0, 1.0)),
    "action 0.25 m/s^2": soft(u_limit=(0.25, 0.25, 0.25, 1.0, 1.0, 1.0)),
    "action scaled by 1/m_eff": soft(u_limit=(0.3, 0.15, 0.1, 1.0, 1.0, 1.0)),
    "one 6x6 block": soft(law={"split": False}),
    "control at every physics step": soft(hold=False),
}
"""The regimes, the ingredients of the soft one, and what else was tried."""


def table() -> pd.DataFrame:
    """A row for each configuration."""
    same = {"test": "nominal", "step": 0, "last": True, "seed": 0}
    return pd.DataFrame(
        [{"method": k, "title": k, **same, **measure(c)} for k, c in CONFIGS.items()]
    )
