"""Real eigenbases of `f_y`, with every reason why there may be none said in one sentence.

The columns of `V` are eigenvectors, `f_y = V Lambda V^-1`. Order, sign and length of an eigenvector
are free; here the slowest mode (largest eigenvalue) comes first, columns have unit norm and their
largest component is positive. `cmc.theory.tracking` keeps the choice continuous along a path.
"""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.jacobians import not_square

Array = NDArray[np.float64]

EPS = float(np.finfo(np.float64).eps)
MAX_CONDITION = 2e7
"""Above this condition number of `V` (about 1/sqrt(eps)) a matrix counts as defective."""
SINGULAR = 1e-12
"""Below this reciprocal condition number `f_u` counts as singular."""


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
    if f_u.shape[-1] == 2:
        det = f_u[..., 0, 0] * f_u[..., 1, 1] - f_u[..., 0, 1] * f_u[..., 1, 0]
        singular = np.abs(det) <= SINGULAR * np.einsum("...ij,...ij->...", f_u, f_u)
    else:
        sigma = np.linalg.svd(f_u, compute_uv=False)
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

    Closed form for n = 2, LAPACK otherwise. `f_y` is taken as validated.

    Raises:
        ComplexEigenvalueError: If a matrix has a complex pair.
        DefectiveMatrixError: If a matrix is defective to working precision.
    """
    if f_y.shape[-1] == 2:
        return _planar(f_y)
    eigenvalues, V = _lapack(f_y)
    rows = np.abs(V).argmax(axis=-2)[..., None, :]
    return eigenvalues, V * np.copysign(1.0, np.take_along_axis(V, rows, axis=-2))


CHUNK = 4096
"""Planar batches are worked through in pieces of this many systems, which stay in the cache."""


def _planar(f_y: Array) -> tuple[Array, Array]:
    """Closed form for (..., 2, 2), refused as a whole and then solved piece by piece."""
    flat = f_y.reshape(-1, 2, 2)
    eigenvalues, V = np.empty((len(flat), 2)), np.empty(flat.shape)
    bad = np.zeros(len(flat), dtype=bool)
    for start in range(0, len(flat), CHUNK):
        part = slice(start, start + CHUNK)
        bad[part] = _planar_piece(flat[part], eigenvalues[part], V[part])
    if bad.any():
        _explain_planar(f_y, bad.reshape(f_y.shape[:-2]))
    return eigenvalues.reshape(f_y.shape[:-1]), V.reshape(f_y.shape)


def _planar_piece(f_y: Array, eigenvalues: Array, V: Array) -> NDArray[np.bool_]:
    """Write roots and eigenvectors (no cancellation) of (N, 2, 2); return which have none."""
    a, b, c, d = f_y[:, 0, 0], f_y[:, 0, 1], f_y[:, 1, 0], f_y[:, 1, 1]
    mean, h = 0.5 * (a + d), 0.5 * (a - d)
    disc = h * h + b * c
    # sin(angle between the eigenvectors) = 2 sqrt(disc) / hypot(b - c, 2 sqrt(disc))
    bad = disc <= ((b - c) / MAX_CONDITION) ** 2
    root = np.sqrt(np.abs(disc))
    p, flip = np.abs(h) + root, h < 0.0
    x1, y1 = np.where(flip, b, p), np.where(flip, p, c)
    x2, y2 = np.where(flip, -p, -b), np.where(flip, c, p)
    if bad.any():
        scalar = (h == 0.0) & (b == 0.0) & (c == 0.0)  # a multiple of I: every basis will do
        bad &= ~scalar
        x1[scalar], y1[scalar], x2[scalar], y2[scalar] = 1.0, 0.0, 0.0, 1.0
        x1[bad], y1[bad], x2[bad], y2[bad] = 1.0, 0.0, 0.0, 1.0
    k1 = np.copysign(np.sqrt(x1 * x1 + y1 * y1), np.where(np.abs(x1) >= np.abs(y1), x1, y1))
    k2 = np.copysign(np.sqrt(x2 * x2 + y2 * y2), np.where(np.abs(x2) >= np.abs(y2), x2, y2))
    V[:, 0, 0], V[:, 1, 0], V[:, 0, 1], V[:, 1, 1] = x1 / k1, y1 / k1, x2 / k2, y2 / k2
    eigenvalues[:, 0], eigenvalues[:, 1] = mean + root, mean - root
    return bad


def _explain_planar(f_y: Array, bad: NDArray[np.bool_]) -> NoReturn:
    a, b, c, d = f_y[..., 0, 0], f_y[..., 0, 1], f_y[..., 1, 0], f_y[..., 1, 1]
    disc = 0.25 * (a - d) ** 2 + b * c
    pairs = bad & (disc < -(((b - c) / MAX_CONDITION) ** 2))
    if pairs.any():
        k = int(np.flatnonzero(pairs)[0])
        mean = 0.5 * float(a.flat[k] + d.flat[k])
        raise_complex(mean, float(-disc.flat[k]) ** 0.5, _where(pairs))
    raise_defective(_where(bad))


def _lapack(f_y: Array) -> tuple[Array, Array]:
    eigenvalues, V = np.linalg.eig(f_y)
    if np.iscomplexobj(eigenvalues):
        eigenvalues, V = _drop_rounding(f_y, eigenvalues, V)
    if (eigenvalues[..., 1:] > eigenvalues[..., :-1]).any():
        order = np.argsort(-eigenvalues, axis=-1, kind="stable")
        eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
        V = np.take_along_axis(V, order[..., None, :], axis=-1)
    defective = _ill_conditioned(V)
    if defective.any():
        raise_defective(_where(defective))
    return eigenvalues, V


def _drop_rounding(f_y: Array, eigenvalues: Array, V: Array) -> tuple[Array, Array]:
    """Turn pairs that are complex by rounding alone (a repeated eigenvalue) into real ones."""
    size = np.linalg.norm(f_y, axis=(-2, -1))
    pairs = np.abs(eigenvalues.imag).max(axis=-1) > 1e-12 * size
    if pairs.any():
        defective = pairs & _ill_conditioned(V)
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


def _ill_conditioned(V: NDArray[np.inexact]) -> NDArray[np.bool_]:
    sigma = np.linalg.svd(V, compute_uv=False)
    return np.asarray(sigma[..., -1] * MAX_CONDITION < sigma[..., 0])


def _where(bad: NDArray[np.bool_]) -> str:
    """Say which systems of a batch are meant: '' for a single one."""
    if bad.ndim == 0:
        return ""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f" at index {index[0] if len(index) == 1 else index} ({int(bad.sum())} of {bad.size})"


def _first(bad: NDArray[np.bool_], array: Array) -> str:
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{array[index]} at index {index}"
