"""Solutions of the exercises of lesson 09."""

import numpy as np
from scipy.optimize import brentq


def my_surrogate(r, A, clip):
    """Mean of the smaller of the two objectives."""
    return np.minimum(r * A, np.clip(r, 1 - clip, 1 + clip) * A).mean()


def my_factor(k1, k2, tau, K, h):
    """Largest factor, at most 1, that leaves 2 % of the bound."""
    bound = 0.98 / (K * np.tanh(h / (2 * tau)))
    return min(1.0, bound / (k1 + h / 2 * k2))


def my_period(k1, k2, tau, K):
    """Smallest period at which k1 + h k2 / 2 exceeds coth(h / (2 tau)) / K."""
    return brentq(lambda h: k1 + h / 2 * k2 - 1 / (K * np.tanh(h / (2 * tau))), 1e-4, 0.2)
