"""Trajectories of several seeds, collected from a vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.policies import as_numpy


class Rollout(NamedTuple):
    """S seeds, T steps, E trajectories a seed; all arrays start with (S, T, E)."""

    observation: Tensor  # what the policy saw
    privileged: Tensor  # what the critic saw at the same time
    following: Tensor  # what the critic sees at the state that was reached, before any restart
    action: Tensor  # commands, noise included
    noise: Tensor  # standard normal noise of the commands
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]  # where the task ended: no value beyond
    done: NDArray[np.bool_]  # where the trajectory ended, by the task or by a time limit


def collect(
    env: VectorEnv[Any, Any, Any],
    policy: nn.Module,
    log_std: Tensor,
    env_seeds: Any,
    generators: Sequence[np.random.Generator],
    steps: int,
) -> Rollout:
    """Reset `env` and run the policy with Gaussian noise for `steps` steps.

    Args:
        env: S E trajectories, seed by seed.
        policy: from (S, E, d) to (S, E, n).
        log_std: (S, 1, n).
        env_seeds: what `env.reset` takes.
        generators: source of the noise of each seed.
        steps: T.
    """
    S, n = len(generators), log_std.shape[-1]
    E = env.num_envs // S
    noise = np.stack([g.standard_normal((steps, E, n), dtype=np.float32) for g in generators])
    kick = noise * log_std.exp().unsqueeze(1).numpy()
    observation, info = env.reset(seed=env_seeds)
    privileged = info.get("privileged", observation)
    sizes = (observation.shape[-1], privileged.shape[-1], privileged.shape[-1], n)
    floats = [np.empty((S, steps, E, size), dtype=np.float32) for size in sizes]
    scalars = [np.empty((S, steps, E), dtype=kind) for kind in (np.float32, bool, bool)]
    act = as_numpy(policy)
    for t in range(steps):
        seen = observation.reshape(S, E, -1)
        action = act(seen) + kick[:, t]
        floats[0][:, t], floats[1][:, t] = seen, privileged.reshape(S, E, -1)
        observation, gain, end, limit, info = env.step(action.reshape(S * E, n))
        privileged = info.get("privileged", observation)
        reached = _before_restart(privileged, end | limit, info)
        floats[2][:, t], floats[3][:, t] = reached.reshape(S, E, -1), action
        for array, part in zip(scalars, (gain, end, end | limit), strict=True):
            array[:, t] = part.reshape(S, E)
    saw, knew, arrived, acted, kicked = (torch.from_numpy(array) for array in (*floats, noise))
    return Rollout(saw, knew, arrived, acted, kicked, *scalars)


def _before_restart(privileged: np.ndarray, done: np.ndarray, info: dict[str, Any]) -> np.ndarray:
    """Critic's input at the states reached, where the environment has already restarted some."""
    if not done.any() or "final_obs" not in info:
        return privileged
    final = info.get("final_info", {}).get("privileged", info["final_obs"])
    if final.dtype == object:  # Gymnasium's general vector environments hold one array or None
        final = np.stack([row if row is not None else privileged[0] for row in final])
    return np.where(done[:, None], final, privileged)
