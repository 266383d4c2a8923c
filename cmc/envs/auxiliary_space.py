"""Any Gymnasium environment with a known model, seen and commanded in its auxiliary space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from cmc.envs.plant_env import PlantVectorEnv
from cmc.envs.vector import Array32, Mask, NativeVectorEnv, Seed, Step
from cmc.theory.arrays import Array, checked, need, number
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.tracking import Tracker

Model = Callable[[Array], tuple[Array, Array]]
Transforms = AuxiliarySpace | Callable[[Array], AuxiliarySpace]


class AuxiliarySpaceWrapper(gym.Wrapper[Array32, Any, Any, Any]):
    """Observe (z_i, integral of z_i) and command u = u0 + T_a a, with z = T_y (y - y_d).

    With `model`, a policy that decreases in all of its inputs, one network per dimension, meets the
    paper's sign condition on any plant: R_ii is positive (`constraint_sign`). Order, sign and scale
    of the eigenvectors are followed from step to step, so that the integral keeps its meaning.
    With `transforms` of your own, R is theirs: tell it the policy. `space` holds T_y, T_a, Lambda
    and R at the present observation.

    Args:
        env: an environment with Box observations and n commands.
        error: latent tracking error y - y_d (n,) of an observation.
        model: f_y and f_u, (n, n) each, at an observation.
        transforms: in place of `model`: an `AuxiliarySpace`, or a function of the observation to
            one, such as `feedback` or `schur` of `cmc.theory.combinations` give.
        h: time between two steps [s].
        integral: whether the integral is observed; without it the observation is z (n,).
        u0: command to which T_a a is added, broadcast to (n,).
        limit: bound of the declared action space; the command is clipped to the env's own.

    Raises:
        TypeError: if the action space is no Box, or not one of model and transforms is given.
        ValueError: if h is not positive, the action space is not flat, or (at a step) an action or
            an error has another shape or is not finite.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        error: Callable[[Array], Array],
        h: float,
        model: Model | None = None,
        transforms: Transforms | None = None,
        integral: bool = True,
        u0: ArrayLike = 0.0,
        limit: float = 1.0,
    ) -> None:
        super().__init__(env)
        if not isinstance(env.action_space, spaces.Box):
            raise TypeError(f"env: wanted a Box of commands, got {env.action_space}")
        if len(env.action_space.shape) != 1:
            raise ValueError(f"env: wanted flat commands, got {env.action_space}")
        if (model is None) == (transforms is None):
            raise TypeError("wanted either a model or transforms")
        need(callable(error), "error", "a function", error)
        if model is not None:
            need(callable(model), "model", "a function", model)
        self.n, self.h = env.action_space.shape[0], number("h", h, above=0.0)
        self.error, self.model, self.transforms = error, model, transforms
        self._inner, self._seen = env.action_space, slice(None, None, 1 if integral else 2)
        self.u0, limit = _command("u0", u0, self.n), number("limit", limit, above=0.0)
        self.action_space = spaces.Box(-limit, limit, (self.n,), np.float32)
        size = 2 * self.n if integral else self.n
        self.observation_space = spaces.Box(-1e6, 1e6, (size,), np.float32)
        self.integral, self._tracker = np.zeros(self.n), Tracker()
        self.space: AuxiliarySpace | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, dict[str, Any]]:
        """Start an episode; the integral starts with the first error."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._tracker.reset()
        self.integral = np.zeros(self.n)
        return self._observe(obs), info

    def step(self, action: ArrayLike) -> tuple[Array32, Any, bool, bool, dict[str, Any]]:
        """Command u = u0 + T_a a."""
        if self.space is None:
            raise gym.error.ResetNeeded("call reset before step")
        a, inner = checked("action", action, "n", n=self.n), self._inner
        command = np.clip(self.u0 + self.space.T_a @ a, inner.low, inner.high)
        obs, reward, terminated, truncated, info = self.env.step(command.astype(inner.dtype))
        return self._observe(obs), reward, terminated, truncated, info

    def _observe(self, obs: Any) -> Array32:
        seen = checked("observation", obs)
        e = checked("error", self.error(seen), "n", n=self.n)
        if self.model is not None:
            f_y, f_u = checked("model: f_y and f_u", self.model(seen), "2 n n", n=self.n)
            self.space = self._tracker.update(f_y, f_u)
        else:
            found = self.transforms(seen) if callable(self.transforms) else self.transforms
            if not isinstance(found, AuxiliarySpace) or found.T_y.shape != (self.n, self.n):
                raise TypeError(f"transforms: wanted an AuxiliarySpace of {self.n}, got {found!r}")
            self.space = found
        z = self.space.T_y @ e
        self.integral = self.integral + self.h * z  # the new value included, as everywhere
        s = np.stack([z, self.integral], axis=-1).ravel()[self._seen]
        return np.clip(s, -1e6, 1e6).astype(np.float32)


class AuxiliarySpaceVectorWrapper(NativeVectorEnv):
    """N plants that are observed by (z_i, integral of z_i), s flat (N, 2 n), and moved by a.

    z = T_y (y - target) and u = u0 + T_a a, clipped to the plant's limits, as in
    `cmc.theory.simulate.closed_loop` with the same transforms: what was trained can be certified.

    The transforms are the same at every state, such as `transforms_that_fit` offers; y_d and the
    sample time are the plants' `target` and `h`; u0, (n,), holds the target by default.

    Raises:
        TypeError: if env is no `PlantVectorEnv`, or the transforms move with the state.
        ValueError: if the plant cannot be held at the target.
    """

    def __init__(
        self, env: PlantVectorEnv, transforms: AuxiliarySpace, *, u0: ArrayLike | None = None
    ) -> None:
        if not isinstance(env, PlantVectorEnv):
            raise TypeError(f"env: wanted a PlantVectorEnv, got {env!r}")
        self.plants, self.space, n = env, transforms, env.plant.n
        if not isinstance(transforms, AuxiliarySpace) or transforms.T_y.shape != (n, n):
            raise TypeError(f"transforms: wanted an AuxiliarySpace of {n}, got {transforms!r}")
        self.u0 = _command("u0", env.plant.hold(env.target) if u0 is None else u0, n)
        self.integral = np.zeros((env.num_envs, n))
        seen, action = (spaces.Box(-np.inf, np.inf, (k * n,), np.float32) for k in (2, 1))
        super().__init__(env.num_envs, seen, action, env.mode)

    def _seed(self, seed: Seed) -> None:
        self.plants._seed(seed)

    def _begin(self, mask: Mask, options: dict[str, Any]) -> Array32:
        obs = self.plants._begin(mask, options)
        self.integral = np.where(mask[:, None], 0.0, self.integral)
        return self._seen(obs, mask)

    def _advance(self, actions: ArrayLike) -> Step:
        a = checked("actions", actions, "N n", N=self.num_envs, n=len(self.u0))
        step = self.plants._advance(self.u0 + a @ self.space.T_a.T)
        return self._seen(step[0], np.ones(self.num_envs, dtype=bool)), *step[1:]

    def _seen(self, obs: Array32, add: Mask) -> Array32:
        """What is seen of y; the integral starts with the first error and includes the new."""
        z = (np.asarray(obs, dtype=float) - self.plants.target) @ self.space.T_y.T
        self.integral = self.integral + self.plants.h * z * add[:, None]
        s = np.stack([z, self.integral], axis=-1)
        return s.reshape(self.num_envs, -1).astype(np.float32)


def _command(name: str, value: ArrayLike, n: int) -> Array:
    """A command (n,) from one entry for each, or one for all."""
    given = checked(name, value)
    return checked(name, given if given.ndim else np.full(n, given), "n", n=n)
