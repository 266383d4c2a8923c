"""Solution of lesson 07."""

import numpy as np


def ball_radius(J, B, M, size):
    theta = np.linalg.cholesky(M).T
    local = theta @ J @ np.linalg.inv(theta)
    rate = -np.linalg.eigvalsh((local + local.T) / 2).max()
    return np.linalg.norm(theta @ B, 2) * size / rate
