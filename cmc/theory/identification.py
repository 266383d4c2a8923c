"""Learning f_y and f_u from data, for environments whose latent model is not known.

The method needs df/dy and df/du only (`inverse_solution`). Where no controller provides them, one
can excite the plant with held commands and fit y' = f_y y + f_u u + f_0 to what was measured.
The fit below is made on the sampled map and taken back to continuous time by a matrix logarithm, so
noise-free data of a linear plant give the exact Jacobians at any sample time. For a nonlinear plant
the result belongs to the region the data came from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import logm

Array = NDArray[np.float64]


class PoorDataError(ValueError):
    """Data from which the Jacobians cannot be told."""


@dataclass(frozen=True)
class LatentFit:
    """A local model y' = f_y y + f_u u + f_0 learned from data.

    Attributes:
        f_y: (n, n), 1/s.
        f_u: (n, m).
        f_0: (n,), what is left at y = u = 0.
        residual: root mean square of the one-step prediction error, (n,), in units of y.
        condition: condition number of the regressors; large means that the data hardly moved.
    """

    f_y: Array
    f_u: Array
    f_0: Array
    residual: Array
    condition: float


def fit_latent(y: ArrayLike, u: ArrayLike, y_next: ArrayLike, dt: float) -> LatentFit:
    """Fit f_y and f_u to transitions under commands held for `dt` seconds.

    Least squares gives y_next = Phi y + Gamma u + c; the logarithm of the augmented matrix
    [[Phi, Gamma, c], [0, I, 0], [0, 0, 1]] is dt times [[f_y, f_u, f_0], [0, 0, 0], [0, 0, 0]].

    Args:
        y: latent signals (N, n).
        u: commands (N, m).
        y_next: latent signals one sample later (N, n).
        dt: sample time, s.

    Raises:
        PoorDataError: if the data do not tell all coefficients apart, or if no continuous-time
            model has the fitted map (an eigenvalue of Phi on the negative real axis).
        ValueError: for shapes that do not fit, or values that are not finite.
    """
    y, u, after = (np.asarray(a, dtype=float) for a in (y, u, y_next))
    if y.ndim != 2 or after.shape != y.shape or u.ndim != 2 or len(u) != len(y):
        raise ValueError(
            f"wanted y (N, n), u (N, m), y_next (N, n), got {y.shape}, {u.shape}, {after.shape}"
        )
    if not (np.isfinite(y).all() and np.isfinite(u).all() and np.isfinite(after).all()):
        raise ValueError("y, u and y_next must be finite")
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be positive and finite, got {dt}")
    n, m = y.shape[1], u.shape[1]
    regressors = np.concatenate([y, u, np.ones((len(y), 1))], axis=1)
    scale = np.abs(regressors).max(axis=0)
    scale[scale == 0.0] = 1.0
    singular = np.linalg.svd(regressors / scale, compute_uv=False)
    if len(y) < n + m + 1 or singular[-1] < 1e-9 * singular[0]:
        raise PoorDataError(
            f"{len(y)} transitions do not tell {n + m + 1} coefficients per signal apart: "
            "vary y and every command independently"
        )
    solution = np.linalg.lstsq(regressors / scale, after, rcond=None)[0] / scale[:, None]
    residual = np.sqrt(np.mean((after - regressors @ solution) ** 2, axis=0))
    step = np.eye(n + m + 1)
    step[:n] = solution.T
    poles = np.linalg.eigvals(step[:n, :n])
    if np.any((np.abs(poles.imag) < 1e-12) & (poles.real <= 0.0)):
        raise PoorDataError(f"the fitted map has poles {poles}: sample faster")
    generator = np.real(logm(step)) / dt
    return LatentFit(
        f_y=generator[:n, :n],
        f_u=generator[:n, n : n + m],
        f_0=generator[:n, -1],
        residual=residual,
        condition=float(singular[0] / singular[-1]),
    )
