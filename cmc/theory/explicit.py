"""The explicit solution, compiled: eigenvalues, sorting, inverse and QR of many small systems.

`f_y = V Lambda V^-1`, `T_y = V^-1`, `W = T_y f_u = R T_a^T` with R upper triangular. Anything that
is not plain (a complex or repeated eigenvalue, a singular f_u, a number that is not finite) is left
to `cmc.theory.auxiliary.decompose`, which takes its time to say why.
"""

# mypy: disable-error-code="no-untyped-def,misc"
from __future__ import annotations

import numpy as np

from cmc.theory.arrays import compiled

MAX_CONDITION = 2e7
"""Above this condition of `V` (about 1/sqrt(eps)) a matrix counts as defective."""


@compiled
def basis_of(A, w, V):
    """Write eigenvalues (descending) and eigenvectors of one real (n, n) matrix to w and V.

    Returns False where a 2x2 matrix has no real basis; a larger one raises ValueError.
    """
    n = len(A)
    if n == 1:
        w[0] = A[0, 0]
        V[0, 0] = 1.0
        return True
    if n == 2:
        scale = max(abs(A[0, 0]), abs(A[0, 1]), abs(A[1, 0]), abs(A[1, 1]), 1e-300)
        mean, h = 0.5 * (A[0, 0] + A[1, 1]) / scale, 0.5 * (A[0, 0] - A[1, 1]) / scale
        b, c = A[0, 1] / scale, A[1, 0] / scale
        disc = h * h + b * c
        if max(abs(h), abs(b), abs(c)) <= 1e-15:  # a multiple of I: every basis will do
            w[:] = mean * scale
            V[0, 0] = V[1, 1] = 1.0
            V[0, 1] = V[1, 0] = 0.0
            return True
        if disc <= 0.0:
            return False
        root = np.sqrt(disc)
        p = abs(h) + root  # no cancellation
        if h < 0.0:
            V[0, 0], V[1, 0], V[0, 1], V[1, 1] = b, p, -p, c
        else:
            V[0, 0], V[1, 0], V[0, 1], V[1, 1] = p, c, -b, p
        w[0], w[1] = (mean + root) * scale, (mean - root) * scale
    else:
        found, X = np.linalg.eig(A)
        order = np.argsort(-found)
        for j in range(n):
            w[j] = found[order[j]]
            V[:, j] = X[:, order[j]]
    for j in range(n):
        largest, square = 0.0, 0.0
        for i in range(n):
            square += V[i, j] ** 2
            if abs(V[i, j]) > abs(largest):
                largest = V[i, j]
        V[:, j] /= np.sqrt(square) if largest >= 0.0 else -np.sqrt(square)
    return True


@compiled
def bases_of(f_y, w, V):
    """Write the bases of (N, n, n) matrices; False where one has none."""
    good = True
    for k in range(len(f_y)):
        good = good and basis_of(f_y[k], w[k], V[k])
    return good


@compiled
def invert(A, X):
    """Gauss and Jordan with row pivots: write A^-1 to X; False where a pivot is zero."""
    n, A = len(A), A.copy()
    for i in range(n):
        for j in range(n):
            X[i, j] = 1.0 if i == j else 0.0
    for c in range(n):
        p = c
        for i in range(c + 1, n):
            if abs(A[i, c]) > abs(A[p, c]):
                p = i
        if A[p, c] == 0.0:
            return False
        for j in range(n):
            A[c, j], A[p, j] = A[p, j], A[c, j]
            X[c, j], X[p, j] = X[p, j], X[c, j]
        pivot = A[c, c]
        for j in range(n):
            A[c, j] /= pivot
            X[c, j] /= pivot
        for i in range(n):
            if i != c:
                factor = A[i, c]
                for j in range(n):
                    A[i, j] -= factor * A[c, j]
                    X[i, j] -= factor * X[c, j]
    return True


@compiled
def triangular_of(W, T_a, R):
    """Gram and Schmidt from the last row of W up, twice each: R = W T_a upper triangular.

    Returns the smallest share of a row that the rows after it leave over.
    """
    n, least = len(W), 1.0
    v = np.empty(n)
    for i in range(n - 1, -1, -1):
        v[:] = W[i]
        length = np.sqrt((v * v).sum())
        for _ in range(2):
            for j in range(i + 1, n):
                dot = 0.0
                for m in range(n):
                    dot += v[m] * T_a[m, j]
                for m in range(n):
                    v[m] -= dot * T_a[m, j]
        rest = np.sqrt((v * v).sum())
        least = min(least, rest / length) if length > 0.0 else 0.0
        for m in range(n):
            T_a[m, i] = v[m] / rest
        for j in range(n):
            R[i, j] = 0.0
        R[i, i] = rest
        for j in range(i + 1, n):
            for m in range(n):
                R[i, j] += W[i, m] * T_a[m, j]
    return least


@compiled
def spaces_of(f_y, f_u, arrays):
    """Write T_y, T_a, Lambda, R, (4, N, n, n); False where something is wrong with some system."""
    N, n = f_y.shape[:2]
    w, V, W = np.empty(n), np.empty((n, n)), np.empty((n, n))
    T_y, T_a, Lambda, R = arrays[0], arrays[1], arrays[2], arrays[3]
    for k in range(N):
        total = 0.0
        for i in range(n):
            for j in range(n):
                total += 0.0 * (f_y[k, i, j] + f_u[k, i, j])
        if total != 0.0 or not basis_of(f_y[k], w, V) or not invert(V, T_y[k]):
            return False  # NaN is not 0 either
        there, back = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                there += V[i, j] ** 2
                back += T_y[k, i, j] ** 2
        if there * back > MAX_CONDITION**2:
            return False  # the general road looks closer
        for i in range(n):
            for j in range(n):
                total = 0.0
                for m in range(n):
                    total += T_y[k, i, m] * f_u[k, m, j]
                W[i, j] = total
        if triangular_of(W, T_a[k], R[k]) <= 1e-9:
            return False
        Lambda[k] = 0.0
        for i in range(n):
            Lambda[k, i, i] = w[i]
    return True
