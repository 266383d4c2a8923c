"""Two ways to combine modules so that stable ones stay stable: hierarchical and feedback.

Hierarchical: the coupling goes one way (real eigenvalues). Feedback: the coupling of i into j is
minus the transpose of j into i, so that it moves no energy (complex pairs). The paper leaves the
feedback form open; the closed forms here are this project's own.

Order of a hierarchy: the explicit solution empties the blocks below the diagonal (module 1 listens
to all, module n to none), where the paper's section on combinations empties the upper right one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from cmc.theory.auxiliary import AuxiliarySpace, decompose, inverse, triangularize
from cmc.theory.rotations import coupling_skewness, feedback, feedback_gain, real_block_form
from cmc.theory.simulate import equilibrium, transforms_of
from cmc.theory.spectrum import checked_pair, checked_square, raise_complex
from cmc.theory.tracking import jumps

__all__ = [
    "Possibility",
    "block_schur",
    "coupling_skewness",
    "feedback",
    "feedback_gain",
    "possible_combinations",
    "real_block_form",
    "schur",
    "transforms_that_fit",
]


def schur(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Return a hierarchy with orthogonal transforms: Lambda and R both upper triangular.

    `f_y = U S U^T`, `T_y = U^T`: real eigenvalues suffice, eigenvectors need not exist, and
    cond(T_y) is 1. Lambda couples the modules then, but still one way only, so theorem 2 holds
    unchanged.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (n, n), with real eigenvalues.
        f_u: Jacobian of the plant in `u`, (n, n), invertible.

    Raises:
        ComplexEigenvalueError: If `f_y` has a complex pair.
        SingularInputError: If `f_u` is singular.
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit, are a batch, or an entry is not finite.

    Source: our own addition; the paper asks for a diagonalizable `f_y`.
    """
    f_y, f_u = checked_pair(f_y, f_u)
    if f_y.ndim != 2:
        raise ValueError(f"schur takes one system, (n, n), got {f_y.shape}")
    S, U = scipy.linalg.schur(f_y, output="real")
    below = np.diagonal(S, -1)
    if np.any(below != 0.0):
        k = int(np.flatnonzero(below)[0])
        raise_complex(float(S[k, k]), float(np.sqrt(-S[k, k + 1] * S[k + 1, k])))
    T_a, R = triangularize(U.T @ f_u)
    return AuxiliarySpace(U.T, T_a, S, R)


def block_schur(f_y: ArrayLike, f_u: ArrayLike) -> AuxiliarySpace:
    """Return a hierarchy of single modes and feedback pairs, from the real Schur form; R = I.

    `f_y = U S U^T` with blocks of size 1 and 2 on the diagonal of S. Each 2x2 block, a complex
    pair, is scaled to `[[s, w], [-w, s]]`, so that inside it modules are coupled as in `feedback`
    and between blocks one way only. It exists for every `f_y`, defective complex pairs included,
    and every invertible `f_u`: `T_a = (T_y f_u)^-1`.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (n, n).
        f_u: Jacobian of the plant in `u`, (n, n), invertible.

    Raises:
        SingularInputError: If `f_u` is singular.
        ValueError: If shapes do not fit, are a batch, or an entry is not finite.

    Source: our own.
    """
    f_y, f_u = checked_pair(f_y, f_u)
    if f_y.ndim != 2:
        raise ValueError(f"block_schur takes one system, (n, n), got {f_y.shape}")
    S, U = scipy.linalg.schur(f_y, output="real")
    scale = np.ones(len(S))
    for k in np.flatnonzero(np.diagonal(S, -1)):  # LAPACK leaves [[s, b], [c, s]] with b c < 0
        scale[k + 1] = np.sqrt(-S[k, k + 1] / S[k + 1, k])
        if S[k, k + 1] < 0:
            scale[k + 1] *= -1  # w > 0
    T_y = scale[:, None] * U.T
    Lambda = scale[:, None] * S / scale
    return AuxiliarySpace(T_y, inverse(T_y @ f_u), Lambda, np.eye(len(S)))


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
    """Say which combinations exist for one pair of Jacobians, each with its reason.

    Args:
        f_y: Jacobian of the plant in `y` [1/s], (n, n).
        f_u: Jacobian of the plant in `u`, (n, n).

    Returns:
        hierarchical, schur, feedback (policies), feedback (constant slopes), block schur.

    Raises:
        TypeError: If the entries are not real numbers.
        ValueError: If shapes do not fit, are a batch, or an entry is not finite.
    """
    if np.ndim(f_y) != 2:
        raise ValueError(f"one plant at a time, f_y of shape (n, n), got {np.shape(f_y)}")
    real = float(np.linalg.eigvals(checked_square(f_y, "f_y")).real.max())
    floor = "" if real < 0.0 else f"; |d pi/dz| must exceed {real:.6g} everywhere (slope floor)"
    roads: tuple[tuple[str, Callable[..., AuxiliarySpace], str], ...] = (
        ("hierarchical", decompose, "f_y has real eigenvectors, so that couplings go one way"),
        ("schur", schur, "f_y has real eigenvalues, so that a rotation makes it triangular"),
        (
            "feedback (policies)",
            feedback,
            "T_a = (T_y f_u)^-1 leaves rotations as the only couplings; one metric has to be found "
            f"for slopes that vary{floor}",
        ),
        (
            "feedback (constant slopes)",
            lambda f_y, f_u: feedback(f_y, f_u, -np.ones((len(f_y), 2))),
            "every real part is negative, so that all couplings can be made skew",
        ),
        (
            "block schur",
            block_schur,
            f"a rotation leaves single modes and pairs, coupled one way{floor}",
        ),
    )
    return tuple(_try(name, reason, partial(build, f_y, f_u)) for name, build, reason in roads)


