"""The auxiliary space along a path: order, sign and scale of eigenvectors kept continuous.

Eigenvectors are free in order, sign and length. Sorted anew at each step they may swap or flip,
and then the integral of `z = T_y y` adds up different signals. Here each step is matched to the
one before by its eigenvectors, not by sorting eigenvalues: two eigenvalues may cross and each mode
keeps its own place. Lengths are one throughout. Errors are those of `decompose`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from cmc.theory.arrays import Array, checked
from cmc.theory.auxiliary import AuxiliarySpace, assemble, decompose

DEGENERATE = 1e-12
"""Eigenvalues closer than this fraction of max|f_y| share a plane in which any basis will do."""


class Tracker:
    """Decompose one step after another, each in the order and sign of the one before.

    The first call fixes the default choice of `decompose`. A step needs to be short: eigenvectors
    that turn by more than about 45 degrees cannot be followed.
    """

    _before: AuxiliarySpace | None = None

    def reset(self) -> None:
        """Forget the past: the next step fixes order and sign anew."""
        self._before = None

    def update(self, f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
        """Return the auxiliary space of this step; f_y [1/s] and f_u are (n, n)."""
        f_y, before = checked("f_y", f_y, "n n"), self._before
        if before is not None and before.n != len(f_y):
            raise ValueError(f"the size changed from {before.n} to {len(f_y)}: call reset()")
        self._before = decompose(f_y, f_u) if before is None else aligned(f_y, f_u, before)
        return self._before


def aligned(f_y: ArrayLike, f_u: ArrayLike, like: AuxiliarySpace) -> AuxiliarySpace:
    """Decompose (..., n, n) in the order and with the signs nearest to those of `like`, (n, n)."""
    space = decompose(f_y, f_u)
    V, eigenvalues = space.V, space.eigenvalues
    plane = _degenerate(eigenvalues, f_y)
    along = np.diagonal(_shares(like.T_y @ V), axis1=-2, axis2=-1)
    if along.min(initial=1.0) > 0.71 and not plane.any():  # the usual case: all are in place
        return space
    for k in np.argwhere(plane):
        at = tuple(k)
        V[at] = _realign(eigenvalues[at], V[at], like.V, np.broadcast_to(f_y, V.shape)[at])
    order = _orders(_shares(like.T_y @ V))
    V = np.take_along_axis(V, order[..., None, :], axis=-1)
    along = np.diagonal(like.T_y @ V, axis1=-2, axis2=-1)
    V = V * np.where(along < 0.0, -1.0, 1.0)[..., None, :]
    return assemble(np.take_along_axis(eigenvalues, order, axis=-1), V, np.asarray(f_u, float))


def track(f_y_path: ArrayLike, f_u_path: ArrayLike) -> AuxiliarySpace:
    """Decompose a whole path with order, sign and scale continuous in time, (time, n, n).

    The same answer as a `Tracker` fed step by step, but vectorised over time.
    The Jacobian in `u` may be (n, n), constant; those in `y` are in 1/s.
    """
    f_y, f_u = checked("f_y_path", f_y_path, "time n n"), checked("f_u_path", f_u_path)
    shape = "n n" if f_u.ndim == 2 else "time n n"
    f_u = checked("f_u_path", f_u, shape, time=len(f_y), n=f_y.shape[-1])
    space = decompose(f_y, f_u)
    V, eigenvalues = space.V, space.eigenvalues
    for k in np.flatnonzero(_degenerate(eigenvalues[1:], f_y[1:])) + 1:
        V[k] = _realign(eigenvalues[k], V[k], V[k - 1], f_y[k])
    order = np.tile(np.arange(f_y.shape[-1]), (len(f_y), 1))
    for i, step in enumerate(_orders(_shares(np.linalg.solve(V[:-1], V[1:])))):
        order[i + 1] = step[order[i]]
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
    V = np.take_along_axis(V, order[:, None, :], axis=-1)
    along = np.diagonal(np.linalg.solve(V[:-1], V[1:]), axis1=-2, axis2=-1)
    V[1:] *= np.cumprod(np.where(along < 0.0, -1.0, 1.0), axis=0)[:, None, :]
    return assemble(eigenvalues, V, f_u)


def jumps(spaces: Callable[[Array], AuxiliarySpace], low: Array, high: Array) -> bool:
    """Whether an eigenvector turns by over 60 degrees from one point to the next inside a box.

    Looked at on 256 straight lines of 25 points between random points of the box.
    """
    a, b = np.random.default_rng(2).uniform(low, high, (2, 256, len(low)))
    y = a + np.linspace(0, 1, 25)[:, None, None] * (b - a)
    V = np.broadcast_to(spaces(y).V, (*y.shape, y.shape[-1]))
    V = V / np.linalg.norm(V, axis=-2, keepdims=True)
    return bool(((V[1:] * V[:-1]).sum(axis=-2) < 0.5).any())


def _shares(coefficients: Any) -> Array:
    """Components of the new eigenvectors in the old basis, columns brought to unit norm.

    Biorthogonal, so that even nearly parallel eigenvectors are told apart.
    """
    return coefficients / np.linalg.norm(coefficients, axis=-2, keepdims=True)


def _orders(shares: Array) -> np.ndarray:
    """For each old eigenvector the index of the new one that continues it, (..., n)."""
    # where every old vector has its own largest share, no assignment can do better
    orders = np.abs(shares).argmax(axis=-1)
    clash = np.any(np.sort(orders, axis=-1) != np.arange(shares.shape[-1]), axis=-1)
    for k in np.argwhere(clash):
        at = tuple(k)
        orders[at] = linear_sum_assignment(np.abs(shares[at]), maximize=True)[1]
    return orders


def _degenerate(eigenvalues: Array, f_y: ArrayLike) -> np.ndarray:
    gap = np.abs(eigenvalues[..., 1:] - eigenvalues[..., :-1]).min(axis=-1, initial=np.inf)
    return gap <= DEGENERATE * np.abs(f_y).max(axis=(-2, -1))


def _realign(eigenvalues: Array, V: Array, before: Array, f_y: Array) -> Array:
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
