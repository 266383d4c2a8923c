"""Exercises of lessons 00 to 04."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from cmc import plants
from cmc.exercises import check, expect, expect_close, numbers

# ---- lesson 00: a rate, the slope of a network, and slopes to choose


@check("00-rate")
def rate(answer: Any) -> None:
    """Judge `rate(A)`: the slowest rate, 1/s, at which trajectories of y' = A y approach."""
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
        slips = {f"for {name} the sign is wrong: decay counts positive": -right}
        expect_close(found, right, f"the rate of {name}", slips)


@check("00-slope")
def slope(answer: Any) -> None:
    """Judge `slope(s, W, w)`: d/ds_1 of w . tanh(W s), (..., 2) to (...)."""
    rng = np.random.default_rng(0)
    W, w, s = rng.normal(size=(5, 2)), rng.normal(size=5), rng.normal(size=(4, 3, 2))
    up, down = (np.tanh((s + [step, 0.0]) @ W.T) @ w for step in (1e-6, -1e-6))
    slips = {"the inner derivative W[:, 0] is missing": (w / np.cosh(s @ W.T) ** 2).sum(-1)}
    found = answer(s.copy(), W.copy(), w.copy())
    expect_close(found, (up - down) / 2e-6, "the slope", slips, atol=1e-8)


@check("00-design")
def design(answer: Any) -> None:
    """Judge two slopes of the coupled lags, at most 2 each, whose loop decays at 0.9 1/s."""
    sizes = numbers(answer, (2,), "the pair of slopes")
    expect((sizes <= 2.0).all(), f"neither slope may be above 2, yours are {sizes.tolist()}")
    space = plants.get("coupled_lags").space()
    found = -np.linalg.eigvals(space.loop(space.signed(*sizes))).real.max()
    expect(found > 0.0, "this loop does not decay at all: both slopes count positive here")
    expect(found >= 0.9, f"the rate should be 0.9 1/s or more, yours gives {found:.3f} 1/s")


# ---- lesson 01: the rate in a metric, a metric to design, and where nothing contracts


_LEANING = np.array([[-1.0, 8.0], [0.0, -1.5]])


@check("01-rate-in-a-metric")
def rate_in_a_metric(answer: Any) -> None:
    """Judge `my_rate(J, M)`: the largest beta with J^T M + M J <= -2 beta M."""
    eye = np.eye(2)
    plain = numbers(answer(-2.0 * eye, eye), (), "the rate")
    expect(not np.iscomplexobj(plain), "the rate should be real: use eigvalsh or .real")
    expect(plain > 0.0, "J = -2 I decays at 2 1/s: the rate counts decay positive")
    slips = {"J = -2 I gives 4: the symmetric part has a half": 4.0}
    expect_close(plain, 2.0, "the rate of J = -2 I, M = I", slips)
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
        slack = -np.linalg.eigvalsh(J.T @ M + M @ J + 2 * beta * M).max() / np.linalg.norm(M)
        expect(slack > -1e-7, f"in a {size} x {size} metric your rate is too large")
        expect(slack < 1e-7, f"in a {size} x {size} metric your rate is too small")


@check("01-metric-design")
def metric_design(answer: Any) -> None:
    """Judge d: diag(1, d) proves 0.8 1/s for [[-1, 8], [0, -1.5]], and sqrt(d) is at most 11."""
    d = float(answer)
    expect(d > 0.0, "d must be positive, or M is no metric")
    expect(np.sqrt(d) <= 11.0, f"sqrt(d) should be at most 11, yours is {np.sqrt(d):.2f}")
    M = np.diag([1.0, d])
    left = np.linalg.eigvalsh(_LEANING.T @ M + M @ _LEANING + 1.6 * M)[-1]
    expect(left <= 1e-9, f"diag(1, {d:g}) does not prove 0.8 1/s: the overshoot it allows is small")


@check("01-no-contraction")
def no_contraction(answer: Any) -> None:
    """Judge two neighboring starts of a damped pendulum that end at different rests."""
    pair = numbers(answer, (2, 2), "the pair of starts (angle, rate)")
    near = float(np.linalg.norm(pair[0] - pair[1]))
    expect(near <= 0.2, f"the starts should be at most 0.2 apart, yours are {near:.3f}")

    def pendulum(_: float, s: np.ndarray) -> list[float]:
        return [s[1], -s[1] - np.sin(s[0])]

    ends = [solve_ivp(pendulum, (0.0, 30.0), s, rtol=1e-9, atol=1e-9).y[:, -1] for s in pair]
    far = float(np.linalg.norm(ends[0] - ends[1]))
    expect(far > 6.0, f"after 30 s they are {far:.2f} apart: look near the upper rest, angle pi")


# ---- lesson 02: relative gains, the angle of T_a, F, theorem 1


