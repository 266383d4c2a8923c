"""Two ways to combine modules so that stable ones stay stable: hierarchical and feedback.

Hierarchical: the coupling goes one way (real eigenvalues). Feedback: the coupling of i into j is
minus the transpose of j into i, so that it moves no energy (complex pairs). The paper leaves the
feedback form open; the closed forms here are this project's own.

Order of a hierarchy: the explicit solution empties the blocks below the diagonal (module 1 listens
to all, module n to none), where the paper's section on combinations empties the upper right one.

Throughout f_y [1/s] and f_u are the plant's Jacobians, (..., n, n) or where one system is meant
(n, n), f_u invertible. `SingularInputError`, `ComplexEigenvalueError` and `DefectiveMatrixError`
say what a plant lacks; wrong shapes and entries that are not finite raise ValueError, or TypeError.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, not_overflown, together
from cmc.theory.auxiliary import AuxiliarySpace, decompose, triangularize
from cmc.theory.explicit import (
    MAX_CONDITION,
    ComplexEigenvalueError,
    DefectiveMatrixError,
    checked_pair,
)
from cmc.theory.simulate import equilibrium, transforms_of
from cmc.theory.tracking import jumps


def schur(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Return a hierarchy with orthogonal transforms, (n, n): Lambda and R both upper triangular.

    `f_y = U S U^T`, `T_y = U^T`: real eigenvalues suffice, eigenvectors need not exist, and
    cond(T_y) is 1. Lambda couples the modules then, but still one way only, so theorem 2 holds
    unchanged. Source: our own; the paper asks for a diagonalizable `f_y`.
    """
    f_y, f_u = checked_pair(f_y, f_u, "n n")
    S, U = scipy.linalg.schur(f_y, output="real")
    for k in np.flatnonzero(np.diagonal(S, -1)):
        raise ComplexEigenvalueError(complex(S[k, k], np.sqrt(-S[k, k + 1] * S[k + 1, k])))
    T_a, R = triangularize(U.T @ f_u)
    return AuxiliarySpace(U.T, T_a, S, R)


