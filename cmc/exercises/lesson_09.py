"""Exercises of lesson 09: the clipped surrogate, a cap on the slopes, the first bad period."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close
from cmc.theory.sampled import sampled_matrix

Array = NDArray[np.float64]


@check("09-surrogate")
def surrogate(answer: Callable[[Array, Array, float], float]) -> None:
    """Judge `my_surrogate(r, A, clip)`: the mean of min(r A, clip(r, 1 - c, 1 + c) A)."""
    for r, A, what in (
        (1.5, 1.0, "likelier and good: the gain stops at 1.2"),
        (0.5, -1.0, "unlikelier and bad: the gain stops at -0.8"),
        (1.5, -1.0, "likelier and bad: nothing is cut, or it could not be undone"),
        (0.5, 1.0, "unlikelier and good: nothing is cut, or it could not be undone"),
    ):
        wanted = min(r * A, float(np.clip(r, 0.8, 1.2)) * A)
        found = answer(np.array([r]), np.array([A]), 0.2)
        expect_close(found, wanted, f"the surrogate at r = {r}, A = {A:+.0f} ({what})")
    rng = np.random.default_rng(0)
    ratios, gains = rng.lognormal(sigma=0.4, size=50), rng.normal(size=50)
    wanted = float(np.minimum(ratios * gains, np.clip(ratios, 0.7, 1.3) * gains).mean())
    expect_close(answer(ratios, gains, 0.3), wanted, "the mean over 50 samples at clip 0.3")


@check("09-slope-cap")
def slope_cap(answer: Callable[..., float]) -> None:
    """Judge `my_factor(k1, k2, tau, K, h)`: at most 1, and at most 98 % of the sampled limit."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        tau, K, h = rng.uniform(0.005, 0.05), rng.uniform(1.0, 60.0), rng.uniform(0.002, 0.02)
        k1, k2 = rng.uniform(0.01, 3.0) / K, rng.uniform(0.1, 300.0) / K
        used = (k1 + h / 2 * k2) * K * np.tanh(h / (2 * tau))
        found = answer(k1, k2, tau, K, h)
        expect(found is not None, "the factor is None; does your function return something?")
        factor = float(found)
        expect(0.0 < factor <= 1.0, f"the factor should be in (0, 1], it is {factor:.3g}")
        expect(
            _radius(factor * k1, factor * k2, tau, K, h) < 1.0,
            f"the scaled loop is unstable for K = {K:.3g} N/m, h = {1e3 * h:.3g} ms: it uses "
            f"{factor * used:.0%} of its bound",
        )
        expect_close(factor * used, min(used, 0.98), "the used share of the bound")


@check("09-period")
def period(answer: Callable[[float, float, float, float], float]) -> None:
    """Judge `my_period(k1, k2, tau, K)`: stable just below, unstable just above."""
    for k1, k2, tau, K in (
        (0.02, 4.0, 0.01, 62.0),
        (0.06, 1.0, 0.01, 31.0),
        (3.0, 20.0, 0.04, 1.0),
    ):
        found = answer(k1, k2, tau, K)
        expect(found is not None, "the period is None; does your function return something?")
        h = float(found)
        expect(1e-4 < h < 0.2, f"wanted seconds between 0.0001 and 0.2, yours is {h:.3g}")
        expect(_radius(k1, k2, tau, K, 0.99 * h) < 1.0, f"at {1e3 * h:.3g} ms it rattles already")
        expect(_radius(k1, k2, tau, K, 1.01 * h) > 1.0, f"beyond {1e3 * h:.3g} ms it is still calm")


def _radius(k1: float, k2: float, tau: float, K: float, h: float) -> float:
    """Spectral radius of the held loop."""
    step = sampled_matrix(k1, k2, -1 / tau, K / tau, h)
    return float(np.abs(np.linalg.eigvals(step)).max())
