"""Exercises of lesson 04: the explicit solution, slope floors, a module to design."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("04-transforms")
def transforms(answer: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    """Judge `my_transforms(f_y, f_u)`: Lambda diagonal, R upper triangular, T_a orthogonal."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        V = np.eye(n) + 0.3 * rng.normal(size=(n, n))
        f_y = V @ np.diag(-np.arange(1.0, n + 1)) @ np.linalg.inv(V)
        f_u = rng.normal(size=(n, n))
        found = answer(f_y.copy(), f_u.copy())
        expect(isinstance(found, tuple) and len(found) == 2, "return two matrices: T_y, T_a")
        T_y, T_a = (np.asarray(m, dtype=float) for m in found)
        for name, matrix in (("T_y", T_y), ("T_a", T_a)):
            expect(matrix.shape == (n, n), f"{name} should be {n} x {n}, yours is {matrix.shape}")
        Lambda = T_y @ f_y @ np.linalg.inv(T_y)
        off = float(np.abs(Lambda - np.diag(np.diag(Lambda))).max())
        expect(off < 1e-8, f"Lambda has {off:.3g} off its diagonal: is T_y the inverse of V?")
        skewed = float(np.abs(T_a.T @ T_a - np.eye(n)).max())
        expect(skewed < 1e-8, f"T_a should be orthogonal, T_a^T T_a is off by {skewed:.3g}")
        R = T_y @ f_u @ T_a
        _explain(R, T_y @ f_u, T_a, float(np.abs(np.tril(R, -1)).max()))


def _explain(R: np.ndarray, W: np.ndarray, T_a: np.ndarray, low: float) -> None:
    """Say which slip left entries of size `low` below the diagonal of R = W T_a."""
    if low < 1e-8:
        return
    P = np.eye(len(W))[::-1]
    untransposed = np.linalg.qr(P @ W)[0]
    slips = {
        "R is lower triangular: P, ones on the skew diagonal, is missing": np.triu(R, 1),
        "R is triangular but for the order of its columns: T_a = Q P lacks P": np.tril(R @ P, -1),
        "that is the QR of P W; transpose first: W^T P": np.abs(T_a) - np.abs(untransposed @ P),
    }
    for sentence, residue in slips.items():
        expect(np.abs(residue).max() > 1e-8, sentence)
    expect(False, f"R has {low:.3g} below its diagonal: decompose (T_y f_u)^T P = Q R_qr")


@check("04-floor")
def floor(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_floor(Lambda, R)`: max(0, Lambda_ii) / |R_ii|, by the trace of the module."""
    rng = np.random.default_rng(0)
    for n in (2, 3):
        Lambda = np.diag(rng.uniform(-2.0, 2.0, n))
        Lambda[0, 0], R = 1.5, np.triu(rng.normal(size=(n, n))) + np.eye(n)
        R[0, 0] = -0.7
        found = np.asarray(answer(Lambda.copy(), R.copy()), dtype=float)
        expect(found.shape == (n,), f"one number for each module: shape ({n},), not {found.shape}")
        expect((found >= 0.0).all(), "no floor is negative: divide by |R_ii|, and cut at 0")
        for i in range(n):
            for factor in (0.99, 1.01):
                trace = Lambda[i, i] - abs(R[i, i]) * factor * found[i]
                holds = trace < 0.0
                right = factor > 1.0 or Lambda[i, i] < 0.0
                expect(
                    holds == right,
                    f"Lambda_ii = {Lambda[i, i]:.3g}, R_ii = {R[i, i]:.3g}: {factor} times your "
                    f"floor {found[i]:.3g} {'meets' if holds else 'misses'} the first inequality",
                )
        expect_close(found, np.maximum(np.diag(Lambda), 0) / np.abs(np.diag(R)), "the floor")


@check("04-module")
def module(answer: Sequence[float]) -> None:
    """Judge p, q: with Lambda = -1, R = 2 both eigenvalues of F_ii are -3."""
    pair = np.asarray(answer, dtype=float)
    expect(pair.shape == (2,), f"two numbers p, q are wanted, got shape {pair.shape}")
    p, q = pair
    expect(p < 0.0 and q < 0.0, "R = 2 is positive, so both slopes are negative")
    trace, det = -1.0 + 2.0 * p, -2.0 * q
    expect(abs(trace + 6.0) < 1e-6, f"the trace should be -6, -1 + 2 p is {trace:.4g}")
    expect(abs(det - 9.0) < 1e-6, f"the determinant should be 9, -2 q is {det:.4g}")
