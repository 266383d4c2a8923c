"""Exercise of lesson 09: scale gains until the sampled loop is stable."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close
from cmc.theory.sampled import sampled_matrix


@check("09-slope-cap")
def slope_cap(answer: Callable[..., float]) -> None:
    """Judge `my_factor(k1, k2, tau, K, h)`: at most 1, and at most 98 % of the sampled limit."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        tau, K, h = rng.uniform(0.005, 0.05), rng.uniform(1.0, 60.0), rng.uniform(0.002, 0.02)
        k1, k2 = rng.uniform(0.01, 3.0) / K, rng.uniform(0.1, 300.0) / K
        factor = float(answer(k1, k2, tau, K, h))
        expect(0.0 < factor <= 1.0, f"the factor should be in (0, 1], it is {factor}")

        def radius(share: float, loop: tuple[float, ...] = (k1, k2, tau, K, h)) -> float:
            k1, k2, tau, K, h = loop
            step = sampled_matrix(share * k1, share * k2, -1 / tau, K / tau, h)
            return float(np.abs(np.linalg.eigvals(step)).max())

        expect(radius(factor) < 1.0, f"the scaled loop is unstable for K = {K:.3g}, h = {h:.3g} s")
        if factor < 1.0:
            expect_close(radius(factor / 0.98), 1.0, "spectral radius at the limit", rtol=1e-6)
        else:
            expect(radius(1.0 / 0.98) < 1.0, "a factor of 1 needs 2 % of room below the limit")
