"""Exercise of lesson 04: the explicit solution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect


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
        low = float(np.abs(np.tril(T_y @ f_u @ T_a, -1)).max())
        expect(low < 1e-8, f"R has {low:.3g} below its diagonal: did you transpose before QR?")
        skewed = float(np.abs(T_a.T @ T_a - np.eye(n)).max())
        expect(skewed < 1e-8, f"T_a should be orthogonal, T_a^T T_a is off by {skewed:.3g}")
