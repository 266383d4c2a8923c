"""How hard the peg touches: pressing, impact and tracking of the maze's regimes, measured.

`python -m cmc.envs.softness` writes `assets/results/softness.json`. Two formulas explain it
(m_eff is what a contact along one axis feels, 1 / (J M^-1 J^T)_ii):

- pressing:  m_eff (K_p e + u): limited by the error limit and by the bound on u, not by the spring;
- impact:    about m_eff v / tau for a rigid peg (tau: a few ms of contact), v sqrt(k m_eff) for one
  on a spring: limited by the spring, and by the speed that the limits allow.

Either limit alone leaves the other term, so the soft regime needs both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.panda_gym import LowLevel
from cmc.envs.panda_task import Array, PandaTask
from cmc.envs.peg_maze import SOFT, STIFF, PegMaze
from cmc.robot.panda import Peg

GAIN = 20.0
"""Slope of the fixed low level at zero, du/dy in translation (rotation: a tenth), our choice."""
WALLS = {  # axis: where the tip starts, and the sub-goal behind the wall
    "x": ((0.4290, -0.0190, 0.008), (0.4000, -0.0190, 0.008)),
    "y": ((0.4180, -0.0150, 0.008), (0.4180, -0.0300, 0.008)),
}


def low_level(config: PandaTaskConfig, gain: float = GAIN) -> LowLevel:
    """A fixed odd policy with positive slopes, u = b tanh(g (y + int y) / b), in units of b."""
    bound, slope = np.array(config.u_limit), gain * np.array([1.0] * 3 + [0.1] * 3)
    return lambda y, integral: np.tanh(slope * (y + integral) / bound)


def measure_softness(worlds: int = 32, ticks: int = 1200, seed: int = 0) -> dict[str, Any]:
    """Figures of both regimes, of each ingredient alone, and of what else was tried.

    Args:
        worlds: worlds driven by a random high level.
        ticks: length of that drive, restarted after every episode.
        seed: of the drive.
    """
    measured = {
        name: measure(config, worlds, ticks, seed) for name, config in {**_NAMED, **_TRIED}.items()
    }
    return {
        "low_level": f"u = b tanh({GAIN:g} (y + integral of y) / b), rotation at a tenth of it",
        "random_high_level_steps": worlds * ticks,
        "regimes": {name: measured[name] for name in _NAMED},
        "tried": {name: measured[name] for name in _TRIED},
    }


def measure(config: PandaTaskConfig, worlds: int, ticks: int, seed: int) -> dict[str, Any]:
    """Tracking, pressing, impact and random driving of one configuration."""
    contact = {axis: _press(config, *ends) for axis, ends in WALLS.items()}
    return {
        "tracking_residual": _track(config),
        "contact": contact,
        "random": _wander(config, worlds, ticks, seed),
    }


def _track(config: PandaTaskConfig) -> dict[str, float]:
    """Share of a 5 mm step in each of six directions that is left after 0.4 s in free space."""
    everywhere = replace(
        config,
        scene="panda.xml",
        start_joints=0.0,
        subgoal_low=(-1.0,) * 3,
        subgoal_high=(1.0,) * 3,
        workspace_low=(-1.0,) * 3,
        workspace_high=(1.0,) * 3,
    )
    task = PegMaze(everywhere, 6, seed=0)
    target = np.array(config.start) + 0.005 * np.vstack([np.eye(3), -np.eye(3)])
    _follow(task, config, lambda k: target if k == 0 else None, config.horizon)
    left = np.linalg.norm(target - task.worlds.tip, axis=-1) / 0.005
    return {"worst": float(left.max()), "mean": float(left.mean())}


def _press(config: PandaTaskConfig, start: Any, beyond: Any) -> dict[str, float]:
    """Drive into a wall and lean on it for 4 s."""
    task = PegMaze(replace(config, start=start, start_joints=0.0), 1, seed=0)
    axis = int(np.argmax(np.abs(np.subtract(beyond, start))))
    speeds, now, peaks = [], [], []

    def note(info: dict[str, Any]) -> None:
        speeds.append(abs(float(task.worlds.signals[0, 6 + axis])))
        now.append(float(info["contact_force"][0]))
        peaks.append(float(info["contact_force_max"][0]))

    goal = np.array([beyond])
    _follow(task, config, lambda k: goal if k == 0 else None, 200, note)
    touched = int(np.argmax(np.array(peaks) > 0))
    return {
        "approach_speed_m_s": speeds[max(touched - 1, 0)],
        "impact_peak_N": max(peaks[touched : touched + 20]),
        "steady_press_N": float(np.mean(now[-100:])),
        "effective_mass_kg": _effective_mass(task, axis),
    }


def _effective_mass(task: PandaTask, axis: int) -> float:
    """1 / (J M^-1 J^T)_ii of the hand's tip, kg."""
    import mujoco

    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    data.qpos[:] = task.worlds.qpos[0]
    mujoco.mj_forward(model, data)
    jac, solved = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jac, None, model.site("tip_nominal").id)
    mujoco.mj_solveM(model, data, solved, jac)
    return float(1.0 / (solved @ jac.T)[axis, axis])


