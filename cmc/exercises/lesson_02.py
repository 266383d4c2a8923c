"""Exercise of lesson 02: the differential dynamics in the auxiliary space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("02-differential-dynamics")
def differential_dynamics(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_F(Lambda, R, p, q)`: F of `inverse_solution` for constant transforms.

    It must be the Jacobian of (z', a') in (z, a), where a' = P z' + Q z.
    """
    rng = np.random.default_rng(0)
    for n in (1, 2, 3):
        Lambda, R = rng.normal(size=(2, n, n))
        p, q = rng.normal(size=(2, n))
        found = answer(Lambda.copy(), R.copy(), p.copy(), q.copy())
        expect(np.shape(found) == (2 * n, 2 * n), f"F should be {2 * n} x {2 * n} for n = {n}")
        d = rng.normal(size=2 * n)
        z_dot = Lambda @ d[:n] + R @ d[n:]
        rate = np.asarray(found) @ d
        expect_close(rate[:n], z_dot, "the rate of z, rows A and B")
        expect_close(rate[n:], p * z_dot + q * d[:n], "the rate of a, rows C and D")
