r"""Operational-space control of the Panda's peg tip, and the latent model made of its gains.

With e = x_d - x (three metres, three radians), u the low-level action and

    p = x_r'' = K_p e + K_d e' + u                                        (`2nd_sys`, Lambda_d = I)

both controllers make x'' = x_r'' in free space, so that e'' + K_d e' + K_p e + u = 0:

- acceleration-based (`tau_task_space_control`; Nakanishi et al. 2008, 3.2)
    tau = M [q_n'' + J^+ r] + h,
- force-based (Nakanishi et al. 2008, 3.3)
    tau = M q_n'' + J^T L r + h,   L = (J M^-1 J^T)^-1,

with r = x_r'' - J' q' - J q_n'' and the posture q_n'' = k_n (q_0 - q) - d_n q'. Both are the usual
projector forms, expanded: M (I - J^+ J) q_n'' in the first, (I - J^T Jbar^T) M q_n'' with
Jbar = M^-1 J^T L in the second. Without M in front, the posture term would move the tip.

With y = K1 e + K2 e' the loop becomes A y' + B y + u = 0 (`LTI`), so any u = pi(y) with positive
slope contracts; held for dt it must also keep (K_d + g K2) dt < 2, where g = d pi / d y.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.robot.panda import JOINTS, READY
from cmc.theory.composite import CompositeModel, composite

Array = NDArray[np.float64]
Form = Literal["acceleration", "force"]


@dataclass(frozen=True)
class Gains:
    """Task-space gains for translation (1/s^2, 1/s) and rotation (1/s^2, 1/s).

    Raises:
        ValueError: if a gain is negative or not finite, or if K_d^2 < 4 K_p, where no composite
            variable exists (`feedback_linearization`).
    """

    kp_trans: float
    kd_trans: float
    kp_rot: float
    kd_rot: float

    def __post_init__(self) -> None:
        _ = self.latent

    @property
    def kp(self) -> Array:
        """Stiffness per dimension, (6,), 1/s^2."""
        return np.repeat([self.kp_trans, self.kp_rot], 3).astype(float)

    @property
    def kd(self) -> Array:
        """Damping per dimension, (6,), 1/s."""
        return np.repeat([self.kd_trans, self.kd_rot], 3).astype(float)

    @property
    def latent(self) -> CompositeModel:
        """K1, K2 (the smaller root) and A y' + B y + u = 0, every field of shape (6,)."""
        return composite(self.kp, self.kd)


#: Peg maze, appendix G of the paper (its second "K_p,rot = 10" is read as K_d,rot).
MAZE_GAINS = Gains(kp_trans=40.0, kd_trans=20.0, kp_rot=20.0, kd_rot=10.0)
#: Peg push, `tab:para`.
PUSH_GAINS = Gains(kp_trans=20.0, kd_trans=30.0, kp_rot=30.0, kd_rot=40.0)


@dataclass(frozen=True)
class ControlLaw:
    """What the controller computes, apart from gains.

    Attributes:
        form: acceleration- or force-based.
        split: separate 3x3 blocks for translation and rotation instead of one 6x6 (force form).
            The 6x6 turns a contact force into a tilt of the peg; split blocks do not, but in
            free space they only approximate x'' = x_r''.
        error_limit: the translation error is shortened to this length, m; None for no limit.
        posture: joint angles the null space returns to, rad.
        posture_stiffness: 1/s^2.
        posture_damping: 1/s.
        pivot_floor: J M^-1 J^T (or J J^T) is damped where its smallest Cholesky pivot is below
            this, so that singular poses give bounded torques; elsewhere the control is exact.
    """

    form: Form = "force"
    split: bool = False
    error_limit: float | None = None
    posture: tuple[float, ...] = field(default=tuple(float(v) for v in READY))
    posture_stiffness: float = 1.0
    posture_damping: float = 2.0
    pivot_floor: float = 1e-3

    def __post_init__(self) -> None:
        if self.form not in ("acceleration", "force"):
            raise ValueError(f"form must be 'acceleration' or 'force', got {self.form!r}")
        if self.split and self.form != "force":
            raise ValueError("split blocks exist for the force form only")
        if self.error_limit is not None and not self.error_limit > 0:
            raise ValueError(f"error_limit must be positive or None, got {self.error_limit}")
        if np.shape(self.posture) != (JOINTS,) or not np.isfinite(self.posture).all():
            raise ValueError(f"posture must be {JOINTS} finite angles, got {self.posture}")


