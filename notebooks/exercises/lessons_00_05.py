"""Exercises of lessons 00 to 05."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm

from cmc import plants
from cmc.plants import LinearPlant
from cmc.theory.certify import certify
from exercises import check, compare, expect, numbers

_LEANING = np.array([[-1.0, 8.0], [0.0, -1.5]])


@compare("00-rate", "the slowest of the rates of A = {0}")
def rate() -> Iterator[Any]:
    """`rate(A)`: the slowest rate, 1/s, at which trajectories of y' = A y approach."""
    for A in (
        [[-1, 0], [0, -3]],
        [[-2, 1], [1, -2]],
        [[-0.5, 2], [-2, -0.5]],
        [[0.25, 0], [5, -1]],
    ):
        growth = np.linalg.eigvals(np.array(A, float)).real.max()
        yield (np.array(A, float),), -growth, {"the sign is wrong: decay counts positive": growth}


@compare("00-slope", "the slope", atol=1e-8)
def slope() -> Iterator[Any]:
    """`slope(s, W, w)`: d/ds_1 of w . tanh(W s), (..., 2) to (...); here by differences."""
    rng = np.random.default_rng(0)
    W, w, s = rng.normal(size=(5, 2)), rng.normal(size=5), rng.normal(size=(4, 3, 2))
    up, down = (np.tanh((s + [step, 0.0]) @ W.T) @ w for step in (1e-6, -1e-6))
    slips = {"the inner derivative W[:, 0] is missing": (w / np.cosh(s @ W.T) ** 2).sum(-1)}
    yield (s, W, w), (up - down) / 2e-6, slips


@check("00-design")
def design(answer: Any) -> None:
    """Judge two slopes of the coupled lags, at most 2 each, whose loop decays at 0.9 1/s."""
    sizes = numbers(answer, (2,), "the pair of slopes")
    expect((sizes <= 2.0).all(), f"neither slope may be above 2, yours are {sizes.tolist()}")
    space = plants.get("coupled_lags").space()
    found = -np.linalg.eigvals(space.loop(space.signed(*sizes))).real.max()
    expect(found > 0.0, "this loop does not decay at all: both slopes count positive here")
    expect(found >= 0.9, f"the rate should be 0.9 1/s or more, yours gives {found:.3f} 1/s")


@compare("01-rate-in-a-metric", "the rate of J = {0}")
def rate_in_a_metric() -> Iterator[Any]:
    """`my_rate(J, M)`: the largest beta with J^T M + M J <= -2 beta M."""
    rng = np.random.default_rng(0)
    roots = [rng.normal(size=(n, n)) + 2 * np.eye(n) for n in (2, 3, 4)]
    cases = [(rng.normal(size=R.shape) - 2 * np.eye(len(R)), R.T @ R) for R in roots]
    for J, M in ((-2.0 * np.eye(2), np.eye(2)), (_LEANING, np.eye(2)), *cases):
        growth, lower = eigh(J.T @ M + M @ J, M, eigvals_only=True)[-1] / 2, np.linalg.cholesky(M)
        F, fastest = lower @ J @ np.linalg.inv(lower), np.linalg.eigvals(J).real.max()
        slips = {
            "the rate counts decay positive": growth,
            "the symmetric part has a half": -2 * growth,
            "it is the symmetric part that counts, not the eigenvalues of J": -fastest,
            "numpy's Cholesky factor L is lower, M = L L^T; Theta with M = Theta^T Theta is its "
            "transpose": -np.linalg.eigvalsh((F + F.T) / 2)[-1],
        }
        yield (J, M), -growth, slips


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


