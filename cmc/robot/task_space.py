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
        pivot_floor: Cholesky pivots of J M^-1 J^T (or J J^T) are kept above this, so that singular
            poses give bounded torques; elsewhere the control is exact.
        drift: whether J' q' is compensated; at the speeds of the tasks it is negligible.
    """

    form: Form = "force"
    split: bool = False
    error_limit: float | None = None
    posture: tuple[float, ...] = field(default=tuple(float(v) for v in READY))
    posture_stiffness: float = 1.0
    posture_damping: float = 2.0
    pivot_floor: float = 1e-3
    drift: bool = True

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
        signals: the error last aimed at, then the velocity, (12,).
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
        self._posture = np.array(self.law.posture)
        nv = model.nv
        self._full, self._jacdot, self._solved = (np.zeros((6, nv)) for _ in range(3))
        self._jacp, self._jacr = self._full[:3], self._full[3:]
        self._dotp, self._dotr = self._jacdot[:3], self._jacdot[3:]
        self.jac, self._jacdot_arm = self._full[:, :JOINTS], self._jacdot[:, :JOINTS]
        self._undriven = self._full[:, JOINTS:] if nv > JOINTS else None
        self._transposed = self._full.T
        # Contiguous arrays of all degrees of freedom multiply faster than slices of seven.
        self._qn_full, self._tau = np.zeros(nv), np.zeros(nv)
        self._qn = self._qn_full[:JOINTS]
        self._inverse, self._scratch = np.zeros((6, 6)), np.zeros(JOINTS)
        self._block_trans, self._block_rot = np.zeros((3, 3)), np.zeros((3, 3))
        self._force = np.zeros(6)
        self._local = np.zeros(3)
        self.signals = np.zeros(12)
        self._error, self.velocity = self.signals[:6], self.signals[6:]
        self._etrans, self._erot = self.signals[:3], self.signals[3:6]
        self._gain = np.hstack([np.diag(gains.kp), -np.diag(gains.kd)])
        self._solution = {3: np.zeros(3), 6: np.zeros(6)}
        self.position, self.quat = np.zeros(3), np.zeros(4)
        self._data: mujoco.MjData | None = None

    def _bind(self, data: mujoco.MjData) -> None:
        """Keep views of what is read, which costs more to look up than to read."""
        self._data = data
        self._site_pos, self._site_mat = data.site_xpos[self.site], data.site_xmat[self.site]
        self._qpos, self._qvel = data.qpos[:JOINTS], data.qvel[:JOINTS]
        self._qvel_full, self._bias, self._passive = data.qvel, data.qfrc_bias, data.qfrc_passive

    def observe(self, data: mujoco.MjData) -> None:
        """Read position, orientation, Jacobian and velocity of the site from the current state."""
        if data is not self._data:
            self._bind(data)
        mujoco.mj_jacSite(self.model, data, self._jacp, self._jacr, self.site)
        if self._undriven is not None:
            self._undriven.fill(0.0)  # sliders and the peg's mount have no motor
        self.position[:] = self._site_pos
        mujoco.mju_mat2Quat(self.quat, self._site_mat)
        self._full.dot(self._qvel_full, out=self.velocity)

    def error(self, position: Array, quat: Array) -> Array:
        """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame), (6,).

        The rotation is the log map; the translation is shortened to the law's error limit.
        """
        return self.aim(position, quat).copy()

    def aim(self, position: Array, quat: Array) -> Array:
        """As `error`, into `signals`, for the torque that follows."""
        trans = self._etrans
        np.subtract(position, self.position, out=trans)
        mujoco.mju_subQuat(self._local, quat, self.quat)  # log map, in the frame of the site
        mujoco.mju_rotVecQuat(self._erot, self._local, self.quat)
        limit = self.law.error_limit
        if limit is not None:
            length = float(trans.dot(trans)) ** 0.5
            if length > limit:
                trans *= limit / length
        return self._error

    def torque(self, data: mujoco.MjData, position: Array, quat: Array, u: Array) -> Array:
        """Joint torques (7,), N m, before the motors' limits.

        Args:
            data: current state.
            position: target of the site, (3,), m.
            quat: target orientation, unit (w, x, y, z).
            u: low-level action, (6,), m/s^2 and rad/s^2; positive u moves the tip towards +x.
        """
        self.observe(data)
        self.aim(position, quat)
        return self.torque_aimed(data, u)

    def torque_from(self, data: mujoco.MjData, error: Array, u: Array) -> Array:
        """Joint torques (7,) for an error (6,) of the state last observed."""
        self._error[:] = error
        return self.torque_aimed(data, u)

    def torque_aimed(self, data: mujoco.MjData, u: Array) -> Array:
        """Joint torques (7,) for the state last observed and the target last aimed at."""
        reference = self._gain.dot(self.signals)
        reference += u  # 2nd_sys
        return self.torque_for(data, reference)

    def torque_for(self, data: mujoco.MjData, reference: Array) -> Array:
        """Joint torques (7,) that realise the tip acceleration `reference` (6,).

        The site must have been observed in this state.
        """
        law, model, jac, qn, tau = self.law, self.model, self._full, self._qn, self._tau
        np.subtract(self._posture, self._qpos, out=qn)
        qn *= law.posture_stiffness
        np.multiply(self._qvel, law.posture_damping, out=self._scratch)
        qn -= self._scratch
        disturbed = jac.dot(self._qn_full)  # what the posture would do to the tip
        if law.drift:
            mujoco.mj_jacDot(model, data, self._dotp, self._dotr, self.position, self._body)
            reference = reference - self._jacdot_arm.dot(self._qvel)
        if law.form == "acceleration":
            inverse = jac.dot(self._transposed, out=self._inverse)
            self._qn_full += self._solve(inverse, reference - disturbed).dot(jac)
            mujoco.mj_mulM(model, data, tau, self._qn_full)  # tau_task_space_control
        else:
            mujoco.mj_mulM(model, data, tau, self._qn_full)
            mujoco.mj_solveM(model, data, self._solved, jac)
            inverse = self._solved.dot(self._transposed, out=self._inverse)  # J M^-1 J^T
            if law.split:
                trans, rot, force = self._block_trans, self._block_rot, self._force
                trans[:], rot[:] = inverse[:3, :3], inverse[3:, 3:]
                undo = self._solve(inverse, disturbed)
                force[:3] = self._solve(trans, reference[:3])
                force[3:] = self._solve(rot, reference[3:])
                force -= undo
            else:
                force = self._solve(inverse, reference - disturbed)
            tau += force.dot(jac)  # Nakanishi 3.3
        tau += self._bias
        tau -= self._passive  # joint damping is compensated
        return tau[:JOINTS].copy()

    def _solve(self, matrix: Array, right: Array) -> Array:
        """Solve with a positive matrix whose pivots are kept from zero; overwrites it."""
        mujoco.mju_cholFactor(matrix, self.law.pivot_floor)
        solution = self._solution[len(right)]
        mujoco.mju_cholSolve(solution, matrix, right)
        return solution
