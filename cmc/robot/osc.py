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

The law itself is scalar code in `cmc.robot.tick`, compiled.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.robot.panda import JOINTS, READY
from cmc.robot.tick import LAW, ROW, refresh, torque
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


def describe(
    model: mujoco.MjModel, gains: Gains, law: ControlLaw, site: str = "tip_nominal", **more: Any
) -> NDArray[np.void]:
    """The `LAW` of a scene, (1,); `more` sets further fields of it.

    Raises:
        ValueError: if the scene has no such site.
    """
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
    if index < 0:
        raise ValueError(f"the scene has no site {site!r}")
    values = {"model": model._address, "nv": model.nv, "site": index, **more}
    values |= {"body": model.site_bodyid[index], "acceleration": law.form == "acceleration"}
    values |= {"kp": gains.kp, "kd": gains.kd, "K1": gains.latent.K1, "K2": gains.latent.K2}
    values["error_limit"] = np.inf if law.error_limit is None else law.error_limit
    for name in (
        "split",
        "drift",
        "posture",
        "posture_stiffness",
        "posture_damping",
        "pivot_floor",
    ):
        values[name] = getattr(law, name)
    answer = np.zeros(1, LAW)
    for name, value in values.items():
        answer[name] = value
    return answer


def bind(row: NDArray[np.void], data: mujoco.MjData, site: int) -> None:
    """Write the addresses that the control law reads; `data` must outlive the row."""
    arrays = {"qpos": data.qpos, "qvel": data.qvel, "ctrl": data.ctrl, "bias": data.qfrc_bias}
    arrays |= {"passive": data.qfrc_passive, "site_pos": data.site_xpos[site]}
    arrays |= {"site_mat": data.site_xmat[site]}
    row["data"] = data._address
    for name, array in arrays.items():
        row[name] = array.ctypes.data


class TaskSpaceController:
    """Torque that moves a site of one simulated Panda towards a target pose.

    Reads positions, velocities, inertia and bias from `data`, which must be current
    (`mj_step1` or `mj_forward`).

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
        self._law, self._row = describe(model, gains, self.law, site), np.zeros(1, ROW)
        self._jac = np.zeros((1, 6, model.nv))
        self.site, self.jac = int(self._law["site"][0]), self._jac[0, :, :JOINTS]
        self.position, self.velocity = self._row["nominal"][0], self._row["signals"][0, 6:]
        self._data: mujoco.MjData | None = None

    def observe(self, data: mujoco.MjData) -> None:
        """Read position, orientation, Jacobian and velocity of the site from the current state."""
        if data is not self._data:
            self._data = data
            bind(self._row[0], data, self.site)
        refresh(self._row, self._law, self._jac)

    def error(self, position: Array, quat: Array) -> Array:
        """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame), (6,).

        The rotation is the log map; the translation is shortened to the law's error limit.
        """
        self._row["target"], self._row["quat"] = position, quat
        refresh(self._row, self._law, self._jac)
        return self._row["signals"][0, :6].copy()

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
        reference = self.gains.kp * error - self.gains.kd * self.velocity + u  # 2nd_sys
        return self.torque_for(data, reference)

    def torque_for(self, data: mujoco.MjData, reference: Array) -> Array:
        """Joint torques (7,) that realise the tip acceleration `reference` (6,).

        The site must have been observed in this state.
        """
        tau = np.zeros(self.model.nv)
        torque(self._row, self._law, self._jac, np.array(reference, dtype=float), tau)
        return tau[:JOINTS]
