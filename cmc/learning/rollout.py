"""Trajectories of several seeds, collected from a vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.policies import as_numpy


@dataclass(frozen=True)
class Rollout:
    """S seeds, T steps, E trajectories a seed; all arrays start with (S, T, E)."""

    observation: Tensor
    """What the policy saw."""
    privileged: Tensor
    """What the critic saw at the same time."""
    following: Tensor
    """What the critic sees at the state that was reached, before any restart."""
    action: Tensor
    """Commands, noise included."""
    noise: Tensor
    """Standard normal noise of the commands."""
    reward: NDArray[np.float32]
    """Reward of each step."""
    terminated: NDArray[np.bool_]
    """Where the task ended: no value beyond."""
    done: NDArray[np.bool_]
    """Where the trajectory ended, by the task or by a time limit."""


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
    d, p = observation.shape[-1], privileged.shape[-1]
    seen = np.empty((S, steps, E, d), dtype=np.float32)
    known, following = (np.empty((S, steps, E, p), dtype=np.float32) for _ in range(2))
    actions = np.empty((S, steps, E, n), dtype=np.float32)
    reward = np.empty((S, steps, E), dtype=np.float32)
    terminated, done = (np.empty((S, steps, E), dtype=bool) for _ in range(2))
    act = as_numpy(policy)
    for t in range(steps):
        seen[:, t] = observation.reshape(S, E, d)
        known[:, t] = privileged.reshape(S, E, p)
        action = act(observation.reshape(S, E, d)) + kick[:, t]
        actions[:, t] = action
        observation, gain, end, limit, info = env.step(action.reshape(S * E, n))
        privileged = info.get("privileged", observation)
        reached = _before_restart(privileged, end | limit, info)
        following[:, t] = reached.reshape(S, E, p)
        reward[:, t] = gain.reshape(S, E)
        terminated[:, t] = end.reshape(S, E)
        done[:, t] = (end | limit).reshape(S, E)
    tensor = torch.from_numpy
    return Rollout(
        observation=tensor(seen),
        privileged=tensor(known),
        following=tensor(following),
        action=tensor(actions),
        noise=tensor(noise),
        reward=reward,
        terminated=terminated,
        done=done,
    )


def _before_restart(privileged: np.ndarray, done: np.ndarray, info: dict[str, Any]) -> np.ndarray:
    """Critic's input at the states reached, where the environment has already restarted some."""
    if not done.any() or "final_obs" not in info:
        return privileged
    final = info.get("final_info", {}).get("privileged", info["final_obs"])
    if final.dtype == object:  # Gymnasium's general vector environments hold one array or None
        final = np.stack([row if row is not None else privileged[0] for row in final])
    return np.where(done[:, None], final, privileged)
