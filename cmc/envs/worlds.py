"""Physics of one Panda world or of many, seen through the same arrays with a leading axis.

A tick lasts `substeps` physics steps; the torque is held over it (`hold`, 50 Hz) or computed at
every physics step. Contact is logged both ways: the force at the end of the tick and the largest
over its physics steps.
"""

from __future__ import annotations

from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.envs.many_worlds import ManyWorlds
from cmc.envs.one_world import OneWorld
from cmc.robot.batched import quat_multiply
from cmc.robot.panda import DOWN
from cmc.robot.task_space import ControlLaw, Gains

Array = NDArray[np.float64]


class Worlds(Protocol):
    """What a task needs of the physics; every array has the leading axis N.

    Attributes:
        model: the scene.
        num: N.
        qpos: joint positions (N, nq), qvel: joint velocities (N, nv): live views.
        tip: true tip (N, 3), m. nominal: tip fixed to the hand (N, 3), m.
        signals: control error towards the target last aimed at, and velocity of the nominal tip,
            (N, 12), m, rad, m/s, rad/s. tip_velocity: of the true tip (N, 6).
        force: net contact force on the peg at the end of the tick (N, 3), N.
        peaks: over the physics steps of the tick, the largest norm of the force in N and the
            deepest penetration in m, at least 0, (2, N).
    """

    model: mujoco.MjModel
    num: int
    qpos: Array
    qvel: Array
    tip: Array
    nominal: Array
    signals: Array
    tip_velocity: Array
    force: Array
    peaks: Array

    def reset(self, qpos: Array, mask: NDArray[np.bool_]) -> None:
        """Put the masked worlds at rest at `qpos` (N, nq)."""

    def aim(self, position: Array, quat: Array) -> None:
        """Compute the control error towards target poses (N, 3), (N, 4) for the current state."""

    def rotation(self) -> Array:
        """Orientation of the hand as a rotation vector from pointing straight down, (N, 3)."""

    def tick_pose(self, position: Array, quat: Array, u: Array) -> None:
        """One tick of task-space control with low-level action `u` (N, 6).

        The worlds must have been aimed at the same target in the current state.
        """

    def tick_joint(self, target: Array, stiffness: float, u: Array) -> None:
        """One tick of joint control, torque = stiffness (q_d - q) + u + gravity and Coriolis."""

    def push(self, force: Array) -> None:
        """Let an external force (N, 3), N, act on the nominal tip, in world axes.

        Force and moment are those of the hand's present pose and last until the next push or reset;
        repeated at every tick, the force follows the tip. Zero takes it away.

        Raises:
            ValueError: on another shape, NaN or infinity.
        """

    def get_state(self) -> Array:
        """Physics states (N, size), enough to continue exactly."""

    def set_state(self, state: Array) -> None:
        """Restore what `get_state` returned."""


def make_worlds(
    model: mujoco.MjModel,
    gains: Gains,
    law: ControlLaw,
    substeps: int,
    hold: bool,
    num: int,
    threads: int = 1,
) -> Worlds:
    """One world or many, whichever is faster for `num`."""
    if num < 1:
        raise ValueError(f"the number of worlds must be at least 1, got {num}")
    if num == 1:
        return OneWorld(model, gains, law, substeps, hold)
    return ManyWorlds(model, gains, law, substeps, hold, num, threads)


def pose_quat(rotation: Array) -> Array:
    """Orientation (N, 4) that lies a rotation vector (N, 3) away from pointing straight down."""
    angle = np.sqrt((rotation**2).sum(-1, keepdims=True))
    scale = np.divide(np.sin(angle / 2), angle, out=np.full_like(angle, 0.5), where=angle > 1e-9)
    turn = np.concatenate([np.cos(angle / 2), scale * rotation], -1)
    return quat_multiply(turn, np.broadcast_to(DOWN, turn.shape))
