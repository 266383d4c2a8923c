"""Solution of the exercise of lesson 11."""

import numpy as np


def my_choice(states, actions, goals, act):
    """Position of the sub-goal under which `act` comes closest to what was done."""
    losses = []
    for goal in goals:
        left = states[0] + goal - states  # g' = s + g - s', from the first tick on
        today = np.array([act(s, g) for s, g in zip(states, left, strict=True)])
        losses.append(((actions - today) ** 2).sum())
    return int(np.argmin(losses))
