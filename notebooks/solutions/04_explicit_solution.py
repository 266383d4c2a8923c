"""Solutions of the exercises of lesson 04."""

import numpy as np


def my_transforms(f_y, f_u):
    """Explicit solution: inverse eigenvector matrix, and the transposed QR decomposition."""
    V = np.linalg.eig(f_y)[1]
    T_y = np.linalg.inv(V)
    P = np.eye(len(f_y))[::-1]
    Q = np.linalg.qr((T_y @ f_u).T @ P)[0]
    return T_y, Q @ P


def my_floor(Lambda, R):
    """Least steepness of each policy in z_i."""
    return np.maximum(np.diag(Lambda), 0) / abs(np.diag(R))


my_module = (-2.5, -4.5)  # trace -1 + 2 p = -6, determinant -2 q = 9
