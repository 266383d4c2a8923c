"""Gymnasium around `PandaTask`: a single environment and a natively batched one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, Literal, get_args

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from cmc.envs.checks import checked
from cmc.envs.panda_task import Array, Mask, PandaTask
from cmc.envs.vector import NativeVectorEnv, Seed, Step, without_pictures

Observation = NDArray[np.float32]
ActionMode = Literal["two_level", "low", "high"]
LowLevel = Callable[[Array, Array], ArrayLike]
"""Low-level policy: y (N, 6) and its integral (N, 6) to actions (N, 6) in [-1, 1]."""


_SCALARS = ("contact_force", "contact_force_max", "penetration", "success")


class ActionInterface:
    """How one action array becomes sub-goals and low-level actions.

    - "two_level": (u, sub-goal), concatenated. The sub-goal is read at the first tick and then at
      every `horizon`-th one; in between it is ignored.
    - "low": u alone; sub-goals come from `set_subgoal`, and the start pose is the first.
    - "high": the sub-goal alone; a step lasts `horizon` ticks, with `low_level` (default: u = 0)
      acting at every tick. Rewards are summed, contact forces and penetrations maximised.
    """

    def __init__(self, task: PandaTask, mode: ActionMode, low_level: LowLevel | None) -> None:
        if mode not in get_args(ActionMode):
            raise ValueError(f"action_mode must be one of {get_args(ActionMode)}, got {mode!r}")
        if low_level is not None and (mode != "high" or task.config.command == "joint"):
            raise ValueError('low_level goes with action_mode "high" and a pose command only')
        self.task, self.mode, self._low_level = task, mode, low_level
        c = task.config
        high = np.array([c.subgoal_low, c.subgoal_high])
        low = np.array([[-1.0], [1.0]]) * np.ones(c.low_size)
        both = {"two_level": np.hstack([low, high]), "low": low, "high": high}[mode]
        self.space: Any = spaces.Box(*both.astype(np.float32))
        self._split = c.low_size
        self._shape = (task.num, both.shape[1])

    def step(self, action: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """One environment step; as `PandaTask.step`."""
        task = self.task
        if self.mode == "low":
            return task.step(action)
        values = checked(action, self._shape, "action")
        if self.mode == "two_level":
            due = task.due
            if due.any():
                task.set_subgoal(values[:, self._split :], due)
            return task.step(values[:, : self._split])
        return self._macro_step(values)

    def _macro_step(self, subgoal: Array) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        task = self.task
        obs, ticks = task.set_subgoal(subgoal), []
        for _ in range(task.config.horizon):
            u: ArrayLike = np.zeros((task.num, task.config.low_size))
            if self._low_level is not None:
                fields = (obs[:, task.layout[name]] for name in ("latent", "integral"))
                u = self._low_level(*fields)
            obs, reward, terminated, truncated, info = task.step(u)
            ticks.append((reward, info))
            if truncated.any():
                break
        for group in ("reward_terms", "tracking_terms"):
            info[group] = {
                name: sum((i[group][name] for _, i in ticks), np.zeros(task.num))
                for name in info[group]
            }
        for name in ("contact_force_max", "penetration"):
            info[name] = np.max([i[name] for _, i in ticks], axis=0)
        total = np.sum([reward for reward, _ in ticks], axis=0)
        return obs, total, terminated, truncated, info


class PandaEnv(gym.Env[Observation, NDArray[np.float32]]):
    """One world of a peg task; the tasks' own classes document spaces and rewards."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: PandaTask,
        action_mode: ActionMode = "two_level",
        low_level: LowLevel | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: wanted None or 'rgb_array', got {render_mode!r}")
        self.task, self.render_mode = task, render_mode
        self._renderer: mujoco.Renderer | None = None
        self._interface = ActionInterface(task, action_mode, low_level)
        self.action_space = self._interface.space
        self.observation_space = observation_space(task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode."""
        super().reset(seed=seed)
        if seed is not None:
            self.task.seed(seed)
        return self.task.reset()[0].astype(np.float32), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; see the class for the action."""
        obs, reward, _, truncated, info = self._interface.step(np.asarray(action)[None])
        flat: dict[str, Any] = {name: info[name].item() for name in _SCALARS}
        for group in ("reward_terms", "tracking_terms"):
            flat[group] = {name: term.item() for name, term in info[group].items()}
        return obs[0].astype(np.float32), float(reward[0]), False, truncated.item(), flat

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The world from the scene's own point of view, (480, 640, 3); None without render mode.

        Raises:
            RuntimeError: where MuJoCo finds no graphics.
        """
        if self.render_mode is None:
            gym.logger.warn("render was called without render_mode='rgb_array'")
            return None
        if self._renderer is None:
            self._renderer = _renderer(self.task)
        self._renderer.update_scene(self.task.worlds.data[0])
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Give the graphics back."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_renderer": None}  # graphics belong to a process

    def set_subgoal(self, high_action: ArrayLike) -> Observation:
        """Set the sub-goal and observe again; for the action mode "low"."""
        return self.task.set_subgoal(np.asarray(high_action)[None])[0].astype(np.float32)

    def snapshot(self) -> dict[str, Any]:
        """Everything that decides what follows."""
        return self.task.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> Observation:
        """Go back to a snapshot; the observation there."""
        return self.task.restore(snapshot)[0].astype(np.float32)


class PandaVectorEnv(NativeVectorEnv):
    """N worlds stepped in one call; world k with seed s + k is the single environment with it."""

    def __init__(
        self,
        task: PandaTask,
        action_mode: ActionMode = "two_level",
        low_level: LowLevel | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        without_pictures(render_mode)
        self.task, self._interface = task, ActionInterface(task, action_mode, low_level)
        seen = observation_space(task)
        super().__init__(task.num, seen, self._interface.space, autoreset_mode)

    def _seed(self, seed: Seed) -> None:
        if seed is not None:
            self.task.seed(seed)

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Observation:
        return self.task.reset(mask).astype(np.float32)

    def _advance(self, actions: ArrayLike) -> Step:
        obs, reward, terminated, truncated, info = self._interface.step(actions)
        return obs.astype(np.float32), reward, terminated, truncated, info

    def _describe(self, info: dict[str, Any]) -> dict[str, Any]:
        return {"success": info["success"]} if info else {}

    def set_subgoal(self, high_action: ArrayLike, mask: Mask | None = None) -> Observation:
        """Set the sub-goals of the masked worlds and observe again; for the action mode "low"."""
        return self.task.set_subgoal(high_action, mask).astype(np.float32)

    def snapshot(self) -> dict[str, Any]:
        """Everything that decides what follows."""
        return self.task.snapshot()

    def restore(self, snapshot: dict[str, Any]) -> Observation:
        """Go back to a snapshot; the observations there."""
        return self.task.restore(snapshot).astype(np.float32)


_failures: list[str] = []
"""Why there are no graphics: a second attempt to start them aborts the whole process."""


def _renderer(task: PandaTask) -> mujoco.Renderer:
    windows = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "MUJOCO_GL")))
    if not windows and not _failures:
        _failures.append("neither DISPLAY nor MUJOCO_GL is set")
    if not _failures:
        try:
            return mujoco.Renderer(task.worlds.model, 480, 640)
        except Exception as error:  # EGL, GLFW and OSMesa raise whatever they like
            _failures.append(str(error))
    raise RuntimeError(
        f"render_mode 'rgb_array' needs graphics, and there are none: {_failures[0]}. Set "
        "MUJOCO_GL=egl (or osmesa) before Python starts, or let cmc.view.playback.record make a "
        "3D page of the motion"
    )


def observation_space(task: PandaTask) -> Any:
    """Unbounded box of the task's observation size: nothing in it is clipped."""
    return spaces.Box(-np.inf, np.inf, (task.observation_size,), dtype=np.float32)
