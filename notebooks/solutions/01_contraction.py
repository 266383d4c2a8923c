"""Solution of the exercise of lesson 01."""

import numpy as np


def my_rate(J, M):
    """Largest beta with J^T M + M J <= -2 beta M."""
    theta = np.linalg.cholesky(M).T
    generalized = theta @ J @ np.linalg.inv(theta)
    return -np.linalg.eigvalsh((generalized + generalized.T) / 2)[-1]
