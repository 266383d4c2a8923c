"""Physics of one Panda world or of many alike, seen through arrays with a leading axis.

A tick lasts `substeps` physics steps; the torque is held over it (50 Hz) or computed at every
physics step (`cmc.robot.tick`, compiled). Contact is logged both ways: the force at the end of
the tick and the largest over its physics steps.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.robot.osc import ControlLaw, Gains, bind, describe
from cmc.robot.panda import DOWN, JOINTS
from cmc.robot.tick import ROW, refresh, tick

Array = NDArray[np.float64]
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Worlds:
    """N worlds of one scene; every array has the leading axis N and is a live view.

    Args:
        model: the scene, whose contact sensors remember `substeps` physics steps.
        gains: K_p, K_d of the task-space controller.
        law: its form and options.
        substeps: physics steps of a tick.
        hold: whether the torque is held over a tick, or computed at every physics step.
        num: N.
        threads: that share the worlds.
        u_limit: what an action of 1 means, (6,) m/s^2 and rad/s^2, or (7,) N m.
        joint_stiffness: K_p of joint control, N m/rad; None for task-space control.

    Attributes:
        target, quat, target_joints: where to go: position (N, 3), m, orientation (N, 4), or joint
            angles (N, 7), rad. After a change, `refresh`.
        tip: true tip (N, 3), m. nominal: tip fixed to the hand (N, 3), m.
        tip_velocity: of the true tip, linear and angular, (N, 6), m/s and rad/s.
        signals: control error towards the target and velocity of the nominal tip, (N, 12).
        latent: y = K1 e + K2 e' (N, 6). integral: of its translation, tick by tick, (N, 6).
        force: net contact force on the peg at the end of the tick (N, 3), N.
        peaks: over the physics steps of the tick, the largest norm of the force in N and the
            deepest penetration in m, at least 0, (N, 2).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        gains: Gains,
        law: ControlLaw,
        substeps: int,
        hold: bool,
        num: int = 1,
        threads: int = 1,
        u_limit: ArrayLike = (1.0,) * 6,
        joint_stiffness: float | None = None,
    ) -> None:
        if num < 1 or threads < 1:
            raise ValueError(f"wanted at least 1 of worlds and threads, got {num} and {threads}")
        self.model, self.num = model, num
        limit = np.zeros(JOINTS)
        limit[: np.size(u_limit)] = u_limit
        compliant = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "peg_x") >= 0
        seconds = substeps * model.opt.timestep
        more = {"substeps": substeps, "hold": hold, "tick": seconds, "u_limit": limit}
        more |= {"compliant": compliant, "joint": joint_stiffness is not None}
        more |= {"joint_stiffness": joint_stiffness or 0.0}
        self._law = describe(model, gains, law, **more)
        self._hand = model.body("hand").id
        self.data = [mujoco.MjData(model) for _ in range(num)]
        self.rows, self._jacobians = np.zeros(num, ROW), np.zeros((num, 6, model.nv))
        for row, data in zip(self.rows, self.data, strict=True):
            self._bind(row, data, substeps)
        self._qpos, self._qvel = ([getattr(d, n) for d in self.data] for n in ("qpos", "qvel"))
        rows = self.rows
        self.target, self.quat, self.target_joints = (
            rows[name] for name in ("target", "quat", "target_joints")
        )
        self.tip, self.nominal = rows["tip"], rows["nominal"]
        self.tip_velocity, self.signals = rows["tip_velocity"], rows["signals"]
        self.latent, self.integral = rows["latent"], rows["integral"]
        self.force, self.peaks = rows["force"], rows["peaks"]
        threads = min(threads, num)
        self._ends = [k * num // threads for k in range(threads + 1)]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.quat[:] = DOWN
        self.reset(np.zeros((num, model.nq)), np.ones(num, dtype=bool))

    def _bind(self, row: NDArray[np.void], data: mujoco.MjData, steps: int) -> None:
        """Addresses in `data`: the law's, the true tip's, and the contact of the last tick.

        A sensor's history is two numbers of bookkeeping, `steps` times, and a ring of values.
        """
        model = self.model
        bind(row, data, int(self._law["site"][0]))
        row["tip_pos"] = data.site_xpos[model.site("tip").id].ctypes.data
        row["hand_mat"] = data.xmat[self._hand].ctypes.data
        row["push"] = data.sensordata[model.sensor("peg_force").adr[0] :].ctypes.data
        for name, sensor in (("forces", "peg_force"), ("distances", "peg_distance")):
            start = int(model.sensor_historyadr[model.sensor(sensor).id]) + 2 + steps
            row[name] = data.history[start:].ctypes.data

    @property
    def qpos(self) -> Array:
        """Joint positions (N, nq), a copy."""
        return np.array(self._qpos)

    @property
    def qvel(self) -> Array:
        """Joint velocities (N, nv), a copy."""
        return np.array(self._qvel)

    def rotation(self) -> Array:
        """Orientation of the hand as a rotation vector from pointing straight down, (N, 3), rad."""
        turn: Array = self.rows["rotation"]
        return turn

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

    def tick(self, actions: Array) -> None:
        """One tick; actions (N, 6), or (N, 7) of joint control, in units of `u_limit`.

        Raises:
            ValueError: on NaN or infinity; then nothing has happened.
        """
        if self._pool is None:
            done = tick(self.rows, self._law, self._jacobians, actions, 0, self.num)
        else:
            whole = partial(tick, self.rows, self._law, self._jacobians, actions)
            done = all(self._pool.map(whole, self._ends[:-1], self._ends[1:]))
        if not done:
            raise ValueError(f"low-level action: wanted finite numbers, got {actions.tolist()}")

    def push(self, force: ArrayLike) -> None:
        """Let an external force (N, 3), N, act on the nominal tip, in world axes.

        Force and moment are those of the hand's present pose and last until the next push or reset;
        repeated at every tick, the force follows the tip. Zero takes it away.

        Raises:
            ValueError: on another shape, NaN or infinity.
        """
        force = np.asarray(force, dtype=float)
        if force.shape != (self.num, 3):
            raise ValueError(f"push: wanted shape {(self.num, 3)}, got {force.shape}")
        if not np.isfinite(force).all():
            raise ValueError(f"push: wanted finite numbers, got {force.tolist()}")
        # MuJoCo applies forces at the centre of mass.
        arm = self.model.site("tip_nominal").pos - self.model.body("hand").ipos
        for data, f in zip(self.data, force, strict=True):
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


def pose_quat(rotation: Array) -> Array:
    """Orientation (N, 4) that lies a rotation vector (N, 3) away from pointing straight down."""
    half = np.sqrt((rotation**2).sum(-1)) / 2
    w, (x, y, z) = np.cos(half), (rotation.T * np.sinc(half / np.pi) / 2)
    # The product with DOWN = (0, 1, 0, 0).
    return np.stack([-x, w, z, -y], axis=-1)
