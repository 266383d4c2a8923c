"""Vector environments that step all their trajectories at once: what they share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Step = tuple[Array32, Array, Mask, Mask, dict[str, Any]]
Seed = int | Sequence[int | None] | None


class NativeVectorEnv(VectorEnv[Array32, ArrayLike, Any]):
    """Resets and ends of `num_envs` trajectories; a subclass begins, advances and describes them.

    `autoreset_mode` is one of Gymnasium's, as `AutoresetMode` or text ("NextStep", "next_step"):

    - SAME_STEP: an ended trajectory starts anew in the step that ends it; `info` then has
      `final_obs` and `final_info`, with the masks `_final_obs` and `_final_info`;
    - NEXT_STEP: in the step after; its action is ignored, its reward and other numbers are 0;
    - DISABLED: when `reset(options={"reset_mask": ...})` says so.

    Args:
        num_envs: trajectories.
        observation: space of one.
        action: space of one.
        autoreset_mode: see above.

    Raises:
        ValueError: for another mode, fewer than one trajectory, or a mask of another shape.
    """

    def __init__(
        self, num_envs: int, observation: Any, action: Any, autoreset_mode: AutoresetMode | str
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: wanted at least 1, got {num_envs}")
        self.num_envs, self.mode = num_envs, _mode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.mode}
        self.single_observation_space: Any = observation
        self.single_action_space: Any = action
        self.observation_space = batch_space(observation, num_envs)
        self.action_space = batch_space(action, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    @abstractmethod
    def _seed(self, seed: Seed) -> None:
        """Set the random streams; None keeps them."""

    @abstractmethod
    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        """Start the masked trajectories; observations of all."""

    @abstractmethod
    def _advance(self, actions: ArrayLike) -> tuple[Array32, Array, Mask, Mask, dict[str, Any]]:
        """One step of all: observations, reward, terminated, truncated, info."""

    def _describe(self, info: dict[str, Any]) -> dict[str, Any]:
        """What `info` says of the present states, after a start as well as after a step."""
        return {}

    def reset(
        self, *, seed: Seed = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start new trajectories, all of them or those of `options["reset_mask"]`."""
        options = options or {}
        self._seed(seed)
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs)), dtype=bool)
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask: wanted shape ({self.num_envs},), got {mask.shape}")
        self._ended = self._ended & ~mask
        return self._begin(mask, options), self._describe({})

    def step(self, actions: ArrayLike) -> Step:
        """One step of every trajectory."""
        obs, reward, terminated, truncated, info = self._advance(actions)
        if self.mode is AutoresetMode.NEXT_STEP and self._ended.any():
            fresh, reward = self._ended, np.where(self._ended, 0.0, reward)
            obs, info = self._begin(fresh, {}), _without(info, fresh)
            terminated, truncated = terminated & ~fresh, truncated & ~fresh
        ended = terminated | truncated
        self._ended = ended
        present = self._describe(info)
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            final: dict[str, Any] = {"final_obs": obs, "_final_obs": ended}
            final |= {"final_info": present, "_final_info": ended}
            obs = self._begin(ended, {})
            return obs, reward, terminated, truncated, info | final | self._describe({})
        return obs, reward, terminated, truncated, info | present


class SingleEnv(gym.Env[Array32, Array32]):
    """One trajectory of a native vector environment.

    Args:
        batch: the environment with one trajectory, without automatic resets.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, batch: Any) -> None:
        self.batch = batch
        self.action_space, self.observation_space = (
            batch.single_action_space,
            batch.single_observation_space,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start a new trajectory; see the vector environment for `options`."""
        super().reset(seed=seed)
        stream = int(self.np_random.integers(2**31))
        obs, info = self.batch.reset(seed=stream, options=options)
        return obs[0], _first(info)

    def step(self, action: ArrayLike) -> tuple[Array32, float, bool, bool, dict[str, Any]]:
        """Hold one command for a control period."""
        obs, reward, ended, truncated, info = self.batch.step(np.asarray(action)[None])
        return obs[0], float(reward[0]), bool(ended[0]), bool(truncated[0]), _first(info)


def _first(info: dict[str, Any]) -> dict[str, Any]:
    """What `info` says of the first trajectory."""
    return {
        name: _first(value)
        if isinstance(value, dict)
        else (value[0] if value.ndim > 1 else value[0].item())
        for name, value in info.items()
    }


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    names = {m.value.lower(): m for m in AutoresetMode}
    key = getattr(mode, "value", mode)
    plain = key.lower().replace("_", "") if isinstance(key, str) else None
    if plain not in names:
        wanted = ", ".join(m.value for m in AutoresetMode)
        raise ValueError(f"autoreset_mode: wanted one of {wanted}, got {mode!r}")
    return names[plain]


def _without(info: dict[str, Any], fresh: Mask) -> dict[str, Any]:
    """`info` with zeros for trajectories that have just begun."""
    return {
        name: _without(value, fresh)
        if isinstance(value, dict)
        else np.where(fresh, np.zeros((), value.dtype), value)
        for name, value in info.items()
    }


def without_pictures(render_mode: str | None) -> None:
    """Refuse to draw, and say who does.

    Raises:
        ValueError: for any render mode.
    """
    if render_mode is not None:
        raise ValueError(
            f"render_mode: wanted None, got {render_mode!r}: this environment draws no pictures; "
            "cmc.view.playback.record makes a 3D page of a motion"
        )