@compare("02-relative-gain", "the relative gain", rtol=1e-8)
def relative_gain() -> Iterator[Any]:
    """`my_relative_gain(f_u)`: entries f_u_ij (f_u^-1)_ji."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        G = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
        inverse = np.linalg.inv(G)
        slips = {
            "the inverse has to be transposed": G * inverse,
            "the product is taken entry by entry, * and not @": G @ inverse.T,
        }
        yield (G,), G * inverse.T, slips


@compare("02-angle", "the angle for W = {0}, in [-90, 90] degrees,")
def angle() -> Iterator[Any]:
    """`my_angle(W)`: degrees in [-90, 90] with c W_21 - s W_22 = 0."""
    for W in np.random.default_rng(0).normal(size=(20, 2, 2)):
        radians = np.arctan(W[1, 0] / W[1, 1])
        slips = {
            "that is the angle in radians; wanted are degrees": radians,
            "right but for its sign: the matrix turns the other way": -np.degrees(radians),
        }
        yield (W,), np.degrees(radians), slips


@compare("02-differential-dynamics", "F")
def differential_dynamics() -> Iterator[Any]:
    """`my_F(Lambda, R, p, q)`: d (z', a') / d (z, a) with a' = P z' + Q z."""
    rng = np.random.default_rng(0)
    for n in (3, 2, 1):
        (Lambda, R), (p, q) = rng.normal(size=(2, n, n)), rng.normal(size=(2, n))
        P, Q = np.diag(p), np.diag(q)
        slips = {"C lacks the slopes q towards int z": [[Lambda, R], [P @ Lambda, P @ R]]}
        hint = "p * Lambda scales columns; P Lambda scales rows: np.diag(p)"
        slips[hint] = [[Lambda, R], [Lambda @ P + Q, R @ P]]
        right = np.block([[Lambda, R], [P @ Lambda + Q, P @ R]])
        yield (Lambda, R, p, q), right, {hint: np.block(F) for hint, F in slips.items()}


@check("02-theorem-1")
def theorem_1(answer: Any) -> None:
    """Judge p, q: for Lambda = -2, R = 1 theorem 1 gives at least 1.9 1/s."""
    p, q = numbers(answer, (2,), "the pair p, q")
    expect(p < 0.0 and q < 0.0, f"R = 1 is positive, so both slopes are negative; yours: {p}, {q}")
    # symmetric part [[-2, b], [b, p]] with b = (1 - 2 p + q) / 2
    b = (1.0 - 2.0 * p + q) / 2.0
    rate = -(0.5 * (p - 2.0) + np.hypot(0.5 * (p + 2.0), b))
    expect(rate >= 1.9, f"theorem 1 gives {rate:.3f} 1/s; off the diagonal stands {b:.2f}")


@compare("03-harmless-coupling", "the limit for a = {0}")
def harmless_coupling() -> Iterator[Any]:
    """`my_limit(a, b)`: the largest c for which [[-a, c], [c, -b]] does not grow."""
    for a, b in ((0.5, 2.0), (0.3, 0.1), (4.0, 0.25), (3.0, 2.0)):
        yield (a, b), np.sqrt(a * b), {"a b is the square of the limit": a * b}


@check("03-hierarchy-metric")
def hierarchy_metric(answer: Any) -> None:
    """Judge k: in diag(I, k I) the hierarchy at strength 4 contracts at 0.3 1/s."""
    k = float(answer)
    expect(k > 0.0, "k must be positive, or there is no metric")
    F = np.array([[-1, 1.2, 2.4, 4], [-0.8, -0.4, 3.6, 1.6], [0, 0, -0.6, 0.9], [0, 0, -1.1, -0.8]])
    M = np.diag([1.0, 1.0, k, k])
    left = np.linalg.eigvalsh(F.T @ M + M @ F + 0.6 * M)[-1]
    expect(left <= 1e-9 * k, f"k = {k:g} does not show 0.3 1/s: give the free module more weight")


@compare("03-feedback-gain", "B, which makes the couplings skew,")
def feedback_gain() -> Iterator[Any]:
    """`my_B(s, w, p, q)`: couplings skew and the symmetric part of F negative definite."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        s, w = -rng.uniform(0.1, 2.0), rng.uniform(0.1, 5.0)
        p, q = -rng.uniform(0.1, 2.0, (2, 2))
        B = np.array([[p[0] * s - q[0], p[1] * w], [-p[0] * w, p[1] * s - q[1]]])
        hint = "that is the transpose: b_12 belongs to the slope p_2"
        yield (s, w, p, q), B, {hint: B.T}


