"""Solutions of the exercises of lesson 01."""

import numpy as np


def my_rate(J, M):
    """Largest beta with J^T M + M J <= -2 beta M."""
    theta = np.linalg.cholesky(M).T
    generalized = theta @ J @ np.linalg.inv(theta)
    return -np.linalg.eigvalsh((generalized + generalized.T) / 2)[-1]


my_d = 8**2 / (4 * (1 - 0.8) * (1.5 - 0.8))  # where det(sym(F) + 0.8 I) = 0

my_pair = ((np.pi - 0.05, 0.0), (np.pi + 0.05, 0.0))
