"""Contraction: the differential dynamics in the auxiliary space, rates in a metric, both theorems.

With `a = pi(z, int z)` one network a dimension, `d/dt (dz, da) = F (dz, da)`. Throughout, `slopes`
has shape (..., n, 2) and holds d pi_i / d s_1i (towards z_i) and d pi_i / d s_2i (towards int z_i),
signs included, and `T_y_dot` is the time derivative of T_y [1/s], (..., n, n). The change of the
slopes themselves is dropped, as in the paper: what F says is about one frozen instant, and so do
the margins of theorem 1 (F1_theorem1, on the symmetric part of F1) and of theorem 2 (eq_theorem2,
two signs a module); `cmc.theory.certificates` says when instants add up to a guarantee.

A system contracts at `rate` > 0 if the distance of any two trajectories obeys

    d(t) <= overshoot e^{-rate t} d(0),

which holds where J^T M + M J <= -2 rate M, with an overshoot of at most sqrt(cond(M)) (appendix A;
Lohmiller and Slotine, Automatica 34, 1998). A metric that is not symmetric positive definite, wrong
shapes and wrong numbers raise ValueError, or TypeError, with the argument's name.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_continuous_lyapunov

from cmc.theory.arrays import Array, checked, inverse, need, not_overflown, number, together
from cmc.theory.auxiliary import AuxiliarySpace


class Blocks(NamedTuple):
    """The four blocks of F, each (..., n, n), in 1/s, up to the units of the action."""

    A_blk: Array
    B_blk: Array
    C_blk: Array
    D_blk: Array


def blocks(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None) -> Blocks:
    """Return the blocks of the differential dynamics (inverse_solution).

    `A = T_y' T_y^-1 + Lambda`, `B = R`, `C = Pi_1 A + Pi_2`, `D = Pi_1 B`, Pi_j the diagonal
    matrices of slopes; `T_y_dot` is zero by default.
    """
    s = checked("slopes", slopes, "... n 2", n=space.n)
    A_blk, B_blk = space.Lambda, space.R
    if T_y_dot is not None:
        dot = checked("T_y_dot", T_y_dot, "... n n", n=space.n)
        dot, V, A_blk = together(T_y_dot=dot, V=space.V, space=A_blk)
        A_blk = dot @ V + A_blk
    A_blk, B_blk, pi_1 = together(T_y_dot=A_blk, space=B_blk, slopes=s[..., 0, None])
    C_blk, D_blk = pi_1 * A_blk + s[..., 1, None] * np.eye(space.n), pi_1 * B_blk
    not_overflown("slopes and T_y_dot", A_blk, C_blk, D_blk)
    return Blocks(A_blk, B_blk, C_blk, D_blk)


def F(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None) -> Array:
    """Return F of `d/dt (dz, da) = F (dz, da)`, (..., 2n, 2n), ordered z_1..z_n, a_1..a_n (F).

    Without `T_y_dot` the transforms are held: the paper's F_1.
    """
    A_blk, B_blk, C_blk, D_blk = blocks(space, slopes, T_y_dot)
    return np.block([[A_blk, B_blk], [C_blk, D_blk]])


def F2(space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike) -> Array:
    """Return the part of F that the moving transform adds, F - F_1 (F2), (..., 2n, 2n)."""
    return F(space, slopes, T_y_dot) - F(space, slopes)


def Theta_M(space: AuxiliarySpace) -> Array:
    """Return diag(T_y, T_a^-1), (..., 2n, 2n), which maps (y, u) to (z, a) (theta_m).

    Its square `Theta_M^T Theta_M` is the metric in (y, u) that the identity in (z, a) becomes.
    """
    zero = np.zeros(space.T_y.shape)
    return np.block([[space.T_y, zero], [zero, inverse("T_a", space.T_a)]])


def subsystems(matrix: ArrayLike) -> Array:
    """Return all 2x2 blocks of F, (..., n, n, 2, 2): entry i, j is [[a_ij, b_ij], [c_ij, d_ij]].

    The self-feedback of module i is entry i, i (selffeedback), what module j does to module i is
    entry i, j (coupling). `matrix` is F, (..., 2n, 2n), in the order z_1..z_n, a_1..a_n.
    """
    array = checked("matrix", matrix, "... 2n 2n")
    n = array.shape[-1] // 2
    if array.shape[-1] % 2:
        raise ValueError(f"matrix needs shape (..., 2n, 2n), got shape {array.shape}")
    split = array.reshape(*array.shape[:-2], 2, n, 2, n)
    return np.moveaxis(split, (-3, -1), (-4, -3))


def metric_factor(metric: ArrayLike) -> Array:
    """Upper triangular Theta with M = Theta^T Theta, (..., n, n)."""
    metric = checked("metric", metric, "... n n")
    flipped = np.swapaxes(metric, -1, -2)
    if not np.allclose(metric, flipped, rtol=1e-6, atol=1e-9 * np.abs(metric).max(initial=0.0)):
        raise ValueError("a metric needs to be symmetric")
    even = metric / 2 + flipped / 2
    try:
        return np.asarray(np.swapaxes(np.linalg.cholesky(even), -1, -2))
    except np.linalg.LinAlgError:
        lowest = float(np.linalg.eigvalsh(even).min())
        raise ValueError(
            f"a metric needs to be positive definite; its smallest eigenvalue is {lowest:.3g}"
        ) from None


def contraction_rate(J: ArrayLike, metric: ArrayLike | None = None) -> Array:
    """Rate that the differential dynamics have in a constant metric, (...,), 1/s.

    The largest beta with J^T M + M J <= -2 beta M: minus the largest eigenvalue of the symmetric
    part of Theta J Theta^-1, M = Theta^T Theta. J and M are (..., n, n), M = I by default.
    """
    given = checked("J", J, "... n n")
    if metric is not None:
        metric = checked("metric", metric, "... n n", n=given.shape[-1])
        given, theta = together(J=given, metric=metric_factor(metric))
        given = theta @ given @ np.linalg.inv(theta)
    not_overflown("J and metric", given)
    symmetric = (given + np.swapaxes(given, -1, -2)) / 2
    return np.asarray(-np.linalg.eigvalsh(symmetric)[..., -1], dtype=float)


def lyapunov_metric(J: ArrayLike, rate: float = 0.0) -> Array:
    """Metric in which a constant Jacobian contracts faster than `rate` in 1/s, (n, n).

    Solves (J + rate I)^T M + M (J + rate I) = -I, scaled to a smallest eigenvalue of 1; every
    eigenvalue of J needs a real part below -rate.
    """
    J, rate = checked("J", J, "n n"), number("rate", rate)
    slowest = float(np.linalg.eigvals(J).real.max())
    if slowest >= -rate:
        raise ValueError(
            f"no metric contracts J at {rate:g} 1/s: an eigenvalue has real part {slowest:.4g} 1/s"
        )
    shifted = J + rate * np.eye(len(J))
    metric = solve_continuous_lyapunov(shifted.T, -np.eye(len(J)))
    metric = (metric + metric.T) / 2
    metric = metric / np.linalg.eigvalsh(metric)[0]
    not_overflown("J and rate", metric)
    return metric


def overshoot(metric: ArrayLike) -> Array:
    """Bound on the Euclidean transient that a metric allows: sqrt(cond(M)), (...,)."""
    return np.linalg.cond(metric_factor(metric))


def theorem1_margin(
    space: AuxiliarySpace, slopes: ArrayLike, T_y_dot: ArrayLike | None = None
) -> Array:
    """Return the contraction rate beta that theorem 1 guarantees [1/s], shape (...).

    `beta = -(lmax(F1) + max(lmax(F2), 0))`, lmax the largest eigenvalue of the symmetric part
    `(M + M^T)/2`; positive means that distances in (z, a) shrink at least as exp(-beta t).
    The theorem's text compares `F1^T + F1`, without the half, with beta, and its proof halves it:
    they differ by a factor 2. The proof's convention is used here, because only there beta is the
    rate; the text's beta is twice this number.
    """
    need(isinstance(space, AuxiliarySpace), "space", "an AuxiliarySpace", space)
    margin = contraction_rate(F(space, slopes))  # F1_theorem1
    if T_y_dot is not None:
        margin = margin + np.minimum(contraction_rate(F2(space, slopes, T_y_dot)), 0.0)
    return margin


def theorem2_margin(space: AuxiliarySpace, slopes: ArrayLike) -> Array:
    """Return by how much theorem 2's inequalities hold [1/s], (..., n, 2); alpha is the least.

    `-(Lambda_ii + R_ii d pi_i/d s_1i)` and `-R_ii d pi_i/d s_2i`: trace (negated) and determinant
    of the module's F_ii, both positive where its eigenvalues have negative real part. A positive
    alpha is not a rate: trace -1e4 with determinant 1 decays at 1e-4.
    """
    need(isinstance(space, AuxiliarySpace), "space", "an AuxiliarySpace", space)
    s = checked("slopes", slopes, "... n 2", n=space.n)
    first = -(space.eigenvalues + space.gains * s[..., 0])  # eq_theorem2
    return np.stack(np.broadcast_arrays(first, -space.gains * s[..., 1]), axis=-1)


def slope_floor(space: AuxiliarySpace, alpha: float = 0.0) -> Array:
    """Return how steep each policy must be in z_i, (..., n): `|d pi_i/d s_1i| > floor`.

    `max(0, (Lambda_ii + alpha) / |R_ii|)` for a margin alpha [1/s]: zero for a stable mode, where
    the right sign is enough; an open-loop unstable one (Lambda_ii >= 0) needs a slope that does not
    vanish by saturation.
    """
    alpha = number("alpha", alpha, least=0.0)
    need(isinstance(space, AuxiliarySpace), "space", "an AuxiliarySpace", space)
    if np.any(space.gains == 0.0):
        raise ValueError("R has a zero on its diagonal: no slope helps that module")
    return np.maximum(space.eigenvalues + alpha, 0.0) / np.abs(space.gains)
