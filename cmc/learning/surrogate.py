"""The formulas of PPO: advantages, and the gradient of the clipped surrogate."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cmc.learning.rollout import Rollout


def generalised_advantage(
    rollout: Rollout, value: np.ndarray, following: np.ndarray, gamma: float, lam: float
) -> np.ndarray:
    """Generalised advantage estimate A_t = delta_t + gamma lambda A_t+1 (Schulman et al. 2016).

    delta_t = r_t + gamma V(next) - V(now), where V(next) is the critic at the state that was
    reached, also where a time limit cut the episode, and 0 only where the task ended.

    Args:
        rollout: reward, terminated and done, (S, T, E) each.
        value: critic at the states, (S, T, E).
        following: critic at the states reached, before any restart, (S, T, E).
        gamma: discount factor.
        lam: lambda.
    """
    delta = rollout.reward + gamma * following * ~rollout.terminated - value
    carry = gamma * lam * ~rollout.done
    advantage = delta.copy()
    for t in range(delta.shape[1] - 2, -1, -1):
        advantage[:, t] += carry[:, t] * advantage[:, t + 1]
    return advantage


def normalised(advantage: Tensor) -> Tensor:
    """Shift and scale each row of advantages (S, m) to mean 0 and standard deviation 1."""
    spread, centre = torch.std_mean(advantage, dim=1, keepdim=True)
    return (advantage - centre) / (spread + 1e-8)


def surrogate_gradient(
    mean: Tensor,
    log_std: Tensor,
    action: Tensor,
    old_log_probability: Tensor,
    advantage: Tensor,
    clip: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the clipped surrogate for a Gaussian policy, by mean and log_std.

    With r = p(action)/p_old(action) the loss L = -mean_m min(r A, clip(r, 1 - c, 1 + c) A) has

        dL/dlog p = -r A / m   where r A is the smaller of the two, and 0 where it is clipped,
        dlog p/dmean = x / std,   dlog p/dlog_std = x^2 - 1   with x = (action - mean) / std.

    Args:
        mean: (S, m, n).
        log_std: (S, 1, n).
        action: (S, m, n).
        old_log_probability: (S, m), without the constant -n/2 log 2 pi.
        advantage: A, (S, m).
        clip: c.

    Returns:
        dL/dmean (S, m, n), dL/dlog_std (S, 1, n) and the ratio r (S, m).
    """
    precision = torch.exp(-log_std)
    x = (action - mean) * precision
    square = x * x
    log_probability = -(0.5 * square + log_std).sum(-1)
    ratio = torch.exp(log_probability - old_log_probability)
    gain = ratio * advantage
    active = gain <= ratio.clamp(1.0 - clip, 1.0 + clip) * advantage
    slope = (gain * active).mul_(-1.0 / advantage.shape[1]).unsqueeze(-1)
    return slope * (x * precision), (slope * (square - 1.0)).sum(1, keepdim=True), ratio
