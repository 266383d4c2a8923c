"""What both peg tasks share: configuration, commands, observations, rewards, snapshots.

A tick lasts 20 ms. The low level acts at every tick; the high level sets a sub-goal, usually every
20 ticks. All arrays have a leading axis N of worlds; everything is in SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from cmc.envs.vector import Mask, Seed, generators, masked, set_counts, set_numbers
from cmc.robot.osc import ControlLaw, Gains, Worlds
from cmc.robot.panda import FINGERTIP, JOINTS, LOWER, UPPER, Peg, inverse_kinematics, load_scene
from cmc.robot.tick import ROOM, ROW
from cmc.theory.arrays import Array, checked

HIGH_LEVEL = ("position", "rotation", "velocity", "goal")
"""Observation fields that a planner sees; tasks add their own (`PandaTask.high_level`)."""
CRITIC = ("latent", "integral", "error", "velocity", "time_to_go")
"""Observation fields that make the low level's 20-tick segment a Markov process."""


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
        kinds = {"peg": Peg, "gains": Gains, "law": ControlLaw, "increments": bool, "hold": bool}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name}: wanted a {kind.__name__}, got {getattr(self, name)!r}")
        if self.command not in ("pose", "joint"):
            raise ValueError(f"command must be 'pose' or 'joint', got {self.command!r}")
        set_numbers(self, "3", ("start",))
        set_numbers(self, "3", ("start_box",), least=0.0)
        set_numbers(self, str(self.low_size), ("u_limit",), least=0.0)
        set_numbers(self, "", ("start_joints", "joint_stiffness"), least=0.0)
        set_numbers(self, "", ("tilt_limit", "tick", "timestep"), above=0.0)
        set_counts(self, ("ticks", "horizon"))
        joint = self.command == "joint"
        sizes = (JOINTS, JOINTS) if joint else (6 if self.increments else 3, 3)
        for name, size in zip(("subgoal", "workspace"), sizes, strict=True):
            sides = (f"{name}_low", f"{name}_high")
            set_numbers(self, str(size), sides)
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


