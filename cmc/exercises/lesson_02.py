"""Exercises of lesson 02: relative gains, the angle of T_a, F, theorem 1."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cmc.exercises import check, expect, expect_close


@check("02-relative-gain")
def relative_gain(answer: Callable[[np.ndarray], np.ndarray]) -> None:
    """Judge `my_relative_gain(f_u)`: entries f_u_ij (f_u^-1)_ji."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        G = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
        found = np.asarray(answer(G.copy()), dtype=float)
        expect(found.shape == (n, n), f"wanted shape {(n, n)}, yours has {found.shape}")
        inverse = np.linalg.inv(G)
        expect(not np.allclose(found, G * inverse), "the inverse has to be transposed")
        expect(
            not np.allclose(found, G @ inverse.T),
            "the product is taken entry by entry, * and not @",
        )
        # entry (i, j) is the gain of command j on signal i, all other loops open over all closed
        for i, j in np.ndindex(n, n):
            others = [k for k in range(n) if k != i], [k for k in range(n) if k != j]
            closed = np.linalg.det(G) / np.linalg.det(G[np.ix_(*others)]) * (-1.0) ** (i + j)
            expect_close(found[i, j], G[i, j] / closed, f"the relative gain at {(i, j)}", rtol=1e-8)


@check("02-angle")
def angle(answer: Callable[[np.ndarray], float]) -> None:
    """Judge `my_angle(W)`: degrees in [-90, 90] with c W_21 - s W_22 = 0."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        W = rng.normal(size=(2, 2))
        found = float(answer(W.copy()))
        expect(abs(found) <= 90.0, f"the angle should lie in [-90, 90] degrees, yours is {found}")
        c, s = np.cos(np.radians(found)), np.sin(np.radians(found))
        R = W @ np.array([[c, s], [-s, c]])
        if abs(R[1, 0]) > 1e-9:
            c, s = np.cos(found), np.sin(found)
            right = abs(c * W[1, 0] - s * W[1, 1]) < 1e-9
            expect(not right, "that is the angle in radians; wanted are degrees")
            c, s = np.cos(np.radians(found)), -np.sin(np.radians(found))
            right = abs(c * W[1, 0] - s * W[1, 1]) < 1e-9
            expect(not right, "right but for its sign: the matrix turns the other way")
        expect(abs(R[1, 0]) <= 1e-9, f"R_21 should vanish, with your angle it is {R[1, 0]:.3g}")


@check("02-differential-dynamics")
def differential_dynamics(answer: Callable[..., np.ndarray]) -> None:
    """Judge `my_F(Lambda, R, p, q)`: F of `inverse_solution` for constant transforms.

    It must be the Jacobian of (z', a') in (z, a), where a' = P z' + Q z.
    """
    rng = np.random.default_rng(0)
    for n in (3, 2, 1):
        Lambda, R = rng.normal(size=(2, n, n))
        p, q = rng.normal(size=(2, n))
        found = np.asarray(answer(Lambda.copy(), R.copy(), p.copy(), q.copy()), dtype=float)
        expect(found.shape == (2 * n, 2 * n), f"F should be {2 * n} x {2 * n} for n = {n}")
        A, B, C, D = found[:n, :n], found[:n, n:], found[n:, :n], found[n:, n:]
        expect_close(A, Lambda, "the block A")
        expect_close(B, R, "the block B")
        expect(not np.allclose(C, p[:, None] * Lambda), "C lacks the slopes q towards int z")
        slip = np.allclose(C, Lambda * p + np.diag(q)) or np.allclose(D, R * p)
        expect(n == 1 or not slip, "p * Lambda scales columns; P Lambda scales rows: np.diag(p)")
        d = rng.normal(size=2 * n)
        z_dot = Lambda @ d[:n] + R @ d[n:]
        expect_close((found @ d)[n:], p * z_dot + q * d[:n], "the rate of a, blocks C and D,")


@check("02-theorem-1")
def theorem_1(answer: Sequence[float]) -> None:
    """Judge p, q: for Lambda = -2, R = 1 theorem 1 gives at least 1.9 1/s."""
    pair = np.asarray(answer, dtype=float)
    expect(pair.shape == (2,), f"two numbers p, q are wanted, got shape {pair.shape}")
    p, q = pair
    expect(p < 0.0 and q < 0.0, f"R = 1 is positive, so both slopes are negative; yours: {p}, {q}")
    # symmetric part [[-2, b], [b, p]] with b = (1 - 2 p + q) / 2
    b = (1.0 - 2.0 * p + q) / 2.0
    rate = -(0.5 * (p - 2.0) + np.hypot(0.5 * (p + 2.0), b))
    expect(rate >= 1.9, f"theorem 1 gives {rate:.3f} 1/s; off the diagonal stands {b:.2f}")
