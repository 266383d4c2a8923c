"""Solutions of the exercises of lesson 00."""

import numpy as np


def rate(A):
    """Rate at which the slowest distance of y' = A y decays, 1/s."""
    return -np.linalg.eigvals(A).real.max()


def slope(s, W, w):
    """Derivative of w . tanh(W s) towards the first input."""
    return (w * (1 - np.tanh(s @ W.T) ** 2)) @ W[:, 0]


my_slopes = (0.7, 2.0)
