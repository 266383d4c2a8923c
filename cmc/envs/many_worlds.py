"""Physics of many Panda worlds: a `mujoco.batch.Batch`, and all torques in numpy."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from cmc.envs.tip import UP, contact_log, is_compliant, lever, wrench
from cmc.robot.batched import BatchedController, quat_multiply, rotation_vector
from cmc.robot.panda import JOINTS
from cmc.robot.task_space import ControlLaw, Gains

Array = NDArray[np.float64]
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


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
        self._compliant = is_compliant(model)
        self._tip = self.batch.bind("site_xpos")[:, model.site("tip").id]
        self._hand_mat = self.batch.bind("xmat")[:, model.body("hand").id]
        self._hand_quat = self.batch.bind("xquat")[:, model.body("hand").id]
        self._forces, self._distances = contact_log(model, substeps, self.batch.bind("history"))
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
        return rotation_vector(quat_multiply(self._hand_quat, UP))

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
        levers = self._hand_mat.reshape(-1, 3, 3) @ lever(self.model)
        self.batch.bind("xfrc_applied")[:, self.model.body("hand").id] = wrench(force, levers)

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
