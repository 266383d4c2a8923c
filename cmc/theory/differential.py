"""Differential dynamics in the auxiliary space: blocks, F = F1 + F2, and the two theorems' margins.

With `a = pi(z, int z)` one network a dimension, `d/dt (dz, da) = F (dz, da)`. Throughout, `slopes`
has shape (..., n, 2) and holds d pi_i / d s_1i (towards z_i) and d pi_i / d s_2i (towards int z_i),
signs included. The change of the slopes themselves is dropped, as in the paper: what these
functions say is about one frozen instant; `cmc.theory.certificates` says when instants add up to a
guarantee.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.auxiliary import AuxiliarySpace, inverse
from cmc.theory.spectrum import Array, checked_square


def loop_jacobian(Lambda: ArrayLike, R: ArrayLike, p: ArrayLike, q: ArrayLike) -> Array:
    """Jacobian [[Lambda + R P, R Q], [I, 0]] of the loop in (z, int z), (..., 2n, 2n).

    Args:
        Lambda: Open-loop Jacobian in z, (..., n, n), 1/s.
        R: Gain of the auxiliary command, (..., n, n).
        p: Signed slopes dpi_i/dz_i, (..., n).
        q: Signed slopes dpi_i/d(int z_i), (..., n).
    """
    Lambda, R = np.asarray(Lambda, dtype=float), np.asarray(R, dtype=float)
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    n = Lambda.shape[-1]
    if p.shape[-1:] != (n,) or q.shape[-1:] != (n,) or R.shape[-2:] != (n, n):
        raise ValueError(
            f"Lambda {Lambda.shape} needs R (..., {n}, {n}) and slopes (..., {n}), "
            f"got R {R.shape}, p {p.shape}, q {q.shape}"
        )
    RP, RQ = R * p[..., None, :], R * q[..., None, :]
    shape = np.broadcast_shapes(Lambda.shape, RP.shape, RQ.shape)
    J = np.zeros((*shape[:-2], 2 * n, 2 * n))
    J[..., :n, :n], J[..., :n, n:] = Lambda + RP, RQ
    J[..., n:, :n] = np.eye(n)
    return J


class Blocks(NamedTuple):
    """The four blocks of F, each (..., n, n), in 1/s, up to the units of the action."""

    A_blk: Array
    B_blk: Array
    C_blk: Array
    D_blk: Array


def checked_slopes(slopes: ArrayLike, n: int) -> Array:
    """Return `slopes` as finite float64 of shape (..., n, 2).

    Raises:
        ValueError: If the shape is another one, or an entry is not finite.
    """
    array = np.asarray(slopes, dtype=np.float64)
    if array.ndim < 2 or array.shape[-2:] != (n, 2):
        raise ValueError(
            f"slopes must have shape (..., {n}, 2): d pi_i/d z_i and d pi_i/d int z_i for each "
            f"dimension, got {array.shape}"
        )
    if not np.isfinite(array).all():
        raise ValueError("slopes must be finite")
    return array


def blocks(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None) -> Blocks:
    """Return the blocks of the differential dynamics (inverse_solution).

    `A = T_y' T_y^-1 + Lambda`, `B = R`, `C = Pi_1 A + Pi_2`, `D = Pi_1 B`, Pi_j the diagonal
    matrices of slopes.

    Args:
        space: Auxiliary space, arrays (..., n, n).
        slopes: Signed slopes of the policy, (..., n, 2).
        T_y_dot: Time derivative of `T_y` [1/s], (..., n, n); none if constant.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    s = checked_slopes(slopes, space.n)
    pi_1, pi_2 = s[..., 0, None], s[..., 1, None]
    A_blk = space.Lambda + (0.0 if T_y_dot is None else _frame_rate(space.T_y, T_y_dot))
    B_blk = space.R
    C_blk = pi_1 * A_blk + pi_2 * np.eye(space.n)
    return Blocks(*np.broadcast_arrays(A_blk, B_blk, C_blk, pi_1 * B_blk))


def F(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None) -> Array:
    """Return F of `d/dt (dz, da) = F (dz, da)`, (..., 2n, 2n), ordered z_1..z_n, a_1..a_n (F).

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    A_blk, B_blk, C_blk, D_blk = blocks(space, slopes, T_y_dot)
    return np.block([[A_blk, B_blk], [C_blk, D_blk]])


def F1(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return F with the transforms held (F1), (..., 2n, 2n)."""
    return F(space, slopes)


def F2(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike) -> Array:
    """Return the part of F that the moving transform adds (F2), (..., 2n, 2n); F = F1 + F2.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    pi_1 = checked_slopes(slopes, space.n)[..., 0, None]
    left = _frame_rate(space.T_y, T_y_dot)
    left, lower = np.broadcast_arrays(left, pi_1 * left)
    zero = np.zeros(left.shape)
    return np.block([[left, zero], [lower, zero]])


def F_without_integral(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return `Lambda + R Pi_1`, (..., n, n): the dynamics of z when the policy sees z alone.

    With d pi / d int z = 0 the action follows z, so F in (z, a) has n zero eigenvalues and cannot
    contract; the paper's "proofs hold without the integral" is true of this matrix, in z alone.

    Raises:
        ValueError: If shapes do not fit or an entry is not finite.
    """
    return space.Lambda + space.R * checked_slopes(slopes, space.n)[..., None, :, 0]


def Theta_M(space: AuxiliarySpace) -> Array:
    """Return diag(T_y, T_a^-1), (..., 2n, 2n), which maps (y, u) to (z, a) (theta_m).

    Its square `Theta_M^T Theta_M` is the metric in (y, u) that the identity in (z, a) becomes.
    """
    zero = np.zeros(space.T_y.shape)
    return np.block([[space.T_y, zero], [zero, inverse(space.T_a)]])


def regroup(matrix: ArrayLike) -> Array:
    """Reorder F from (z_1..z_n, a_1..a_n) to (z_1, a_1, z_2, a_2, ...) (deconstruction_explicit).

    Raises:
        ValueError: If the matrix is not (..., 2n, 2n) and finite.
    """
    array = _even(matrix)
    order = np.arange(array.shape[-1]).reshape(2, -1).T.ravel()
    return array[..., order[:, None], order]


def subsystems(matrix: ArrayLike) -> Array:
    """Return all 2x2 blocks of F, (..., n, n, 2, 2): entry i, j is [[a_ij, b_ij], [c_ij, d_ij]].

    The self-feedback of module i is entry i, i (selffeedback), what module j does to module i is
    entry i, j (coupling). `matrix` is F in the order z_1..z_n, a_1..a_n.

    Raises:
        ValueError: If the matrix is not (..., 2n, 2n) and finite.
    """
    array = _even(matrix)
    n = array.shape[-1] // 2
    split = array.reshape(*array.shape[:-2], 2, n, 2, n)
    return np.moveaxis(split, (-3, -1), (-4, -3))


def _even(matrix: ArrayLike) -> Array:
    array = checked_square(matrix, "F")
    if array.shape[-1] % 2:
        raise ValueError(f"F must have shape (..., 2n, 2n), got {array.shape}")
    return array


def _frame_rate(T_y: Array, T_y_dot: ArrayLike) -> Array:
    """T_y' T_y^-1 [1/s]."""
    dot = checked_square(T_y_dot, "T_y_dot")
    if dot.shape[-1] != T_y.shape[-1]:
        raise ValueError(f"T_y_dot must be of the size of T_y, got {dot.shape} and {T_y.shape}")
    return dot @ inverse(T_y)
