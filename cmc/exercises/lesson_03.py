"""Exercise of lesson 03: the gain of the feedback combination of a complex pair."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect


@check("03-feedback-gain")
def feedback_gain(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_B(s, w, p, q)`: couplings skew and the symmetric part of F negative definite."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        s, w = -rng.uniform(0.1, 2.0), rng.uniform(0.1, 5.0)
        p, q = -rng.uniform(0.1, 2.0, (2, 2))
        B = np.asarray(answer(s, w, p.copy(), q.copy()), dtype=float)
        expect(B.shape == (2, 2), f"B should be 2 x 2, yours has shape {B.shape}")
        A, P, Q = np.array([[s, w], [-w, s]]), np.diag(p), np.diag(q)
        F = np.block([[A, B], [P @ A + Q, P @ B]])[np.ix_([0, 2, 1, 3], [0, 2, 1, 3])]
        residue = float(np.abs(F[:2, 2:] + F[2:, :2].T).max())
        expect(residue < 1e-9, f"the couplings should be skew; F_12 + F_21^T has {residue:.3g}")
        growth = float(np.linalg.eigvalsh(F + F.T)[-1]) / 2.0
        expect(growth < 0.0, f"the symmetric part should be negative, it has {growth:.3g}")
