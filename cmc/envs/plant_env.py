"""Any `Plant` as an environment: y' = f(y, u) under commands that are held, natively batched."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from cmc import plants
from cmc.envs.vector import Array32, Mask, NativeVectorEnv, SingleEnv, Step
from cmc.plants import Plant
from cmc.theory.arrays import Array, checked, count, need, number


class PlantVectorEnv(NativeVectorEnv):
    """Bring y to `target` from anywhere in the plant's box.

    Every step holds the command u for h seconds, `substeps` steps of classical Runge-Kutta (RK4).

    - Action: u (n,), clipped to the plant's `u_low` and `u_high`.
    - Observation: y (n,), float32. With `AuxiliarySpaceWrapper` (of one trajectory) it becomes z.
    - Reward: -mean over i of ((y_i - target_i) / half-width_i)^2, after the step; or `reward`.
    - Start: uniform in `y_low` to `y_high`; `reset(options={"y": ...})` sets it, (n,) or (N, n).
    - End: terminated where y leaves a box `room` times as wide; truncated after `horizon` steps.

    Args:
        num_envs: N.
        plant: the plant, or a name of `cmc.plants`.
        h: seconds for which a command is held.
        target: y_d (n,); the middle of the box by default.
        reward: maps y (N, n) after the step and the applied u (N, n) to rewards (N,).
        horizon: steps of an episode.
        substeps: of RK4 within h.
        room: how far out y may go.

    Attributes:
        y: states (N, n). u: commands last applied (N, n).

    Raises:
        ValueError: where an argument is no number of the wanted kind, or f or the reward answers
            in another shape.
    """

    def __init__(
        self,
        num_envs: int = 1,
        plant: Plant | str = "coupled_lags",
        h: float = 0.02,
        *,
        target: ArrayLike | None = None,
        reward: Callable[[Array, Array], Array] | None = None,
        horizon: int = 500,
        substeps: int = 4,
        room: float = 10.0,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        self.plant = p = plants.get(plant) if isinstance(plant, str) else plant
        if not isinstance(p, Plant):
            raise TypeError(f"plant: wanted a Plant or the name of one, got {plant!r}")
        self.h, room = number("h", h, above=0.0), number("room", room, least=1.0)
        self.horizon, self.substeps = count("horizon", horizon), count("substeps", substeps)
        middle, self._half = (p.y_low + p.y_high) / 2, (p.y_high - p.y_low) / 2
        self.target = checked("target", middle if target is None else target, "n", n=p.n)
        self._ends = ends = (middle - room * self._half, middle + room * self._half)
        seen = spaces.Box(ends[0].astype(np.float32), ends[1].astype(np.float32))
        command = spaces.Box(p.u_low.astype(np.float32), p.u_high.astype(np.float32))
        super().__init__(num_envs, seen, command, autoreset_mode, render_mode)
        self._reward = self._quadratic if reward is None else reward
        need(callable(self._reward), "reward", "a function", self._reward)
        self.y, self.u = np.tile(middle, (num_envs, 1)), np.zeros((num_envs, p.n))
        self.steps = np.zeros(num_envs, dtype=int)
        if (shape := np.shape(p.f(self.y, self.u))) != self.y.shape:
            raise ValueError(f"f(y, u): wanted shape {self.y.shape}, got {shape}")

    def _quadratic(self, y: Array, u: Array) -> Array:
        return -np.mean(((y - self.target) / self._half) ** 2, axis=-1)

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        p, start = self.plant, self._draw(self.plant.y_low, self.plant.y_high, self.plant.n)
        if "y" in options:
            given = checked("y", options["y"], "... n", n=p.n)
            wide = given if given.ndim > 1 else np.tile(given, (self.num_envs, 1))
            start = checked("y", wide, "N n", N=self.num_envs, n=p.n)
        self.y = np.where(mask[:, None], start, self.y)
        self.u, self.steps = np.where(mask[:, None], 0.0, self.u), np.where(mask, 0, self.steps)
        return self.y.astype(np.float32)

    def _advance(self, actions: ArrayLike) -> Step:
        p, dt = self.plant, self.h / self.substeps
        u = checked("actions", actions, "N n", N=self.num_envs, n=p.n)
        self.u = u = np.clip(u, p.u_low, p.u_high)
        for _ in range(self.substeps):
            k1 = np.asarray(p.f(self.y, u))
            k2 = np.asarray(p.f(self.y + dt / 2 * k1, u))
            k3 = np.asarray(p.f(self.y + dt / 2 * k2, u))
            k4 = np.asarray(p.f(self.y + dt * k3, u))
            self.y = self.y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        low, high = self._ends
        self.y = np.clip(np.nan_to_num(self.y, nan=np.inf), low, high)
        self.steps = self.steps + 1
        left = np.any((self.y <= low) | (self.y >= high), axis=-1)
        reward = checked("reward", self._reward(self.y, u), "N", N=self.num_envs)
        return self.y.astype(np.float32), reward, np.asarray(left), self.steps >= self.horizon, {}


class PlantEnv(SingleEnv):
    """One trajectory of a plant; everything else is documented at `PlantVectorEnv`."""

    many = PlantVectorEnv

    @property
    def plant(self) -> Plant:
        """The plant."""
        plant: Plant = self.batch.plant
        return plant