@check("02-relative-gain")
def relative_gain(answer: Any) -> None:
    """Judge `my_relative_gain(f_u)`: entries f_u_ij (f_u^-1)_ji."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        G = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
        inverse, wanted = np.linalg.inv(G), np.empty((n, n))
        # entry (i, j) is the gain of command j on signal i, all other loops open over all closed
        for i, j in np.ndindex(n, n):
            minor = np.delete(np.delete(G, i, 0), j, 1)
            closed = np.linalg.det(G) / np.linalg.det(minor) * (-1.0) ** (i + j)
            wanted[i, j] = G[i, j] / closed
        slips = {
            "the inverse has to be transposed": G * inverse,
            "the product is taken entry by entry, * and not @": G @ inverse.T,
        }
        expect_close(answer(G.copy()), wanted, "the relative gain", slips, rtol=1e-8)


@check("02-angle")
def angle(answer: Any) -> None:
    """Judge `my_angle(W)`: degrees in [-90, 90] with c W_21 - s W_22 = 0."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        W = rng.normal(size=(2, 2))
        found = float(numbers(answer(W.copy()), (), "the angle"))

        def left(radians: float, row: np.ndarray = W[1]) -> float:
            return float(abs(np.cos(radians) * row[0] - np.sin(radians) * row[1]))

        expect(abs(found) <= 90.0, f"the angle should lie in [-90, 90] degrees, yours is {found}")
        turned = np.radians(found)
        if left(turned) > 1e-9:
            expect(left(found) > 1e-9, "that is the angle in radians; wanted are degrees")
            hint = "right but for its sign: the matrix turns the other way"
            expect(left(-turned) > 1e-9, hint)
            expect(False, f"R_21 should vanish, with your angle it is {left(turned):.3g}")


@check("02-differential-dynamics")
def differential_dynamics(answer: Any) -> None:
    """Judge `my_F(Lambda, R, p, q)`: d (z', a') / d (z, a) with a' = P z' + Q z."""
    rng = np.random.default_rng(0)
    for n in (3, 2, 1):
        Lambda, R = rng.normal(size=(2, n, n))
        p, q = rng.normal(size=(2, n))
        F = answer(Lambda.copy(), R.copy(), p.copy(), q.copy())
        found = numbers(F, (2 * n, 2 * n), f"F for n = {n}")
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
def theorem_1(answer: Any) -> None:
    """Judge p, q: for Lambda = -2, R = 1 theorem 1 gives at least 1.9 1/s."""
    p, q = numbers(answer, (2,), "the pair p, q")
    expect(p < 0.0 and q < 0.0, f"R = 1 is positive, so both slopes are negative; yours: {p}, {q}")
    # symmetric part [[-2, b], [b, p]] with b = (1 - 2 p + q) / 2
    b = (1.0 - 2.0 * p + q) / 2.0
    rate = -(0.5 * (p - 2.0) + np.hypot(0.5 * (p + 2.0), b))
    expect(rate >= 1.9, f"theorem 1 gives {rate:.3f} 1/s; off the diagonal stands {b:.2f}")


# ---- lesson 03: a harmless coupling, a hierarchy's metric, the feedback gain


@check("03-harmless-coupling")
def harmless_coupling(answer: Any) -> None:
    """Judge `my_limit(a, b)`: the largest c for which [[-a, c], [c, -b]] does not grow."""
    for a, b in ((1.0, 1.0), (0.5, 2.0), (0.3, 0.1), (4.0, 0.25)):
        found = float(numbers(answer(a, b), (), "the limit"))
        low, high = (
            np.linalg.eigvalsh([[-a, c], [c, -b]])[-1] for c in (0.999 * found, 1.001 * found)
        )
        square = not low < 0.0 < high and np.isclose(found, a * b)
        expect(not square, f"a b is the square of the limit, got {found:.4g} for a = {a}, b = {b}")
        does = "already grows" if low >= 0 else "still decays"
        expect(low < 0.0 < high, f"for a = {a}, b = {b} the loop {does} at c = {found:.4g}")


@check("03-hierarchy-metric")
def hierarchy_metric(answer: Any) -> None:
    """Judge k: in diag(I, k I) the hierarchy at strength 4 contracts at 0.3 1/s."""
    k = float(answer)
    expect(k > 0.0, "k must be positive, or there is no metric")
    F = np.array([[-1, 1.2, 2.4, 4], [-0.8, -0.4, 3.6, 1.6], [0, 0, -0.6, 0.9], [0, 0, -1.1, -0.8]])
    M = np.diag([1.0, 1.0, k, k])
    left = np.linalg.eigvalsh(F.T @ M + M @ F + 0.6 * M)[-1]
    expect(left <= 1e-9 * k, f"k = {k:g} does not show 0.3 1/s: give the free module more weight")


