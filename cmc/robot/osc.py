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
slope contracts; held for dt it must also keep (K_d + g K2) dt < 2, where g = d pi / d y. The law
itself is compiled, in `cmc.robot.tick`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.robot.panda import JOINTS, READY
from cmc.robot.tick import LAW, ROW, refresh, torque
from cmc.theory.arrays import checked, number
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

    `split` takes separate 3x3 blocks for translation and rotation instead of one 6x6 (force form).
    The 6x6 turns a contact force into a tilt of the peg; split blocks do not, but in free space
    they only approximate x'' = x_r''. Cholesky pivots of J M^-1 J^T (or J J^T) are kept above
    `pivot_floor`, so that singular poses give bounded torques; elsewhere the control is exact.
    """

    form: Form = "force"
    split: bool = False
    error_limit: float | None = None  # the translation error is shortened to this length, m
    posture: tuple[float, ...] = tuple(READY.tolist())  # what the null space returns to, rad
    posture_stiffness: float = 1.0  # 1/s^2
    posture_damping: float = 2.0  # 1/s
    pivot_floor: float = 1e-3
    drift: bool = True  # J' q' is compensated; at the speeds of the tasks it is negligible

    def __post_init__(self) -> None:
        if self.form not in ("acceleration", "force"):
            raise ValueError(f"form must be 'acceleration' or 'force', got {self.form!r}")
        if self.split and self.form != "force":
            raise ValueError("split blocks exist for the force form only")
        if self.error_limit is not None:
            number("error_limit", self.error_limit, above=0.0)
        checked("posture", self.posture, str(JOINTS))


def describe(model: mujoco.MjModel, gains: Gains, law: ControlLaw, **more: Any) -> NDArray[np.void]:
    """The `LAW` of a scene, (1,); `more` sets further fields of it."""
    site, joints = model.site("tip_nominal").id, {model.joint(k).name for k in range(model.njnt)}
    values = {**vars(law), **more, "model": model._address, "nv": model.nv, "site": site}
    values |= {"body": model.site_bodyid[site], "acceleration": values.pop("form") != "force"}
    values |= {"kp": gains.kp, "kd": gains.kd, "K1": gains.latent.K1, "K2": gains.latent.K2}
    values |= {"error_limit": law.error_limit or np.inf, "compliant": "peg_x" in joints}
    answer = np.zeros(1, LAW)
    for name, value in values.items():
        answer[name] = value
    return answer


def bind(row: NDArray[np.void], model: mujoco.MjModel, data: mujoco.MjData, steps: int = 0) -> None:
    """Write the addresses that law and tick read; `data` must outlive the row.

    A sensor's history is two numbers of bookkeeping, `steps` times, and a ring of values.
    """
    site, hand = model.site("tip_nominal").id, model.body("hand").id
    arrays = {"qpos": data.qpos, "qvel": data.qvel, "ctrl": data.ctrl, "bias": data.qfrc_bias}
    arrays |= {"passive": data.qfrc_passive, "hand_mat": data.xmat[hand]}
    arrays |= {"site_pos": data.site_xpos[site], "site_mat": data.site_xmat[site]}
    arrays |= {"tip_pos": data.site("tip").xpos, "push": data.sensor("peg_force").data}
    for name, sensor in (("forces", "peg_force"), ("distances", "peg_distance")):
        start = int(model.sensor_historyadr[model.sensor(sensor).id]) + 2 + steps
        arrays[name] = data.history[start:]
    row["data"] = data._address
    for name, array in arrays.items():
        row[name] = array.ctypes.data


class TaskSpaceController:
    """Torque that moves the tip of one simulated Panda, from `load_scene`, towards a target pose.

    Reads positions, velocities, inertia and bias from MuJoCo's data, which must be current
    (`mj_step1` or `mj_forward`). When last observed, the tip had the velocity `velocity`, linear
    and angular, (6,), m/s and rad/s, and for the seven joints the Jacobian `jac`, (6, 7). The tip
    is the one that is fixed to the hand, the site "tip_nominal".
    """

    def __init__(self, model: mujoco.MjModel, gains: Gains, law: ControlLaw | None = None) -> None:
        self.model, self.gains, self._law = (
            model,
            gains,
            describe(model, gains, law or ControlLaw()),
        )
        self._row, self._jac = np.zeros(1, ROW), np.zeros((1, 6, model.nv))
        self.velocity, self.jac = self._row["signals"][0, 6:], self._jac[0, :, :JOINTS]

    def observe(self, data: mujoco.MjData) -> None:
        """Read pose, Jacobian and velocity of the tip from the current state."""
        self._data = data  # its arrays are read by address
        bind(self._row[0], self.model, data)
        refresh(self._row, self._law, self._jac)

    def error(self, position: Array, quat: Array) -> Array:
        """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame), (6,).

        Of the state last observed, towards a position, m, and a unit quaternion (w, x, y, z). The
        rotation is the log map; the translation is shortened to the law's error limit.
        """
        self._row["target"], self._row["quat"] = position, quat
        refresh(self._row, self._law, self._jac)
        return self._row["signals"][0, :6].copy()

    def torque(self, data: mujoco.MjData, position: Array, quat: Array, u: Array) -> Array:
        """Joint torques (7,), N m, towards a pose as in `error`, before the motors' limits.

        The low-level action u, (6,), m/s^2 and rad/s^2, moves the tip towards +x where positive.
        """
        self.observe(data)
        error = self.error(position, quat)
        return self.torque_for(self.gains.kp * error - self.gains.kd * self.velocity + u)  # 2nd_sys

    def torque_for(self, reference: Array) -> Array:
        """Joint torques (7,) for the tip acceleration `reference` (6,), in the state observed."""
        tau = np.zeros(self._jac.shape[-1])
        torque(self._row, self._law, self._jac, np.array(reference, dtype=float), tau)
        return tau[:JOINTS]
