"""Exercise of lesson 00: the rate at which two trajectories of a linear system approach."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("00-rate")
def rate(answer: Callable[[np.ndarray], float]) -> None:
    """Judge `rate(A)`: the slowest rate, in 1/s, at which trajectories of y' = A y approach.

    It is minus the largest real part of the eigenvalues of A.
    """
    cases = {
        "a diagonal matrix": np.diag([-1.0, -3.0]),
        "a full matrix": np.array([[-2.0, 1.0], [1.0, -2.0]]),
        "a spiral": np.array([[-0.5, 2.0], [-2.0, -0.5]]),
        "an unstable matrix": np.array([[0.25, 0.0], [5.0, -1.0]]),
    }
    for name, A in cases.items():
        found = answer(A.copy())
        expect(not np.iscomplexobj(found), f"for {name} the rate should be real: use real parts")
        expect_close(found, -np.max(np.linalg.eigvals(A).real), f"the rate of {name}", rtol=1e-8)
