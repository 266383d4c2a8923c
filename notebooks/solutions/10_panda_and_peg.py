"""Solutions of the exercises of lesson 10."""

import numpy as np


def my_torque(M, J, h, drift, p):
    """Acceleration-based task-space torque, M J^+ (p - drift) + h."""
    return M @ np.linalg.pinv(J) @ (p - drift) + h


def my_posture(M, J, qn):
    """The posture acceleration with the part that would move the tip taken off first."""
    return M @ (np.eye(7) - np.linalg.pinv(J) @ J) @ qn


def my_limit(mass, K_p, clip):
    """Bound of |u| at which mass (K_p clip + u) is one newton."""
    return max(0.0, 1.0 / mass - K_p * clip)
