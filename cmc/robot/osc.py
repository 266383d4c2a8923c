r"""Operational-space control of the Panda's peg tip, its latent model, and the worlds under it.

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
itself is compiled, in `cmc.robot.tick`; `Worlds` is its face: physics seen through arrays.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.robot.panda import DOWN, JOINTS, READY
from cmc.robot.tick import LAW, ROW, refresh, tick
from cmc.theory.arrays import Array, checked, count, number
from cmc.theory.composite import CompositeModel, composite

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


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
        for name, value in vars(self).items():
            number(name, value, least=0.0)
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

    form: Literal["acceleration", "force"] = "force"
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
        for name in ("split", "drift"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name}: wanted True or False, got {getattr(self, name)!r}")
        if self.split and self.form != "force":
            raise ValueError("split blocks exist for the force form only")
        if self.error_limit is not None:
            number("error_limit", self.error_limit, above=0.0)
        checked("posture", self.posture, str(JOINTS))
        for name in ("posture_stiffness", "posture_damping"):
            number(name, getattr(self, name), least=0.0)
        number("pivot_floor", self.pivot_floor, above=0.0)


class Worlds:
    """`num` worlds of a scene whose contact sensors remember the physics steps of a tick.

    A tick lasts `substeps` physics steps; the torque is held over it, or computed at every one.
    `threads` share the worlds. `law` and `more` are the fields of `cmc.robot.tick.LAW`. The arrays
    below are live views of the worlds' records, `rows`; after a change of a target, `refresh`.
    """

    target: Array  # where the tip is to go, (N, 3), m
    quat: Array  # and how the hand is to be turned, (N, 4)
    target_joints: Array  # the same for joint control, (N, 7), rad
    tip: Array  # the true tip, (N, 3), m
    nominal: Array  # the tip that is fixed to the hand, (N, 3), m
    rotation: Array  # of the hand, a rotation vector from pointing straight down, (N, 3), rad
    signals: Array  # control error towards the target and velocity of the nominal tip, (N, 12)
    latent: Array  # y = K1 e + K2 e', (N, 6)
    integral: Array  # of its translation, tick by tick, (N, 6)
    force: Array  # net contact force on the peg at the end of the tick, (N, 3), N
    peaks: Array  # largest |force|, N, and penetration, m, of the tick's physics steps, (N, 2)

    def __init__(
        self,
        model: mujoco.MjModel,
        gains: Gains,
        law: ControlLaw,
        num: int = 1,
        substeps: int = 1,
        threads: int = 1,
        **more: Any,
    ) -> None:
        self.model, self.num = model, count("worlds", num)
        remembered = [model.sensor_history[model.sensor(n).id][0] for n in _CONTACT.values()]
        if min(remembered) < substeps:
            raise ValueError(f"model: wanted sensors with a history of {substeps} (`load_scene`)")
        self._law = _describe(model, gains, law, substeps=substeps, **more)
        self._hand, self._actions = model.body("hand").id, (num, JOINTS if more.get("joint") else 6)
        self.data = [mujoco.MjData(model) for _ in range(num)]
        self.rows, self._jacobians = np.zeros(num, ROW), np.zeros((num, 6, model.nv))
        for row, data in zip(self.rows, self.data, strict=True):
            _bind(row, model, data, substeps)
        for name in Worlds.__annotations__:
            setattr(self, name, self.rows[name])
        self._qpos, self._qvel = ([getattr(d, n) for d in self.data] for n in ("qpos", "qvel"))
        threads = min(count("threads", threads), num)
        ends = [k * num // threads for k in range(threads + 1)]
        self._parts = [slice(*part) for part in zip(ends, ends[1:], strict=False)]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.quat[:] = DOWN
        self.reset(np.zeros((num, model.nq)), np.ones(num, dtype=bool))

    @property
    def qpos(self) -> Array:
        """Joint positions (N, nq), a copy."""
        return np.array(self._qpos)

    @property
    def qvel(self) -> Array:
        """Joint velocities (N, nv), a copy."""
        return np.array(self._qvel)

    def reset(self, qpos: Array, mask: NDArray[np.bool_]) -> None:
        """Put the masked worlds at rest at `qpos` (N, nq)."""
        for k in np.flatnonzero(mask):
            mujoco.mj_resetData(self.model, self.data[k])
            self._qpos[k][:] = qpos[k]
            mujoco.mj_step1(self.model, self.data[k])
        self.force[mask], self.peaks[mask] = 0.0, 0.0
        self.refresh()

    def refresh(self) -> None:
        """Observe the current states and compute errors towards the targets."""
        refresh(self.rows, self._law, self._jacobians)

    def tick(self, actions: ArrayLike) -> None:
        """One tick; actions (N, 6), or (N, 7) of joint control, in units of `u_limit`."""
        num, size = shape = self._actions
        floats = isinstance(actions, np.ndarray) and actions.dtype.kind == "f"
        if not floats or np.shape(actions) != shape:  # always `checked`: a tenth of a tick more
            actions = checked("low-level action", actions, "N size", N=num, size=size)
        values = np.array(actions, dtype=np.float64, order="C")
        arrays = self.rows, self._jacobians, values
        if self._pool is not None and np.isfinite(values).all():
            cut = ([array[part] for array in arrays] for part in self._parts)
            list(self._pool.map(lambda a: tick(a[0], self._law, *a[1:]), cut))
        elif not tick(self.rows, self._law, self._jacobians, values):
            checked("low-level action", values)

    def push(self, force: ArrayLike) -> None:
        """Let an external force (N, 3), N, act on the nominal tip, in world axes.

        Force and moment are those of the hand's present pose and last until the next push or reset;
        repeated at every tick, the force follows the tip. Zero takes it away.
        """
        forces = checked("push", force, "N 3", N=self.num)
        # MuJoCo applies forces at the centre of mass.
        arm = self.model.site("tip_nominal").pos - self.model.body("hand").ipos
        for data, f in zip(self.data, forces, strict=True):
            lever = data.xmat[self._hand].reshape(3, 3) @ arm
            data.xfrc_applied[self._hand] = np.concatenate([f, np.cross(lever, f)])

    def get_state(self) -> Array:
        """Physics states (N, size), enough to continue exactly."""
        states = np.empty((self.num, mujoco.mj_stateSize(self.model, _STATE)))
        for data, state in zip(self.data, states, strict=True):
            mujoco.mj_getState(self.model, data, state, _STATE)
        return states

    def set_state(self, states: Array) -> None:
        """Restore what `get_state` returned."""
        for data, state in zip(self.data, states, strict=True):
            mujoco.mj_setState(self.model, data, state, _STATE)
            mujoco.mj_step1(self.model, data)
        self.refresh()


_CONTACT = {"forces": "peg_force", "distances": "peg_distance"}


def _describe(
    model: mujoco.MjModel, gains: Gains, law: ControlLaw, **more: Any
) -> NDArray[np.void]:
    """The `LAW` of a scene, (1,)."""
    site, joints = model.site("tip_nominal").id, {model.joint(k).name for k in range(model.njnt)}
    values = {**vars(law), **more, "model": model._address, "nv": model.nv, "site": site}
    values |= {"body": model.site_bodyid[site], "acceleration": values.pop("form") != "force"}
    values |= {"kp": gains.kp, "kd": gains.kd, "K1": gains.latent.K1, "K2": gains.latent.K2}
    values |= {"error_limit": law.error_limit or np.inf, "compliant": "peg_x" in joints}
    answer = np.zeros(1, LAW)
    for name, value in values.items():
        answer[name] = value
    return answer


def _bind(row: NDArray[np.void], model: mujoco.MjModel, data: mujoco.MjData, steps: int) -> None:
    """Write the addresses that law and tick read; `data` must outlive the row.

    A sensor's history is two numbers of bookkeeping, `steps` times, and a ring of values.
    """
    site, hand = model.site("tip_nominal").id, model.body("hand").id
    arrays = {"qpos": data.qpos, "qvel": data.qvel, "ctrl": data.ctrl, "bias": data.qfrc_bias}
    arrays |= {"passive": data.qfrc_passive, "hand_mat": data.xmat[hand]}
    arrays |= {"site_pos": data.site_xpos[site], "site_mat": data.site_xmat[site]}
    arrays |= {"tip_pos": data.site("tip").xpos, "push": data.sensor("peg_force").data}
    for name, sensor in _CONTACT.items():
        start = int(model.sensor_historyadr[model.sensor(sensor).id]) + 2 + steps
        arrays[name] = data.history[start:]
    row["data"] = data._address
    for name, array in arrays.items():
        row[name] = array.ctypes.data
