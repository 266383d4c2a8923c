"""Solution of the exercise of lesson 00."""

import numpy as np


def rate(A):
    """Rate at which the slowest distance of y' = A y decays, 1/s."""
    return -np.linalg.eigvals(A).real.max()
