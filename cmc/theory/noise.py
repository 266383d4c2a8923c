"""Sensor noise in a sampled loop: how much of it reaches the signal, exactly.

The policy sees e_k + n_k, and so does its integral; everything else is the loop of
`cmc.theory.delay`. Noise does not end a guarantee. It sets a price on the slope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from cmc.theory.delay import LagLoop, sample_matrix, spectral_radius

Array = NDArray[np.float64]


def noise_channel(loop: LagLoop, delay: float, slope: float) -> Array:
    """How n_k enters the state of `sample_matrix`, (d + 3,).

    Noise takes the path of the error through the policy and the integral, but not through the lag.
    """
    a = loop.weights(delay)[0]
    column = sample_matrix(loop, delay, slope)[:, 0].copy()
    column[0] -= a  # what is left of e_{k+1} is the command's part
    return column


def noise_gain(loop: LagLoop, delay: float, slope: float) -> float:
    """Standard deviation of e per standard deviation of independent noise, at rest.

    The state's covariance solves S = Phi S Phi^T + b b^T.

    Raises:
        ValueError: if the loop is not stable.
    """
    radius = spectral_radius(loop, delay, slope)
    if not radius < 1.0:
        raise ValueError(f"the loop is not stable: spectral radius {radius:.4g}")
    b = noise_channel(loop, delay, slope)
    covariance = solve_discrete_lyapunov(sample_matrix(loop, delay, slope), np.outer(b, b))
    return float(np.sqrt(covariance[0, 0]))


def disturbance_gain(loop: LagLoop, delay: float, slope: float) -> float:
    """Largest |e| per unit of a disturbance |d_k| <= 1 added to the command, exactly.

    The sum of the absolute impulse response (at the samples), from rest.

    Raises:
        ValueError: if the loop is not stable.
    """
    radius = spectral_radius(loop, delay, slope)
    if not radius < 1.0:
        raise ValueError(f"the loop is not stable: spectral radius {radius:.4g}")
    matrix = sample_matrix(loop, delay, slope)
    state = np.zeros(len(matrix))
    state[0] = loop.gain * -np.expm1(-loop.period / loop.tau)
    total, steps = 0.0, int(np.ceil(np.log(1e-12) / np.log(radius))) + len(matrix)
    for _ in range(steps):
        total += abs(state[0])
        state = matrix @ state
    return total
