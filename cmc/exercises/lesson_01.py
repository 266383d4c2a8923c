"""Exercises of lesson 01: the rate in a metric, a metric to design, and where nothing contracts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from cmc.exercises import check, expect

_LEANING = np.array([[-1.0, 8.0], [0.0, -1.5]])


@check("01-rate-in-a-metric")
def rate_in_a_metric(answer: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """Judge `my_rate(J, M)`: the largest beta with J^T M + M J <= -2 beta M."""
    eye = np.eye(2)
    plain = answer(-2.0 * eye, eye)
    expect(plain is not None, "my_rate returns None; does it end with return?")
    expect(not np.iscomplexobj(plain), "the rate should be real: use eigvalsh or .real")
    expect(float(plain) > 0.0, "J = -2 I decays at 2 1/s: the rate counts decay positive")
    expect(abs(float(plain) - 4.0) > 1e-9, "J = -2 I gives 4: the symmetric part has a half")
    expect(abs(float(plain) - 2.0) < 1e-9, f"J = -2 I, M = I should give 2, yours is {plain:.6g}")
    expect(
        float(answer(_LEANING, eye)) < 0,
        "J = [[-1, 8], [0, -1.5]] grows in the identity metric although its eigenvalues are "
        "negative: it is the symmetric part that counts",
    )
    rng = np.random.default_rng(0)
    for size in (2, 3, 4):
        root = rng.normal(size=(size, size)) + 2 * np.eye(size)
        M, J = root.T @ root, rng.normal(size=(size, size)) - 2 * np.eye(size)
        beta = float(answer(J.copy(), M.copy()))
        lower = np.linalg.cholesky(M)
        slip = lower @ J @ np.linalg.inv(lower)
        expect(
            abs(beta + np.linalg.eigvalsh((slip + slip.T) / 2)[-1]) > 1e-9,
            "numpy's Cholesky factor L is lower, M = L L^T; Theta with M = Theta^T Theta is its "
            "transpose",
        )
        # independent of any formula: beta is right if the inequality holds there and not beyond
        slack = -np.linalg.eigvalsh(J.T @ M + M @ J + 2 * beta * M).max()
        scale = np.linalg.norm(M)
        expect(slack > -1e-7 * scale, f"in a {size} x {size} metric your rate is too large")
        expect(slack < 1e-7 * scale, f"in a {size} x {size} metric your rate is too small")


@check("01-metric-design")
def metric_design(answer: float) -> None:
    """Judge d: diag(1, d) proves 0.8 1/s for [[-1, 8], [0, -1.5]], and sqrt(d) is at most 11."""
    d = float(answer)
    expect(d > 0.0, "d must be positive, or M is no metric")
    expect(np.sqrt(d) <= 11.0, f"sqrt(d) should be at most 11, yours is {np.sqrt(d):.2f}")
    M = np.diag([1.0, d])
    left = np.linalg.eigvalsh(_LEANING.T @ M + M @ _LEANING + 1.6 * M)[-1]
    expect(left <= 1e-9, f"diag(1, {d:g}) does not prove 0.8 1/s: the overshoot it allows is small")


@check("01-no-contraction")
def no_contraction(answer: ArrayLike) -> None:
    """Judge two neighboring starts of a damped pendulum that end at different rests."""
    pair = np.asarray(answer, dtype=float)
    expect(pair.shape == (2, 2), f"two starts (angle, rate) are wanted, got shape {pair.shape}")
    near = float(np.linalg.norm(pair[0] - pair[1]))
    expect(near <= 0.2, f"the starts should be at most 0.2 apart, yours are {near:.3f}")

    def pendulum(_: float, s: np.ndarray) -> list[float]:
        return [s[1], -s[1] - np.sin(s[0])]

    ends = [solve_ivp(pendulum, (0.0, 30.0), s, rtol=1e-9, atol=1e-9).y[:, -1] for s in pair]
    far = float(np.linalg.norm(ends[0] - ends[1]))
    expect(far > 6.0, f"after 30 s they are {far:.2f} apart: look near the upper rest, angle pi")
