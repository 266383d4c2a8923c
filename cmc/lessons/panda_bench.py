"""A test bench for the Panda of lesson 10: one controlled motion, everything logged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.robot.panda import DOWN, FINGERTIP, JOINTS, Peg, inverse_kinematics, load_scene
from cmc.robot.task_space import MAZE_GAINS, ControlLaw, Gains, TaskSpaceController

Array = NDArray[np.float64]
Policy = Callable[[Array], Array]
Torque = Callable[[mujoco.MjData], Array]

START = (0.4290, -0.019, 0.008)
"""Tip position at which the maze begins, m."""
TICK = 0.02
"""Seconds between two torques: 50 Hz."""
SUBSTEPS = 10
"""Physics steps per tick, 2 ms each."""


def no_policy(y: Array) -> Array:
    """No learned part: u = 0."""
    return np.zeros(6)


def saturated(gain: float, limit: float = 1.0) -> Policy:
    """Policy u = limit tanh(gain y / limit) in each dimension: odd, with a positive slope."""
    return lambda y: limit * np.tanh(gain * y / limit)


@dataclass(frozen=True)
class Setup:
    """What one run of the bench fixes.

    Attributes:
        scene: the shipped scene.
        start: first tip position, m.
        policy: from y (6,) to u (6,).
        gains: of the task-space controller.
        law: its form and options.
        peg: the tool.
        every_step: new torque at every physics step in place of the 50 Hz hold.
    """

    scene: str = "peg_maze.xml"
    start: tuple[float, float, float] = START
    policy: Policy = no_policy
    gains: Gains = MAZE_GAINS
    law: ControlLaw = field(default_factory=ControlLaw)
    peg: Peg = field(default_factory=Peg)
    every_step: bool = False


def world(setup: Setup) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Model and data with the tip at the start, at rest."""
    model = _model(setup.scene, setup.peg)
    data = mujoco.MjData(model)
    data.qpos[:JOINTS] = _start_pose(setup.start, setup.peg.length)
    mujoco.mj_forward(model, data)
    return model, data


def run(
    setup: Setup,
    target: Callable[[float], ArrayLike],
    seconds: float,
    push: Callable[[float], ArrayLike] | None = None,
) -> dict[str, Array]:
    """Let the tip follow `target(t)`, the hand pointing down.

    Args:
        setup: what is fixed.
        target: tip position (3,), m, over time.
        seconds: length of the run.
        push: joint torques (7,) added over time, such as a disturbance; none by default.

    Returns:
        Arrays with one row per tick: `t`, `qpos`, `tip` (T, 3), `goal` (T, 3), `e`, `y`, `u`
        (T, 6), `velocity` (T, 6), `tau` (T, 7), `force` (T, 3) of the walls
        on the peg at the tick, and `peak` (T,), the
        largest force over the physics steps that follow.
    """
    model, data = world(setup)
    controller = TaskSpaceController(model, setup.gains, setup.law)
    latent = setup.gains.latent
    names = ("t", "qpos", "tip", "goal", "e", "y", "u", "velocity", "tau", "force", "peak")
    log: dict[str, list] = {name: [] for name in names}
    tip, sensor = model.site("tip").id, data.sensor("peg_force").data
    for _ in range(round(seconds / TICK)):
        goal = np.asarray(target(float(data.time)), dtype=float)
        controller.observe(data)
        e = controller.error(goal, DOWN)
        y = latent.y(e, -controller.velocity)
        u = setup.policy(y)
        tau = controller.torque_from(data, e, u)
        if push is not None:
            tau = tau + np.asarray(push(float(data.time)), dtype=float)
        row: list = [data.time, data.qpos.copy(), data.site_xpos[tip].copy(), goal, e, y, u]
        row += [
            controller.velocity.copy(),
            tau,
            -sensor,
        ]  # the sensor reports the peg's push on the walls
        peak = 0.0
        for k in range(SUBSTEPS):
            if setup.every_step and k:
                mujoco.mj_forward(model, data)
                controller.observe(data)
                tau = controller.torque_from(data, controller.error(goal, DOWN), u)
            data.ctrl[:JOINTS] = tau
            mujoco.mj_step(model, data)
            peak = max(peak, float(np.linalg.norm(sensor)))
        mujoco.mj_forward(model, data)
        for name, value in zip(names, (*row, peak), strict=True):
            log[name].append(value)
    return {name: np.array(values) for name, values in log.items()}


def effective_mass(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Mass that the tip shows along x, y, z, (3,), kg: 1 / (J M^-1 J^T)_ii, arm joints only."""
    jac, inverse = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jac, None, model.site("tip_nominal").id)
    jac[:, JOINTS:] = 0.0
    mujoco.mj_solveM(model, data, inverse, jac)
    return 1.0 / np.einsum("ij,ij->i", jac, inverse)


@lru_cache(maxsize=8)
def _model(scene: str, peg: Peg) -> mujoco.MjModel:
    return load_scene(scene, peg)


@lru_cache(maxsize=32)
def _start_pose(start: tuple[float, float, float], length: float) -> Array:
    return inverse_kinematics(start, tool=FINGERTIP + length)
