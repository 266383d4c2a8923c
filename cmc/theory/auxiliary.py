"""The auxiliary space: coordinates `z = T_y y`, `a = T_a^-1 u` in which modules combine.

With `f_y = V Lambda V^-1` and `T_y = V^-1` the dynamics become `z' = Lambda z + R a`, with Lambda
diagonal and `R = T_y f_u T_a` upper triangular: each action moves its own signal and those before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import checked
from cmc.theory.spectrum import (
    CHUNK,
    MAX_CONDITION,
    SINGULAR,
    Array,
    ComplexEigenvalueError,
    DefectiveMatrixError,
    SingularInputError,
    checked_pair,
    checked_square,
    raise_complex,
    raise_defective,
    raise_singular,
    real_eigenbasis,
)

__all__ = [
    "AuxiliarySpace",
    "ComplexEigenvalueError",
    "DefectiveMatrixError",
    "SingularInputError",
    "decompose",
    "triangularize",
]


@dataclass(frozen=True, eq=False)
class AuxiliarySpace:
    """Transforms and the Jacobians they produce, each of shape (..., n, n).

    `Lambda = T_y f_y T_y^-1` in 1/s and `R = T_y f_u T_a` (eq_theorem2); leading axes are a batch
    or time.

    Raises:
        TypeError: If the entries are not real numbers.
        ValueError: If shapes differ, are not square, or an entry is not finite.
    """

    T_y: Array
    """Latent signals to auxiliary ones, `z = T_y y`."""
    T_a: Array
    """Auxiliary actions to commands, `u = T_a a`."""
    Lambda: Array
    """Open-loop Jacobian in the auxiliary space [1/s]."""
    R: Array
    """Input Jacobian in the auxiliary space."""

    def __post_init__(self) -> None:
        for name in ("T_y", "T_a", "Lambda", "R"):
            object.__setattr__(self, name, checked_square(getattr(self, name), name))
            if getattr(self, name).shape != self.T_y.shape:
                shapes = [getattr(self, k).shape for k in ("T_y", "T_a", "Lambda", "R")]
                raise ValueError(f"T_y, T_a, Lambda, R must have one shape, got {shapes}")

    @classmethod
    def from_transforms(
        cls, T_y: ArrayLike, T_a: ArrayLike, f_y: ArrayLike, f_u: ArrayLike
    ) -> AuxiliarySpace:
        """Apply given transforms: `Lambda = T_y f_y T_y^-1`, `R = T_y f_u T_a`, of any structure.

        Args:
            T_y: Transform of the latent signal, (..., n, n), invertible.
            T_a: Transform of the action, (..., n, n).
            f_y: Jacobian of the plant in `y` [1/s], (..., n, n).
            f_u: Jacobian of the plant in `u`, (..., n, n).

        Raises:
            TypeError: If the entries are not real numbers.
            ValueError: If shapes do not fit or an entry is not finite.
            numpy.linalg.LinAlgError: If `T_y` is singular.
        """
        given = [(T_y, "T_y"), (T_a, "T_a"), (f_y, "f_y"), (f_u, "f_u")]
        try:
            y, a, J, G = np.broadcast_arrays(*(checked_square(x, name) for x, name in given))
        except ValueError as error:
            shapes = ", ".join(f"{name} {np.shape(x)}" for x, name in given)
            raise ValueError(f"T_y, T_a, f_y, f_u must fit together: {shapes}; {error}") from None
        return cls(y, a, y @ J @ np.linalg.inv(y), y @ G @ a)

    @classmethod
    def identity(cls, f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
        """Leave the coordinates alone: `T_y = T_a = I`, `Lambda = f_y`, `R = f_u`."""
        eye = np.eye(np.shape(f_y)[-1]) if np.ndim(f_y) else f_y
        return cls.from_transforms(eye, eye, f_y, f_u)

    @property
    def n(self) -> int:
        """Number of latent signals."""
        return int(self.T_y.shape[-1])

    @property
    def eigenvalues(self) -> Array:
        """Diagonal of `Lambda` [1/s], shape (..., n)."""
        return np.diagonal(self.Lambda, axis1=-2, axis2=-1)

    @property
    def gains(self) -> Array:
        """Diagonal of `R`: what an action does to its own signal, shape (..., n)."""
        return np.diagonal(self.R, axis1=-2, axis2=-1)

    @property
    def V(self) -> Array:
        """Eigenvector matrix `T_y^-1`, shape (..., n, n)."""
        return inverse(self.T_y)

    def to_z(self, y: ArrayLike) -> Array:
        """Return `z = T_y y` for `y` of shape (..., n)."""
        return np.einsum("...ij,...j->...i", self.T_y, np.asarray(y, dtype=np.float64))

    def to_u(self, a: ArrayLike) -> Array:
        """Return `u = T_a a` for `a` of shape (..., n)."""
        return np.einsum("...ij,...j->...i", self.T_a, np.asarray(a, dtype=np.float64))

    def signed(self, k1: ArrayLike, k2: ArrayLike) -> Array:
        """Slopes of sizes `k1` in z and `k2` in int z against the sign of R_ii, (..., n, 2)."""
        sizes = np.stack(np.broadcast_arrays(k1, k2, self.gains)[:2], axis=-1)
        return -np.sign(self.gains)[..., None] * sizes  # constraint_sign

    def loop(self, slopes: ArrayLike) -> Array:
        """Jacobian of the loop in (z, int z) [1/s] for signed slopes (..., n, 2): (..., 2n, 2n).

        [[Lambda + R P, R Q], [I, 0]], P and Q the diagonal matrices of the slopes.
        """
        s, n = checked("slopes", slopes, "... n 2", n=self.n), self.n
        P, Q = s[..., None, :, 0], s[..., None, :, 1]
        top = np.concatenate(np.broadcast_arrays(self.Lambda + self.R * P, self.R * Q), axis=-1)
        J = np.zeros((*top.shape[:-2], 2 * n, 2 * n))
        J[..., :n, :], J[..., n:, :n] = top, np.eye(n)
        return J


def decompose(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Find `T_y`, `T_a` that make `Lambda` diagonal and `R` upper triangular (explicit solution).

    `T_y = V^-1` from `f_y = V Lambda V^-1`, and the orthogonal `T_a = Q P` from
    `(T_y f_u)^T P = Q R_qr` with P the exchange matrix.
    Eigenvalues descend (slowest mode first), columns of `V` have unit norm and a positive largest
    component, and the free sign of the QR factors is fixed by `R_ii > 0`.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (..., n, n), with real eigenvalues.
        f_u: Jacobian of the plant in `u`, (..., n, n), invertible; batches broadcast.

    Returns:
        The auxiliary space; its arrays have the broadcast shape (..., n, n).

    Raises:
        ComplexEigenvalueError: If `f_y` has a complex pair (use the feedback combination).
        DefectiveMatrixError: If `f_y` lacks eigenvectors, to working precision.
        SingularInputError: If `f_u` is singular.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit or an entry is NaN or infinite.

    Source: appendix "Proof of the theorem for the hierarchical combination" (the theorem's own text
    prints `T_y = V` and forgets a transpose, see `cmc.theory.as_printed`).
    """
    if getattr(f_y, "shape", None) == getattr(f_u, "shape", None) == (2, 2):
        space = _decompose_one_planar(f_y, f_u)  # type: ignore[arg-type]
        if space is not None:
            return space
    f_y, f_u = checked_pair(f_y, f_u)
    eigenvalues, V = real_eigenbasis(f_y)
    return assemble(eigenvalues, V, f_u)