def _wander(config: PandaTaskConfig, worlds: int, ticks: int, seed: int) -> dict[str, float]:
    """A random high level, with forces counted at 50 Hz and as maximum over the physics steps."""
    task, rng = PegMaze(config, worlds, seed), np.random.default_rng(seed)
    shape, now, peaks = (worlds, config.high_size), [], []

    def note(info: dict[str, Any]) -> None:
        now.append(info["contact_force"])
        peaks.append(info["contact_force_max"])
        if len(peaks) % config.ticks == 0:
            task.reset()

    def subgoal(k: int) -> Array | None:
        if k % config.horizon:
            return None
        return rng.uniform(config.subgoal_low, config.subgoal_high, shape)

    _follow(task, config, subgoal, ticks, note)
    f, peak = np.array(now), np.array(peaks)
    return {
        "share_no_contact_50Hz": float((f == 0).mean()),
        "share_no_contact_substeps": float((peak == 0).mean()),
        "share_below_1N_50Hz": float((f < 1).mean()),
        "share_below_1N_substeps": float((peak < 1).mean()),
        "force_99.9_percent_N": float(np.quantile(peak, 0.999)),
        "largest_N": float(peak.max()),
    }


def _follow(
    task: PandaTask,
    config: PandaTaskConfig,
    subgoal: Callable[[int], Array | None],
    ticks: int,
    note: Callable[[dict[str, Any]], None] = lambda info: None,
) -> None:
    """Run the fixed low level under sub-goals given tick by tick (None: keep)."""
    policy, obs = low_level(config), task.reset()
    for k in range(ticks):
        goal = subgoal(k)
        if goal is not None:
            obs = task.set_subgoal(goal)
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        obs, *_, info = task.step(policy(y, integral))
        note(info)


def _peg(stiffness: float, damping: float = 8.0, mass: float = 0.03) -> Peg:
    return Peg(length=0.05, stiffness=stiffness, damping=damping, mass=mass)


def _u(*translation: float) -> tuple[float, ...]:
    return (*translation, 1.0, 1.0, 1.0)


_NAMED = {
    "stiff": STIFF,
    "soft": SOFT,
    "spring alone": replace(STIFF, peg=SOFT.peg),
    "limits alone": replace(SOFT, peg=STIFF.peg),
}
_TRIED = {
    "spring 50 N/m": replace(SOFT, peg=_peg(50.0, 4.0)),
    "spring 100 N/m": replace(SOFT, peg=_peg(100.0)),
    "spring 200 N/m": replace(SOFT, peg=_peg(200.0)),
    "spring 400 N/m": replace(SOFT, peg=_peg(400.0)),
    "damping 2 N s/m": replace(SOFT, peg=_peg(150.0, 2.0)),
    "damping 16 N s/m": replace(SOFT, peg=_peg(150.0, 16.0)),
    "peg of 10 g": replace(SOFT, peg=_peg(150.0, mass=0.01)),
    "error limit 3 mm": replace(SOFT, law=replace(SOFT.law, error_limit=0.003)),
    "error limit 4 mm": replace(SOFT, law=replace(SOFT.law, error_limit=0.004)),
    "action 0.15 m/s^2": replace(SOFT, u_limit=_u(0.15, 0.15, 0.15)),
    "action 0.25 m/s^2": replace(SOFT, u_limit=_u(0.25, 0.25, 0.25)),
    "action scaled by 1/m_eff": replace(SOFT, u_limit=_u(0.3, 0.15, 0.1)),
    "one 6x6 block": replace(SOFT, law=replace(SOFT.law, split=False)),
    "control at every physics step": replace(SOFT, hold=False),
}


def main() -> None:
    """Measure and write `assets/results/softness.json`."""
    from cmc.store import asset, provenance, write_json

    result = measure_softness()
    record = provenance("python -m cmc.envs.softness", [0])
    path = write_json(asset("results") / "softness.json", {"provenance": record, **result})
    for name, figures in {**result["regimes"], **result["tried"]}.items():
        print(
            f"{name:30s} left {figures['tracking_residual']['worst']:.3f}  press x "
            f"{figures['contact']['x']['steady_press_N']:.2f} N, impact x "
            f"{figures['contact']['x']['impact_peak_N']:.2f} N, below 1 N "
            f"{figures['random']['share_below_1N_substeps']:.5f}"
        )
    print(path)


if __name__ == "__main__":
    main()
