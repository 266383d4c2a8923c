"""Exercise of lesson 01: the rate of a Jacobian in a metric."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("01-rate-in-a-metric")
def rate_in_a_metric(answer: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """Judge `my_rate(J, M)`: the largest beta with J^T M + M J <= -2 beta M."""
    eye = np.eye(2)
    expect_close(answer(-2.0 * eye, eye), 2.0, "the rate of J = -2 I in the identity metric")
    J = np.array([[-1.0, 8.0], [0.0, -1.5]])
    expect(
        not np.iscomplexobj(answer(J, eye)),
        "the rate should be a real number: use eigvalsh or .real",
    )
    expect(
        np.real(answer(J, eye)) < 0,
        "J = [[-1, 8], [0, -1.5]] grows in the identity metric although its eigenvalues are "
        "negative: it is the symmetric part that counts",
    )
    rng = np.random.default_rng(0)
    for size in (2, 3, 4):
        root = rng.normal(size=(size, size)) + 2 * np.eye(size)
        M, J = root.T @ root, rng.normal(size=(size, size)) - 2 * np.eye(size)
        beta = float(answer(J.copy(), M.copy()))
        # independent of any formula: beta is right if the inequality holds there and not beyond
        slack = -np.linalg.eigvalsh(J.T @ M + M @ J + 2 * beta * M).max()
        scale = np.linalg.norm(M)
        expect(slack > -1e-7 * scale, f"in a {size} x {size} metric your rate is too large")
        expect(slack < 1e-7 * scale, f"in a {size} x {size} metric your rate is too small")
