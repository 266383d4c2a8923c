"""Physics of one Panda world: an `MjData`, and MuJoCo's own calls for small matrices."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.envs.tip import UP, contact_log, is_compliant, lever, wrench
from cmc.robot.panda import JOINTS
from cmc.robot.task_space import ControlLaw, Gains, TaskSpaceController

Array = NDArray[np.float64]
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


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
        self._compliant = is_compliant(model)
        self._tip_id = model.site("tip").id
        self._tip = self.data.site_xpos[self._tip_id]
        self.tip = self._tip[None] if self._compliant else self.nominal
        self.tip_velocity = np.zeros((1, 6)) if self._compliant else self.signals[:, 6:]
        self._slide = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "hand")
        self._forces, self._distances = contact_log(model, substeps, self.data.history)
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
        mujoco.mju_mulQuat(self._down, self.controller.quat, UP)
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
        self.data.xfrc_applied[self._slide] = wrench(force, axes @ lever(self.model))[0]

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
