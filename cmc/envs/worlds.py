"""Physics of one Panda world or of many, seen through the same arrays with a leading axis.

`OneWorld` steps one `MjData` and uses MuJoCo's small-matrix calls; `ManyWorlds` steps a
`mujoco.batch.Batch` and computes all torques in numpy. A tick lasts `substeps` physics steps; the
torque is held over it (`hold`, 50 Hz) or computed at every physics step. Contact is logged both
ways: the force at the end of the tick and the largest over its physics steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from cmc.robot.batched import BatchedController, cross, quat_multiply, rotation_vector
from cmc.robot.panda import DOWN, JOINTS
from cmc.robot.task_space import ControlLaw, Gains, TaskSpaceController

Array = NDArray[np.float64]
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_UP = np.array([0.0, -1.0, 0.0, 0.0])  # conjugate of DOWN


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


class OneWorld:
    """One world on an `MjData`; the arrays have a leading axis of length 1."""

    def __init__(
        self, model: mujoco.MjModel, gains: Gains, law: ControlLaw, substeps: int, hold: bool
    ) -> None:
        self.model, self.num, self.substeps, self.hold = model, 1, substeps, hold
        self.data = mujoco.MjData(model)
        self.controller = TaskSpaceController(model, gains, law)
        self.qpos, self.qvel = self.data.qpos[None], self.data.qvel[None]
        self.nominal, self.signals = self.controller.position[None], self.controller.signals[None]
        self._compliant = _is_compliant(model)
        self._tip_id = model.site("tip").id
        self._tip = self.data.site_xpos[self._tip_id]
        self.tip = self._tip[None] if self._compliant else self.nominal
        self.tip_velocity = np.zeros((1, 6)) if self._compliant else self.signals[:, 6:]
        self._slide = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "hand")
        self._forces, self._distances = _history(model, substeps, self.data.history)
        self._every_force = self._forces.reshape(-1)
        self._last_force = self.data.sensordata[:3]
        self.force, self.peaks = np.zeros((1, 3)), np.zeros((2, 1))
        self._down, self._vector = np.zeros(4), np.zeros(3)

    def reset(self, qpos: Array, mask: NDArray[np.bool_]) -> None:
        """See `Worlds.reset`."""
        if not mask[0]:
            return
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos[0]
        mujoco.mj_step1(self.model, self.data)
        self.force[:], self.peaks[:] = 0.0, 0.0
        self._observe()

    def aim(self, position: Array, quat: Array) -> None:
        """See `Worlds.aim`."""
        self.controller.aim(position[0], quat[0])

    def rotation(self) -> Array:
        """See `Worlds.rotation`."""
        mujoco.mju_mulQuat(self._down, self.controller.quat, _UP)
        mujoco.mju_quat2Vel(self._vector, self._down, 1.0)
        return self._vector[None]

    def tick_pose(self, position: Array, quat: Array, u: Array) -> None:
        """See `Worlds.tick_pose`."""
        data, controller = self.data, self.controller
        goal, turn, action = position[0], quat[0], u[0]
        if self.hold:
            self._step_held(controller.torque_aimed(data, action))
        else:
            self._step_each(lambda: controller.torque(data, goal, turn, action))

    def tick_joint(self, target: Array, stiffness: float, u: Array) -> None:
        """See `Worlds.tick_joint`."""
        data, goal, action = self.data, target[0], u[0]

        def torque() -> Array:
            return stiffness * (goal - data.qpos[:JOINTS]) + action + data.qfrc_bias[:JOINTS]

        if self.hold:
            self._step_held(torque())
        else:
            self._step_each(torque)

    def _step_held(self, torque: Array) -> None:
        """mj_step1 has run for this state: finish it, step on, and prepare the next tick."""
        self.data.ctrl[:] = torque
        mujoco.mj_step2(self.model, self.data)
        if self.substeps > 1:
            mujoco.mj_step(self.model, self.data, self.substeps - 1)
        self._finish()

    def _step_each(self, torque: Callable[[], Array]) -> None:
        for k in range(self.substeps):
            self.data.ctrl[:] = torque()
            mujoco.mj_step2(self.model, self.data)
            if k < self.substeps - 1:
                mujoco.mj_step1(self.model, self.data)
        self._finish()

    def _finish(self) -> None:
        mujoco.mj_step1(self.model, self.data)
        np.negative(self._last_force, out=self.force[0])  # the sensor: the peg's push
        if self._every_force.dot(self._every_force) > 0.0:
            squares = np.vecdot(self._forces, self._forces)
            self.peaks[0] = float(squares.max()) ** 0.5
            self.peaks[1] = max(0.0, -float(self._distances.min()))
        else:
            self.peaks.fill(0.0)
        self._observe()

    def _observe(self) -> None:
        self.controller.observe(self.data)
        if self._compliant:
            axes = self.data.xmat[self._slide].reshape(3, 3)[:, :2]
            self.tip_velocity[0] = self.controller.velocity
            self.tip_velocity[0, :3] += axes @ self.data.qvel[JOINTS : JOINTS + 2]

    def push(self, force: Array) -> None:
        """See `Worlds.push`."""
        axes = self.data.xmat[self._slide].reshape(1, 3, 3)
        self.data.xfrc_applied[self._slide] = _wrench(force, axes @ _lever(self.model))[0]

    def get_state(self) -> Array:
        """See `Worlds.get_state`."""
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return state[None]

    def set_state(self, state: Array) -> None:
        """See `Worlds.set_state`."""
        mujoco.mj_setState(self.model, self.data, state[0], _STATE)
        mujoco.mj_step1(self.model, self.data)
        self._observe()


class ManyWorlds:
    """N worlds on a `mujoco.batch.Batch`, on one thread unless told otherwise."""

    def __init__(
        self,
        model: mujoco.MjModel,
        gains: Gains,
        law: ControlLaw,
        substeps: int,
        hold: bool,
        num: int,
        threads: int = 1,
    ) -> None:
        self.model, self.num, self.substeps, self.hold = model, num, substeps, hold
        self.batch = Batch(model, num, nthread=threads, persistent=True)
        self.controller = BatchedController(model, self.batch, gains, law)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl, self._bias = self.batch.bind("ctrl"), self.batch.bind("qfrc_bias")
        self._compliant = _is_compliant(model)
        self._tip = self.batch.bind("site_xpos")[:, model.site("tip").id]
        self._hand_mat = self.batch.bind("xmat")[:, model.body("hand").id]
        self._hand_quat = self.batch.bind("xquat")[:, model.body("hand").id]
        self._forces, self._distances = _history(model, substeps, self.batch.bind("history"))
        self._last_force = self.batch.bind("sensordata")[:, :3]
        self.force, self.peaks = np.zeros((num, 3)), np.zeros((2, num))
        self._refresh()

    def reset(self, qpos: Array, mask: NDArray[np.bool_]) -> None:
        """See `Worlds.reset`."""
        ids = np.flatnonzero(mask)
        if len(ids) == 0:
            return
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[ids] = qpos[ids]
        self.batch.forward(ids=ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.force[ids], self.peaks[:, ids] = 0.0, 0.0
        self._observe()

    def aim(self, position: Array, quat: Array) -> None:
        """See `Worlds.aim`."""
        self.controller.aim(position, quat)

    def rotation(self) -> Array:
        """See `Worlds.rotation`."""
        return rotation_vector(quat_multiply(self._hand_quat, _UP))

    def tick_pose(self, position: Array, quat: Array, u: Array) -> None:
        """See `Worlds.tick_pose`."""
        controller = self.controller

        def torque() -> Array:
            if not self.hold:
                controller.aim(position, quat)
            return controller.torque_aimed(u)

        self._tick(torque)

    def tick_joint(self, target: Array, stiffness: float, u: Array) -> None:
        """See `Worlds.tick_joint`."""
        arm = slice(JOINTS)
        self._tick(lambda: stiffness * (target - self.qpos[:, arm]) + u + self._bias[:, arm])

    def _tick(self, torque: Callable[[], Array]) -> None:
        every = 1 if not self.hold else self.substeps
        for _ in range(self.substeps // every):
            self._ctrl[:] = torque()
            self.batch.step(nstep=every, stage=mujoco.mjtStage.mjSTAGE_VEL)
            self._observe()
        np.negative(self._last_force, out=self.force)  # the sensor: the peg's push
        self.peaks[0] = np.sqrt(np.vecdot(self._forces, self._forces).max(-1))
        self.peaks[1] = np.maximum(0.0, -self._distances.min(-1))

    def _refresh(self) -> None:
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._observe()

    def _observe(self) -> None:
        self.controller.observe()
        self.nominal, self.signals = self.controller.position, self.controller.signals
        self.tip, self.tip_velocity = self.nominal, self.signals[:, 6:]
        if self._compliant:
            axes = self._hand_mat.reshape(-1, 3, 3)[:, :, :2]
            self.tip, self.tip_velocity = self._tip.copy(), self.tip_velocity.copy()
            slide = self.qvel[:, JOINTS : JOINTS + 2, None]
            self.tip_velocity[:, :3] += (axes @ slide)[..., 0]

    def push(self, force: Array) -> None:
        """See `Worlds.push`."""
        wrench = _wrench(force, self._hand_mat.reshape(-1, 3, 3) @ _lever(self.model))
        self.batch.bind("xfrc_applied")[:, self.model.body("hand").id] = wrench

    def get_state(self) -> Array:
        """See `Worlds.get_state`."""
        size = mujoco.mj_stateSize(self.model, _STATE)
        states, data = np.empty((self.num, size)), mujoco.MjData(self.model)
        for k in range(self.num):
            mujoco.mj_getState(self.model, self.batch.get_data(k, data), states[k], _STATE)
        return states

    def set_state(self, state: Array) -> None:
        """See `Worlds.set_state`."""
        data = mujoco.MjData(self.model)
        warm, history = self.batch.bind("qacc_warmstart"), self.batch.bind("history")
        clock, pushed = self.batch.bind("time"), self.batch.bind("xfrc_applied")
        for k in range(self.num):
            mujoco.mj_setState(self.model, data, state[k], _STATE)
            self.qpos[k], self.qvel[k], self._ctrl[k] = data.qpos, data.qvel, data.ctrl
            warm[k], history[k], clock[k] = data.qacc_warmstart, data.history, data.time
            pushed[k] = data.xfrc_applied
        self._refresh()


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


def _lever(model: mujoco.MjModel) -> Array:
    """From the hand's center of mass, where MuJoCo applies forces, to the nominal tip, (3,), m."""
    lever: Array = model.site("tip_nominal").pos - model.body("hand").ipos
    return lever


def _wrench(force: Array, lever: Array) -> Array:
    """Force and moment (N, 6) on the hand of forces (N, 3) at the ends of levers (N, 3)."""
    force = np.asarray(force, dtype=float)
    if force.shape != lever.shape:
        raise ValueError(f"push: wanted shape {lever.shape}, got {force.shape}")
    if not np.isfinite(force).all():
        raise ValueError(f"push: wanted finite numbers, got {force.tolist()}")
    return np.concatenate([force, cross(lever, force)], -1)


def _is_compliant(model: mujoco.MjModel) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "peg_x") >= 0


def _history(model: mujoco.MjModel, steps: int, buffer: Array) -> tuple[Array, Array]:
    """Views of the contact forces (..., steps, 3) and distances (..., steps) of a tick.

    A sensor's history is two numbers of bookkeeping, `steps` times, and a ring of `steps` values.
    """
    names = ("peg_force", "peg_distance")
    first, second = (int(model.sensor_historyadr[model.sensor(name).id]) for name in names)
    start = first + 2 + steps
    forces = buffer[..., start : start + 3 * steps].reshape(*buffer.shape[:-1], steps, 3)
    start = second + 2 + steps
    return forces, buffer[..., start : start + steps]