class PandaTask:
    """`num` worlds of one task, without Gymnasium around them, shared by `threads`.

    A learner with two levels uses it like this:

        obs = task.reset()
        every `horizon` ticks: obs = task.set_subgoal(high_action)
        every tick:            obs, reward, terminated, truncated, info = task.step(u)

    World k has the random stream of `seed + k`. `layout` gives the slice of an observation's last
    axis for each field, `high_level` the names of the fields that a planner sees.
    """

    sliders = 0
    """Joints of the scene after the arm's that are observed as well."""
    near, box = np.inf, (np.inf, np.inf, np.inf)
    """Success is a tip nearer to the goal than `near`, m, and within `box`, m, along each axis."""

    def __init__(
        self, config: PandaTaskConfig, num: int = 1, seed: int | None = None, threads: int = 1
    ) -> None:
        if not isinstance(config, PandaTaskConfig):
            raise TypeError(f"config: wanted a PandaTaskConfig, got {config!r}")
        self.config, self.num, self.threads = config, num, threads
        c, joint, steps = config, config.command == "joint", round(config.tick / config.timestep)
        self._q_start = inverse_kinematics(c.start, tool=FINGERTIP + c.peg.length)
        shared = {name: getattr(c, name) for name in ("hold", "tick", "ticks", "joint_stiffness")}
        shared |= {"joint": joint, "u_limit": np.resize(c.u_limit, JOINTS)}
        shared |= {"near": self.near, "box": self.box}
        law, scene = replace(c.law, posture=tuple(self._q_start)), self._scene(steps)
        self.worlds = w = Worlds(scene, c.gains, law, num, steps, threads, **shared)
        self.target, self.target_joints = w.target, w.target_joints
        self._goal, self._left, self._ticks = (w.rows[n] for n in ("goal", "left", "ticks"))
        self._numbers, self._flags = w.rows["numbers"], w.rows["flags"]
        # what a snapshot holds apart from physics and random streams
        self._kept = {"target": w.target, "target_joints": w.target_joints, "_goal": self._goal}
        self._kept |= {"_ticks": self._ticks, "_left": self._left}
        self._kept |= {"_target_quat": w.quat, "_integral": w.integral}
        self.seed(seed)
        self._space = np.array([c.workspace_low, c.workspace_high])
        if joint:
            self._space = np.clip(self._q_start + self._space, LOWER, UPPER)
        fields = self._fields(scene.nq)
        ends = np.cumsum([len(columns) for columns in fields.values()]).tolist()
        self.layout = {n: slice(e - len(fields[n]), e) for n, e in zip(fields, ends, strict=True)}
        self._columns = np.concatenate(list(fields.values())).astype(int)
        self.observation_size, self._table = ends[-1], w.rows.view(float).reshape(num, -1)
        self.high_level = (*HIGH_LEVEL, *(("sliders", "slider_velocity") if self.sliders else ()))
        self.reset()

    def _fields(self, joints: int) -> dict[str, Array]:
        """Observation field, in order, to its columns in the records of the worlds."""
        if self.sliders and joints > ROOM:
            raise ValueError(f"sliders: wanted a scene of {ROOM} joints at most, got {joints}")
        at = np.arange(ROW.itemsize // 8, dtype=float).view(ROW)[0]
        fields = {"position": at["tip"], "rotation": at["rotation"], "velocity": at["tip_velocity"]}
        fields["goal"] = at["goal"]
        if self.sliders:
            last = slice(joints - self.sliders, joints)
            fields |= {"sliders": at["joints"][last], "slider_velocity": at["joint_velocity"][last]}
        if self.config.command == "joint":
            fields |= {name: at[name][:JOINTS] for name in ("joints", "joint_velocity")}
            fields["joint_error"] = at["joint_error"]
        else:
            fields["error"] = at["signals"][:6]
            fields |= {name: at[name] for name in ("latent", "integral")}
        return fields | {"time_to_go": at["left"][None]}

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles are built anew and put into the same state."""
        force = self.worlds.force.copy(), self.worlds.peaks.copy()
        parts = (self.config, self.num, None, self.threads)
        return type(self), parts, (self.snapshot(), force)

    def __setstate__(self, state: tuple[dict[str, Any], tuple[Array, Array]]) -> None:
        self.restore(state[0])
        self.worlds.force[:], self.worlds.peaks[:] = state[1]

    def _scene(self, history: int) -> mujoco.MjModel:
        """The compiled scene; contact sensors remember `history` physics steps."""
        return load_scene(self.config.scene, self.config.peg, self.config.timestep, history)

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        raise NotImplementedError

    def _reward(self, distance: Array, tilt: Array) -> tuple[Array, dict[str, Array]]:
        """Reward (N,) and its named terms, from the tip's distance to the goal and its tilt."""
        raise NotImplementedError

    def seed(self, seed: Seed) -> None:
        """Give every world its own random stream: `seed + k`, or one seed each."""
        if seed is None or isinstance(seed, (int, np.integer)):
            seed = [None if seed is None else int(seed) + k for k in range(self.num)]
        streams = generators(seed, self.num)
        if len(streams) != self.num:
            raise ValueError(f"seed: wanted one, or {self.num} of them, got {len(streams)}")
        self.streams = streams

    def reset(self, mask: Mask | None = None) -> Array:
        """Start new episodes in the masked worlds (all by default); observations (N, size)."""
        mask, worlds = masked("mask", mask, self.num), self.worlds
        qpos = np.zeros((self.num, worlds.model.nq))
        for k in np.flatnonzero(mask):
            qpos[k, :JOINTS] = self._draw_start(self.streams[k])
            self._goal[k] = self._draw_goal(self.streams[k])
        worlds.reset(qpos, mask)
        self._ticks[mask], self._left[mask] = 0, 0.0
        if self.config.command == "pose":
            self._aim(worlds.nominal, worlds.rotation, mask)
        self.target_joints[mask] = qpos[mask, :JOINTS]
        return self._anew(mask)

    def _draw_start(self, rng: np.random.Generator) -> Array:
        c, q = self.config, self._q_start
        if any(c.start_box):
            tip = np.array(c.start) + rng.uniform(-1, 1, 3) * np.array(c.start_box)
            q = inverse_kinematics(tip, tool=FINGERTIP + c.peg.length, q0=self._q_start)
        return q + rng.uniform(-c.start_joints, c.start_joints, JOINTS)

    def set_subgoal(self, high_action: ArrayLike, mask: Mask | None = None) -> Array:
        """Set the sub-goals of the masked worlds, reset their integrals, and observe again.

        Actions (N, high_size), positions, pose increments or joint increments, are clipped to their
        bounds; then positions are clamped to the workspace, tilts to `tilt_limit`, joints to their
        limits: an unreachable sub-goal becomes the nearest allowed.
        """
        c, worlds, mask = self.config, self.worlds, masked("mask", mask, self.num)
        action = checked("high-level action", high_action, "N size", N=self.num, size=c.high_size)
        action = np.clip(action, c.subgoal_low, c.subgoal_high)
        self._left[mask] = c.horizon * c.tick
        if c.command == "joint":
            aimed = np.clip(worlds.qpos[:, :JOINTS] + action, *self._space)
            self.target_joints[mask] = aimed[mask]
        elif c.increments:
            self._aim(worlds.nominal + action[:, :3], worlds.rotation + action[:, 3:], mask)
        else:
            self._aim(action, np.zeros((self.num, 3)), mask)
        return self._anew(mask)

    def _aim(self, position: Array, rotation: Array, mask: Mask) -> None:
        """Clamp positions and rotation vectors from pointing straight down, (N, 3), and aim."""
        length, limit = np.sqrt((rotation**2).sum(-1)), self.config.tilt_limit
        rotation = rotation * (limit / np.maximum(length, limit))[:, None]
        half = np.sqrt((rotation**2).sum(-1)) / 2
        w, (x, y, z) = np.cos(half), (rotation.T * np.sinc(half / np.pi) / 2)
        quat = np.stack([-x, w, z, -y], axis=-1)  # the product with DOWN = (0, 1, 0, 0)
        self.target[mask] = np.clip(position, *self._space)[mask]
        self.worlds.quat[mask] = quat[mask]

    def _anew(self, mask: Mask) -> Array:
        """Observations; the integral of the masked worlds starts with the present y."""
        worlds = self.worlds
        worlds.refresh()
        worlds.integral[mask, :3] = self.config.tick * worlds.latent[mask, :3]
        return self._observe()

    def _observe(self) -> Array:
        """Observations (N, size) of what was last seen of the worlds."""
        return self._table.take(self._columns, axis=1)

    @property
    def due(self) -> Mask:
        """Worlds whose sub-goal has had its `horizon` ticks, or that have none yet, (N,)."""
        due: Mask = self._left < 0.5 * self.config.tick
        return due

    def step(self, u: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """One tick under low-level actions (N, low_size) in `u_limit`, clipped to [-1, 1].

        Gives observations (N, size), reward, terminated, truncated and info, as `PandaEnv` does.
        """
        self.worlds.tick(u)
        distance, tilt, force, largest, deepest, missed, turned = self._numbers.T.copy()
        terminated, truncated, success = self._flags.T != 0.0
        reward, terms = self._reward(distance, tilt)
        joint = self.config.command == "joint"
        tracking = {"joints": missed} if joint else {"translation": missed, "rotation": turned}
        info = {"reward_terms": terms, "tracking_terms": tracking, "contact_force": force}
        info |= {"contact_force_max": largest, "penetration": deepest, "success": success}
        return self._observe(), reward, terminated, truncated, info

    def select(self, obs: Array, names: Sequence[str]) -> Array:
        """Concatenate the named fields of observations (..., size)."""
        return np.concatenate([obs[..., self.layout[name]] for name in names], axis=-1)

    def snapshot(self) -> dict[str, Any]:
        """Everything that decides what follows: physics, targets, counters, random streams."""
        kept = {name: array.copy() for name, array in self._kept.items()}
        streams = [stream.bit_generator.state for stream in self.streams]
        return {"physics": self.worlds.get_state(), "streams": streams, **kept}

    def restore(self, snapshot: Mapping[str, Any]) -> Array:
        """Go back to a snapshot of the same task and number of worlds; observations (N, size)."""
        if not isinstance(snapshot, Mapping) or "physics" not in snapshot:
            raise TypeError(f"snapshot: wanted what `snapshot` gave, got {snapshot!r}")
        found, wanted = np.shape(snapshot["physics"]), self.worlds.get_state().shape
        if found != wanted:
            raise ValueError(f"the snapshot is of other worlds: physics {found}, wanted {wanted}")
        self.worlds.set_state(snapshot["physics"])
        for stream, state in zip(self.streams, snapshot["streams"], strict=True):
            stream.bit_generator.state = state
        for name, array in self._kept.items():
            array[:] = snapshot[name]
        self.worlds.refresh()
        return self._observe()
