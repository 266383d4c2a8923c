"""Solutions of the exercises of lesson 06."""

from math import sqrt

import numpy as np


def my_design(slow, fast, g):
    """The poles are -slow and -fast; det(step) = 1 - dt k_v + dt^2 k_x / 2 must not be negative."""
    K_p, K_d = slow * fast, slow + fast
    k_x, k_v = K_p + g * K_p, K_d + g * slow  # K_1 = K_p, and K_2 = K_p / fast = slow
    return K_p, K_d, (k_v - sqrt(k_v**2 - 2 * k_x)) / k_x


def my_verdict(K_p, K_d, g, dt):
    """Eigenvalues of one held step of (e, e')."""
    K2 = 2 * K_p / (K_d + sqrt(K_d**2 - 4 * K_p))
    k_x, k_v = K_p + g * K_p, K_d + g * K2
    step = [[1 - dt**2 / 2 * k_x, dt - dt**2 / 2 * k_v], [-dt * k_x, 1 - dt * k_v]]
    values = np.linalg.eigvals(step)
    if np.abs(values).max() >= 1:
        return "diverges"
    return "alternates" if values.real.min() < 0 else "settles"


def my_commands(count):
    """The corners of the square in turn: as large as allowed, and orthogonal columns."""
    corners = np.array([[3.0, 3.0], [3.0, -3.0], [-3.0, 3.0], [-3.0, -3.0]])
    return np.resize(corners, (count, 2))
