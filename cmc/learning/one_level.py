"""PPO as a planner without a low level: one environment step is a segment with u = 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import nn

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import rollout
from cmc.learning.low_level import Fixed
from cmc.learning.planning import Planning
from cmc.learning.ppo import PPO, PPOConfig

Array32 = NDArray[np.float32]


class SegmentEnv(VectorEnv[Array32, Array32, NDArray[Any]]):
    """A task as a planner without a low level sees it; a step is a segment with u = 0.

    Observations are normalised, actions are sub-goals in [-1, 1] (others are clipped), rewards are
    means over the segment times `reward_scale`. Episodes are truncated by their time limit, and
    reset from outside only.

    Args:
        task: its worlds are the environments.
        planning: normalisation.
        reward_scale: factor on rewards.
    """

    def __init__(self, task: PandaTask, planning: Planning, reward_scale: float = 1.0) -> None:
        self.task, self.planning, self.reward_scale = task, planning, reward_scale
        self.num_envs = task.num
        size, ends = planning.observe(task, task.reset()).shape[-1], len(planning.low)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (ends,), np.float32)
        self.idle = Fixed(None, task.config.low_size)
        self.success = np.zeros(task.num)  # at the last tick of the latest segment

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start all episodes anew; `seed` is one integer for each equal group of worlds."""
        if seed is not None:
            seeds = np.atleast_1d(seed)
            if self.num_envs % len(seeds):
                raise ValueError(
                    f"wanted seeds that divide {self.num_envs} worlds equally, got {len(seeds)}"
                )
            each = self.num_envs // len(seeds)
            self.task.seed([int(s) + k for s in seeds for k in range(each)])
        return self._seen(self.task.reset()), {}

    def step(
        self, actions: Array32
    ) -> tuple[Array32, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One segment of every world."""
        aim = self.planning.subgoal(np.clip(actions.astype(np.float64), -1.0, 1.0))
        obs = self.task.set_subgoal(aim)
        last: dict[str, Any] = {}
        shape = (1, self.num_envs)
        _, reward, obs, over = rollout(self.task, self.idle, obs, shape, False, last.update)
        self.success[:] = last["success"]
        gain = self.reward_scale * reward[0]
        ended, limit = np.zeros(self.num_envs, bool), np.full(self.num_envs, over)
        return self._seen(obs), gain, ended, limit, {}

    def _seen(self, obs: NDArray[np.float64]) -> Array32:
        return self.planning.observe(self.task, obs).astype(np.float32)


class OneLevelPPO(PPO):
    """PPO on `SegmentEnv`, with the face of a two-level training; an update is whole episodes.

    Args:
        env: several worlds of each seed.
        actor: the policy.
        seeds: one integer for each seed.
        config: hyperparameters.
    """

    env: SegmentEnv

    def __init__(
        self, env: SegmentEnv, actor: nn.Module, seeds: Sequence[int], config: PPOConfig
    ) -> None:
        super().__init__(env, actor, seeds, config)
        self.low = env.idle

    @property
    def stride(self) -> int:
        """Environment steps of each seed in an update."""
        each = self.env.num_envs // len(self.seeds)
        return self.config.steps * self.env.task.config.horizon * each

    @property
    def steps(self) -> int:
        """Environment steps of each seed so far."""
        return self.updates * self.stride

    @property
    def success(self) -> NDArray[np.float64]:
        """Share of each seed's last episodes that were solved at their end, (seeds,)."""
        return self.env.success.reshape(len(self.seeds), -1).mean(1)

    def segment(self) -> NDArray[np.float64]:
        """One update; mean rewards (seeds,).

        Raises:
            ValueError: if it has fewer than two segments for each minibatch.
        """
        size = self.config.steps * (self.env.num_envs // len(self.seeds))
        if size < 2 * self.config.minibatches:
            raise ValueError(
                f"wanted two segments for each of {self.config.minibatches} minibatches, got {size}"
            )
        total = self.update()["episode_return"]
        return np.asarray(total / (self.config.steps * self.env.reward_scale), dtype=np.float64)

    def actors(self) -> dict[str, nn.Module]:
        """The network that acts, as "planner"."""
        return {"planner": self.policy}
