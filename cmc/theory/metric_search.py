"""Search for one quadratic metric in which every one of several matrices contracts.

Wanted is M > 0 with J_v^T M + M J_v < 0 for every vertex J_v (or A_v^T M A_v - M < 0 for steps of a
sampled loop): a linear matrix inequality. Because it is linear in J, it then holds on the whole
convex hull of the vertices. An interior-point method with a logarithmic barrier decides it either
way: it stops at a metric, or at a duality gap that proves that none exists up to a given
condition number (Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities, 1994).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import (
    cho_factor,
    cho_solve,
    matrix_balance,
    solve_continuous_lyapunov,
    solve_discrete_lyapunov,
)

from cmc.theory.arrays import Array, checked
from cmc.theory.contraction import metric_factor

_CONDITION = 1e6
# A metric worse than this is left as it is: what could be gained is lost in rounding.
_HOPELESS = 1e14
_GAP = 1e-7


def search_metric(vertices: ArrayLike, *, discrete: bool = False) -> tuple[Array | None, int]:
    """Find M > 0 with J^T M + M J < 0 for every vertex, or A^T M A < M with `discrete`.

    Returns:
        M (m, m) with a smallest eigenvalue of 1, or None if there is none, and the index of the
        vertex (V, m, m) that resists most.
    """
    J = checked("vertices", vertices, "V m m")
    growth = _growth(J, discrete)
    worst = int(np.argmax(growth))
    if growth[worst] >= 0 or _growth(J.mean(axis=0), discrete) >= 0:
        # a common metric would make every convex combination decay, the mean among them
        return None, worst
    try:
        theta = _mean_metric_factor(J.mean(axis=0), discrete)
        metric, worst = _feasible(theta @ J @ np.linalg.inv(theta), discrete)
    except np.linalg.LinAlgError:  # further apart in size than floats can tell
        return None, worst
    return None if metric is None else _scaled(theta.T @ metric @ theta), worst


def condition_metric(vertices: ArrayLike, metric: ArrayLike, *, discrete: bool = False) -> Array:
    """Improve a common metric: the one with the smallest condition number, (m, m).

    Minimises kappa subject to the inequalities and I <= M <= kappa I, from a metric that meets
    them, to within 2 %. A smaller condition number is a smaller bound on the transient.
    Arguments as of `search_metric`.
    """
    J = checked("vertices", vertices, "V m m")
    metric_factor(metric)
    start = _scaled(checked("metric", metric, "m m", m=J.shape[-1]))
    if np.linalg.cond(start) > _HOPELESS:
        return start
    theta = np.linalg.cholesky(start).T
    inverse = np.linalg.inv(theta)
    # the identity of the original coordinates, seen from the local ones, is the floor of P
    barrier = _Barrier(theta @ J @ inverse, discrete, inverse.T @ inverse, free=False)
    x = np.append(1.01 * np.eye(len(start))[barrier.at], 1.1 * 1.01 * np.linalg.cond(start))
    if barrier.growth(x).max() >= 0:
        raise ValueError("the metric to start from is not a common metric of the vertices")
    weight = 1 / x[-1]
    while True:
        x = barrier.center(weight, x)
        if (len(J) + 2) * len(start) / weight < 0.02 * x[-1]:
            return _scaled(theta.T @ x[barrier.index] @ theta)
        weight *= 8.0


def _scaled(metric: Array) -> Array:
    """The symmetric part, with a smallest eigenvalue of 1."""
    metric = (metric + metric.T) / 2
    smallest = np.linalg.eigvalsh(metric)[0]
    return metric / (smallest if smallest > 0 else np.diag(metric).min())  # 0 but for rounding


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


def _feasible(J: Array, discrete: bool) -> tuple[Array | None, int]:
    """Minimise t subject to growth_v(P) <= t I and I <= P <= condition I; stop at its sign."""
    m = J.shape[-1]
    barrier = _Barrier(J, discrete, np.eye(m), free=True)
    x = np.append(2.0 * np.eye(m)[barrier.at], 0.0)  # P = 2 I
    x[-1] = barrier.growth(x).max() + 0.1
    weight = 1.0
    while True:
        x = barrier.center(weight, x, until=lambda x: barrier.growth(x).max() < -_GAP)
        growth = barrier.growth(x)
        worst = int(np.argmax(growth))
        if growth[worst] < -_GAP:
            return x[barrier.index], worst
        if x[-1] - (len(J) + 2) * m / weight > -_GAP:  # a lower bound on the best t: no metric
            return None, worst
        weight *= 8.0


class _Barrier:
    """weight s - log det of all that has to stay positive definite, in x = (P, s).

    These are B < P at the bottom, and growth_v(P) = D^T P K + K^T P D at each vertex: J^T P + P J
    with D = J, K = I, and A^T P A - P with D = A - I, K = I + D/2. With `free` growth_v < s I and
    P < condition B, otherwise growth_v < 0 and P < s B.
    """

    def __init__(self, J: Array, discrete: bool, bottom: Array, *, free: bool) -> None:
        self.m, self.bottom, self.free = len(bottom), bottom, free
        self.eye, self.at = np.eye(self.m), np.triu_indices(self.m)
        self.index = np.empty((self.m, self.m), dtype=int)  # where x holds each entry of P
        self.index[self.at] = self.index.T[self.at] = np.arange(len(self.at[0]))
        basis = (self.index == np.arange(len(self.at[0]))[:, None, None]).astype(float)
        self.basis = basis.reshape(len(basis), -1)
        D = J - self.eye if discrete else J
        self.K = self.eye + D / 2 if discrete else np.broadcast_to(self.eye, J.shape)
        self.KT = _transposed(self.K)
        image = _transposed(D)[:, None] @ basis @ self.K[:, None]
        size = np.sqrt(np.square(image + _transposed(image)).sum(axis=(1, 2, 3)))
        self.D = D / size[:, None, None]  # every inequality may be scaled by a positive factor
        self.DT = _transposed(self.D)

    def growth(self, x: Array) -> Array:
        """Largest eigenvalue of each growth_v(P), (V,)."""
        half = self.DT @ x[self.index] @ self.K
        return np.asarray(np.linalg.eigvalsh(half + _transposed(half))[:, -1], dtype=float)

    def _positive(self, x: Array) -> Array:
        """All matrices that have to stay positive definite, (V + 2, m, m)."""
        P, s = x[self.index], x[-1]
        half = self.DT @ P @ self.K
        found = np.empty((len(half) + 2, self.m, self.m))
        found[:-2] = (s if self.free else 0.0) * self.eye - half - _transposed(half)
        found[-2] = P - self.bottom
        found[-1] = (_CONDITION if self.free else s) * self.bottom - P
        return found

    def value(self, weight: float, x: Array) -> float:
        """The barrier function; infinity outside the constraints."""
        try:
            factors = np.linalg.cholesky(self._positive(x))
        except np.linalg.LinAlgError:
            return np.inf
        return float(weight * x[-1]) - 2 * float(np.log(np.einsum("kii->ki", factors)).sum())

    def derivatives(self, weight: float, x: Array) -> tuple[Array, Array]:
        """Gradient and Hessian at x: -tr(W dS), and tr(W dS W dS) with W = S^-1."""
        W = np.linalg.inv(self._positive(x))
        inner, low, top = W[:-2], W[-2], W[-1]
        N = self.D @ inner @ self.KT
        slope = 2 * N.sum(axis=0) - low + top
        if self.free:
            square = inner @ inner
            mixed = -2 * (self.D @ square @ self.KT).sum(axis=0)
            first, second = np.einsum("vii->", inner), np.einsum("vii->", square)
        else:
            turned = top @ self.bottom
            mixed, first, second = -turned @ top, np.trace(turned), np.trace(turned @ turned)
        # sum of tr(X P Y R) over pairs (P, R), in the entries of X and of Y
        P = np.concatenate([2 * N, 2 * self.K @ inner @ self.KT, W[-2:]])
        R = np.concatenate([N, self.D @ inner @ self.DT, W[-2:]])
        m, d = self.m, len(x) - 1
        curved = (P.reshape(-1, m * m).T @ R.reshape(-1, m * m)).reshape(m, m, m, m)
        hessian = np.empty((d + 1, d + 1))
        curved = curved.transpose(3, 0, 1, 2).reshape(m * m, -1)
        hessian[:d, :d] = self.basis @ curved @ self.basis.T
        hessian[:d, d] = hessian[d, :d] = self.basis @ mixed.ravel()
        hessian[d, d] = second
        return np.append(self.basis @ slope.ravel(), weight - first), hessian

    def squares(self, x: Array) -> Array:
        """The Hessian as a sum of squares: slower, and positive semidefinite whatever rounds."""
        root = np.linalg.inv(np.linalg.cholesky(self._positive(x)))[:, None]
        basis = self.basis.reshape(-1, self.m, self.m)
        image = self.DT[:, None] @ basis @ self.K[:, None]
        moved = np.zeros((len(root), len(x), self.m, self.m))
        moved[:-2, :-1], moved[-2, :-1] = -image - _transposed(image), basis
        moved[-1, :-1] = -basis
        if self.free:
            moved[:-2, -1] = self.eye
        else:
            moved[-1, -1] = self.bottom
        flat = (root @ moved @ _transposed(root)).transpose(1, 0, 2, 3).reshape(len(x), -1)
        return np.asarray(flat @ flat.T)

    def center(
        self, weight: float, x: Array, until: Callable[[Array], bool] = lambda x: False
    ) -> Array:
        """Newton's method from a point inside."""
        here = self.value(weight, x)
        for _ in range(60):
            if until(x):
                break
            gradient, hessian = self.derivatives(weight, x)
            try:
                scale = 1 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
                scaled = cho_factor(hessian * scale * scale[:, None])
                move = -scale * cho_solve(scaled, scale * gradient)
            except np.linalg.LinAlgError:  # not positive definite to rounding
                hessian = self.squares(x)
                scale = 1 / np.sqrt(np.diag(hessian))
                scaled = hessian * scale * scale[:, None]
                move = -scale * np.linalg.lstsq(scaled, scale * gradient, rcond=None)[0]
            decrement, length = float(-gradient @ move), 1.0
            if decrement < 1e-3:
                break
            while (
                ahead := self.value(weight, x + length * move)
            ) > here - 0.1 * length * decrement:
                length /= 2
                if length < 1e-10:
                    return x
            x, here = x + length * move, ahead
        return x


def _transposed(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)