def assemble(eigenvalues: Array, V: Array, f_u: Array) -> AuxiliarySpace:
    """Build the space from an eigenbasis: eigenvalues (..., n), `V` and `f_u` (..., n, n)."""
    shape, n = V.shape, V.shape[-1]
    if n != 2 or V.ndim == 2:
        T_y = inverse(V)
        T_a, R = triangularize(T_y @ f_u)
        return _trusted(T_y, T_a, eigenvalues[..., None] * np.eye(n), R)
    eigenvalues, V, f_u = eigenvalues.reshape(-1, n), V.reshape(-1, n, n), f_u.reshape(-1, n, n)
    arrays = np.empty((4, len(V), n, n))
    for start in range(0, len(V), CHUNK):
        part = slice(start, start + CHUNK)
        T_y, T_a, Lambda, R = arrays[:, part]
        T_y[:] = inverse(V[part])
        T_a[:], R[:] = triangularize(_planar_product(T_y, f_u[part]))
        Lambda[:] = 0.0
        np.einsum("kii->ki", Lambda)[:] = eigenvalues[part]
    return _trusted(*arrays.reshape(4, *shape))


def triangularize(W: Array) -> tuple[Array, Array]:
    """Return an orthogonal `T_a` and `R = W T_a`, upper triangular with a positive diagonal.

    Args:
        W: `T_y f_u`, (..., n, n), invertible.

    Returns:
        `T_a` and `R`, each (..., n, n).
    """
    if W.shape[-1] == 2:
        return _triangularize_planar(W)
    # W^T P = Q R_qr with P the exchange matrix; T_a = Q P, R = P R_qr^T P
    Q, R_qr = np.linalg.qr(np.swapaxes(W, -1, -2)[..., ::-1])
    T_a, R = Q[..., ::-1], np.swapaxes(R_qr, -1, -2)[..., ::-1, ::-1]
    sign = np.copysign(1.0, np.diagonal(R, axis1=-2, axis2=-1))[..., None, :]
    return T_a * sign, R * sign


