"""Exercises of lesson 00: a rate, the slope of a network, and slopes to choose."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cmc import plants
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
        found, right = answer(A.copy()), -np.linalg.eigvals(A).real.max()
        expect(not np.iscomplexobj(found), f"for {name} the rate should be real: use real parts")
        expect(np.ndim(found) == 0, f"for {name} one number is wanted, the slowest of the rates")
        expect(
            abs(float(found) + right) > 1e-9, f"for {name} the sign is wrong: decay counts positive"
        )
        expect_close(found, right, f"the rate of {name}", rtol=1e-8)


@check("00-slope")
def slope(answer: Callable[..., np.ndarray]) -> None:
    """Judge `slope(s, W, w)`: d/ds_1 of w . tanh(W s), (..., 2) to (...)."""
    rng = np.random.default_rng(0)
    W, w, s = rng.normal(size=(5, 2)), rng.normal(size=5), rng.normal(size=(4, 3, 2))
    step = np.array([1e-6, 0.0])
    sides = [np.tanh((s + sign * step) @ W.T) @ w for sign in (1.0, -1.0)]
    wanted = (sides[0] - sides[1]) / 2e-6
    found = np.asarray(answer(s.copy(), W.copy(), w.copy()), dtype=float)
    expect(
        found.shape == (4, 3),
        f"for s of shape (4, 3, 2) the slopes should have shape (4, 3), yours have {found.shape}",
    )
    chained = (w * (1.0 - np.tanh(s @ W.T) ** 2)).sum(-1)
    expect(not np.allclose(found, chained), "the inner derivative W[:, 0] is missing")
    expect_close(found, wanted, "the slope", rtol=1e-6, atol=1e-8)


@check("00-design")
def design(answer: Sequence[float]) -> None:
    """Judge two slopes of the coupled lags, at most 2 each, whose loop decays at 0.9 1/s."""
    sizes = np.asarray(answer, dtype=float)
    expect(sizes.shape == (2,), f"two numbers are wanted, got shape {sizes.shape}")
    expect((sizes <= 2.0).all(), f"neither slope may be above 2, yours are {sizes.tolist()}")
    space = plants.get("coupled_lags").space()
    found = -np.linalg.eigvals(space.loop(space.signed(*sizes))).real.max()
    expect(found > 0.0, "this loop does not decay at all: both slopes count positive here")
    expect(found >= 0.9, f"the rate should be 0.9 1/s or more, yours gives {found:.3f} 1/s")
