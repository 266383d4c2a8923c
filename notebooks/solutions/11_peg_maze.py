"""Solutions of the exercises of lesson 11."""

import numpy as np
import torch


def near(s, a):
    """In the notebook: everything the critics see; here only what the check needs."""
    return torch.cat([s, a], dim=-1)


def my_target(reward, following, actor, critics, discount=0.5, noise=0.2):
    """TD3's target: the slow actor's noisy action, by the more pessimistic critic."""
    a = torch.tanh(actor(following))
    a = (a + (noise * torch.randn_like(a)).clamp(-0.5, 0.5)).clamp(-1, 1)
    x = near(following, a)
    return reward + discount * torch.minimum(*(critic(x) for critic in critics))


def my_choice(states, actions, goals, act):
    """Smallest sum of squared errors, with what is left of each goal at every tick."""
    losses = []
    for goal in goals:
        left = goal + states[0] - states
        acted = np.array([act(s, g) for s, g in zip(states, left, strict=True)])
        losses.append(((actions - acted) ** 2).sum())
    return int(np.argmin(losses))


def my_gain(K_p, K_d, h, level):
    """Slope at which the held loop reaches a level."""
    K_2 = 2 * K_p / (K_d + np.sqrt(K_d**2 - 4 * K_p))
    return (level / h - K_d) / K_2