def _try(name: str, reason: str, build: Callable[[], Any]) -> Possibility:
    try:
        return Possibility(name, True, reason, build())
    except (ValueError, np.linalg.LinAlgError) as error:
        return Possibility(name, False, str(error))


def transforms_that_fit(plant: Any, points: int = 200) -> tuple[Possibility, ...]:
    """Say which transforms fit a plant in its whole box, in the order in which to try them.

    Looked at on random points of the box, at the commands that hold them.

    Args:
        plant: Has `n`, `f`, `f_y`, `f_u`, `y_low`, `y_high`, `constant`.
        points: How many points.

    Returns:
        own order, reversed order: T_y is the identity or turns the order round, where f_y and f_u
        are triangular as they are. eigenvectors at every state: the explicit solution, followed
        from the middle of the box. eigenvectors of the middle, feedback, block schur: kept fixed;
        off the middle they no longer fit exactly, which only an exact certificate sees.
    """
    low, high = np.asarray(plant.y_low, dtype=float), np.asarray(plant.y_high, dtype=float)
    y = np.concatenate(
        [[(low + high) / 2], np.random.default_rng(0).uniform(low, high, (points, plant.n))]
    )
    try:
        u = equilibrium(plant, y)
        f_y, f_u = checked_pair(plant.f_y(y, u), plant.f_u(y, u))
    except ValueError as error:
        return (Possibility("any", False, str(error)),)
    eye = np.eye(plant.n)
    found = []
    for name, T in (("own order", eye), ("reversed order", eye[::-1])):
        below = np.abs(np.tril(T @ f_y @ T, -1)) + np.abs(np.tril(T @ f_u @ T, -1))
        i, j = np.unravel_index(np.argmax(below.max(axis=0)), below.shape[1:])
        reason = "f_y and f_u are triangular: no signal drives one that comes after it"
        if below.max() > 0:
            order = np.arange(plant.n) if T is eye else np.arange(plant.n)[::-1]
            reason = f"signal {order[j] + 1} drives signal {order[i] + 1}, against the order"
        space = AuxiliarySpace(T, T, T @ f_y[0] @ T, T @ f_u[0] @ T)
        found.append(Possibility(name, not below.max() > 0, reason, space))

    def at_every_state() -> None:
        if not plant.constant and jumps(transforms_of(plant, None, y[0]), low, high):
            raise ValueError("order or sign of the eigenvectors jumps: two eigenvalues meet")
        decompose(f_y, f_u)

    found.append(
        _try(
            "eigenvectors at every state",
            "f_y has real eigenvectors at all points that were looked at",
            at_every_state,
        )
    )
    kept = "" if plant.constant else ", kept: exact in the middle of the box only"
    fixed: tuple[tuple[str, Callable[..., AuxiliarySpace]], ...] = (
        ("eigenvectors of the middle", decompose),
        ("feedback", feedback),
        ("block schur", block_schur),
    )
    for name, build in fixed:
        found.append(_try(name, f"they exist{kept}", partial(build, f_y[0], f_u[0])))
    return tuple(found)
