"""Configuration and physics of Panda worlds, seen through arrays with a leading axis.

A tick lasts some physics steps; the torque is held over it (50 Hz) or computed at every one of them
(`cmc.robot.tick`, compiled). Contact is logged both ways: the force at the end of the tick and the
largest over its physics steps.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.envs.vector import Array, set_counts, set_numbers
from cmc.robot.osc import ControlLaw, Gains, bind, describe
from cmc.robot.panda import DOWN, FINGERTIP, JOINTS, Peg, inverse_kinematics
from cmc.robot.tick import ROW, refresh, tick
from cmc.theory.arrays import checked, count

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@dataclass(frozen=True)
class PandaTaskConfig:
    """Physics, control and episode of a peg task."""

    scene: str  # shipped scene, or path of an MJCF file
    peg: Peg
    gains: Gains
    law: ControlLaw  # its posture is replaced by the starting pose
    start: tuple[float, ...]  # tip at the start (3,), m
    subgoal_low: tuple[float, ...]  # bounds of the high-level action: (3,) m, (6,) m and rad,
    subgoal_high: tuple[float, ...]  # or (7,) rad
    workspace_low: tuple[float, ...]  # what sub-goals are clamped to: positions (3,), m, or
    workspace_high: tuple[float, ...]  # joint angles relative to the start (7,), rad
    ticks: int  # length of an episode
    command: Literal["pose", "joint"] = "pose"  # sub-goals and actions of the tip or the joints
    start_box: tuple[float, ...] = (0.0, 0.0, 0.0)  # half-widths around `start` (3,), m
    start_joints: float = 0.0  # half-width of the uniform error added to every joint, rad
    increments: bool = False  # sub-goals are increments from the current tip pose, or absolute
    tilt_limit: float = 0.5  # largest rotation of the target from pointing straight down, rad
    u_limit: tuple[float, ...] = (1.0,) * 6  # action of 1: (6,) m/s^2, rad/s^2, or (7,) N m
    joint_stiffness: float = 1.0  # K_p of the joint controller, N m/rad ("joint" only)
    horizon: int = 20  # ticks between sub-goals
    tick: float = 0.02  # control period, s
    timestep: float = 0.002  # physics step, s
    hold: bool = True  # torque held over a tick (50 Hz), or computed at every physics step

    def __post_init__(self) -> None:
        for name, kind in (("peg", Peg), ("gains", Gains), ("law", ControlLaw)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name}: wanted a {kind.__name__}, got {getattr(self, name)!r}")
        if self.command not in ("pose", "joint"):
            raise ValueError(f"command must be 'pose' or 'joint', got {self.command!r}")
        set_numbers(self, "3", ("start", "start_box"))
        set_numbers(self, str(self.low_size), ("u_limit",))
        plain = ("start_joints", "tilt_limit", "joint_stiffness", "tick", "timestep")
        set_numbers(self, "", plain)
        set_counts(self, ("ticks", "horizon"))
        for name in ("subgoal", "workspace"):
            sides = (f"{name}_low", f"{name}_high")
            set_numbers(self, str(np.size(getattr(self, sides[0]))), sides)
            low, high = (np.array(getattr(self, side)) for side in sides)
            if not (low < high).all():
                raise ValueError(f"{name}_low must lie below {name}_high, got {low} and {high}")
        steps = self.tick / self.timestep
        if abs(steps - round(steps)) > 1e-9 or steps < 1:
            raise ValueError(f"tick {self.tick} s is no multiple of timestep {self.timestep} s")

    @property
    def low_size(self) -> int:
        """Length of the low-level action."""
        return 6 if self.command == "pose" else JOINTS

    @property
    def high_size(self) -> int:
        """Length of the high-level action."""
        return len(self.subgoal_low)


class Worlds:
    """`num` worlds of a scene, whose contact sensors remember the physics steps of a tick.

    Success is a tip nearer to the goal than `near`, m, and within `box`, m, along each axis.

    Attributes (live views, one row a world; after a change of a target, `refresh`):
        start: joint angles that put the tip at the configuration's start, (7,), rad.
        target: where to go, (N, 3), m; quat: (N, 4); target_joints: (N, 7), rad.
        tip: true tip (N, 3), m. nominal: tip fixed to the hand (N, 3), m.
        rotation: of the hand, as a rotation vector from pointing straight down, (N, 3), rad.
        signals: control error towards the target and velocity of the nominal tip, (N, 12).
        latent: y = K1 e + K2 e' (N, 6). integral: of its translation, tick by tick, (N, 6).
        force: net contact force on the peg at the end of the tick (N, 3), N.
        peaks: largest |force|, N, and penetration, m, of the tick's physics steps, (N, 2).
        rows: all of that as a record of each world, `cmc.robot.tick.ROW`.
    """

    def __init__(
        self,
        config: PandaTaskConfig,
        model: mujoco.MjModel,
        num: int = 1,
        threads: int = 1,
        near: float = np.inf,
        box: tuple[float, ...] = (np.inf,) * 3,
    ) -> None:
        c, steps = config, round(config.tick / config.timestep)
        self.model, self.num = model, count("worlds", num)
        self.start = inverse_kinematics(c.start, tool=FINGERTIP + c.peg.length)
        shared = {name: getattr(c, name) for name in ("hold", "tick", "ticks", "joint_stiffness")}
        shared |= {"substeps": steps, "joint": c.command == "joint", "near": near, "box": box}
        shared["u_limit"] = np.resize(c.u_limit, JOINTS)
        law = replace(c.law, posture=tuple(self.start))
        self._law = describe(model, c.gains, law, **shared)
        self._hand = model.body("hand").id
        self.data = [mujoco.MjData(model) for _ in range(num)]
        self.rows, self._jacobians = np.zeros(num, ROW), np.zeros((num, 6, model.nv))
        for row, data in zip(self.rows, self.data, strict=True):
            bind(row, model, data, steps)
        self._qpos, self._qvel = ([getattr(d, n) for d in self.data] for n in ("qpos", "qvel"))
        self.target, self.quat, self.target_joints, self.tip, self.nominal, self.rotation = (
            self.rows[name]
            for name in ("target", "quat", "target_joints", "tip", "nominal", "rotation")
        )
        self.signals, self.latent, self.integral, self.force, self.peaks = (
            self.rows[name] for name in ("signals", "latent", "integral", "force", "peaks")
        )
        threads = min(count("threads", threads), num)
        self._ends = [k * num // threads for k in range(threads + 1)]
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