class TaskSpaceController:
    """Torque that moves a site of one simulated Panda towards a target pose.

    Reads positions, velocities, inertia and bias from `data`, which must be current
    (`mj_step1` or `mj_forward`). About 20 microseconds a call.

    Args:
        model: a scene from `load_scene`.
        gains: K_p, K_d.
        law: form and options.
        site: the controlled point.

    Attributes:
        position: of the site when last observed, (3,), m.
        velocity: linear and angular, (6,), m/s and rad/s.
        jac: Jacobian of the site for the seven joints, (6, 7).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        gains: Gains,
        law: ControlLaw | None = None,
        site: str = "tip_nominal",
    ) -> None:
        self.model, self.gains, self.law = model, gains, law or ControlLaw()
        self.site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if self.site < 0:
            raise ValueError(f"the scene has no site {site!r}")
        self._body = int(model.site_bodyid[self.site])
        self._kp, self._kd = gains.kp, gains.kd
        self._posture = np.array(self.law.posture)
        nv = model.nv
        self._full, self._jacdot, self._solved = (np.zeros((6, nv)) for _ in range(3))
        self._jacp, self._jacr = self._full[:3], self._full[3:]
        self._dotp, self._dotr = self._jacdot[:3], self._jacdot[3:]
        self.jac, self._jacdot_arm = self._full[:, :JOINTS], self._jacdot[:, :JOINTS]
        self._qn, self._mqn = np.zeros(nv), np.zeros(nv)
        self._quat, self._diff, self._rot = (np.zeros(n) for n in (4, 4, 3))
        self.position, self.velocity = np.zeros(3), np.zeros(6)

    def observe(self, data: mujoco.MjData) -> None:
        """Read position, orientation, Jacobian and velocity of the site from the current state."""
        mujoco.mj_jacSite(self.model, data, self._jacp, self._jacr, self.site)
        self._full[:, JOINTS:] = 0.0  # sliders and the peg's mount are not driven
        self.position[:] = data.site_xpos[self.site]
        mujoco.mju_mat2Quat(self._quat, data.site_xmat[self.site])
        np.matmul(self.jac, data.qvel[:JOINTS], out=self.velocity)

    def error(self, position: Array, quat: Array) -> Array:
        """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame), (6,).

        The rotation is the log map; the translation is shortened to the law's error limit.
        """
        error = np.empty(6)
        np.subtract(position, self.position, out=error[:3])
        self._quat[1:] *= -1.0
        mujoco.mju_mulQuat(self._diff, quat, self._quat)
        self._quat[1:] *= -1.0
        mujoco.mju_quat2Vel(self._rot, self._diff, 1.0)
        error[3:] = self._rot
        limit = self.law.error_limit
        if limit is not None:
            length = float(error[:3] @ error[:3]) ** 0.5
            if length > limit:
                error[:3] *= limit / length
        return error

    def torque(self, data: mujoco.MjData, position: Array, quat: Array, u: Array) -> Array:
        """Joint torques (7,), N m, before the motors' limits.

        Args:
            data: current state.
            position: target of the site, (3,), m.
            quat: target orientation, unit (w, x, y, z).
            u: low-level action, (6,), m/s^2 and rad/s^2; positive u moves the tip towards +x.
        """
        self.observe(data)
        return self.torque_from(data, self.error(position, quat), u)

    def torque_from(self, data: mujoco.MjData, error: Array, u: Array) -> Array:
        """Joint torques (7,) for an error (6,) of the state last observed."""
        reference = self._kp * error
        reference -= self._kd * self.velocity
        reference += u  # 2nd_sys
        return self.torque_for(data, reference)

    def torque_for(self, data: mujoco.MjData, reference: Array) -> Array:
        """Joint torques (7,) that realise the tip acceleration `reference` (6,).

        The site must have been observed in this state.
        """
        law, model, jac, velocity = self.law, self.model, self.jac, data.qvel[:JOINTS]
        qn = self._qn[:JOINTS]
        np.subtract(self._posture, data.qpos[:JOINTS], out=qn)
        qn *= law.posture_stiffness
        qn -= law.posture_damping * velocity
        mujoco.mj_jacDot(model, data, self._dotp, self._dotr, self.position, self._body)
        r = reference - self._jacdot_arm @ velocity
        disturbed = jac @ qn  # what the posture would do to the tip
        if law.form == "acceleration":
            r -= disturbed
            qn += jac.T @ self._solve(jac @ jac.T, r)
            mujoco.mj_mulM(model, data, self._mqn, self._qn)
            tau = self._mqn[:JOINTS] + data.qfrc_bias[:JOINTS]  # tau_task_space_control
        else:
            mujoco.mj_mulM(model, data, self._mqn, self._qn)
            mujoco.mj_solveM(model, data, self._solved, self._full)
            inverse = self._solved @ self._full.T  # J M^-1 J^T
            tau = self._mqn[:JOINTS] + data.qfrc_bias[:JOINTS]
            if law.split:
                tau -= self._solve(inverse.copy(), disturbed) @ jac
                tau += self._solve(inverse[:3, :3].copy(), r[:3]) @ jac[:3]
                tau += self._solve(inverse[3:, 3:].copy(), r[3:]) @ jac[3:]
            else:
                r -= disturbed
                tau += self._solve(inverse, r) @ jac  # Nakanishi 3.3
        tau -= data.qfrc_passive[:JOINTS]  # joint damping is compensated
        return tau

    def _solve(self, matrix: Array, right: Array) -> Array:
        """Solve with a positive matrix, damped near singular poses."""
        factor = matrix.copy()
        mujoco.mju_cholFactor(factor, 1e-12)
        pivot, floor = float(factor.diagonal().min()) ** 2, self.law.pivot_floor
        if pivot < floor:
            matrix[np.diag_indices_from(matrix)] += floor - pivot
            factor = matrix
            mujoco.mju_cholFactor(factor, 1e-12)
        solution = np.empty(len(right))
        mujoco.mju_cholSolve(solution, factor, right)
        return solution
