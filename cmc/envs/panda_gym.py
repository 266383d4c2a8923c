"""Gymnasium around `PandaTask`: a natively batched environment, and one world of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from cmc.envs.panda_task import PandaTask
from cmc.envs.vector import Array32, Mask, NativeVectorEnv, Seed, SingleEnv, Step
from cmc.theory.arrays import Array, checked, need

ACTION_MODES = ("two_level", "low", "high")


class PandaVectorEnv(NativeVectorEnv):
    """N worlds stepped in one call; world k with seed s + k is the single environment with it.

    How one action array becomes sub-goals and low-level actions is `action_mode`:

    - "two_level": (u, sub-goal), concatenated. The sub-goal is read at the first tick and then at
      every `horizon`-th one; in between it is ignored.
    - "low": u alone; sub-goals come from `task.set_subgoal`, and the start pose is the first.
    - "high": the sub-goal alone; a step lasts `horizon` ticks, with `low_level` (y and its
      integral, (N, 6) each, to actions (N, 6) in [-1, 1]; default: 0) acting at every tick. Rewards
      are summed, contact forces and penetrations maximised.

    The space of observations is unbounded: nothing in them is clipped.
    """

    def __init__(
        self,
        task: PandaTask,
        action_mode: str = "two_level",
        low_level: Callable[[Array, Array], ArrayLike] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        if action_mode not in ACTION_MODES:
            raise ValueError(f"action_mode must be one of {ACTION_MODES}, got {action_mode!r}")
        if low_level is not None:
            need(callable(low_level), "low_level", "a function", low_level)
            if action_mode != "high" or task.config.command == "joint":
                raise ValueError('low_level goes with action_mode "high" and a pose command only')
        self.task, self.action_mode, self._low_level = task, action_mode, low_level
        c = task.config
        high, low = [c.subgoal_low, c.subgoal_high], np.outer([-1, 1], np.ones(c.low_size))
        both = {"two_level": np.hstack([low, high]), "low": low, "high": np.array(high)}
        action: Any = spaces.Box(*both[action_mode].astype(np.float32))
        seen = spaces.Box(-np.inf, np.inf, (task.observation_size,), dtype=np.float32)
        super().__init__(task.num, seen, action, autoreset_mode, render_mode)

    def _seed(self, seed: Seed) -> None:
        if seed is not None:
            self.task.seed(seed)

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        return self.task.reset(mask).astype(np.float32)

    def _advance(self, actions: ArrayLike) -> Step:
        task, low = self.task, self.task.config.low_size
        if self.action_mode == "two_level":
            size = self.single_action_space.shape[0]
            values = checked("action", actions, "N size", N=task.num, size=size)
            if task.due.any():
                task.set_subgoal(values[:, low:], task.due)
            actions = values[:, :low]
        play = self._macro_step if self.action_mode == "high" else task.step
        obs, reward, terminated, truncated, info = play(actions)
        return obs.astype(np.float32), reward, terminated, truncated, info

    def _macro_step(self, subgoal: ArrayLike) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        task, rewards, infos = self.task, [], []
        obs = task.set_subgoal(subgoal)
        for _ in range(task.config.horizon):
            u: ArrayLike = np.zeros((task.num, task.config.low_size))
            if self._low_level is not None:
                u = self._low_level(*(obs[:, task.layout[name]] for name in ("latent", "integral")))
            obs, reward, terminated, truncated, info = task.step(u)
            rewards.append(reward)
            infos.append(info)
            if truncated.any():
                break
        for group in ("reward_terms", "tracking_terms"):
            info[group] = {n: sum(i[group][n] for i in infos) for n in info[group]}
        for name in ("contact_force_max", "penetration"):
            info[name] = np.max([i[name] for i in infos], axis=0)
        return obs, np.sum(rewards, axis=0), terminated, truncated, info


class PandaEnv(SingleEnv):
    """One world of a peg task; the tasks' own classes document spaces and rewards.

    A Panda under task-space control carries a peg. Every tick (20 ms) a low-level action u adds an
    acceleration to the control law, x'' = K_p e + K_d e' + u with e = sub-goal - tip; every 20
    ticks a high-level action sets the sub-goal. Actions are clipped to their bounds; NaN, infinity
    and wrong shapes raise ValueError.

    - Observation, slices in `env.task.layout`: position of the (true) tip, m; rotation, a rotation
      vector from pointing straight down, rad; velocity, m/s and rad/s; goal, m; error e of the
      hand's nominal tip, m and rad; latent y = K1 e + K2 e', m/s^2 and rad/s^2; integral of y since
      the sub-goal was set (0 for rotation); time_to_go until the next sub-goal is due, s, < 0 when
      overdue.
    - Reward: the sum of `info["reward_terms"]`. The low level's own, `info["tracking_terms"]`:
      translation = -|sub-goal - tip|, m, and rotation, rad.
    - Info: `contact_force` at the end of the tick, `contact_force_max` over its physics steps, N;
      `penetration`, the deepest of the tick, m; `success`.
    - End: never terminated; truncated when the time is up.

    Keywords: `changes` of fields of `PandaTaskConfig`, such as `{"hold": False}` for control at
    every physics step, `render_mode` (None or "rgb_array"), and `action_mode` and `low_level` (see
    `PandaVectorEnv`).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}
    _renderer: mujoco.Renderer | None = None

    def __init__(self, *arguments: Any, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: wanted None or 'rgb_array', got {render_mode!r}")
        super().__init__(*arguments, **options)
        self.task: PandaTask = self.batch.task
        self.render_mode = render_mode

    def _stream(self, seed: int | None) -> int | None:
        return seed  # the same as the worlds' own

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The world from the scene's own point of view, (480, 640, 3); None without render mode.

        A RuntimeError where MuJoCo finds no graphics.
        """
        if self.render_mode is None:
            gym.logger.warn("render was called without render_mode='rgb_array'")
            return None
        if self._renderer is None:
            self._renderer = _renderer(self.task.worlds.model)
        self._renderer.update_scene(self.task.worlds.data[0])
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Give the graphics back."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_renderer": None}  # graphics belong to a process


_failures: list[str] = []
"""Why there are no graphics: a second attempt to start them aborts the whole process."""


def _renderer(model: mujoco.MjModel) -> mujoco.Renderer:
    windows = sys.platform != "linux" or any(map(os.environ.get, ("DISPLAY", "MUJOCO_GL")))
    if not windows and not _failures:
        _failures.append("neither DISPLAY nor MUJOCO_GL is set")
    if not _failures:
        try:
            return mujoco.Renderer(model, 480, 640)
        except Exception as error:  # EGL, GLFW and OSMesa raise whatever they like
            _failures.append(str(error))
    raise RuntimeError(
        f"render_mode 'rgb_array' needs graphics, and there are none: {_failures[0]}. Set "
        "MUJOCO_GL=egl (or osmesa) before Python starts, or let cmc.view.playback.record make a "
        "3D page of the motion"
    )
