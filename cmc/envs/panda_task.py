"""What both peg tasks share: commands, latent signals, observations, rewards, snapshots.

A tick lasts 20 ms. The low level acts at every tick; the high level sets a sub-goal, usually every
20 ticks. All arrays have a leading axis N of worlds; everything is in SI units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.envs.checks import checked
from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.panda_observation import FIXED, STATE, measure, observation_layout
from cmc.envs.worlds import Worlds, pose_quat
from cmc.robot.panda import FINGERTIP, JOINTS, LOWER, UPPER, inverse_kinematics, load_scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HIGH_LEVEL = ("position", "rotation", "velocity", "goal")
"""Observation fields that a planner sees; tasks add their own (`PandaTask.high_level`)."""
ACTOR = ("latent", "integral")
"""Observation fields of the low-level actor: s_i = (y_i, integral of y_i)."""
CRITIC = ("latent", "integral", "error", "velocity", "time_to_go")
"""Observation fields that make the low level's 20-tick segment a Markov process."""


class PandaTask:
    """N worlds of one task, without Gymnasium around them.

    A learner with two levels uses it (or the environments' methods of the same names) like this:

        obs = task.reset()
        every `horizon` ticks: obs = task.set_subgoal(high_action)
        every tick:            obs, reward, terminated, truncated, info = task.step(u)

    Args:
        config: the task.
        num: number of worlds N.
        seed: world k gets the stream of `numpy.random.default_rng(seed + k)`.
        threads: of the physics, if N > 1.

    Attributes:
        layout: observation field to its slice of the last axis.
        high_level: names of the fields a planner sees.
    """

    sliders = 0
    """Joints of the scene after the arm's that are observed as well."""
    near, box = np.inf, (np.inf, np.inf, np.inf)
    """Success is a tip nearer to the goal than `near`, m, and within `box`, m, along each axis."""

    def __init__(
        self, config: PandaTaskConfig, num: int = 1, seed: int | None = None, threads: int = 1
    ) -> None:
        self.config, self.num, self.threads = config, num, threads
        c, joint = config, config.command == "joint"
        self._q_start = inverse_kinematics(c.start, tool=FINGERTIP + c.peg.length)
        law = replace(c.law, posture=tuple(self._q_start))
        substeps = round(c.tick / c.timestep)
        scene, stiffness = self._scene(substeps), c.joint_stiffness if joint else None
        self.worlds = Worlds(
            scene, c.gains, law, substeps, c.hold, num, threads, c.u_limit, stiffness
        )
        self.target, self.target_joints = self.worlds.target, self.worlds.target_joints
        self.seed(seed)
        self._high = np.array([c.subgoal_low, c.subgoal_high])
        self._space = np.array([c.workspace_low, c.workspace_high])
        if joint:
            self._space = np.clip(self._q_start + self._space, LOWER, UPPER)
        self._state = np.zeros(num, STATE)
        self._goal, self._left = self._state["goal"], self._state["left"]
        self._ticks, self.target_rotation = self._state["ticks"], np.zeros((num, 3))
        self.layout = observation_layout(joint, self.sliders)
        self.observation_size = self.layout["time_to_go"].stop
        self.high_level = (*HIGH_LEVEL, *(("sliders", "slider_velocity") if self.sliders else ()))
        self._shape, self._pose = (num, c.low_size), not joint
        fixed = (joint, self.sliders, scene.nq - self.sliders, c.tick, c.ticks, self.near, self.box)
        self._fixed = np.array([fixed], FIXED)
        self.reset()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles are built anew and put into the same state."""
        force = self.worlds.force.copy(), self.worlds.peaks.copy()
        parts = (type(self), self.config, self.num, self.threads)
        return _rebuild, parts, (self.snapshot(), force)

    def __setstate__(self, state: tuple[dict[str, Any], tuple[Array, Array]]) -> None:
        self.restore(state[0])
        self.worlds.force[:], self.worlds.peaks[:] = state[1]

    # -- what a task defines -------------------------------------------------------------------

    def _scene(self, history: int) -> mujoco.MjModel:
        """The compiled scene; contact sensors remember `history` physics steps."""
        c = self.config
        return load_scene(c.scene, c.peg, c.timestep, history=history)

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        raise NotImplementedError

    def _reward(self, distance: Array, tilt: Array) -> tuple[Array, dict[str, Array]]:
        """Reward (N,) and its named terms, from the tip's distance to the goal and its tilt."""
        raise NotImplementedError

    # -- episodes ------------------------------------------------------------------------------

    def seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Give every world its own random stream: `seed + k`, or one seed each."""
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num:
            raise ValueError(f"wanted one seed or {self.num}, got {len(seeds)}")
        self.streams = [np.random.default_rng(s) for s in seeds]

    def reset(self, mask: Mask | None = None) -> Array:
        """Start new episodes in the masked worlds (all by default); observations (N, size)."""
        mask, worlds = self._mask(mask), self.worlds
        qpos = np.zeros((self.num, worlds.model.nq))
        for k in np.flatnonzero(mask):
            qpos[k, :JOINTS] = self._draw_start(self.streams[k])
            self._goal[k] = self._draw_goal(self.streams[k])
        worlds.reset(qpos, mask)
        self._ticks[mask], self._left[mask] = 0, 0.0
        if self.config.command == "pose":
            self._aim(worlds.nominal, worlds.rotation(), mask)
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

        Actions are clipped to their bounds; then positions are clamped to the workspace, tilts to
        `tilt_limit`, joints to their limits: an unreachable sub-goal becomes the nearest allowed.

        Args:
            high_action: (N, high_size): positions, pose increments or joint increments.
            mask: worlds that get a new sub-goal; all by default.
        """
        c, worlds = self.config, self.worlds
        action = checked(high_action, (self.num, c.high_size), "high-level action")
        action, mask = np.clip(action, *self._high), self._mask(mask)
        self._left[mask] = c.horizon * c.tick
        if c.command == "joint":
            aimed = np.clip(worlds.qpos[:, :JOINTS] + action, *self._space)
            self.target_joints[mask] = aimed[mask]
        elif c.increments:
            self._aim(worlds.nominal + action[:, :3], worlds.rotation() + action[:, 3:], mask)
        else:
            self._aim(action, np.zeros((self.num, 3)), mask)
        return self._anew(mask)

    def _aim(self, position: Array, rotation: Array, mask: Mask) -> None:
        length = np.sqrt((rotation**2).sum(-1, keepdims=True))
        limit = self.config.tilt_limit
        rotation = rotation * (limit / np.maximum(length, limit))
        self.target[mask] = np.clip(position, *self._space)[mask]
        self.target_rotation[mask] = rotation[mask]
        self.worlds.quat[mask] = pose_quat(rotation)[mask]

    def _anew(self, mask: Mask) -> Array:
        """Observations; the integral of the masked worlds starts with the present y."""
        worlds = self.worlds
        worlds.refresh()
        worlds.integral[mask, :3] = self.config.tick * worlds.latent[mask, :3]
        return self._observe()[0]

    @property
    def due(self) -> Mask:
        """Worlds whose sub-goal has had its `horizon` ticks, or that have none yet, (N,)."""
        due: Mask = self._left < 0.5 * self.config.tick
        return due

    def step(self, u: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """One tick of 20 ms.

        Args:
            u: low-level actions (N, low_size) in units of `u_limit`, clipped to [-1, 1].

        Returns:
            Observations (N, size), reward (N,), terminated (never), truncated (time is up), info:
            `reward_terms` and `tracking_terms` (the low level's reward) by name,
            `contact_force` at the end of the tick and `contact_force_max` over its physics steps
            (N), `penetration` (m, deepest of the tick), `success`.
        """
        action = np.array(u, dtype=np.float64, order="C")
        if action.shape != self._shape:
            raise ValueError(f"low-level action: wanted {self._shape}, got {action.shape}")
        self.worlds.tick(action)
        obs, numbers, (terminated, truncated, success) = self._observe(1)
        distance, tilt, force, largest, deepest, missed, turned = numbers
        reward, terms = self._reward(distance, tilt)
        tracking = {"translation": missed, "rotation": turned}
        info = {
            "reward_terms": terms,
            "tracking_terms": tracking if self._pose else {"joints": missed},
            "contact_force": force,
            "contact_force_max": largest,
            "penetration": deepest,
            "success": success,
        }
        return obs, reward, terminated, truncated, info

    # -- observations --------------------------------------------------------------------------

    def _observe(self, passed: int = 0) -> tuple[Array, Array, Mask]:
        """Observations (N, size), numbers (7, N) and flags (3, N); see `measure`."""
        obs, numbers = np.empty((self.num, self.observation_size)), np.empty((7, self.num))
        flags = np.empty((3, self.num), dtype=bool)
        measure(self.worlds.rows, self._state, self._fixed, passed, obs, numbers, flags)
        return obs, numbers, flags

    def select(self, obs: Array, names: Sequence[str]) -> Array:
        """Concatenate the named fields of observations (..., size)."""
        return np.concatenate([obs[..., self.layout[name]] for name in names], axis=-1)

    # -- snapshots -----------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Everything that decides what follows: physics, targets, counters, random streams."""
        kept = {name: array.copy() for name, array in self._kept().items()}
        streams = [stream.bit_generator.state for stream in self.streams]
        return {"physics": self.worlds.get_state(), "streams": streams, **kept}

    def restore(self, snapshot: Mapping[str, Any]) -> Array:
        """Go back to a snapshot of the same task and number of worlds; observations (N, size)."""
        physics = np.asarray(snapshot["physics"])
        if physics.shape != self.worlds.get_state().shape:
            raise ValueError(
                f"the snapshot is of other worlds: physics {physics.shape}, "
                f"wanted {self.worlds.get_state().shape}"
            )
        self.worlds.set_state(physics)
        for stream, state in zip(self.streams, snapshot["streams"], strict=True):
            stream.bit_generator.state = state
        for name, array in self._kept().items():
            array[:] = snapshot[name]
        self.worlds.refresh()
        return self._observe()[0]

    def _kept(self) -> dict[str, Array]:
        """What a snapshot holds apart from physics and random streams."""
        own = {n: getattr(self, n) for n in ("target", "target_rotation", "target_joints")}
        own |= {n: getattr(self, n) for n in ("_goal", "_ticks", "_left")}
        return own | {"_target_quat": self.worlds.quat, "_integral": self.worlds.integral}

    def _mask(self, mask: ArrayLike | None) -> Mask:
        chosen = np.ones(self.num, bool) if mask is None else np.asarray(mask, dtype=bool)
        if chosen.shape != (self.num,):
            raise ValueError(f"wanted a mask of shape ({self.num},), got {chosen.shape}")
        return chosen


def _rebuild(kind: type[PandaTask], config: PandaTaskConfig, num: int, threads: int) -> PandaTask:
    return kind(config, num, threads=threads)
