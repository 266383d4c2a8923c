"""The same task-space control for many worlds at once: numpy over a leading axis.

`task_space.TaskSpaceController` spends its time in MuJoCo's small-matrix calls, which suits one
world; here every formula is one array operation over all worlds. Both give the same torque.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from cmc.robot.panda import JOINTS
from cmc.robot.task_space import ControlLaw, Gains

Array = NDArray[np.float64]

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: Array, b: Array) -> Array:
    """Cross product over the last axis (`np.cross` without its bookkeeping)."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


def rotation_vector(difference: Array) -> Array:
    """Log map of unit quaternions (..., 4) to rotation vectors (..., 3), the shorter way round."""
    signed = np.where(difference[..., :1] < 0, -difference, difference)
    sine = np.sqrt((signed[..., 1:] ** 2).sum(-1, keepdims=True))
    angle = 2.0 * np.arctan2(sine, signed[..., :1])
    scale = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    return scale * signed[..., 1:]


def quat_multiply(a: Array, b: Array) -> Array:
    """Product of quaternions (w, x, y, z) over the last axis."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], -1)


class BatchedController:
    """Task-space torques for all worlds of a `mujoco.batch.Batch`.

    The batch's derived arrays must be current (`step(stage=mjSTAGE_VEL)` or `forward`).

    Args:
        model: the scene all worlds share.
        batch: the worlds.
        gains: K_p, K_d.
        law: form and options.
        site: the controlled point.

    Attributes:
        position: of the site when last observed, (N, 3), m.
        velocity: linear and angular, (N, 6), m/s and rad/s.
        signals: the error last aimed at, then the velocity, (N, 12).
        jac: Jacobian of the site for the seven joints, (N, 6, 7).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        batch: Batch,
        gains: Gains,
        law: ControlLaw | None = None,
        site: str = "tip_nominal",
    ) -> None:
        self.gains, self.law = gains, law or ControlLaw()
        self._posture = np.array(self.law.posture)
        site_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if site_id < 0:
            raise ValueError(f"the scene has no site {site!r}")
        self._qpos, self._qvel = batch.bind("qpos")[:, :JOINTS], batch.bind("qvel")[:, :JOINTS]
        self._bias = batch.bind("qfrc_bias")[:, :JOINTS]
        self._passive = batch.bind("qfrc_passive")[:, :JOINTS]
        self._anchor = batch.bind("xanchor")[:, :JOINTS]
        self._axis = batch.bind("xaxis")[:, :JOINTS]
        self._site_pos = batch.bind("site_xpos")[:, site_id]
        self._site_quat = batch.bind("xquat")[:, int(model.site_bodyid[site_id])]
        self._inertia = batch.bind("M")
        self._gather, self._absent = _dense_index(model)
        self.position = np.zeros((batch.nsim, 3))
        self.signals = np.zeros((batch.nsim, 12))
        self._error, self.velocity = self.signals[:, :6], self.signals[:, 6:]
        self._gain = np.vstack([np.diag(gains.kp), -np.diag(gains.kd)])
        self.jac = np.zeros((batch.nsim, 6, JOINTS))

    def observe(self) -> None:
        """Read position, Jacobian and velocity of the site from the current states."""
        self.position = self._site_pos.copy()
        self.jac[:, 3:] = self._axis.swapaxes(1, 2)
        arm = self.position[:, None] - self._anchor
        self.jac[:, :3] = cross(self._axis, arm).swapaxes(1, 2)
        self.velocity[:] = (self.jac @ self._qvel[..., None])[..., 0]

    def error(self, position: Array, quat: Array) -> Array:
        """Pose error (N, 6) of the states last observed: limited translation, log-map rotation."""
        return self.aim(position, quat).copy()

    def aim(self, position: Array, quat: Array) -> Array:
        """As `error`, into `signals`, for the torque that follows."""
        error = self._error
        np.subtract(position, self.position, out=error[:, :3])
        conjugate = self._site_quat * np.array([1.0, -1.0, -1.0, -1.0])
        error[:, 3:] = rotation_vector(quat_multiply(quat, conjugate))
        limit = self.law.error_limit
        if limit is not None:
            length = np.sqrt((error[:, :3] ** 2).sum(-1, keepdims=True))
            error[:, :3] *= limit / np.maximum(length, limit)
        return error

    def torque_from(self, error: Array, u: Array) -> Array:
        """Joint torques (N, 7) for errors (N, 6) of the states last observed."""
        self._error[:] = error
        return self.torque_aimed(u)

    def torque_aimed(self, u: Array) -> Array:
        """Joint torques (N, 7) for the states last observed and the targets last aimed at."""
        return self.torque_for(self.signals @ self._gain + u)  # 2nd_sys

    def torque_for(self, reference: Array) -> Array:
        """Joint torques (N, 7) that realise tip accelerations (N, 6)."""
        law, jac, velocity = self.law, self.jac, self._qvel
        qn = law.posture_stiffness * (self._posture - self._qpos) - law.posture_damping * velocity
        r = reference - self._drift() if law.drift else reference
        disturbed = (jac @ qn[..., None])[..., 0]  # what the posture would do to the tip
        mass = self._mass()
        transposed = jac.swapaxes(1, 2)
        if law.form == "acceleration":
            r = r - disturbed
            qn = qn + (transposed @ self._solve(jac @ transposed, r)[..., None])[..., 0]
            task = np.zeros_like(qn)
        else:
            wide = np.zeros((len(jac), mass.shape[-1], 6))
            wide[:, :JOINTS] = transposed
            inverse = jac @ np.linalg.solve(mass, wide)[:, :JOINTS]
            if law.split:
                force = np.concatenate(
                    [self._solve(inverse[:, b, b], r[:, b]) for b in (slice(3), slice(3, 6))], -1
                ) - self._solve(inverse, disturbed)
            else:
                force = self._solve(inverse, r - disturbed)
            task = (transposed @ force[..., None])[..., 0]
        # tau_task_space_control, or Nakanishi 3.3
        tau = task + (mass[:, :JOINTS, :JOINTS] @ qn[..., None])[..., 0]
        return tau + self._bias - self._passive

    def _drift(self) -> Array:
        """J' q', the acceleration of the site while the joints do not accelerate, (N, 6)."""
        spin = self._axis * self._qvel[..., None]
        omega = np.cumsum(spin, axis=1) - spin  # angular velocity below each joint
        origin = cross(self._anchor, spin)  # velocity at the world's origin
        anchor_rate = np.cumsum(origin, axis=1) - origin + cross(omega, self._anchor)
        spin_rate = cross(omega, spin)
        arm = self.position[:, None] - self._anchor
        arm_rate = self.velocity[:, None, :3] - anchor_rate
        linear = cross(spin_rate, arm) + cross(spin, arm_rate)
        return np.concatenate([linear.sum(1), spin_rate.sum(1)], -1)

    def _mass(self) -> Array:
        """Mass matrices of the arm's tree, (N, d, d)."""
        mass = self._inertia[:, self._gather]
        if self._absent is not None:
            mass[:, self._absent] = 0.0
        return mass

    def _solve(self, matrix: Array, right: Array) -> Array:
        """Solve with positive matrices (N, d, d) whose pivots are kept from zero."""
        floor = self.law.pivot_floor
        try:
            pivots = np.linalg.cholesky(matrix).diagonal(axis1=-2, axis2=-1) ** 2
            singular = np.flatnonzero((pivots < floor).any(-1))
        except np.linalg.LinAlgError:
            singular = np.arange(len(matrix))
        regular = matrix
        if len(singular):
            regular = matrix.copy()
            regular[singular] = np.eye(matrix.shape[-1])
        solution = np.asarray(np.linalg.solve(regular, right[..., None])[..., 0], dtype=np.float64)
        for k in singular:
            factor, one = matrix[k].copy(), np.empty(matrix.shape[-1])
            mujoco.mju_cholFactor(factor, floor)
            mujoco.mju_cholSolve(one, factor, right[k])
            solution[k] = one
        return solution


def _dense_index(model: mujoco.MjModel) -> tuple[NDArray[np.intp], NDArray[np.bool_] | None]:
    """Where the arm tree's dense mass matrix lies in MuJoCo's sparse one, and which are absent."""
    size = int((model.dof_treeid == model.dof_treeid[0]).sum())
    index = np.full((size, size), -1, dtype=np.intp)
    for row in range(size):
        start = int(model.M_rowadr[row])
        for k in range(start, start + int(model.M_rownnz[row])):
            column = int(model.M_colind[k])
            index[row, column] = index[column, row] = k
    absent = index < 0
    return np.where(absent, 0, index), absent if absent.any() else None