def block_schur(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Return a hierarchy of modes and feedback pairs from the real Schur form, (n, n); R = I.

    `f_y = U S U^T` with blocks of size 1 and 2 on the diagonal of S. Each 2x2 block, a complex
    pair, is scaled to `[[s, w], [-w, s]]`, so that inside it modules are coupled as in `feedback`
    and between blocks one way only. It exists for every `f_y`, defective complex pairs included:
    `T_a = (T_y f_u)^-1`. Source: our own.
    """
    f_y, f_u = checked_pair(f_y, f_u, "n n")
    S, U = scipy.linalg.schur(f_y, output="real")
    scale = np.ones(len(S))
    for k in np.flatnonzero(np.diagonal(S, -1)):  # LAPACK leaves [[s, b], [c, s]] with b c < 0
        scale[k + 1] = np.sqrt(-S[k, k + 1] / S[k + 1, k])
        if S[k, k + 1] < 0:
            scale[k + 1] *= -1  # w > 0
    T_y = scale[:, None] * U.T
    T_a = np.linalg.inv(T_y @ f_u)
    not_overflown("f_y and f_u", T_y, T_a)
    return AuxiliarySpace(T_y, T_a, scale[:, None] * S / scale, np.eye(len(S)))


def feedback(f_y: ArrayLike, f_u: ArrayLike, slopes: ArrayLike | None = None) -> AuxiliarySpace:
    """Return the feedback combination: `T_y` brings `f_y` to real block form, `T_a` follows.

    Without slopes, `T_a = (T_y f_u)^-1`, so R = I: the form for policies, whose slopes vary.
    Modules are coupled by the rotations of Lambda alone, which change no distance: with constant
    Pi_2 and `V = |dz|^2 - dI^T Pi_2 dI`, I = int z, `V' = 2 dz^T (sym(Lambda) + Pi_1) dz`. Real and
    complex eigenvalues may be mixed.

    With slopes, (..., n, 2), `T_a = (T_y f_u)^-1 B`, the block form of the paper's feedback
    combination: each pair `[[s, w], [-w, s]]` gets `B = [[p_1 s - q_1, p_2 w], [-p_1 w, p_2 s -
    q_2]]`, p and q the slopes. Then the coupling blocks are exactly skew and sym(F) < 0. It needs
    s < 0 and *constant* negative slopes: `T_a` depends on them, so with slopes that vary with the
    state it is a different system. Source: our own; the paper says that existence "needs further
    study".
    """
    f_y, f_u = checked_pair(f_y, f_u)
    T_y, Lambda = real_block_form(f_y)
    T_a, R = np.linalg.inv(T_y @ f_u), np.broadcast_to(np.eye(f_y.shape[-1]), T_y.shape)
    if slopes is not None:
        R = _block_gain(Lambda, slopes)
        T_a = np.matmul(*together(f_u=T_a, slopes=R))
    not_overflown("f_y and f_u", T_a, R)
    return AuxiliarySpace(*together(T_y=T_y, T_a=T_a, Lambda=Lambda, R=R))


def real_block_form(f_y: ArrayLike) -> tuple[Array, Array]:
    """Return `T_y` and `Lambda = T_y f_y T_y^-1`, block diagonal and real, each (..., n, n).

    A real eigenvalue is a 1x1 block, a pair s +- w j the block `[[s, w], [-w, s]]`, w > 0, with the
    columns Re v and Im v of a unit eigenvector v whose largest component is positive. Real parts
    descend.
    """
    f_y = checked("f_y", f_y, "... n n")
    eigenvalues, V = np.linalg.eig(f_y)
    eigenvalues, V = eigenvalues.astype(np.complex128), V.astype(np.complex128)
    # numpy lists a pair side by side, +w first; a stable sort by real part keeps it so
    order = np.argsort(-eigenvalues.real, axis=-1, kind="stable")
    eigenvalues = np.take_along_axis(eigenvalues, order, axis=-1)
    V = np.take_along_axis(V, order[..., None, :], axis=-1)
    if not (np.linalg.cond(V) <= MAX_CONDITION).all():
        raise DefectiveMatrixError
    largest = np.take_along_axis(V, np.abs(V).argmax(axis=-2)[..., None, :], axis=-2)
    V = V * (np.abs(largest) / largest)
    w, n = eigenvalues.imag, f_y.shape[-1]
    # f_y (Re v, Im v) = (Re v, Im v) [[s, w], [-w, s]]; the partner -w gives the column Im v
    basis = np.where(w[..., None, :] < 0.0, -V.imag, V.real)
    Lambda = np.zeros(f_y.shape)
    Lambda[..., range(n), range(n)] = eigenvalues.real
    i = np.arange(n - 1)
    Lambda[..., i, i + 1] = np.maximum(w[..., :-1], 0.0)
    Lambda[..., i + 1, i] = np.minimum(w[..., 1:], 0.0)
    return np.linalg.inv(basis), Lambda


def _block_gain(L: Array, slopes: ArrayLike) -> Array:
    """B = Pi_1 sym(Lambda) - Pi_2 + skew(Lambda) Pi_1 of `feedback`, (..., n, n)."""
    s, eye = checked("slopes", slopes, "... n 2", n=L.shape[-1]), np.eye(L.shape[-1])
    if not (s < 0.0).all():
        raise ValueError(f"slopes must be negative here (R_ii > 0), got a largest of {s.max():.6g}")
    real = np.diagonal(L, axis1=-2, axis2=-1)
    if not (real < 0.0).all():
        raise ValueError(
            f"the block form needs negative real parts, got {real.max():.6g} 1/s; use feedback("
            "f_y, f_u) without slopes, and policies steeper than slope_floor"
        )
    p, q, real = together(p=s[..., 0], q=s[..., 1], Lambda=real)
    B = L * (1.0 - eye) * p[..., None, :] + (p * real - q)[..., None, :] * eye
    not_overflown("slopes", B)
    return B


@dataclass(frozen=True)
class Possibility:
    """Whether a combination exists for a plant, and why."""

    name: str
    possible: bool
    reason: str
    """One sentence for a person."""
    transforms: Any = None
    """What `certify` and `closed_loop` take as `transforms`; None for their own choice."""


def possible_combinations(f_y: ArrayLike, f_u: ArrayLike) -> tuple[Possibility, ...]:
    """Say which combinations exist for one pair of Jacobians, (n, n) each, and why.

    Hierarchical, schur, feedback (policies), feedback (constant slopes), block schur.
    """
    f_y = checked("f_y", f_y, "n n")
    f_u = checked("f_u", f_u, "n n", n=len(f_y))
    real = float(np.linalg.eigvals(f_y).real.max())
    floor = "" if real < 0.0 else f"; |d pi/dz| must exceed {real:.6g} everywhere (slope floor)"
    steady = partial(feedback, slopes=-np.ones((len(f_y), 2)))
    turning = "T_a = (T_y f_u)^-1 leaves rotations as the only couplings; one metric has to be"
    still = "every real part is negative, so that all couplings can be made skew"
    pairs = "a rotation leaves single modes and pairs, coupled one way"
    roads: tuple[tuple[str, str, Callable[..., AuxiliarySpace]], ...] = (
        ("hierarchical", "f_y has real eigenvectors, so that couplings go one way", decompose),
        ("schur", "f_y has real eigenvalues, so that a rotation makes it triangular", schur),
        ("feedback (policies)", f"{turning} found for slopes that vary{floor}", feedback),
        ("feedback (constant slopes)", still, steady),
        ("block schur", f"{pairs}{floor}", block_schur),
    )
    return tuple(_try(*road, f_y, f_u) for road in roads)


def _try(name: str, reason: str, build: Callable[..., Any], *args: Any) -> Possibility:
    try:
        return Possibility(name, True, reason, build(*args))
    except ValueError as error:  # numpy's LinAlgError is one
        return Possibility(name, False, str(error))


def transforms_that_fit(plant: Any) -> tuple[Possibility, ...]:
    """Say which transforms fit a plant in its whole box, in the order in which to try them.

    Looked at on 200 random points of the box, at the commands that hold them.

    Returns:
        own order, reversed order: T_y is the identity or turns the order round, where f_y and f_u
        are triangular as they are. eigenvectors at every state: the explicit solution, followed
        from the middle of the box. eigenvectors of the middle, feedback, block schur: kept fixed;
        off the middle they no longer fit exactly, which only an exact certificate sees.
    """
    low, high = np.asarray(plant.y_low, dtype=float), np.asarray(plant.y_high, dtype=float)
    y = np.random.default_rng(0).uniform(low, high, (200, plant.n))
    y = np.concatenate([[(low + high) / 2], y])
    try:
        u = equilibrium(plant, y)
        f_y, f_u = checked_pair(plant.f_y(y, u), plant.f_u(y, u))
    except ValueError as error:
        return (Possibility("any", False, str(error)),)
    found = []
    for name, T in (("own order", np.eye(plant.n)), ("reversed order", np.eye(plant.n)[::-1])):
        below = np.abs(np.tril(T @ f_y @ T, -1)) + np.abs(np.tril(T @ f_u @ T, -1))
        i, j = np.unravel_index(np.argmax(below.max(axis=0)), below.shape[1:])
        reason = "f_y and f_u are triangular: no signal drives one that comes after it"
        if below.max() > 0:
            order = T.argmax(axis=1)
            reason = f"signal {order[j] + 1} drives signal {order[i] + 1}, against the order"
        space = AuxiliarySpace(T, T, T @ f_y[0] @ T, T @ f_u[0] @ T)
        found.append(Possibility(name, not below.max() > 0, reason, space))

    def at_every_state() -> None:
        if not plant.constant and jumps(transforms_of(plant, None, y[0]), low, high):
            raise ValueError("order or sign of the eigenvectors jumps: two eigenvalues meet")
        decompose(f_y, f_u)

    why = "f_y has real eigenvectors at all points that were looked at"
    found.append(_try("eigenvectors at every state", why, at_every_state))
    why = "they exist" + ("" if plant.constant else ", kept: exact in the middle of the box only")
    found.append(_try("eigenvectors of the middle", why, decompose, f_y[0], f_u[0]))
    found.append(_try("feedback", why, feedback, f_y[0], f_u[0]))
    return (*found, _try("block schur", why, block_schur, f_y[0], f_u[0]))