def _triangularize_planar(W: Array) -> tuple[Array, Array]:
    """Closed form of the transposed QR: the second row of `W` fixes the second column of `T_a`."""
    p, q, r, s = W[..., 0, 0], W[..., 0, 1], W[..., 1, 0], W[..., 1, 1]
    length = np.sqrt(r * r + s * s)
    det = p * s - q * r
    sign = np.copysign(1.0, det)
    T_a, R = np.empty(W.shape), np.zeros(W.shape)
    x, y = r / length, s / length
    T_a[..., 0, 1], T_a[..., 1, 1] = x, y
    T_a[..., 0, 0], T_a[..., 1, 0] = sign * y, -sign * x
    R[..., 0, 0], R[..., 0, 1], R[..., 1, 1] = np.abs(det) / length, p * x + q * y, length
    return T_a, R


def _planar_product(T_y: Array, f_u: Array) -> Array:
    """Many 2x2 products: faster written out than through matmul."""
    W = np.empty(T_y.shape)
    for i in range(2):
        for j in range(2):
            W[..., i, j] = T_y[..., i, 0] * f_u[..., 0, j] + T_y[..., i, 1] * f_u[..., 1, j]
    return W


def inverse(V: Array) -> Array:
    """Return `V^-1` for (..., n, n), in closed form for n = 2."""
    if V.shape[-1] != 2:
        return np.asarray(np.linalg.inv(V), dtype=np.float64)
    T_y = np.empty(V.shape)
    det = V[..., 0, 0] * V[..., 1, 1] - V[..., 0, 1] * V[..., 1, 0]
    T_y[..., 0, 0], T_y[..., 0, 1] = V[..., 1, 1] / det, -V[..., 0, 1] / det
    T_y[..., 1, 0], T_y[..., 1, 1] = -V[..., 1, 0] / det, V[..., 0, 0] / det
    return T_y


def _trusted(T_y: Array, T_a: Array, Lambda: Array, R: Array) -> AuxiliarySpace:
    """Make a space from arrays that are right by construction, without checking them again."""
    space = object.__new__(AuxiliarySpace)
    space.__dict__.update(T_y=T_y, T_a=T_a, Lambda=Lambda, R=R)
    return space


def _decompose_one_planar(f_y: Array, f_u: Array) -> AuxiliarySpace | None:
    """One 2x2 system in plain floats, for a control loop. None leaves it to the general path."""
    if f_y.dtype != np.float64 or f_u.dtype != np.float64:
        return None
    (a, b), (c, d) = f_y.tolist()
    (p, q), (r, s) = f_u.tolist()
    h, det_u = 0.5 * (a - d), p * s - q * r
    disc = h * h + b * c
    if not (math.isfinite(disc) and math.isfinite(det_u)):
        return None  # the general path says which entry is not finite
    limit = ((b - c) / MAX_CONDITION) ** 2
    if disc <= limit:
        if h == b == c == 0.0:
            return None
        if disc < -limit:
            raise_complex(0.5 * (a + d), math.sqrt(-disc))
        raise_defective()
    if abs(det_u) <= SINGULAR * (p * p + q * q + r * r + s * s):
        raise_singular()
    root = math.sqrt(disc)
    if h >= 0.0:
        x1, y1 = h + root, c
        x2, y2 = -b, x1
    else:
        x1, y1 = b, root - h
        x2, y2 = -y1, c
    # unit columns, largest component positive
    k1 = math.copysign(math.sqrt(x1 * x1 + y1 * y1), x1 if abs(x1) >= abs(y1) else y1)
    k2 = math.copysign(math.sqrt(x2 * x2 + y2 * y2), x2 if abs(x2) >= abs(y2) else y2)
    x1, y1, x2, y2 = x1 / k1, y1 / k1, x2 / k2, y2 / k2
    det = x1 * y2 - x2 * y1
    t11, t12, t21, t22 = y2 / det, -x2 / det, -y1 / det, x1 / det
    # W = T_y f_u, then the transposed QR: the second row of W is R_22 times a column of T_a
    w11, w12, w21, w22 = t11 * p + t12 * r, t11 * q + t12 * s, t21 * p + t22 * r, t21 * q + t22 * s
    length = math.sqrt(w21 * w21 + w22 * w22)
    x, y = w21 / length, w22 / length
    det_w = w11 * w22 - w12 * w21
    e1, e2 = (y, -x) if det_w > 0.0 else (-y, x)
    mean = 0.5 * (a + d)
    flat = (
        (t11, t12, t21, t22, e1, x, e2, y)
        + (mean + root, 0.0, 0.0, mean - root)
        + (abs(det_w) / length, w11 * x + w12 * y, 0.0, length)
    )
    return _trusted(*np.array(flat).reshape(4, 2, 2))
