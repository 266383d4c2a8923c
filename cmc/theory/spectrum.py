"""Real eigenbases of `f_y`, compiled, with every reason why there may be none in one sentence.

The columns of `V` are eigenvectors, `f_y = V Lambda V^-1`. Order, sign and length of an eigenvector
are free; here the slowest mode (largest eigenvalue) comes first, columns have unit norm and their
largest component is positive. `cmc.theory.tracking` keeps the choice continuous along a path.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.arrays import Array
from cmc.theory.explicit import MAX_CONDITION, bases_of
from cmc.theory.jacobians import not_square

SINGULAR = 1e-12
"""Below this share of a row that no other row explains, in the best units, `f_u` is singular."""


class ComplexEigenvalueError(ValueError):
    """`f_y` has a complex pair, so no real `T_y` makes it diagonal, nor triangular."""


class DefectiveMatrixError(ValueError):
    """`f_y` has fewer independent eigenvectors than rows, to working precision."""


class SingularInputError(ValueError):
    """`f_u` is singular: some direction of `y` cannot be moved by any command."""


def checked_square(value: ArrayLike, name: str) -> Array:
    """Return `value` as a finite float64 array of shape (..., n, n).

    Raises:
        TypeError: If the entries are not real numbers.
        ValueError: If the last two axes are not square, or an entry is NaN or infinite.
    """
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must hold real numbers, got dtype {array.dtype}")
    if array.ndim < 2 or array.shape[-1] != array.shape[-2] or array.shape[-1] == 0:
        raise ValueError(f"{name} must have shape (..., n, n), got {array.shape}")
    array = array.astype(np.float64, copy=False)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_first(~np.isfinite(array), array)}")
    return array


def checked_pair(f_y: ArrayLike, f_u: ArrayLike) -> tuple[Array, Array]:
    """Return both Jacobians, validated and broadcast to one shape (..., n, n).

    Raises:
        SingularInputError: If a matrix of `f_u` is singular.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit or an entry is not finite.
    """
    f_y = checked_square(f_y, "f_y")
    if np.ndim(f_u) >= 2 and np.shape(f_u)[-2] == f_y.shape[-1] != np.shape(f_u)[-1]:
        raise ValueError(not_square(f_y.shape[-1], np.shape(f_u)[-1]))
    f_u = checked_square(f_u, "f_u")
    if f_y.shape != f_u.shape:
        if f_y.shape[-1] != f_u.shape[-1]:
            raise ValueError(f"f_y and f_u must be of one size, got {f_y.shape} and {f_u.shape}")
        try:
            f_y, f_u = np.broadcast_arrays(f_y, f_u)
        except ValueError:
            message = f"batches of f_y and f_u do not broadcast: {f_y.shape} and {f_u.shape}"
            raise ValueError(message) from None
    _refuse_singular(f_u)
    return f_y, f_u


def _refuse_singular(f_u: Array) -> None:
    """Rows and columns are brought to a largest entry of 1 first: units make nothing singular."""
    with np.errstate(divide="ignore", invalid="ignore"):
        even = f_u / np.abs(f_u).max(axis=-1, keepdims=True)
        even = even / np.abs(even).max(axis=-2, keepdims=True)
    even = np.nan_to_num(even)
    sigma = np.linalg.svd(even, compute_uv=False)
    singular = sigma[..., -1] <= SINGULAR * sigma[..., 0]
    if singular.any():
        raise_singular(_where(singular))


def raise_singular(where: str = "") -> NoReturn:
    """Raise `SingularInputError` in the words used everywhere."""
    raise SingularInputError(
        f"f_u is singular{where}: some direction of y cannot be moved by u, so R has a zero on its "
        "diagonal and the theorem says nothing (a peg out of contact is such a case)"
    )


def raise_complex(real: float, imag: float, where: str = "") -> NoReturn:
    """Raise `ComplexEigenvalueError` in the words used everywhere."""
    raise ComplexEigenvalueError(
        f"f_y has the complex pair {real:.6g} +- {abs(imag):.6g}j{where}: no real T_y makes it "
        "diagonal or triangular, so there is no hierarchical combination; use the feedback "
        "combination, cmc.theory.combinations.feedback(f_y, f_u)"
    )


def raise_defective(where: str = "") -> NoReturn:
    """Raise `DefectiveMatrixError` in the words used everywhere."""
    raise DefectiveMatrixError(
        f"f_y has a repeated eigenvalue without enough eigenvectors{where} (condition of V above "
        f"{MAX_CONDITION:.0e}): T_y = V^-1 does not exist; a Schur basis still gives the "
        "hierarchy, cmc.theory.combinations.schur(f_y, f_u)"
    )


def real_eigenbasis(f_y: Array) -> tuple[Array, Array]:
    """Return eigenvalues (..., n), descending, and unit eigenvectors `V` (..., n, n).

    `f_y` is taken as validated.

    Raises:
        ComplexEigenvalueError: If a matrix has a complex pair.
        DefectiveMatrixError: If a matrix is defective to working precision.
    """
    flat = np.ascontiguousarray(f_y, dtype=np.float64).reshape(-1, *f_y.shape[-2:])
    w, V = np.empty(flat.shape[:2]), np.empty(flat.shape)
    try:
        found = bases_of(flat, w, V)
    except ValueError:  # how the compiled eig says that an eigenvalue is complex
        found = False
    if found and not _ill_conditioned(w, V).any():
        return w.reshape(f_y.shape[:-1]), V.reshape(f_y.shape)
    eigenvalues, V = _lapack(f_y)
    rows = np.abs(V).argmax(axis=-2)[..., None, :]
    return eigenvalues, V * np.copysign(1.0, np.take_along_axis(V, rows, axis=-2))


def _lapack(f_y: Array) -> tuple[Array, Array]:
    """In numpy: it sorts out why there is no basis, and pairs that are complex by rounding."""
    eigenvalues, V = np.linalg.eig(f_y)
    # numpy 2.5 returns complex arrays whatever is in them
    if np.iscomplexobj(eigenvalues):
        eigenvalues, V = _drop_rounding(f_y, eigenvalues, V)
    if (eigenvalues[..., 1:] > eigenvalues[..., :-1]).any():
        order = np.argsort(-eigenvalues, axis=-1, kind="stable")
        eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
        V = np.take_along_axis(V, order[..., None, :], axis=-1)
    defective = _ill_conditioned(eigenvalues, V)
    if defective.any():
        raise_defective(_where(defective))
    return eigenvalues, V


def _drop_rounding(f_y: Array, eigenvalues: Array, V: Array) -> tuple[Array, Array]:
    """Turn pairs that are complex by rounding alone (a repeated eigenvalue) into real ones."""
    size = np.linalg.norm(f_y, axis=(-2, -1))
    pairs = np.abs(eigenvalues.imag).max(axis=-1) > 1e-12 * size
    if pairs.any():
        defective = pairs & _ill_conditioned(eigenvalues, V)
        if (pairs & ~defective).any():
            k = int(np.flatnonzero(pairs & ~defective)[0])
            row = eigenvalues.reshape(-1, eigenvalues.shape[-1])[k]
            worst = row[np.abs(row.imag).argmax()]
            raise_complex(float(worst.real), float(worst.imag), _where(pairs & ~defective))
        raise_defective(_where(defective))
    # Re v and Im v span the real invariant plane of the pair
    basis = np.where(eigenvalues.imag[..., None, :] < 0.0, V.imag, V.real)
    norm = np.linalg.norm(basis, axis=-2, keepdims=True)
    return eigenvalues.real.copy(), basis / np.where(norm > 0.0, norm, 1.0)


def _ill_conditioned(w: NDArray[np.inexact], V: NDArray[np.inexact]) -> NDArray[np.bool_]:
    """Whether V is close to singular: as it is, and not for the units of the signals alone.

    Units alone are the cause where rows scaled to a largest entry of 1 are well conditioned and no
    two eigenvalues are close.
    """
    bad = _condition(V) > MAX_CONDITION
    if not bad.any():
        return bad
    rows = np.abs(V).max(axis=-1, keepdims=True)
    even = _condition(V / np.where(rows > 0.0, rows, 1.0)) <= MAX_CONDITION
    gap = np.abs(w[..., :, None] - w[..., None, :]) + np.diag(np.full(w.shape[-1], np.inf))
    apart = gap.min(axis=(-2, -1)) > np.abs(w).max(axis=-1) / MAX_CONDITION
    return bad & ~(even & apart)


def _condition(V: NDArray[np.inexact]) -> Array:
    sigma = np.linalg.svd(V, compute_uv=False)
    return np.asarray(sigma[..., 0] / np.maximum(sigma[..., -1], 1e-300), dtype=np.float64)


def _where(bad: NDArray[np.bool_]) -> str:
    """Say which systems of a batch are meant: '' for a single one."""
    if bad.ndim == 0:
        return ""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f" at index {index[0] if len(index) == 1 else index} ({int(bad.sum())} of {bad.size})"


def _first(bad: NDArray[np.bool_], array: Array) -> str:
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{array[index]} at index {index}"
