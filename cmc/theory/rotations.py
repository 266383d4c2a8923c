"""The feedback combination: complex pairs as rotations, coupled by minus each other's transpose.

The coupling of i into j is minus the transpose of j into i, so that it moves no energy. The paper
leaves this form open; the closed forms here are this project's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.auxiliary import AuxiliarySpace, inverse
from cmc.theory.differential import F, checked_slopes, subsystems
from cmc.theory.spectrum import (
    MAX_CONDITION,
    Array,
    checked_pair,
    checked_square,
    raise_defective,
)


def feedback(f_y: ArrayLike, f_u: ArrayLike, slopes: ArrayLike | None = None) -> AuxiliarySpace:
    """Return the feedback combination: `T_y` brings `f_y` to real block form, `T_a` follows.

    Without slopes, `T_a = (T_y f_u)^-1`, so R = I: the form for policies, whose slopes vary.
    Modules are coupled by the rotations of Lambda alone, which change no distance: with constant
    Pi_2 and `V = |dz|^2 - dI^T Pi_2 dI`, I = int z, `V' = 2 dz^T (sym(Lambda) + Pi_1) dz`. Real and
    complex eigenvalues may be mixed.

    With slopes, `T_a = (T_y f_u)^-1 B`, the block form of the paper's feedback combination: each
    pair `[[s, w], [-w, s]]` gets `B = [[p_1 s - q_1, p_2 w], [-p_1 w, p_2 s - q_2]]`, p and q the
    slopes. Then the coupling blocks are exactly skew and sym(F) < 0. It needs s < 0 and *constant*
    slopes: `T_a` depends on them, so with slopes that vary with the state it is a different system.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (..., n, n).
        f_u: Jacobian of the plant in `u`, (..., n, n), invertible.
        slopes: Constant negative slopes, (..., n, 2), or None for policies.

    Raises:
        DefectiveMatrixError: If `f_y` lacks (complex) eigenvectors.
        SingularInputError: If `f_u` is singular.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit, an entry is not finite, slopes are not negative, or (with
            slopes) an eigenvalue has a real part that is not negative.

    Source: our own; the paper says that existence "needs further study".
    """
    f_y, f_u = checked_pair(f_y, f_u)
    T_y, Lambda = real_block_form(f_y)
    T_a = inverse(T_y @ f_u)
    if slopes is None:
        return AuxiliarySpace(T_y, T_a, Lambda, np.broadcast_to(np.eye(f_y.shape[-1]), T_y.shape))
    B = feedback_gain(Lambda, slopes)
    T_y, T_a, Lambda, B = np.broadcast_arrays(T_y, T_a @ B, Lambda, B)
    return AuxiliarySpace(T_y, T_a, Lambda, B)


def real_block_form(f_y: ArrayLike) -> tuple[Array, Array]:
    """Return `T_y` and `Lambda = T_y f_y T_y^-1`, block diagonal and real, each (..., n, n).

    A real eigenvalue is a 1x1 block, a pair s +- w j the block `[[s, w], [-w, s]]`, w > 0, with the
    columns Re v and Im v of a unit eigenvector v whose largest component is positive. Real parts
    descend.

    Raises:
        DefectiveMatrixError: If `f_y` lacks eigenvectors, to working precision.
        TypeError: If the entries are not real numbers.
        ValueError: If `f_y` is not (..., n, n) or an entry is not finite.
    """
    f_y = checked_square(f_y, "f_y")
    eigenvalues, V = np.linalg.eig(f_y)
    eigenvalues, V = eigenvalues.astype(np.complex128), V.astype(np.complex128)
    # numpy lists a pair side by side, +w first; a stable sort by real part keeps it so
    order = np.argsort(-eigenvalues.real, axis=-1, kind="stable")
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
    V = np.take_along_axis(V, order[..., None, :], axis=-1)
    rows = np.abs(V).argmax(axis=-2)[..., None, :]
    largest = np.take_along_axis(V, rows, axis=-2)
    V = V * (np.abs(largest) / largest)
    w = eigenvalues.imag
    # f_y (Re v, Im v) = (Re v, Im v) [[s, w], [-w, s]]; the partner -w gives the column Im v
    basis = np.where(w[..., None, :] < 0.0, -V.imag, V.real)
    if not (np.linalg.cond(V) <= MAX_CONDITION).all():
        raise_defective()
    n = f_y.shape[-1]
    Lambda = np.zeros(f_y.shape)
    Lambda[..., range(n), range(n)] = eigenvalues.real
    i = np.arange(n - 1)
    Lambda[..., i, i + 1] = np.maximum(w[..., :-1], 0.0)
    Lambda[..., i + 1, i] = np.minimum(w[..., 1:], 0.0)
    return inverse(basis), Lambda


def feedback_gain(Lambda: ArrayLike, slopes: ArrayLike) -> Array:
    """Return B = `T_y f_u T_a` of the block form, (..., n, n), for `Lambda` from `real_block_form`.

    `B = Pi_1 sym(Lambda) - Pi_2 + skew(Lambda) Pi_1`, that is `b_ii = p_i s - q_i > 0`,
    `b_12 = p_2 w`, `b_21 = -p_1 w`.

    Raises:
        ValueError: If shapes do not fit, slopes are not negative, or a real part is not negative.
    """
    L = checked_square(Lambda, "Lambda")
    s = checked_slopes(slopes, L.shape[-1])
    if not (s < 0.0).all():
        raise ValueError(f"slopes must be negative here (R_ii > 0), got a largest of {s.max():.6g}")
    real = np.diagonal(L, axis1=-2, axis2=-1)
    if not (real < 0.0).all():
        raise ValueError(
            f"the block form needs negative real parts, got {real.max():.6g} 1/s; use feedback("
            "f_y, f_u) without slopes, and policies steeper than slope_floor"
        )
    eye = np.eye(L.shape[-1])
    return L * (1.0 - eye) * s[..., None, :, 0] + (s[..., 0] * real - s[..., 1])[..., None, :] * eye


def coupling_skewness(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return the largest entry of `F_ij + F_ji^T`, i != j, shape (...): zero for feedback.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    parts = subsystems(F(space, slopes))
    mirrored = np.swapaxes(np.swapaxes(parts, -4, -3), -2, -1)
    off = ~np.eye(space.n, dtype=bool)
    return np.abs((parts + mirrored)[..., off, :, :]).max(axis=(-3, -2, -1), initial=0.0)
