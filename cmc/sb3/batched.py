"""Native vector environments for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv


class BatchedVecEnv(VecEnv):
    """A natively batched Gymnasium vector environment as a Stable-Baselines3 one.

    Args:
        env: a vector environment that restarts in the same step.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                "wanted a vector environment that restarts in the same step (autoreset_mode="
                f"AutoresetMode.SAME_STEP), as Stable-Baselines3 expects; got {mode}"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._seed: int | None = None
        self._actions: Any = None
        self._return, self._length = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Use `seed` at the next reset."""
        self._seed = seed
        return [seed] * self.num_envs

    def reset(self) -> Any:
        """Start all trajectories."""
        observation, _ = self.env.reset(seed=self._seed)
        self._seed = None
        self._return[:], self._length[:] = 0.0, 0
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step; what ended reports its last observation and its return ("episode")."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        self._return += reward
        self._length += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "episode": {"r": float(self._return[index]), "l": int(self._length[index])},
            }
        self._return[done], self._length[done] = 0.0, 0
        return observation, np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the batched environment's attribute, once for each trajectory asked for."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: trajectories of a batch share their attributes."""
        raise NotImplementedError("trajectories of a batch share their attributes")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refuse: trajectories of a batch share their methods."""
        raise NotImplementedError("trajectories of a batch share their methods")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No trajectory of a batch is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
