"""The auxiliary space along a path: order, sign and scale of eigenvectors kept continuous.

Eigenvectors are free in order, sign and length. Sorted anew at each step they may swap or flip,
and then the integral of `z = T_y y` adds up different signals. Here each step is matched to the
one before by its eigenvectors, not by sorting eigenvalues: two eigenvalues may cross and each mode
keeps its own place. Lengths are one throughout.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from cmc.theory.auxiliary import AuxiliarySpace, assemble, decompose, inverse
from cmc.theory.spectrum import Array, checked_pair, real_eigenbasis

DEGENERATE = 1e-12
"""Eigenvalues closer than this fraction of max|f_y| share a plane in which any basis will do."""


class Tracker:
    """Decompose one step after another, each in the order and sign of the one before.

    The first call fixes the default choice of `decompose`; `confidence` says how sure the latest
    match is. A match below about 0.7 means that the step was too long to follow.
    """

    def __init__(self) -> None:
        """Start without a past."""
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next step fixes order and sign anew."""
        self._space: AuxiliarySpace | None = None
        self._confidence = 1.0

    @property
    def confidence(self) -> float:
        """Smallest share of an eigenvector that lies along its predecessor, 0 to 1."""
        return self._confidence

    def update(self, f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
        """Return the auxiliary space of this step.

        Args:
            f_y: Jacobian of the plant in `y` [1/s], (n, n).
            f_u: Jacobian of the plant in `u`, (n, n).

        Raises:
            ComplexEigenvalueError: If `f_y` has a complex pair.
            DefectiveMatrixError: If `f_y` lacks eigenvectors.
            SingularInputError: If `f_u` is singular.
            TypeError: If the entries are not real numbers.
            ValueError: If shapes do not fit, change from call to call, or an entry is not finite.
        """
        space = decompose(f_y, f_u)
        if space.T_y.ndim != 2:
            raise ValueError(f"a tracker takes one system, (n, n), got {space.T_y.shape}")
        before = self._space
        if before is not None:
            if before.n != space.n:
                raise ValueError(f"the size changed from {before.n} to {space.n}: call reset()")
            space = self._follow(before, space, f_y, f_u)
        self._space = space
        return space

    def _follow(
        self, before: AuxiliarySpace, space: AuxiliarySpace, f_y: ArrayLike, f_u: ArrayLike
    ) -> AuxiliarySpace:
        """Return `space` in the order and signs of `before`."""
        coefficients = before.T_y @ inverse(space.T_y)
        shares = coefficients / np.sqrt((coefficients * coefficients).sum(axis=0))
        same = float(shares.diagonal().min())
        eigenvalues = space.Lambda.diagonal()
        if same > 0.9 and not _degenerate(eigenvalues, f_y):  # the usual case: nothing to do
            self._confidence = same
            return space
        V = inverse(space.T_y)
        if _degenerate(eigenvalues, f_y):
            V = _realign(eigenvalues, V, inverse(before.T_y), f_y)
        shares = _shares(inverse(before.T_y), V)
        order = _assign(shares)
        picked = shares[np.arange(len(order)), order]
        self._confidence = float(np.abs(picked).min())
        V = V[:, order] * np.where(picked < 0.0, -1.0, 1.0)
        return assemble(eigenvalues[order], V, np.asarray(f_u, dtype=np.float64))


def track(f_y_path: ArrayLike, f_u_path: ArrayLike) -> AuxiliarySpace:
    """Decompose a whole path with order, sign and scale continuous in time.

    The same answer as a `Tracker` fed step by step, but vectorised over time.

    Args:
        f_y_path: Jacobians in `y` [1/s], (time, n, n).
        f_u_path: Jacobians in `u`, (time, n, n), or (n, n) where constant.

    Returns:
        The auxiliary space with arrays of shape (time, n, n).

    Raises:
        ComplexEigenvalueError: If `f_y` has a complex pair at some time.
        DefectiveMatrixError: If `f_y` lacks eigenvectors at some time.
        SingularInputError: If `f_u` is singular at some time.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit or an entry is not finite.
    """
    f_y, f_u = checked_pair(f_y_path, f_u_path)
    if f_y.ndim != 3:
        raise ValueError(f"a path has shape (time, n, n), got {f_y.shape}")
    eigenvalues, V = real_eigenbasis(f_y)
    for k in np.flatnonzero(_degenerate(eigenvalues[1:], f_y[1:])) + 1:
        V[k] = _realign(eigenvalues[k], V[k], V[k - 1], f_y[k])
    order = _chain(_step_orders(_shares(V[:-1], V[1:])))
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
    V = np.take_along_axis(V, order[:, None, :], axis=-1)
    along = np.diagonal(_shares(V[:-1], V[1:]), axis1=-2, axis2=-1)
    V[1:] *= np.cumprod(np.where(along < 0.0, -1.0, 1.0), axis=0)[:, None, :]
    return assemble(eigenvalues, V, f_u)


def aligned(f_y: ArrayLike, f_u: ArrayLike, like: AuxiliarySpace) -> AuxiliarySpace:
    """Decompose with the order and signs that are nearest to those of one other space, (n, n).

    Args:
        f_y: Jacobians in `y` [1/s], (..., n, n).
        f_u: Jacobians in `u`, (..., n, n).
        like: The space to be near to, (n, n).
    """
    f_y, f_u = checked_pair(f_y, f_u)
    eigenvalues, V = real_eigenbasis(f_y)
    shares = _shares(inverse(like.T_y), V)
    order = _step_orders(shares.reshape(-1, like.n, like.n)).reshape(eigenvalues.shape)
    V = np.take_along_axis(V, order[..., None, :], axis=-1)
    along = np.diagonal(_shares(inverse(like.T_y), V), axis1=-2, axis2=-1)
    V = V * np.where(along < 0.0, -1.0, 1.0)[..., None, :]
    return assemble(np.take_along_axis(eigenvalues, order, axis=-1), V, f_u)


def jumps(spaces: Callable[[Array], AuxiliarySpace], low: Array, high: Array) -> bool:
    """Whether an eigenvector turns by over 60 degrees from one point to the next inside a box.

    Looked at on 256 straight lines of 25 points between random points of the box.
    """
    a, b = np.random.default_rng(2).uniform(low, high, (2, 256, len(low)))
    y = a + np.linspace(0, 1, 25)[:, None, None] * (b - a)
    V = np.linalg.inv(np.broadcast_to(spaces(y).T_y, (*y.shape, y.shape[-1])))
    V = V / np.linalg.norm(V, axis=-2, keepdims=True)
    return bool(((V[1:] * V[:-1]).sum(axis=-2) < 0.5).any())


def _shares(before: Array, after: Array) -> Array:
    """Components of the new eigenvectors in the old basis, columns of unit norm.

    Biorthogonal, so that even nearly parallel eigenvectors are told apart.
    """
    coefficients = np.linalg.solve(before, after)
    return coefficients / np.linalg.norm(coefficients, axis=-2, keepdims=True)


def _assign(shares: Array) -> np.ndarray:
    """For each old eigenvector, the index of the new one that continues it."""
    return linear_sum_assignment(np.abs(shares), maximize=True)[1]


def _step_orders(shares: Array) -> np.ndarray:
    """`_assign` for every step at once, (time - 1, n)."""
    # where every old vector has its own largest share, no assignment can do better
    orders = np.abs(shares).argmax(axis=-1)
    clash = np.any(np.sort(orders, axis=-1) != np.arange(shares.shape[-1]), axis=-1)
    for k in np.flatnonzero(clash):
        orders[k] = _assign(shares[k])
    return orders


def _chain(step_orders: np.ndarray) -> np.ndarray:
    """Compose the orders of single steps into the order at each time, (time, n)."""
    n = step_orders.shape[-1]
    order = np.tile(np.arange(n), (len(step_orders) + 1, 1))
    changes = np.flatnonzero(np.any(step_orders != np.arange(n), axis=-1))
    ends = np.append(changes[1:], len(step_orders))
    for k, end in zip(changes, ends, strict=False):
        order[k + 1 : end + 1] = step_orders[k][order[k]]
    return order


def _degenerate(eigenvalues: Array, f_y: ArrayLike) -> np.ndarray:
    gap = np.abs(eigenvalues[..., 1:] - eigenvalues[..., :-1]).min(axis=-1, initial=np.inf)
    return gap <= DEGENERATE * np.abs(f_y).max(axis=(-2, -1))


def _realign(eigenvalues: Array, V: Array, before: Array, f_y: ArrayLike) -> Array:
    """Choose, in each plane of equal eigenvalues, the basis nearest to the eigenvectors before."""
    V, tolerance = V.copy(), DEGENERATE * np.abs(f_y).max()
    edges = np.flatnonzero(np.abs(np.diff(eigenvalues)) > tolerance) + 1
    for group in np.split(np.arange(len(eigenvalues)), edges):
        if len(group) > 1:
            parts = np.linalg.solve(V, before)[group]
            near = np.sort(np.argsort(-np.linalg.norm(parts, axis=0))[: len(group)])
            plane = V[:, group] @ parts[:, near]
            V[:, group] = plane / np.linalg.norm(plane, axis=0)
    return V
