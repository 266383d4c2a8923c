"""The explicit solution, compiled, and real eigenbases with every reason why there may be none.

`f_y = V Lambda V^-1`, `T_y = V^-1`, `W = T_y f_u = R T_a^T` with R upper triangular. Order, sign
and length of an eigenvector are free; here the slowest mode (largest eigenvalue) comes first,
columns of V have unit norm and their largest component is positive. `cmc.theory.tracking` keeps the
choice continuous along a path.
"""

# mypy: disable-error-code="no-untyped-def,misc"
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.arrays import Array, checked, compiled, first_index, not_square, together

MAX_CONDITION = 2e7
"""Above this condition of `V` (about 1/sqrt(eps)) a matrix counts as defective."""
SINGULAR = 1e-12
"""Below this share of a row that no other row explains, in the best units, `f_u` is singular."""


class ComplexEigenvalueError(ValueError):
    """`f_y` has a complex pair, so no real `T_y` makes it diagonal, nor triangular."""

    def __init__(self, pair: complex, where: str = "") -> None:
        super().__init__(
            f"f_y has the complex pair {pair.real:.6g} +- {abs(pair.imag):.6g}j{where}: no real "
            "T_y makes it diagonal or triangular, so there is no hierarchical combination; use the "
            "feedback combination, cmc.theory.combinations.feedback(f_y, f_u)"
        )


class DefectiveMatrixError(ValueError):
    """`f_y` has fewer independent eigenvectors than rows, to working precision."""

    def __init__(self, where: str = "") -> None:
        super().__init__(
            f"f_y has a repeated eigenvalue without enough eigenvectors{where} (condition of V "
            f"above {MAX_CONDITION:.0e}): T_y = V^-1 does not exist; a Schur basis still gives the "
            "hierarchy, cmc.theory.combinations.schur(f_y, f_u)"
        )


class SingularInputError(ValueError):
    """`f_u` is singular: some direction of `y` cannot be moved by any command."""

    def __init__(self, where: str = "") -> None:
        super().__init__(
            f"f_u is singular{where}: some direction of y cannot be moved by u, so R has a zero on "
            "its diagonal and the theorem says nothing (a peg out of contact is such a case)"
        )


def checked_pair(f_y: ArrayLike, f_u: ArrayLike, shape: str = "... n n") -> tuple[Array, Array]:
    """Return both Jacobians, checked and broadcast to one shape (..., n, n); f_u is invertible."""
    f_y, f_u = checked("f_y", f_y, shape), checked("f_u", f_u)
    n = f_y.shape[-1]
    if f_u.ndim >= 2 and f_u.shape[-2] == n != f_u.shape[-1]:
        raise ValueError(not_square(n, f_u.shape[-1]))
    f_y, f_u = together(f_y=f_y, f_u=checked("f_u", f_u, shape, n=n))
    # rows and columns are brought to a largest entry of 1 first: units make nothing singular
    with np.errstate(divide="ignore", invalid="ignore"):
        even = f_u / np.abs(f_u).max(axis=-1, keepdims=True)
        even = even / np.abs(even).max(axis=-2, keepdims=True)
    sigma = np.linalg.svd(np.nan_to_num(even), compute_uv=False)
    singular = sigma[..., -1] <= SINGULAR * sigma[..., 0]
    if singular.any():
        raise SingularInputError(_where(singular))
    return f_y, f_u


def real_eigenbasis(f_y: Array) -> tuple[Array, Array]:
    """Return eigenvalues (..., n), descending, and unit eigenvectors `V` of checked (..., n, n)."""
    eigenvalues, V = np.linalg.eig(f_y)
    if np.iscomplexobj(eigenvalues):  # numpy 2.5 returns complex arrays whatever is in them
        eigenvalues, V = _drop_rounding(f_y, eigenvalues, V)
    order = np.argsort(-eigenvalues, axis=-1, kind="stable")
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
    V = np.take_along_axis(V, order[..., None, :], axis=-1)
    defective = _ill_conditioned(eigenvalues, V)
    if defective.any():
        raise DefectiveMatrixError(_where(defective))
    rows = np.abs(V).argmax(axis=-2)[..., None, :]
    return eigenvalues, V * np.copysign(1.0, np.take_along_axis(V, rows, axis=-2))


def _drop_rounding(f_y: Array, eigenvalues: Array, V: Array) -> tuple[Array, Array]:
    """Turn pairs that are complex by rounding alone (a repeated eigenvalue) into real ones."""
    size = np.linalg.norm(f_y, axis=(-2, -1))
    pairs = np.abs(eigenvalues.imag).max(axis=-1) > 1e-12 * size
    if pairs.any():
        defective = pairs & _ill_conditioned(eigenvalues, V)
        if (pairs & ~defective).any():
            row = eigenvalues[pairs & ~defective][0]
            raise ComplexEigenvalueError(row[np.abs(row.imag).argmax()], _where(pairs & ~defective))
        raise DefectiveMatrixError(_where(defective))
    # Re v and Im v span the real invariant plane of the pair
    basis = np.where(eigenvalues.imag[..., None, :] < 0.0, V.imag, V.real)
    norm = np.linalg.norm(basis, axis=-2, keepdims=True)
    return eigenvalues.real.copy(), basis / np.where(norm > 0.0, norm, 1.0)


