"""Exercises of lesson 03: a harmless coupling, a hierarchy's metric, the feedback gain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("03-harmless-coupling")
def harmless_coupling(answer: Callable[[float, float], float]) -> None:
    """Judge `my_limit(a, b)`: the largest c for which [[-a, c], [c, -b]] does not grow."""
    for a, b in ((1.0, 1.0), (0.5, 2.0), (0.3, 0.1), (4.0, 0.25)):
        found = answer(a, b)
        expect(found is not None, "my_limit returns None; does it end with return?")
        expect(
            abs(found - a * b) > 1e-9 or abs(a * b - np.sqrt(a * b)) < 1e-9,
            f"a b is the square of the limit, got {found:.4g} for a = {a}, b = {b}",
        )
        growth = [
            np.linalg.eigvalsh([[-a, c], [c, -b]])[-1] for c in (0.999 * found, 1.001 * found)
        ]
        expect(
            growth[0] < 0.0 < growth[1],
            f"for a = {a}, b = {b} the loop {'already grows' if growth[0] >= 0 else 'still decays'}"
            f" at c = {found:.4g}",
        )


@check("03-hierarchy-metric")
def hierarchy_metric(answer: float) -> None:
    """Judge k: in diag(I, k I) the hierarchy at strength 4 contracts at 0.3 1/s."""
    k = float(answer)
    expect(k > 0.0, "k must be positive, or there is no metric")
    first, second = [[-1.0, 1.2], [-0.8, -0.4]], [[-0.6, 0.9], [-1.1, -0.8]]
    F = np.block([[np.array(first), 4.0 * np.array([[0.6, 1.0], [0.9, 0.4]])], [np.zeros((2, 4))]])
    F[2:, 2:] = second
    M = np.diag([1.0, 1.0, k, k])
    left = np.linalg.eigvalsh(F.T @ M + M @ F + 0.6 * M)[-1]
    expect(left <= 1e-9 * k, f"k = {k:g} does not show 0.3 1/s: give the free module more weight")


@check("03-feedback-gain")
def feedback_gain(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_B(s, w, p, q)`: couplings skew and the symmetric part of F negative definite."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        s, w = -rng.uniform(0.1, 2.0), rng.uniform(0.1, 5.0)
        p, q = -rng.uniform(0.1, 2.0, (2, 2))
        B = np.asarray(answer(s, w, p.copy(), q.copy()), dtype=float)
        expect(B.shape == (2, 2), f"B should be 2 x 2, yours has shape {B.shape}")
        b = np.array([[p[0] * s - q[0], p[1] * w], [-p[0] * w, p[1] * s - q[1]]])
        expect(not np.allclose(B, b.T), "that is the transpose: b_12 belongs to the slope p_2")
        A, P, Q = np.array([[s, w], [-w, s]]), np.diag(p), np.diag(q)
        F = np.block([[A, B], [P @ A + Q, P @ B]])[np.ix_([0, 2, 1, 3], [0, 2, 1, 3])]
        residue = float(np.abs(F[:2, 2:] + F[2:, :2].T).max())
        expect(residue < 1e-9, f"the couplings should be skew; F_12 + F_21^T has {residue:.3g}")
        growth = float(np.linalg.eigvalsh(F + F.T)[-1]) / 2.0
        expect(growth < 0.0, f"the symmetric part should be negative, it has {growth:.3g}")
        expect_close(B, b, "B")
