"""Exercise of lesson 08: the transform that undoes the slope of the surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close
from cmc.plants import Peg


@check("08-undo-the-slope")
def undo_the_slope(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_T_y(stiffness, slope)`: the peg's T_y, unit diagonal, slow mode first."""
    rng = np.random.default_rng(0)
    for stiffness, size in zip((1.0, 12.0, 31.0), (0.01, 0.2, -0.3), strict=True):
        peg = Peg(K_sur=stiffness, surface_sin=size, surface_cos=-0.5 * size)
        x = rng.uniform(1.0, 3.0)
        y = np.array([x, -1.0])
        T_y = np.asarray(answer(stiffness, float(peg.surface_slope(x))), dtype=float)
        expect(T_y.shape == (2, 2), f"T_y should be 2 x 2, it is {T_y.shape}")
        expect_close(np.diag(T_y), [1.0, 1.0], "the diagonal of T_y")
        Lambda = T_y @ peg.f_y(y, peg.hold(y)) @ np.linalg.inv(T_y)
        wanted = np.diag([-1.0 / peg.tau_x, -1.0 / peg.tau_z])
        expect_close(Lambda, wanted, "T_y f_y T_y^-1, slow mode first")
