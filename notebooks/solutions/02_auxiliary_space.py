"""Solutions of the exercises of lesson 02."""

import numpy as np


def my_relative_gain(f_u):
    """Entrywise product of f_u and its transposed inverse."""
    return f_u * np.linalg.inv(f_u).T


def my_angle(W):
    """Degrees at which W times a rotation is upper triangular."""
    return np.degrees(np.arctan(W[1, 0] / W[1, 1]))


def my_F(Lambda, R, p, q):
    """Differential dynamics [[A, B], [C, D]] for constant transforms."""
    P, Q = np.diag(p), np.diag(q)
    return np.block([[Lambda, R], [P @ Lambda + Q, P @ R]])


my_pair = (-3.0, -7.0)  # C = -2 p + q = -1 = -R: the coupling of z and a is skew
