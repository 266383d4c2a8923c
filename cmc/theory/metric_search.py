"""Search for one quadratic metric in which every one of several matrices contracts.

Wanted is M > 0 with J_v^T M + M J_v < 0 for every vertex J_v (or A_v^T M A_v - M < 0 for steps of a
sampled loop): a linear matrix inequality. Because it is linear in J, it then holds on the whole
convex hull of the vertices. An interior-point method with a logarithmic barrier decides it either
way: it stops at a metric, or at a duality gap that proves that none exists up to a given
condition number (Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities, 1994).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_continuous_lyapunov, solve_discrete_lyapunov

Array = NDArray[np.float64]

_CONDITION = 1e6
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
    theta = _mean_metric_factor(J.mean(axis=0), discrete)
    local = theta @ J @ np.linalg.inv(theta)
    metric, worst = _barrier(_operators(local, discrete))
    if metric is None:
        return MetricSearch(None, worst)
    metric = theta.T @ metric @ theta
    metric = (metric + metric.T) / 2
    return MetricSearch(metric / np.linalg.eigvalsh(metric)[0], worst)


def _growth(J: Array, discrete: bool) -> Array:
    """Below 0 exactly where the matrix alone decays, (...,)."""
    eigenvalues = np.linalg.eigvals(J)
    return np.abs(eigenvalues).max(-1) - 1 if discrete else eigenvalues.real.max(-1)


def _mean_metric_factor(J: Array, discrete: bool) -> Array:
    """Theta of a metric of the mean vertex: in those coordinates the search starts near."""
    eye = np.eye(len(J))
    solve = solve_discrete_lyapunov if discrete else solve_continuous_lyapunov
    metric = solve(J.T, eye if discrete else -eye)
    return np.linalg.cholesky((metric + metric.T) / 2).T


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


def _barrier(operators: Array) -> tuple[Array | None, int]:
    """Minimise t subject to operator_v(P) <= t I and I <= P <= condition I; stop at its sign."""
    m = operators.shape[-1]
    E, eye = _basis(m), np.eye(m)
    x = 2.0 * np.einsum("dii->d", E)  # P = 2 I
    t = float(np.linalg.eigvalsh(_apply(operators, x)).max()) + 0.1
    weight, constraints = 1.0, m * (len(operators) + 2)
    worst = 0
    for _ in range(60):
        for _ in range(50):
            x, t, decrement = _newton(operators, E, eye, x, t, weight)
            residual = np.linalg.eigvalsh(_apply(operators, x))[:, -1]
            worst = int(np.argmax(residual))
            if residual[worst] < -_GAP:
                return np.tensordot(x, E, 1), worst
            if decrement < 1e-3:
                break
        if t - constraints / weight > -_GAP:  # a lower bound on the best t: no metric
            return None, worst
        weight *= 8.0
    return None, worst


def _apply(operators: Array, x: Array) -> Array:
    return np.einsum("vdij,d->vij", operators, x)


def _newton(
    operators: Array, E: Array, eye: Array, x: Array, t: float, weight: float
) -> tuple[Array, float, float]:
    """One damped Newton step of weight t - sum log det; returns x, t and the squared decrement."""
    P = np.tensordot(x, E, 1)
    inverse = np.linalg.inv(t * eye - _apply(operators, x))
    W = inverse[:, None] @ operators
    low, high = np.linalg.inv(P - eye) @ E, np.linalg.inv(_CONDITION * eye - P) @ E
    d = len(x)
    gradient, hessian = np.empty(d + 1), np.empty((d + 1, d + 1))
    gradient[:d] = np.einsum("vdii->d", W) - np.einsum("dii->d", low) + np.einsum("dii->d", high)
    gradient[d] = weight - np.einsum("vii->", inverse)
    flat = np.concatenate([W, low[None], high[None]])
    hessian[:d, :d] = np.einsum("vaij,vbji->ab", flat, flat, optimize=True)
    hessian[:d, d] = hessian[d, :d] = -np.einsum("vdij,vji->d", W, inverse)
    hessian[d, d] = np.einsum("vij,vji->", inverse, inverse)
    scale = 1 / np.sqrt(np.diag(hessian))
    move = (
        -scale * np.linalg.lstsq(hessian * scale * scale[:, None], scale * gradient, rcond=None)[0]
    )
    decrement = float(-gradient @ move)
    here, length = _value(operators, E, eye, x, t, weight), 1.0
    while length > 1e-10:
        x_new, t_new = x + length * move[:d], t + length * float(move[d])
        if _value(operators, E, eye, x_new, t_new, weight) <= here - 0.1 * length * decrement:
            return x_new, t_new, decrement
        length /= 2
    return x, t, 0.0


def _value(operators: Array, E: Array, eye: Array, x: Array, t: float, weight: float) -> float:
    """The barrier function; infinity outside the constraints."""
    P = np.tensordot(x, E, 1)
    inside = np.concatenate([t * eye - _apply(operators, x), [P - eye, _CONDITION * eye - P]])
    try:
        factors = np.linalg.cholesky(inside)
    except np.linalg.LinAlgError:
        return np.inf
    return weight * t - 2 * float(np.log(np.einsum("vii->vi", factors)).sum())
