"""The auxiliary space: coordinates `z = T_y y`, `a = T_a^-1 u` in which modules combine.

With `f_y = V Lambda V^-1` and `T_y = V^-1` the dynamics become `z' = Lambda z + R a`, with Lambda
diagonal and `R = T_y f_u T_a` upper triangular: each action moves its own signal and those before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, inverse, not_overflown, together
from cmc.theory.explicit import checked_pair, real_eigenbasis, spaces_of, triangular_of


@dataclass(frozen=True, eq=False)
class AuxiliarySpace:
    """Transforms and the Jacobians they produce, each of shape (..., n, n).

    `Lambda = T_y f_y T_y^-1` in 1/s and `R = T_y f_u T_a` (eq_theorem2); leading axes are a batch
    or time. Wrong shapes and entries that are not finite raise ValueError, or TypeError.
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
            object.__setattr__(self, name, checked(name, getattr(self, name), "... n n"))
            if getattr(self, name).shape != self.T_y.shape:
                shapes = [np.shape(getattr(self, k)) for k in ("T_y", "T_a", "Lambda", "R")]
                raise ValueError(f"T_y, T_a, Lambda, R need one shape, got {shapes}")

    @classmethod
    def from_transforms(
        cls, T_y: ArrayLike, T_a: ArrayLike, f_y: ArrayLike, f_u: ArrayLike
    ) -> AuxiliarySpace:
        """Apply given transforms: `Lambda = T_y f_y T_y^-1`, `R = T_y f_u T_a`, of any structure.

        All are (..., n, n) and broadcast; f_y in 1/s.
        """
        given = {"T_y": T_y, "T_a": T_a, "f_y": f_y, "f_u": f_u}
        n = checked("T_y", T_y, "... n n").shape[-1]
        y, a, J, G = together(**{k: checked(k, x, "... n n", n=n) for k, x in given.items()})
        Lambda, R = y @ J @ inverse("T_y", y), y @ G @ a
        not_overflown("T_y, T_a, f_y and f_u", Lambda, R)
        return cls(y, a, Lambda, R)

    @classmethod
    def identity(cls, f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
        """Leave the coordinates alone: `T_y = T_a = I`, `Lambda = f_y`, `R = f_u`."""
        eye = np.eye(checked("f_y", f_y, "... n n").shape[-1])
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
        return inverse("T_y", self.T_y)

    def to_z(self, y: ArrayLike) -> Array:
        """Return `z = T_y y` for `y` of shape (..., n)."""
        return applied(self.T_y, checked("y", y, "... n", n=self.n))

    def to_u(self, a: ArrayLike) -> Array:
        """Return `u = T_a a` for `a` of shape (..., n)."""
        return applied(self.T_a, checked("a", a, "... n", n=self.n))

    def signed(self, k1: ArrayLike, k2: ArrayLike) -> Array:
        """Slopes of sizes `k1` in z and `k2` in int z against the sign of R_ii, (..., n, 2)."""
        sizes = together(k1=checked("k1", k1), k2=checked("k2", k2), R_ii=self.gains)[:2]
        return -np.sign(self.gains)[..., None] * np.stack(sizes, axis=-1)  # constraint_sign

    def loop(self, slopes: ArrayLike, h: float | None = None) -> Array:
        """Jacobian of the loop in (z, int z) [1/s] for signed slopes (..., n, 2): (..., 2n, 2n).

        [[Lambda + R P, R Q], [I, 0]], P and Q the diagonal matrices of the slopes. With `h` (s),
        where Lambda and R are those of a sample, the step in (z_k, I_{k-1}), I_k = I_{k-1} + h z_k:
        [[Lambda + R (P + h Q), R Q], [h I, I]].
        """
        s, n = checked("slopes", slopes, "... n 2", n=self.n), self.n
        P, Q = s[..., None, :, 0], s[..., None, :, 1]
        P = P if h is None else P + h * Q
        top = np.concatenate(together(slopes=self.Lambda + self.R * P, R=self.R * Q), axis=-1)
        J = np.zeros((*top.shape[:-2], 2 * n, 2 * n))
        J[..., :n, :], J[..., n:, :n] = top, np.eye(n) * (1.0 if h is None else h)
        J[..., n:, n:] = np.eye(n) * (h is not None)
        not_overflown("slopes", J)
        return J


def applied(matrix: Array, x: Array) -> Array:
    """M x for (..., n, n) and (..., n)."""
    return np.einsum("...ij,...j->...i", matrix, x)


def decompose(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Find `T_y`, `T_a` that make `Lambda` diagonal and `R` upper triangular (explicit solution).

    `T_y = V^-1` from `f_y = V Lambda V^-1`, and the orthogonal `T_a = Q P` from
    `(T_y f_u)^T P = Q R_qr` with P the exchange matrix.
    Eigenvalues descend (slowest mode first), columns of `V` have unit norm and a positive largest
    component, and the free sign of the QR factors is fixed by `R_ii > 0`.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (..., n, n), with real eigenvalues.
        f_u: Jacobian of the plant in `u`, (..., n, n), invertible; batches broadcast.

    Raises:
        ComplexEigenvalueError: If `f_y` has a complex pair (use the feedback combination).
        DefectiveMatrixError: If `f_y` lacks eigenvectors, to working precision.
        SingularInputError: If `f_u` is singular.
        ValueError: If shapes do not fit or an entry is NaN or infinite; TypeError if not real.

    Source: appendix "Proof of the theorem for the hierarchical combination" (the theorem's own text
    prints `T_y = V` and forgets a transpose; lesson 04 shows that both are needed).
    """
    space = _at_once(f_y, f_u)
    if space is None:
        f_y, f_u = checked_pair(f_y, f_u)
        space = assemble(*real_eigenbasis(f_y), f_u)
    return space


def _at_once(f_y: Any, f_u: Any) -> AuxiliarySpace | None:
    """All systems in one compiled call; None where the general road has to say what is wrong."""
    plain = isinstance(f_y, np.ndarray) and isinstance(f_u, np.ndarray)
    if not (plain and f_y.dtype == f_u.dtype == np.float64):
        return None
    shape = f_y.shape
    if len(shape) < 2 or shape != f_u.shape or shape[-1] != shape[-2] or not f_y.size:
        return None
    flat = [np.ascontiguousarray(x).reshape(-1, *shape[-2:]) for x in (f_y, f_u)]
    arrays = np.empty((4, *flat[0].shape))
    try:
        if not spaces_of(*flat, arrays):
            return None
    except ValueError:  # how the compiled eig says that an eigenvalue is complex
        return None
    return _trusted(*arrays.reshape(4, *shape))


def assemble(eigenvalues: Array, V: Array, f_u: Array) -> AuxiliarySpace:
    """Build the space from an eigenbasis: eigenvalues (..., n), `V` and `f_u` (..., n, n)."""
    T_y = np.linalg.inv(V)
    T_a, R = triangularize(T_y @ f_u)
    return _trusted(T_y, T_a, eigenvalues[..., None] * np.eye(V.shape[-1]), R)


def triangularize(W: Array) -> tuple[Array, Array]:
    """Return an orthogonal `T_a` and `R = W T_a`, upper triangular with a positive diagonal.

    `W^T P = Q R_qr` with P the exchange matrix gives `T_a = Q P` and `R = P R_qr^T P`, for an
    invertible `W = T_y f_u`, (..., n, n).
    """
    flat = np.ascontiguousarray(W, dtype=np.float64).reshape(-1, *W.shape[-2:])
    T_a, R = np.empty(flat.shape), np.empty(flat.shape)
    for k in range(len(flat)):
        triangular_of(flat[k], T_a[k], R[k])
    not_overflown("f_y and f_u", T_a, R)
    return T_a.reshape(W.shape), R.reshape(W.shape)


def _trusted(T_y: Any, T_a: Any, Lambda: Any, R: Any) -> AuxiliarySpace:
    """Make a space from arrays that are right by construction, without checking them again."""
    space = object.__new__(AuxiliarySpace)
    space.__dict__.update(T_y=T_y, T_a=T_a, Lambda=Lambda, R=R)
    return space
