"""Search for one quadratic metric in which every one of several matrices contracts.

Wanted is M > 0 with J_v^T M + M J_v < 0 for every vertex J_v (or A_v^T M A_v - M < 0 for steps of a
sampled loop): a linear matrix inequality. Because it is linear in J, it then holds on the whole
convex hull of the vertices. An interior-point method with a logarithmic barrier decides it either
way: it stops at a metric, or at a duality gap that proves that none exists up to a given
condition number (Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities, 1994).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import matrix_balance, solve_continuous_lyapunov, solve_discrete_lyapunov

Array = NDArray[np.float64]

_CONDITION = 1e6
# A metric worse than this is left as it is: what could be gained is lost in rounding.
_HOPELESS = 1e14
_GAP = 1e-7


@dataclass(frozen=True)
class MetricSearch:
    """Outcome of a search.

    Attributes:
        metric: M, symmetric positive definite, smallest eigenvalue 1, (m, m); None if there is
            none.
        worst: Index of the vertex that resists most.
    """

    metric: Array | None
    worst: int


def search_metric(vertices: ArrayLike, *, discrete: bool = False) -> MetricSearch:
    """Find M > 0 with J^T M + M J < 0 for every vertex, or A^T M A < M with `discrete`.

    Args:
        vertices: Matrices, (V, m, m).
        discrete: Whether the vertices are steps of a sampled loop.

    Raises:
        ValueError: if the vertices have a wrong shape or are not finite.
    """
    J = np.asarray(vertices, dtype=float)
    if J.ndim != 3 or not len(J) or J.shape[1] != J.shape[2]:
        raise ValueError(f"vertices needs shape (V, m, m) with V >= 1, got {J.shape}")
    if not np.isfinite(J).all():
        raise ValueError("vertices needs finite entries")
    growth = _growth(J, discrete)
    worst = int(np.argmax(growth))
    if growth[worst] >= 0 or _growth(J.mean(axis=0), discrete) >= 0:
        # a common metric would make every convex combination decay, the mean among them
        return MetricSearch(None, worst)
    try:
        theta = _mean_metric_factor(J.mean(axis=0), discrete)
        metric, worst = _feasible(_operators(theta @ J @ np.linalg.inv(theta), discrete))
    except np.linalg.LinAlgError:  # further apart in size than floats can tell
        return MetricSearch(None, worst)
    if metric is None:
        return MetricSearch(None, worst)
    return MetricSearch(_scaled(theta.T @ metric @ theta), worst)


def condition_metric(vertices: ArrayLike, metric: ArrayLike, *, discrete: bool = False) -> Array:
    """Improve a common metric: the one with the smallest condition number, (m, m).

    Minimises kappa subject to the inequalities and I <= M <= kappa I, from a metric that meets
    them, to within 2 %. A smaller condition number is a smaller bound on the transient.

    Args:
        vertices: Matrices, (V, m, m), as in `search_metric`.
        metric: A common metric of the vertices, (m, m).
        discrete: Whether the vertices are steps of a sampled loop.

    Raises:
        ValueError: if the given metric is not a common metric of the vertices.
    """
    J, start = np.asarray(vertices, dtype=float), _scaled(np.asarray(metric, dtype=float))
    if np.linalg.cond(start) > _HOPELESS:
        return start
    theta = np.linalg.cholesky(start).T
    operators = _operators(theta @ J @ np.linalg.inv(theta), discrete)
    m, d = start.shape[0], operators.shape[1]
    E, inverse = _basis(m), np.linalg.inv(theta)
    unit = inverse.T @ inverse  # the identity of the original coordinates, seen from the local ones
    x = np.append(1.01 * np.einsum("dii->d", E), 1.1 * 1.01 * np.linalg.cond(start))
    if np.linalg.eigvalsh(np.einsum("vdij,d->vij", operators, x[:d])).max() >= 0:
        raise ValueError("the metric to start from is not a common metric of the vertices")
    A, C = np.zeros((len(J) + 2, d + 1, m, m)), np.zeros((len(J) + 2, m, m))
    A[:-2, :d], A[-2, :d], A[-1, :d] = -operators, E, -E
    A[-1, d], C[-2] = unit, -unit
    weight = 1 / x[d]
    while True:
        x = _center(A, C, weight * np.eye(d + 1)[d], x)
        if A.shape[0] * m / weight < 0.02 * x[d]:
            return _scaled(theta.T @ np.tensordot(x[:d], E, 1) @ theta)
        weight *= 8.0


def _scaled(metric: Array) -> Array:
    """The symmetric part, with a smallest eigenvalue of 1."""
    metric = (metric + metric.T) / 2
    smallest = np.linalg.eigvalsh(metric)[0]
    return metric / (smallest if smallest > 0 else np.diag(metric).min())


def _growth(J: Array, discrete: bool) -> Array:
    """Below 0 exactly where the matrix alone decays, (...,)."""
    eigenvalues = np.linalg.eigvals(J)
    return np.abs(eigenvalues).max(-1) - 1 if discrete else eigenvalues.real.max(-1)


def _mean_metric_factor(J: Array, discrete: bool) -> Array:
    """Theta of a metric of the mean vertex: in those coordinates the search starts near.

    The units of the coordinates are balanced first: by the matrix, then by the metric's diagonal.
    """
    eye, units = np.eye(len(J)), 1 / matrix_balance(J, permute=False, separate=True)[1][0]
    size = 1.0 if discrete else float(np.abs(np.linalg.eigvals(J)).max())
    for _ in range(3):
        local = J * units[:, None] / units / size
        solve = solve_discrete_lyapunov if discrete else solve_continuous_lyapunov
        metric = solve(local.T, eye if discrete else -eye)
        if not (np.diag(metric) > 0).all():
            raise np.linalg.LinAlgError("the mean vertex has no metric in floats")
        scale = np.sqrt(np.diag(metric))
        units = units * scale
    metric = (metric + metric.T) / 2 / scale / scale[:, None]
    return np.linalg.cholesky(metric).T * units


def _basis(m: int) -> Array:
    """Basis of the symmetric m x m matrices, (m (m + 1) / 2, m, m)."""
    i, j = np.triu_indices(m)
    basis = np.zeros((len(i), m, m))
    basis[np.arange(len(i)), i, j] = 1.0
    basis[np.arange(len(i)), j, i] = 1.0
    return basis


def _operators(J: Array, discrete: bool) -> Array:
    """Left-hand sides of the inequality for every basis matrix, scaled to 1, (V, d, m, m)."""
    E = _basis(J.shape[-1])[None]
    J = J[:, None]
    Jt = np.swapaxes(J, -1, -2)
    operators = Jt @ E @ J - E if discrete else Jt @ E + E @ J
    # every inequality may be scaled by its own positive factor
    return operators / np.sqrt((operators**2).sum(axis=(1, 2, 3), keepdims=True))


def _feasible(operators: Array) -> tuple[Array | None, int]:
    """Minimise t subject to operator_v(P) <= t I and I <= P <= condition I; stop at its sign."""
    d, m = operators.shape[1], operators.shape[-1]
    E, eye = _basis(m), np.eye(m)
    A, C = np.zeros((len(operators) + 2, d + 1, m, m)), np.zeros((len(operators) + 2, m, m))
    A[:-2, :d], A[-2, :d], A[-1, :d] = -operators, E, -E
    A[:-2, d], C[-2], C[-1] = eye, -eye, _CONDITION * eye
    x = np.append(2.0 * np.einsum("dii->d", E), 0.0)  # P = 2 I

    def residuals(x: Array) -> Array:
        return np.linalg.eigvalsh(np.einsum("vdij,d->vij", operators, x[:d]))[:, -1]

    x[d] = residuals(x).max() + 0.1
    weight = 1.0
    while True:
        x = _center(A, C, weight * np.eye(d + 1)[d], x, until=lambda x: residuals(x).max() < -_GAP)
        growth = residuals(x)
        worst = int(np.argmax(growth))
        if growth[worst] < -_GAP:
            return np.tensordot(x[:d], E, 1), worst
        if x[d] - len(A) * m / weight > -_GAP:  # a lower bound on the best t: no metric
            return None, worst
        weight *= 8.0


def _center(
    A: Array, C: Array, cost: Array, x: Array, until: Callable[[Array], bool] = lambda x: False
) -> Array:
    """Newton's method on cost . x - sum log det(C_k + sum_d x_d A_kd), from a point inside."""
    here = _value(A, C, cost, x)
    for _ in range(60):
        if until(x):
            break
        W = np.linalg.inv(C + np.einsum("kdij,d->kij", A, x))[:, None] @ A
        gradient = cost - np.einsum("kdii->d", W)
        flat = W.transpose(1, 0, 2, 3).reshape(W.shape[1], -1)
        hessian = flat @ W.transpose(1, 0, 3, 2).reshape(W.shape[1], -1).T
        scale = 1 / np.sqrt(np.diag(hessian))
        scaled = hessian * scale * scale[:, None]
        move = -scale * np.linalg.lstsq(scaled, scale * gradient, rcond=None)[0]
        decrement, length = float(-gradient @ move), 1.0
        if decrement < 1e-3:
            break
        while (ahead := _value(A, C, cost, x + length * move)) > here - 0.1 * length * decrement:
            length /= 2
            if length < 1e-10:
                return x
        x, here = x + length * move, ahead
    return x


def _value(A: Array, C: Array, cost: Array, x: Array) -> float:
    """The barrier function; infinity outside the constraints."""
    try:
        factors = np.linalg.cholesky(C + np.einsum("kdij,d->kij", A, x))
    except np.linalg.LinAlgError:
        return np.inf
    return float(cost @ x) - 2 * float(np.log(np.einsum("kii->ki", factors)).sum())
