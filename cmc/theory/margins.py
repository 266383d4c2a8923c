"""Margins of the two stability theorems, and what they do not promise.

Theorem 1 (F1_theorem1) bounds the symmetric part of F1, theorem 2 (eq_theorem2) asks each module
for two signs. Both look at one frozen instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.differential import F1, F2, Theta_M, checked_slopes
from cmc.theory.spectrum import Array, checked_square


def symmetric_bound(matrix: ArrayLike) -> Array:
    """Return the largest eigenvalue of `(M + M^T) / 2` [1/s], shape (...): growth of a distance.

    Raises:
        ValueError: If the matrix is not square and finite.
    """
    M = checked_square(matrix, "matrix")
    return np.asarray(np.linalg.eigvalsh(0.5 * (M + np.swapaxes(M, -1, -2)))[..., -1])


def theorem1_margin(
    space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None
) -> Array:
    """Return the contraction rate beta that theorem 1 guarantees [1/s], shape (...).

    `beta = -(lmax(F1) + max(lmax(F2), 0))`, lmax the largest eigenvalue of the symmetric part
    `(M + M^T)/2`; positive means that distances in (z, a) shrink at least as exp(-beta t).
    The theorem's text compares `F1^T + F1`, without the half, with beta, and its proof halves it:
    they differ by a factor 2. The proof's convention is used here, because only there beta is the
    rate; the text's beta is twice this number.

    Args:
        space: Auxiliary space, arrays (..., n, n).
        slopes: Signed slopes of the policy, (..., n, 2).
        T_y_dot: Time derivative of `T_y` [1/s], (..., n, n); none if constant.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    growth = symmetric_bound(F1(space, slopes))  # F1_theorem1
    if T_y_dot is not None:
        growth = growth + np.maximum(symmetric_bound(F2(space, slopes, T_y_dot)), 0.0)
    return -growth


def theorem2_margin(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return by how much theorem 2's inequalities hold [1/s], (..., n, 2); alpha is the least.

    `-(Lambda_ii + R_ii d pi_i/d s_1i)` and `-R_ii d pi_i/d s_2i`: trace (negated) and determinant
    of the module's F_ii, both positive where its eigenvalues have negative real part. A positive
    alpha is not a rate: trace -1e4 with determinant 1 decays at 1e-4; see `module_eigenvalues`.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    s = checked_slopes(slopes, space.n)
    first = -(space.eigenvalues + space.gains * s[..., 0])  # eq_theorem2
    return np.stack(np.broadcast_arrays(first, -space.gains * s[..., 1]), axis=-1)


def module_eigenvalues(space: AuxiliarySpace, slopes: ArrayLike) -> np.ndarray:
    """Return the two eigenvalues of each F_ii [1/s], complex, (..., n, 2), slowest first.

    Roots of `s^2 - (Lambda_ii + R_ii p_i) s - R_ii q_i`, the small one without cancellation.
    Admissible signs give negative real parts, often a complex pair: decay, not "no oscillation".

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    margin = theorem2_margin(space, slopes)
    trace, det = -margin[..., 0], margin[..., 1]
    root = np.sqrt((0.25 * trace * trace - det).astype(np.complex128))
    far = 0.5 * trace + np.where(trace > 0.0, root, -root)
    near = np.divide(det, far, out=np.zeros_like(far), where=far != 0.0)
    swap = near.real < far.real
    return np.stack([np.where(swap, far, near), np.where(swap, near, far)], axis=-1)


def slope_floor(space: AuxiliarySpace, alpha: float = 0.0) -> Array:
    """Return how steep each policy must be in z_i, (..., n): `|d pi_i/d s_1i| > floor`.

    `max(0, (Lambda_ii + alpha) / |R_ii|)`: zero for a stable mode, where the right sign is enough;
    an open-loop unstable one (Lambda_ii >= 0) needs a slope that does not vanish by saturation.

    Args:
        space: Auxiliary space, arrays (..., n, n).
        alpha: Margin asked for [1/s], zero or more.

    Raises:
        ValueError: If alpha is negative or not finite, or some `R_ii` is zero.
    """
    if not (np.isfinite(alpha) and alpha >= 0.0):
        raise ValueError(f"alpha must be finite and not negative, got {alpha}")
    if np.any(space.gains == 0.0):
        raise ValueError("R has a zero on its diagonal: no slope helps that module")
    return np.maximum(space.eigenvalues + alpha, 0.0) / np.abs(space.gains)


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """How a moving `T_y` disturbs the analysis: theorem 2 assumes it bounded, then zero.

    F2 is the part of F that `T_y'` adds. The theorem wants a time `settled` (its N) after which it
    is zero, and bounded distances before.
    """

    t: Array
    """Times [s], shape (time,)."""
    norm: Array
    """Spectral norm of F2 [1/s], shape (time,)."""
    settled: float
    """First time from which F2 stays zero to tolerance [s]; infinite if it does not."""
    bound: float
    """Largest norm of F2 before that time [1/s]."""
    growth: float
    """exp of the integral of max(lmax(F2), 0): by how much F2 alone can stretch a distance."""


def frame_motion(
    T_y_path: ArrayLike, t: ArrayLike, slopes: ArrayLike, tolerance: float = 1e-6
) -> FrameMotion:
    """Return what F2 does along a path of `T_y`, derivatives by central differences.

    Args:
        T_y_path: Transform at each time, continuous in order and sign (see `tracking.track`),
            (time, n, n).
        t: Increasing times [s], at least three, (time,).
        slopes: Signed slopes of the policy, (n, 2) or (time, n, 2).
        tolerance: Below this fraction of its largest norm F2 counts as zero.

    Raises:
        ValueError: If shapes do not fit, an entry is not finite, or times do not increase.
    """
    T_y, times = checked_square(T_y_path, "T_y_path"), np.asarray(t, dtype=np.float64)
    if T_y.ndim != 3 or times.shape != T_y.shape[:1] or len(times) < 3:
        raise ValueError(
            f"T_y_path and t must have shapes (time, n, n) and (time,) with at least 3 times, got "
            f"{T_y.shape} and {times.shape}"
        )
    if not np.all(np.diff(times) > 0.0):
        raise ValueError("t must increase")
    T_y_dot = np.gradient(T_y, times, axis=0, edge_order=2)
    eye = np.broadcast_to(np.eye(T_y.shape[-1]), T_y.shape)
    part = F2(AuxiliarySpace(T_y, eye, eye, eye), slopes, T_y_dot)
    norm = np.linalg.norm(part, ord=2, axis=(-2, -1))
    stretch = np.maximum(symmetric_bound(part), 0.0)
    growth = float(np.exp(np.trapezoid(stretch, times)))
    moving = np.flatnonzero(norm > tolerance * norm.max())
    if len(moving) == 0:
        return FrameMotion(times, norm, float(times[0]), 0.0, 1.0)
    last = int(moving[-1])
    settled = float(times[last + 1]) if last + 1 < len(times) else np.inf
    return FrameMotion(times, norm, settled, float(norm.max()), growth)


def transient_factor(space: AuxiliarySpace) -> Array:
    """Return cond(Theta_M), shape (...): the price in (y, u) of a distance that shrinks in (z, a).

    Contraction at rate beta in the auxiliary space bounds distances d in (y, u) by
    `|d(t)| <= cond(Theta_M) e^(-beta t) |d(0)|` (appendix theorem_1): a bounded transient, not a
    monotone one.
    """
    sigma = np.linalg.svd(Theta_M(space), compute_uv=False)
    return sigma[..., 0] / sigma[..., -1]
