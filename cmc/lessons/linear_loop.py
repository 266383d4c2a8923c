"""Linear loops around an auxiliary space, solved exactly: what lessons 02 to 04 draw."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certificates import loop_jacobian
from cmc.theory.spectrum import Array


def signed_slopes(space: AuxiliarySpace, kp: ArrayLike, ki: ArrayLike) -> Array:
    """Slopes of size `kp` (in z) and `ki` (in int z), with the sign against R_ii, (..., n, 2)."""
    sizes = np.stack(np.broadcast_arrays(kp, ki, space.gains)[:2], axis=-1)
    return -np.sign(space.gains)[..., None] * sizes  # constraint_sign


def loop_matrix(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Jacobian of the loop in (z, int z) for constant slopes, (..., 2n, 2n) [1/s]."""
    s = np.asarray(slopes, dtype=np.float64)
    return loop_jacobian(space.Lambda, space.R, s[..., 0], s[..., 1])


def largest_real_part(matrix: ArrayLike) -> Array:
    """Largest real part of the eigenvalues [1/s], shape (...): negative means decay."""
    return np.asarray(np.linalg.eigvals(np.asarray(matrix)).real.max(axis=-1))


def flow(J: ArrayLike, start: ArrayLike, t: ArrayLike) -> Array:
    """Solve x' = J x exactly at uniform times: start (..., m) to (time, ..., m)."""
    J, x, times = (np.asarray(v, dtype=np.float64) for v in (J, start, t))
    step = expm(J * (times[1] - times[0])).T
    states = np.empty((len(times), *x.shape))
    states[0] = x
    for k in range(1, len(times)):
        states[k] = states[k - 1] @ step
    return states


def loop_paths(space: AuxiliarySpace, slopes: ArrayLike, y0: ArrayLike, t: ArrayLike) -> Array:
    """Latent signals of the loop from `y0` (number, n), integrals at zero: (time, number, n)."""
    z0 = space.to_z(y0)
    states = flow(loop_matrix(space, slopes), np.concatenate([z0, 0.0 * z0], axis=-1), t)
    return states[..., : space.n] @ space.V.T


def growth(
    J: ArrayLike, t: ArrayLike, left: ArrayLike | None = None, right: ArrayLike | None = None
) -> Array:
    """Largest factor by which a distance grows: spectral norm of left e^(J t) right, (time,)."""
    J = np.asarray(J, dtype=np.float64)
    start = np.eye(len(J)) if right is None else np.asarray(right, dtype=np.float64)
    maps = np.swapaxes(flow(J, start.T, t), -1, -2)
    maps = maps if left is None else np.asarray(left, dtype=np.float64) @ maps
    return np.linalg.norm(maps, ord=2, axis=(-2, -1))


def circle(number: int = 12, radius: float = 1.0) -> Array:
    """Starts on a circle, (number, 2)."""
    angle = 2.0 * np.pi * np.arange(number) / number
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
