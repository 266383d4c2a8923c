"""Vector environments that step all their trajectories at once, and one trajectory of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from cmc.theory.arrays import Array, checked, count

Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Step = tuple[Array32, Array, Mask, Mask, dict[str, Any]]
Seed = int | Sequence[int | None] | None


class NativeVectorEnv(VectorEnv[Array32, ArrayLike, Any]):
    """Resets and ends of `num_envs` trajectories; a subclass begins, advances and describes them.

    `reset(seed=[s_1, ..., s_G])` gives each of G equal groups of trajectories its own random
    stream, so that what one group sees does not depend on the others. `autoreset_mode` is one of
    Gymnasium's, as `AutoresetMode` or text ("NextStep", "next_step"):

    - SAME_STEP: an ended trajectory starts anew in the step that ends it; `info` then has
      `final_obs` and `final_info`, with the masks `_final_obs` and `_final_info`;
    - NEXT_STEP: in the step after; its action is ignored, its reward and other numbers are 0;
    - DISABLED: when `reset(options={"reset_mask": ...})` says so.

    Raises:
        ValueError: for another mode, bad seeds, or a mask of another shape.
        TypeError: for any render mode.
        ResetNeeded: for a step before the first reset.
    """

    def __init__(
        self,
        num_envs: int,
        observation: Any,
        action: Any,
        autoreset_mode: AutoresetMode | str,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise TypeError(
                f"render_mode: wanted None, got {render_mode!r}: this environment draws no "
                "pictures; cmc.view.playback.record makes a 3D page of a motion"
            )
        self.num_envs, self.mode = count("num_envs", num_envs), _mode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.mode}
        self.single_observation_space: Any = observation
        self.single_action_space: Any = action
        self.observation_space = batch_space(observation, num_envs)
        self.action_space = batch_space(action, num_envs)
        self._ended, self._begun = np.zeros(num_envs, dtype=bool), False
        self._streams = [np.random.default_rng()]

    def _seed(self, seed: Seed) -> None:
        """Set the random streams; None keeps them."""
        if seed is not None:
            self._streams = generators(seed, self.num_envs)

    def _draw(self, low: Array, high: Array, size: int) -> Array:
        """Uniform draws for all trajectories, (N, size), each from its group's stream."""
        shape = self.num_envs // len(self._streams), size
        return np.concatenate([stream.uniform(low, high, shape) for stream in self._streams])

    @abstractmethod
    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        """Start the masked trajectories; observations of all."""

    @abstractmethod
    def _advance(self, actions: ArrayLike) -> Step:
        """One step of all: observations, reward, terminated, truncated, info."""

    def _describe(self) -> dict[str, Any]:
        """What `info` says of the present states, after a start as well as after a step."""
        return {}

    def reset(
        self, *, seed: Seed = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start new trajectories, all of them or those of `options["reset_mask"]`."""
        options = options or {}
        if not isinstance(options, dict):
            raise TypeError(f"options: wanted a dictionary, got {options!r}")
        mask = masked("reset_mask", options.get("reset_mask"), self.num_envs)
        self._seed(seed)
        self._ended = self._ended & ~mask
        obs, self._begun = self._begin(mask, options), True
        return obs, self._describe()

    def step(self, actions: ArrayLike) -> Step:
        """One step of every trajectory."""
        if not self._begun:
            raise gym.error.ResetNeeded("call reset before step")
        obs, reward, terminated, truncated, info = self._advance(actions)
        if self.mode is AutoresetMode.NEXT_STEP and self._ended.any():
            fresh, reward = self._ended, np.where(self._ended, 0.0, reward)
            obs = self._begin(fresh, {})
            info = _each(info, lambda value: np.where(fresh, np.zeros((), value.dtype), value))
            terminated, truncated = terminated & ~fresh, truncated & ~fresh
        self._ended = ended = terminated | truncated
        info = info | self._describe()
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            final = {"final_obs": obs, "_final_obs": ended, "_final_info": ended}
            obs = self._begin(ended, {})
            info = info | final | {"final_info": info} | self._describe()
        return obs, reward, terminated, truncated, info


class SingleEnv(gym.Env[Array32, Array32]):
    """One trajectory: `batch` is the vector environment `many` of one that never resets itself."""

    metadata: dict[str, Any] = {"render_modes": []}
    many: Any

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.batch = self.many(1, *arguments, autoreset_mode=AutoresetMode.DISABLED, **options)
        self.action_space = self.batch.single_action_space
        self.observation_space = self.batch.single_observation_space

    def _stream(self, seed: int | None) -> int | None:
        """Seed of the trajectory that begins."""
        return int(self.np_random.integers(2**31))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start a new trajectory; see the vector environment for `options`."""
        super().reset(seed=seed)
        obs, info = self.batch.reset(seed=self._stream(seed), options=options)
        return obs[0], _each(info, _first)

    def step(self, action: ArrayLike) -> tuple[Array32, float, bool, bool, dict[str, Any]]:
        """One step; see the vector environment for the action."""
        actions = action[None] if isinstance(action, np.ndarray) else [action]
        obs, reward, ended, truncated, info = self.batch.step(actions)
        return obs[0], reward.item(), ended.item(), truncated.item(), _each(info, _first)


def generators(seed: Seed, num: int) -> list[np.random.Generator]:
    """A random stream for each seed; the number of seeds divides `num`."""
    try:
        seeds: list[Any] = [seed] if np.ndim(seed) == 0 else list(seed)  # type: ignore
        if num % len(seeds) == 0:
            return [np.random.default_rng(s) for s in seeds]
    except (TypeError, ValueError, ZeroDivisionError):  # numpy does not say whose number was bad
        pass
    raise ValueError(
        f"seed: wanted a whole number of at least 0, or a number of them that divides {num}, "
        f"got {seed!r}"
    )


def masked(name: str, mask: ArrayLike | None, num: int) -> Mask:
    """Which of `num` trajectories are meant, (num,); without a mask, all."""
    found = np.ones(num, bool) if mask is None else np.asarray(mask)
    if found.shape != (num,) or found.dtype != bool:
        raise ValueError(f"{name}: wanted {num} of True and False, got {mask!r}")
    return found


def set_numbers(config: Any, shape: str, names: Sequence[str], **limits: float) -> None:
    """Turn fields of a frozen dataclass into finite floats, or tuples of them (JSON has lists)."""
    for name in names:
        found = checked(name, getattr(config, name), shape, **limits).tolist()  # type: ignore[arg-type]
        object.__setattr__(config, name, tuple(found) if shape else found)


def set_counts(config: Any, names: Sequence[str]) -> None:
    """Turn fields of a frozen dataclass into whole numbers of at least 1."""
    for name in names:
        object.__setattr__(config, name, count(name, getattr(config, name)))


def _each(info: dict[str, Any], change: Callable[[NDArray[Any]], Any]) -> dict[str, Any]:
    """`info` with every array of it changed."""
    return {
        name: _each(value, change) if isinstance(value, dict) else change(value)
        for name, value in info.items()
    }


def _first(value: NDArray[Any]) -> Any:
    return value[0] if value.ndim > 1 else value.item()


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    for found in AutoresetMode:
        if mode is found or str(mode).lower().replace("_", "") == found.value.lower():
            return found
    wanted = ", ".join(found.value for found in AutoresetMode)
    raise ValueError(f"autoreset_mode: wanted one of {wanted}, got {mode!r}")