def _ill_conditioned(w: NDArray[np.inexact], V: NDArray[np.inexact]) -> NDArray[np.bool_]:
    """Whether V is close to singular: as it is, and not for the units of the signals alone.

    Units alone are the cause where rows scaled to a largest entry of 1 are well conditioned and no
    two eigenvalues are close.
    """
    bad = ~(np.linalg.cond(V) <= MAX_CONDITION)
    if not bad.any():
        return bad
    rows = np.abs(V).max(axis=-1, keepdims=True)
    even = np.linalg.cond(V / np.where(rows > 0.0, rows, 1.0)) <= MAX_CONDITION
    gap = np.abs(w[..., :, None] - w[..., None, :]) + np.diag(np.full(w.shape[-1], np.inf))
    apart = gap.min(axis=(-2, -1)) > np.abs(w).max(axis=-1) / MAX_CONDITION
    return bad & ~(even & apart)


def _where(bad: NDArray[np.bool_]) -> str:
    """Say which systems of a batch are meant: '' for a single one."""
    return f"{first_index(bad)} ({int(bad.sum())} of {bad.size})" if bad.ndim else ""


@compiled
def _basis_of(A, w, V):
    """Write eigenvalues (descending) and eigenvectors of one real (n, n) matrix to w and V.

    Returns False where it has no real basis; numba before numpy 2.5 raises ValueError for n > 2.
    """
    n = len(A)
    if n == 2:
        scale = max(abs(A[0, 0]), abs(A[0, 1]), abs(A[1, 0]), abs(A[1, 1]), 1e-300)
        mean, h = 0.5 * (A[0, 0] / scale + A[1, 1] / scale), 0.5 * (A[0, 0] - A[1, 1]) / scale
        b, c = A[0, 1] / scale, A[1, 0] / scale
        disc = h * h + b * c
        if max(abs(h), abs(b), abs(c)) <= 1e-15:  # a multiple of I: every basis will do
            w[:] = mean * scale
            V[0, 0] = V[1, 1] = 1.0
            V[0, 1] = V[1, 0] = 0.0
            return True
        if disc <= 0.0:
            return False
        root = np.sqrt(disc)
        p = abs(h) + root  # no cancellation
        if h < 0.0:
            V[0, 0], V[1, 0], V[0, 1], V[1, 1] = b, p, -p, c
        else:
            V[0, 0], V[1, 0], V[0, 1], V[1, 1] = p, c, -b, p
        w[0], w[1] = (mean + root) * scale, (mean - root) * scale
    else:
        found, X = np.linalg.eig(A)  # complex arrays from numpy 2.5 on
        if np.abs(found.imag).max() > 0.0:
            return False
        order = np.argsort(-found.real)
        for j in range(n):
            w[j] = found.real[order[j]]
            V[:, j] = X.real[:, order[j]]
    for j in range(n):
        largest, square = 0.0, 0.0
        for i in range(n):
            square += V[i, j] ** 2
            if abs(V[i, j]) > abs(largest):
                largest = V[i, j]
        V[:, j] /= np.sqrt(square) if largest >= 0.0 else -np.sqrt(square)
    return True


@compiled
def triangular_of(W, T_a, R):
    """Gram and Schmidt from the last row of W up, twice each: R = W T_a upper triangular.

    Returns the smallest share of a row that the rows after it leave over.
    """
    n, least = len(W), 1.0
    v = np.empty(n)
    for i in range(n - 1, -1, -1):
        v[:] = W[i]
        length = np.sqrt((v * v).sum())
        for _ in range(2):
            for j in range(i + 1, n):
                dot = 0.0
                for m in range(n):
                    dot += v[m] * T_a[m, j]
                for m in range(n):
                    v[m] -= dot * T_a[m, j]
        rest = np.sqrt((v * v).sum())
        least = min(least, rest / length) if 0.0 < length < np.inf else 0.0
        T_a[:, i] = v / rest
        R[i] = 0.0
        R[i, i] = rest
        for j in range(i + 1, n):
            for m in range(n):
                R[i, j] += W[i, m] * T_a[m, j]
    return least


@compiled
def spaces_of(f_y, f_u, arrays):
    """Write T_y, T_a, Lambda, R, (4, N, n, n); False where something is wrong with some system."""
    N, n = f_y.shape[:2]
    w, V, W = np.empty(n), np.empty((n, n)), np.empty((n, n))
    T_y, T_a, Lambda, R = arrays[0], arrays[1], arrays[2], arrays[3]
    Lambda[:] = 0.0
    for k in range(N):
        total = 0.0
        for i in range(n):
            for j in range(n):
                total += 0.0 * (f_y[k, i, j] + f_u[k, i, j])
        if total != 0.0 or not _basis_of(f_y[k], w, V):
            return False  # NaN is not 0 either
        if n == 2:
            det = V[0, 0] * V[1, 1] - V[0, 1] * V[1, 0]
            T_y[k, 0, 0], T_y[k, 0, 1] = V[1, 1] / det, -V[0, 1] / det
            T_y[k, 1, 0], T_y[k, 1, 1] = -V[1, 0] / det, V[0, 0] / det
        else:
            T_y[k] = np.linalg.inv(V)
        there, back = 0.0, 0.0
        for i in range(n):
            Lambda[k, i, i] = w[i]
            for j in range(n):
                there += V[i, j] ** 2
                back += T_y[k, i, j] ** 2
                W[i, j] = 0.0
                for m in range(n):
                    W[i, j] += T_y[k, i, m] * f_u[k, m, j]
        # the general road looks closer
        if not there * back <= MAX_CONDITION**2 or not triangular_of(W, T_a[k], R[k]) > 1e-9:
            return False
    return True
