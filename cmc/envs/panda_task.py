"""What both peg tasks share: commands, latent signals, observations, rewards, snapshots.

A tick lasts 20 ms. The low level acts at every tick; the high level sets a sub-goal, usually every
20 ticks. All arrays have a leading axis N of worlds; everything is in SI units.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.worlds import Worlds, make_worlds, pose_quat
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

    def __init__(
        self, config: PandaTaskConfig, num: int = 1, seed: int | None = None, threads: int = 1
    ) -> None:
        self.config, self.num = config, num
        tool = FINGERTIP + config.peg.length
        self._q_start = inverse_kinematics(config.start, tool=tool)
        law = replace(config.law, posture=tuple(self._q_start))
        substeps = round(config.tick / config.timestep)
        self.worlds: Worlds = make_worlds(
            self._scene(substeps), config.gains, law, substeps, config.hold, num, threads
        )
        self.seed(seed)
        latent = config.gains.latent
        # mapping_pos: y = K1 e + K2 e', with e' = -velocity because a sub-goal is at rest
        self._to_latent = np.vstack([np.diag(latent.K1), -np.diag(latent.K2)])
        self._sum = np.repeat([config.tick, 0.0], 3)  # the integral acts on translation only
        self._u_limit = np.array(config.u_limit)
        self._action = np.zeros((num, config.low_size))
        self._high_low, self._high_high = (
            np.array(config.subgoal_low),
            np.array(config.subgoal_high),
        )
        self._space_low, self._space_high = map(
            np.array, (config.workspace_low, config.workspace_high)
        )
        if config.command == "joint":
            self._space_low = np.maximum(self._q_start + self._space_low, LOWER)
            self._space_high = np.minimum(self._q_start + self._space_high, UPPER)
        self._aims = np.zeros((2, num, 3))
        self._goal, self.target = self._aims
        self._target_quat = np.zeros((num, 4))
        self.target_rotation, self.target_joints = np.zeros((num, 3)), np.zeros((num, JOINTS))
        self._ticks, self._one = np.zeros(num, dtype=int), np.ones(num, dtype=int)
        self._tick = np.full(num, config.tick)
        self.layout, self.observation_size = _slices({**self._fields(), "time_to_go": 1})
        self.high_level = (*HIGH_LEVEL, *self._own_fields())
        self._obs = np.zeros((num, self.observation_size))
        self._views = {name: self._obs[:, part] for name, part in self.layout.items()}
        # These live in the observation itself.
        self._left = self._views["time_to_go"][:, 0]
        self._integral = self._views.get("integral", np.zeros((num, 6)))
        self._everyone, self._nobody = np.ones(num, dtype=bool), np.zeros(num, dtype=bool)
        self._vectors = np.zeros((5, num, 3))
        pose = config.command == "pose"
        self._tracked = ("translation", "rotation") if pose else ("joints",)
        self.reset()

    # -- what a task defines -------------------------------------------------------------------

    def _scene(self, history: int) -> mujoco.MjModel:
        """The compiled scene; contact sensors remember `history` physics steps."""
        c = self.config
        return load_scene(c.scene, c.peg, c.timestep, history=history)

    def _own_fields(self) -> dict[str, int]:
        """Further observation fields and their sizes."""
        return {}

    def _observe_own(self, views: Mapping[str, Array]) -> None:
        """Write the further fields."""

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        raise NotImplementedError

    def _rewards(self, distance: Array, tilt: Array) -> dict[str, Array]:
        """Named terms (N,) from the tip's distance to the goal and its tilt."""
        raise NotImplementedError

    def _success(self, distance: Array) -> Mask:
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
        mask = self._everyone if mask is None else self._checked_mask(mask)
        qpos = np.zeros((self.num, self.worlds.model.nq))
        for k in np.flatnonzero(mask):
            qpos[k, :JOINTS] = self._draw_start(self.streams[k])
            self._goal[k] = self._draw_goal(self.streams[k])
        self.worlds.reset(qpos, mask)
        self._ticks[mask], self._left[mask] = 0, 0.0
        if self.config.command == "pose":
            self._aim(self.worlds.nominal, self.worlds.rotation(), mask)
        self.target_joints[mask] = self.worlds.qpos[mask, :JOINTS]
        return self._observe(mask)

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
        action = np.minimum(np.maximum(action, self._high_low), self._high_high)
        mask = self._everyone if mask is None else self._checked_mask(mask)
        self._left[mask] = c.horizon * c.tick
        if c.command == "joint":
            aimed = worlds.qpos[:, :JOINTS] + action
            aimed = np.minimum(np.maximum(aimed, self._space_low), self._space_high)
            self.target_joints[mask] = aimed[mask]
        elif c.increments:
            self._aim(worlds.nominal + action[:, :3], worlds.rotation() + action[:, 3:], mask)
        else:
            self._aim(action, np.zeros((self.num, 3)), mask)
        return self._observe(mask)

    def _aim(self, position: Array, rotation: Array, mask: Mask) -> None:
        position = np.minimum(np.maximum(position, self._space_low), self._space_high)
        length = np.sqrt((rotation**2).sum(-1, keepdims=True))
        limit = self.config.tilt_limit
        rotation = rotation * (limit / np.maximum(length, limit))
        self.target[mask], self.target_rotation[mask] = position[mask], rotation[mask]
        self._target_quat[mask] = pose_quat(rotation)[mask]

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
        action = checked(u, (self.num, self.config.low_size), "low-level action")
        action = np.clip(action, -1.0, 1.0, out=self._action)
        action *= self._u_limit
        worlds = self.worlds
        if self.config.command == "pose":
            worlds.tick_pose(self.target, self._target_quat, action)
        else:
            # The low-level action may only add to the pull towards the sub-goal (appendix G).
            pull = np.sign(self.target_joints - worlds.qpos[:, :JOINTS])
            worlds.tick_joint(self.target_joints, self.config.joint_stiffness, abs(action) * pull)
        self._ticks += self._one
        self._left -= self._tick
        obs = self._observe(None)
        lengths = self._lengths()
        distance, peaks, tracking = lengths[0], worlds.peaks.copy(), -lengths[1::3]
        terms = self._rewards(distance, lengths[2])
        info = {
            "reward_terms": terms,
            "tracking_terms": dict(zip(self._tracked, tracking, strict=False)),
            "contact_force": lengths[3],
            "contact_force_max": peaks[0],
            "penetration": peaks[1],
            "success": self._success(distance),
        }
        total: Array = functools.reduce(operator.add, terms.values())
        return obs, total, self._nobody.copy(), self._ticks >= self.config.ticks, info

    def _lengths(self) -> Array:
        """Distances to goal and sub-goal, tilt, contact force, rotation error, (5, N)."""
        vectors, views, worlds = self._vectors, self._views, self.worlds
        np.subtract(self._aims, worlds.tip, out=vectors[:2])
        vectors[2], vectors[3] = views["rotation"], worlds.force
        if self.config.command == "pose":
            vectors[4] = worlds.signals[:, 3:6]
            return np.sqrt(np.vecdot(vectors, vectors))
        vectors[4] = 0.0
        joints = views["joint_error"]
        lengths = np.sqrt(np.vecdot(vectors, vectors))
        lengths[1] = np.sqrt(np.vecdot(joints, joints))
        return lengths

    # -- observations --------------------------------------------------------------------------

    def _fields(self) -> dict[str, int]:
        shared = {"position": 3, "rotation": 3, "velocity": 6, "goal": 3, **self._own_fields()}
        if self.config.command == "joint":
            return {**shared, "joints": JOINTS, "joint_velocity": JOINTS, "joint_error": JOINTS}
        return {**shared, "error": 6, "latent": 6, "integral": 6}

    def _observe(self, fresh: Mask | None) -> Array:
        """Observations; `fresh` marks worlds whose integral starts anew, None means one tick on."""
        views, worlds = self._views, self.worlds
        views["position"][:] = worlds.tip
        views["rotation"][:] = worlds.rotation()
        views["velocity"][:] = worlds.tip_velocity
        if self.config.command == "joint":
            views["joints"][:] = worlds.qpos[:, :JOINTS]
            views["joint_velocity"][:] = worlds.qvel[:, :JOINTS]
            np.subtract(self.target_joints, views["joints"], out=views["joint_error"])
        else:
            worlds.aim(self.target, self._target_quat)
            views["error"][:] = worlds.signals[:, :6]
            latent = np.matmul(worlds.signals, self._to_latent, out=views["latent"])
            if fresh is None:
                self._integral += self._sum * latent  # I_k = I_{k-1} + h y_k
            else:
                self._integral[fresh] = self._sum * latent[fresh]
        if fresh is not None:
            views["goal"][:] = self._goal
        self._observe_own(views)
        return self._obs.copy()

    def select(self, obs: Array, names: Sequence[str]) -> Array:
        """Concatenate the named fields of observations (..., size)."""
        return np.concatenate([obs[..., self.layout[name]] for name in names], axis=-1)

    # -- snapshots -----------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Everything that decides what follows: physics, targets, counters, random streams."""
        kept = {name: getattr(self, name).copy() for name in _KEPT}
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
        for name in _KEPT:
            getattr(self, name)[:] = snapshot[name]
        return self._observe(~self._everyone)

    def _checked_mask(self, mask: ArrayLike) -> Mask:
        checked_mask = np.asarray(mask, dtype=bool)
        if checked_mask.shape != (self.num,):
            raise ValueError(f"wanted a mask of shape ({self.num},), got {checked_mask.shape}")
        return checked_mask


_KEPT = (
    "target",
    "_target_quat",
    "target_rotation",
    "target_joints",
    "_integral",
    "_goal",
    "_ticks",
    "_left",
)


def checked(value: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """`value` as a finite float array of the given shape.

    Raises:
        ValueError: on another shape, NaN or infinity.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{what}: wanted shape {shape}, got {array.shape}")
    flat = array.ravel()
    if not math.isfinite(flat.dot(flat)) and not np.isfinite(array).all():  # the first is faster
        raise ValueError(f"{what}: wanted finite numbers, got {array.tolist()}")
    return array


def _slices(fields: Mapping[str, int]) -> tuple[dict[str, slice], int]:
    layout, start = {}, 0
    for name, size in fields.items():
        layout[name] = slice(start, start + size)
        start += size
    return layout, start
