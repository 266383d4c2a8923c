"""How a task looks to a planner and to its critics, and PPO as a planner without a low level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.envs.panda_task import PandaTask
from cmc.learning.low_level import LowLevel, rollout, tensor
from cmc.learning.ppo import PPO
from cmc.theory.arrays import Array

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class Planning:
    """How a task's observations and sub-goals are normalized for the planner."""

    shift: Mapping[str, Array]  # fields to (field - shift) * scale, by name; others stay
    scale: Mapping[str, Array]
    low: Array  # ends of the sub-goal's range, which the planner's [-1, 1] is mapped to
    high: Array
    fields: tuple[str, ...] | None = None  # what the planner sees; the task's own if None
    aim: Array | None = None  # joints around which the warm-up's sub-goals lie, (7,); 0 if None

    def observe(self, task: PandaTask, observation: Array) -> Array:
        """The planner's normalized view of observations (..., size)."""
        parts = [
            (observation[..., task.layout[name]] - self.shift.get(name, np.zeros(1)))
            * self.scale.get(name, np.ones(1))
            for name in self.fields or task.high_level
        ]
        return np.concatenate(parts, axis=-1)

    def subgoal(self, action: Array) -> Array:
        """Sub-goal in the task's units from an action in [-1, 1]."""
        return self.low + 0.5 * (action + 1.0) * (self.high - self.low)

    def direction(self, task: PandaTask, observation: Array) -> Array:
        """Middle of the random sub-goals in [-1, 1] that the warm-up draws, (..., size) or ()."""
        if self.aim is None:
            return np.zeros(())
        missing = self.aim - observation[..., task.layout["joints"]]
        return np.clip(2.0 * (missing - self.low) / (self.high - self.low) - 1.0, -1.0, 1.0)


class CriticView:
    """What the planner's critics see: also where tip and sub-goal lie from the goal, in mm.

    A planner's observation brings centimeters to order one: a tanh layer hardly tells half a
    millimeter from zero. The critics alone (not needed once the planner is trained) also see tip
    and asked sub-goal relative to the goal, as they are and through tanh at two scales, and their
    smoothed lengths n(v, c) = sqrt(v.v + c^2). Sub-goals are (3,), m, or poses (6,), m and rad.
    """

    def __init__(self, task: PandaTask, planning: Planning) -> None:
        names = planning.fields or task.high_level
        ends = np.cumsum([task.layout[name].stop - task.layout[name].start for name in names])
        starts = [0, *ends[:-1]]
        self._parts = {k: slice(a, b) for k, a, b in zip(names, starts, ends, strict=True)}
        shift = {k: np.broadcast_to(planning.shift[k], 3) for k in ("position", "goal")}
        unit = {k: 1e3 / np.broadcast_to(planning.scale[k], 3) for k in ("position", "goal")}
        middle, half = 0.5 * (planning.low + planning.high), 0.5 * (planning.high - planning.low)
        self._increments = task.config.increments
        self._mm = {k: tensor(value) for k, value in unit.items()}
        self._apart = tensor(1e3 * (shift["position"] - shift["goal"]))
        origin = 0.0 if self._increments else shift["goal"]
        self._middle = tensor(1e3 * middle[:3] - 1e3 * origin)
        self._half, self._turn = tensor(1e3 * half[:3]), (tensor(middle[3:]), tensor(half[3:]))

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Observation, action, and the features of both."""
        goal = observation[..., self._parts["goal"]] * self._mm["goal"]
        tip = observation[..., self._parts["position"]] * self._mm["position"] + self._apart - goal
        aim = self._middle + self._half * action[..., :3] + (tip if self._increments else -goal)
        near, far = _norm(tip, 0.1), _norm(aim, 0.1)
        seen = [observation, action, aim / 5, aim.tanh(), (aim / 0.3).tanh()]
        seen += [tip.tanh(), (tip / 0.3).tanh(), far / 5, far.tanh(), near / 5, near.tanh()]
        if action.shape[-1] > 3:
            rotation = observation[..., self._parts["rotation"]]
            asked = rotation + self._turn[0] + self._turn[1] * action[..., 3:]
            seen += [(asked / 0.1).tanh(), 2 * asked, 5 * _norm(asked, 0.01)]
            seen += [5 * _norm(rotation, 0.01)]
        return torch.cat(seen, dim=-1)


def _norm(v: Tensor, c: float) -> Tensor:
    """sqrt(v.v + c^2), (..., 1): a length without a kink at zero."""
    return (v.square().sum(-1, keepdim=True) + c * c).sqrt()


class SegmentEnv(VectorEnv[Array32, Array32, NDArray[Any]]):
    """The worlds of a task as a planner without a low level sees it; a step is a segment, u = 0.

    Observations are normalized, actions are sub-goals in [-1, 1] (others are clipped), rewards are
    means over the segment times `reward_scale`. Episodes are truncated by their time limit, and
    reset from outside only.
    """

    def __init__(self, task: PandaTask, planning: Planning, reward_scale: float = 1.0) -> None:
        self.task, self.planning, self.reward_scale = task, planning, reward_scale
        self.num_envs = task.num
        size, ends = planning.observe(task, task.reset()).shape[-1], len(planning.low)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (ends,), np.float32)
        self.idle = LowLevel(None, task.config.low_size)
        self.success = np.zeros(task.num)  # at the last tick of the latest segment

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Array32, dict[str, Any]]:
        """Start all episodes anew; `seed` is one integer for each equal group of worlds."""
        if seed is not None:
            seeds = np.atleast_1d(seed)
            each = range(self.num_envs // max(len(seeds), 1))
            self.task.seed([int(s) + k for s in seeds for k in each])
        return self._seen(self.task.reset()), {}

    def step(self, actions: Array32) -> tuple[Array32, Any, Any, Any, dict[str, Any]]:
        """One segment of every world."""
        aim = self.planning.subgoal(np.clip(actions.astype(np.float64), -1.0, 1.0))
        obs, shape = self.task.set_subgoal(aim), (1, self.num_envs)
        last: dict[str, Any] = {}
        _, reward, obs, over = rollout(self.task, self.idle, obs, shape, False, last.update)
        self.success[:] = last["success"]
        ended, limit = np.zeros(self.num_envs, bool), np.full(self.num_envs, over)
        return self._seen(obs), self.reward_scale * reward[0], ended, limit, {}

    def _seen(self, obs: Array) -> Array32:
        return self.planning.observe(self.task, obs).astype(np.float32)


class OneLevelPPO(PPO):
    """PPO on `SegmentEnv`, with the face of a two-level training; an update is whole episodes."""

    env: SegmentEnv

    @property
    def stride(self) -> int:
        """Environment steps of each seed in an update."""
        return self.config.steps * self.env.task.config.horizon * self.each

    @property
    def steps(self) -> int:
        """Environment steps of each seed so far."""
        return self.updates * self.stride

    @property
    def success(self) -> Array:
        """Share of each seed's last episodes that were solved at their end, (seeds,)."""
        return self.env.success.reshape(len(self.seeds), -1).mean(1)

    def segment(self) -> Array:
        """One update; mean rewards (seeds,)."""
        total = self.update()["episode_return"]
        return np.asarray(total / (self.config.steps * self.env.reward_scale), dtype=float)

    def actors(self) -> dict[str, nn.Module]:
        """The network that acts, as "planner"."""
        return {"planner": self.policy}

    def acting(self) -> tuple[nn.Module, LowLevel]:
        """The planner, and no action below it."""
        return self.policy.eval(), self.env.idle
