"""Solutions of the exercises of lesson 08."""

import numpy as np


def my_gains():
    """Half of what the stiffest surface allows: k1 + h/2 k2 below coth(1/2) / 62 = 0.035."""
    return 0.01, 4.0


def my_transforms(K, slope, angle):
    """T_y corrects the force by what the slope adds; T_a turns the command back."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0], [K * slope, 1.0]]), np.array([[cos, sin], [-sin, cos]])


def my_best(returns, factors, weights):
    """The factor whose weighted average return is largest."""
    return factors[np.argmax(returns @ weights)]