@check("03-feedback-gain")
def feedback_gain(answer: Any) -> None:
    """Judge `my_B(s, w, p, q)`: couplings skew and the symmetric part of F negative definite."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        s, w = -rng.uniform(0.1, 2.0), rng.uniform(0.1, 5.0)
        p, q = -rng.uniform(0.1, 2.0, (2, 2))
        B = numbers(answer(s, w, p.copy(), q.copy()), (2, 2), "B")
        b = np.array([[p[0] * s - q[0], p[1] * w], [-p[0] * w, p[1] * s - q[1]]])
        expect(not np.allclose(B, b.T), "that is the transpose: b_12 belongs to the slope p_2")
        A, P, Q = np.array([[s, w], [-w, s]]), np.diag(p), np.diag(q)
        F = np.block([[A, B], [P @ A + Q, P @ B]])[np.ix_([0, 2, 1, 3], [0, 2, 1, 3])]
        residue = float(np.abs(F[:2, 2:] + F[2:, :2].T).max())
        expect(residue < 1e-9, f"the couplings should be skew; F_12 + F_21^T has {residue:.3g}")
        growth = float(np.linalg.eigvalsh(F + F.T)[-1]) / 2.0
        expect(growth < 0.0, f"the symmetric part should be negative, it has {growth:.3g}")
        expect_close(B, b, "B")


# ---- lesson 04: the explicit solution, slope floors, a module to design


@check("04-transforms")
def transforms(answer: Any) -> None:
    """Judge `my_transforms(f_y, f_u)`: Lambda diagonal, R upper triangular, T_a orthogonal."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        V = np.eye(n) + 0.3 * rng.normal(size=(n, n))
        f_y = V @ np.diag(-np.arange(1.0, n + 1)) @ np.linalg.inv(V)
        f_u = rng.normal(size=(n, n))
        found = answer(f_y.copy(), f_u.copy())
        expect(isinstance(found, tuple) and len(found) == 2, "return two matrices: T_y, T_a")
        T_y, T_a = (numbers(m, (n, n), k) for k, m in zip(("T_y", "T_a"), found, strict=True))
        Lambda = T_y @ f_y @ np.linalg.inv(T_y)
        off = float(np.abs(Lambda - np.diag(np.diag(Lambda))).max())
        expect(off < 1e-8, f"Lambda has {off:.3g} off its diagonal: is T_y the inverse of V?")
        skewed = float(np.abs(T_a.T @ T_a - np.eye(n)).max())
        expect(skewed < 1e-8, f"T_a should be orthogonal, T_a^T T_a is off by {skewed:.3g}")
        W, P = T_y @ f_u, np.eye(n)[::-1]
        R = W @ T_a
        low = float(np.abs(np.tril(R, -1)).max())
        columns, untransposed = np.tril(R @ P, -1), np.linalg.qr(P @ W)[0] @ P
        slips = {
            "R is lower triangular: P, ones on the skew diagonal, is missing": np.triu(R, 1),
            "R is triangular but for the order of its columns: T_a = Q P lacks P": columns,
            "that is the QR of P W; transpose first: W^T P": np.abs(T_a) - np.abs(untransposed),
        }
        for hint, residue in slips.items():
            expect(low < 1e-8 or np.abs(residue).max() > 1e-8, hint)
        expect(low < 1e-8, f"R has {low:.3g} below its diagonal: decompose (T_y f_u)^T P = Q R_qr")


@check("04-floor")
def floor(answer: Any) -> None:
    """Judge `my_floor(Lambda, R)`: max(0, Lambda_ii) / |R_ii|, by the trace of the module."""
    rng = np.random.default_rng(0)
    for n in (2, 3):
        Lambda = np.diag(rng.uniform(-2.0, 2.0, n))
        Lambda[0, 0], R = 1.5, np.triu(rng.normal(size=(n, n))) + np.eye(n)
        R[0, 0] = -0.7
        found = numbers(answer(Lambda.copy(), R.copy()), (n,), "the floor, one for each module,")
        expect((found >= 0.0).all(), "no floor is negative: divide by |R_ii|, and cut at 0")
        for rate, gain, slope in zip(np.diag(Lambda), np.diag(R), found, strict=True):
            for factor in (0.99, 1.01):
                holds = rate - abs(gain) * factor * slope < 0.0
                expect(
                    holds == (factor > 1.0 or rate < 0.0),
                    f"Lambda_ii = {rate:.3g}, R_ii = {gain:.3g}: {factor} times your floor "
                    f"{slope:.3g} {'meets' if holds else 'misses'} the first inequality",
                )
        expect_close(found, np.maximum(np.diag(Lambda), 0) / np.abs(np.diag(R)), "the floor")


@check("04-module")
def module(answer: Any) -> None:
    """Judge p, q: with Lambda = -1, R = 2 both eigenvalues of F_ii are -3."""
    p, q = numbers(answer, (2,), "the pair p, q")
    expect(p < 0.0 and q < 0.0, "R = 2 is positive, so both slopes are negative")
    trace, det = -1.0 + 2.0 * p, -2.0 * q
    expect(abs(trace + 6.0) < 1e-6, f"the trace should be -6, -1 + 2 p is {trace:.4g}")
    expect(abs(det - 9.0) < 1e-6, f"the determinant should be 9, -2 q is {det:.4g}")
