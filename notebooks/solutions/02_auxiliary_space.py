"""Solution of the exercise of lesson 02."""

import numpy as np


def my_F(Lambda, R, p, q):
    """Differential dynamics [[A, B], [C, D]] for constant transforms."""
    P, Q = np.diag(p), np.diag(q)
    return np.block([[Lambda, R], [P @ Lambda + Q, P @ R]])
