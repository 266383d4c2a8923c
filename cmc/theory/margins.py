"""Margins of the two stability theorems, and what they do not promise.

Theorem 1 (F1_theorem1) bounds the symmetric part of F1, theorem 2 (eq_theorem2) asks each module
for two signs. Both look at one frozen instant. Shapes and finiteness are checked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, number
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.contraction import F2, F, contraction_rate


def _asked(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """The slopes (..., n, 2) of a space that is one."""
    if not isinstance(space, AuxiliarySpace):
        raise TypeError(f"space needs an AuxiliarySpace, got {type(space).__name__}")
    return checked("slopes", slopes, "... n 2", n=space.n)


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
    """
    slopes = _asked(space, slopes)
    margin = contraction_rate(F(space, slopes))  # F1_theorem1
    if T_y_dot is not None:
        T_y_dot = checked("T_y_dot", T_y_dot, "... n n", n=space.n)
        margin = margin + np.minimum(contraction_rate(F2(space, slopes, T_y_dot)), 0.0)
    return margin


def theorem2_margin(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return by how much theorem 2's inequalities hold [1/s], (..., n, 2); alpha is the least.

    `-(Lambda_ii + R_ii d pi_i/d s_1i)` and `-R_ii d pi_i/d s_2i`: trace (negated) and determinant
    of the module's F_ii, both positive where its eigenvalues have negative real part. A positive
    alpha is not a rate: trace -1e4 with determinant 1 decays at 1e-4.
    """
    s = _asked(space, slopes)
    first = -(space.eigenvalues + space.gains * s[..., 0])  # eq_theorem2
    return np.stack(np.broadcast_arrays(first, -space.gains * s[..., 1]), axis=-1)


def slope_floor(space: AuxiliarySpace, alpha: float = 0.0) -> Array:
    """Return how steep each policy must be in z_i, (..., n): `|d pi_i/d s_1i| > floor`.

    `max(0, (Lambda_ii + alpha) / |R_ii|)` for a margin alpha [1/s]: zero for a stable mode, where
    the right sign is enough; an open-loop unstable one (Lambda_ii >= 0) needs a slope that does not
    vanish by saturation.
    """
    alpha = number("alpha", alpha, least=0.0)
    _asked(space, np.zeros((space.n, 2) if isinstance(space, AuxiliarySpace) else 0))
    if np.any(space.gains == 0.0):
        raise ValueError("R has a zero on its diagonal: no slope helps that module")
    return np.maximum(space.eigenvalues + alpha, 0.0) / np.abs(space.gains)