@check("04-transforms")
def transforms(answer: Any) -> None:
    """Judge `my_transforms(f_y, f_u)`: Lambda diagonal, R upper triangular, T_a orthogonal."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        V, P = np.eye(n) + 0.3 * rng.normal(size=(n, n)), np.eye(n)[::-1]
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
        W, R = T_y @ f_u, T_y @ f_u @ T_a
        low, untransposed = float(np.abs(np.tril(R, -1)).max()), np.linalg.qr(P @ W)[0] @ P
        for residue, hint in (
            (np.triu(R, 1), "R is lower triangular: P, ones on the skew diagonal, is missing"),
            (np.tril(R @ P, -1), "R lacks the order of its columns: T_a = Q P lacks P"),
            (np.abs(T_a) - np.abs(untransposed), "transpose first: W^T P, and not P W"),
        ):
            expect(low < 1e-8 or np.abs(residue).max() > 1e-8, hint)
        expect(low < 1e-8, f"R has {low:.3g} below its diagonal: decompose (T_y f_u)^T P = Q R_qr")


@compare("04-floor", "the floor, one for each module,")
def floor() -> Iterator[Any]:
    """`my_floor(Lambda, R)`: max(0, Lambda_ii) / |R_ii|, where the trace of the module vanishes."""
    for rates, gains in (([1.5, -0.4], [-0.7, 1.2]), ([1.5, 0.3, -1.9], [-0.7, 0.2, -2.0])):
        r, g = np.array(rates), np.array(gains)
        slips = {
            "no floor is negative: cut at 0": r / np.abs(g),
            "no floor is negative: divide by |R_ii|": np.maximum(r, 0) / g,
        }
        R = np.diag(g) + np.triu(np.ones((len(g), len(g))), 1)
        yield (np.diag(r), R), np.maximum(r, 0) / np.abs(g), slips


@check("04-module")
def module(answer: Any) -> None:
    """Judge p, q: with Lambda = -1, R = 2 both eigenvalues of F_ii are -3."""
    p, q = numbers(answer, (2,), "the pair p, q")
    expect(p < 0.0 and q < 0.0, "R = 2 is positive, so both slopes are negative")
    trace, det = -1.0 + 2.0 * p, -2.0 * q
    expect(abs(trace + 6.0) < 1e-6, f"the trace should be -6, -1 + 2 p is {trace:.4g}")
    expect(abs(det - 9.0) < 1e-6, f"the determinant should be 9, -2 q is {det:.4g}")


@compare("05-slopes", "the slopes, one for each input,", atol=1e-8)
def slopes() -> Iterator[Any]:
    """`my_slopes(weights, biases, s)`: d pi / d s of a tanh network; here by differences.

    Weights are (out, in); the last layer is linear, has one output and no bias; s is (2,).
    """

    def differences(shifts: list[np.ndarray]) -> list[float]:
        def pi(x: np.ndarray) -> float:
            for W, b in zip(weights[:-1], shifts, strict=True):
                x = np.tanh(W @ x + b)
            return float((weights[-1] @ x)[0])

        return [(pi(s + d) - pi(s - d)) / 2e-6 for d in 1e-6 * np.eye(2)]

    rng = np.random.default_rng(0)
    for hidden in ((4,), (5, 3), (4, 4, 4)):
        sizes = (2, *hidden, 1)
        weights = [rng.uniform(0, 1.5, (b, a)) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        biases, s = [rng.normal(size=len(W)) for W in weights[:-1]], rng.normal(size=2)
        straight = "this is W_l ... W_1 alone; put D_j = diag(1 - tanh^2) between them"
        slips = {
            "the biases are missing inside tanh": differences([0 * b for b in biases]),
            straight: np.linalg.multi_dot(weights[::-1])[0],
        }
        yield (weights, biases, s), differences(biases), slips


@check("05-pump")
def pump(answer: Any) -> None:
    """Judge `my_stiffness(z, w)`: makes z' = -0.28 z - k w, w' = z grow with k in [0.5, 1.5]."""
    z, w, dt, size = 0.0, 1.0, 0.005, []
    for _ in range(12_000):
        k = float(answer(z, w))
        expect(0.5 <= k <= 1.5, f"k should stay in [0.5, 1.5], yours was {k:.3g}")
        z += dt * (-0.28 * z - k * w)
        w += dt * z
        size.append(np.hypot(z, w))
    grown = float(np.log(max(size[-2000:]) / max(size[2000:4000])))
    decay = "decays as fast as a constant k does" if grown < -4 else "still decays"
    hint = "w is pulled back hardest if k is large on the way in (z w < 0) and small on the way out"
    expect(grown > 0, f"the swing {decay}: its size falls by {np.exp(grown):.2g} in 40 s; {hint}")


@compare("05-quadrature", "the step in (z_k, I_k)")
def quadrature() -> Iterator[Any]:
    """`my_step(p, q, Lambda, R, h)`: the held step in (z_k, I_k), I_{k+1} = I_k + h z_k."""
    for p, q, Lambda, R, h in ((0.5, 0.2, -1.0, 2.0, 0.3), (3.0, 1.0, 0.4, 0.7, 0.1)):
        phi, G = expm(h * np.array([[Lambda, R], [0.0, 0.0]]))[0]
        hint = "this is the matrix of the text: the new error must not be in the command's sum"
        slips = {hint: [[phi - G * (p + h * q), -G * q], [h, 1.0]]}
        yield (p, q, Lambda, R, h), [[phi - G * p, -G * q], [h, 1.0]], slips


@check("05-own-plant")
def own_plant(answer: Any) -> None:
    """Judge `my_plant()`: f_y, f_u, floor, ceiling and the sample time where `certify` gives up."""
    found = answer()
    expect(len(found) == 5, "return f_y, f_u, floor, ceiling, h")
    f_y, f_u, floor, ceiling = numbers(found[:4], (4, 2, 2), "the array of f_y ... ceiling")
    h = float(found[4])
    for name, M in (("f_y", f_y), ("f_u", f_u)):
        expect(np.count_nonzero(M - np.diag(np.diag(M))), f"{name} is diagonal: nothing is coupled")
    expect((ceiling > floor).all(), "every ceiling should lie above its floor")
    interval = SimpleNamespace(slope_bounds=lambda: (floor, ceiling))
    for share in (None, 0.9, 1.1):
        verdict = certify(interval, LinearPlant(f_y, f_u), h=None if share is None else share * h)
        when = "without sampling" if share is None else f"at {share:g} h = {share * h:.3g} s"
        said = f"no ({verdict.reason})" if not verdict else f"yes, {verdict.rate:.3g} 1/s"
        expect(bool(verdict) == (share != 1.1), f"{when} certify says {said}")
