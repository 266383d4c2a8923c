"""Exercises of lessons 08 to 09."""

from __future__ import annotations

from typing import Any

import numpy as np

from cmc.exercises import check, expect, expect_close, numbers
from cmc.plants import Peg
from cmc.theory.sampled import sampled_matrix

# ---- lesson 08: gains for a range of surfaces, a turned tool, the best average


H, TAU_Z = 0.01, 0.01


def _left(K: float, k1: float, k2: float) -> float:
    """Largest |f - f_d| after 0.15 s, in touches from the surface to several targets, N."""
    targets = np.linspace(-2.5, -0.5, 9)
    z, integral, log = np.zeros_like(targets), np.zeros_like(targets), []
    for _ in range(60):
        e = K * np.minimum(z, 0.0) - targets
        log.append(np.abs(e))
        integral = integral + H * e
        u = np.clip(-0.5 - k1 * e - k2 * integral, -3.0, 1.0)
        z = u + (z - u) * np.exp(-H / TAU_Z)
    return float(np.array(log)[15:].max())


@check("08-gains")
def gains(answer: Any) -> None:
    """Judge `my_gains()`: k1, k2 that settle 5 to 31 N/m in 0.15 s and stay stable on 62 N/m."""
    found = answer()
    expect(np.shape(found) == (2,), "return two numbers, k1 and k2")
    k1, k2 = numbers(found, (2,), "the pair k1, k2")
    expect(k2 > 0, "k2 <= 0: without an integral of the right sign the force keeps an offset")
    expect(k1 > -1 / 62, "k1 has the wrong sign: u_z = ... - k1 e_f - k2 int e_f")
    for K in (5.0, 15.0, 31.0, 62.0):
        used = (k1 + H / 2 * k2) * K * np.tanh(H / (2 * TAU_Z))
        expect(used < 1, f"on {K:g} N/m you use {used:.0%} of the limit: the loop rattles there")
        late, speed = _left(K, k1, k2), "too slow" if K < 20 else "still ringing, or too slow"
        expect(K > 31 or late < 0.2, f"on {K:g} N/m {late:.2f} N are left after 0.15 s: {speed}")


@check("08-turned-tool")
def turned_tool(answer: Any) -> None:
    """Judge `my_transforms(K, slope, angle)`: T_y (unit diagonal) and T_a of a turned tool."""
    rng = np.random.default_rng(0)
    for K, size, angle in ((1.0, 0.01, 0.4), (12.0, 0.2, -1.2), (31.0, -0.3, 2.5)):
        peg = Peg(K_sur=K, surface_sin=size, surface_cos=-0.5 * size)
        y = np.array([rng.uniform(1.0, 3.0), -1.0])
        slope, cos, sin = float(peg.surface_slope(y[0])), np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin], [sin, cos]])
        found = answer(K, slope, angle)
        expect(found is not None and len(found) == 2, "return two matrices, T_y and T_a")
        T_y, T_a = (numbers(m, (2, 2), k) for k, m in zip(("T_y", "T_a"), found, strict=True))
        expect_close(np.diag(T_y), [1.0, 1.0], "the diagonal of T_y")
        corner = np.isclose(T_y[1, 0], -K * slope)
        expect(not corner, "this is V: the corner of T_y = V^-1 has the other sign")
        Lambda = T_y @ peg.f_y(y, peg.hold(y)) @ np.linalg.inv(T_y)
        wanted = np.diag([-1.0 / peg.tau_x, -1.0 / peg.tau_z])
        expect_close(Lambda, wanted, "T_y f_y T_y^-1, slow mode first")
        expect_close(T_a.T @ T_a, np.eye(2), "T_a^T T_a")
        twice = np.allclose(T_a, turn)
        expect(not twice, "T_a turns the command once more; it has to turn it back")
        R = T_y @ peg.f_u(y, peg.hold(y)) @ turn @ T_a
        expect(abs(R[1, 0]) < 1e-9 * abs(R).max(), f"R_21 should be 0, it is {R[1, 0]:.3g}")
        expect((np.diag(R) > 0).all(), f"the diagonal of R should be positive, it is {np.diag(R)}")


@check("08-best-average")
def best_average(answer: Any) -> None:
    """Judge `my_best(returns, factors, weights)`: the factor with the best weighted average."""
    rng = np.random.default_rng(0)
    for count in (5, 12):
        returns, factors = rng.normal(size=(count, 31)), np.geomspace(0.1, 5.0, count)
        weights = rng.dirichlet(np.ones(31))
        found, average = answer(returns.copy(), factors.copy(), weights.copy()), returns @ weights
        place = "this is the place of the best factor in the list; return factors[place]"
        best = "this is the best average; return the factor that has it"
        slips = {place: np.argmax(average), best: average.max()}
        expect_close(found, factors[np.argmax(average)], "the best factor", slips)


# ---- lesson 09: the clipped surrogate, a cap on the slopes, the first bad period


@check("09-surrogate")
def surrogate(answer: Any) -> None:
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
def slope_cap(answer: Any) -> None:
    """Judge `my_factor(k1, k2, tau, K, h)`: at most 1, and at most 98 % of the sampled limit."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        tau, K, h = rng.uniform(0.005, 0.05), rng.uniform(1.0, 60.0), rng.uniform(0.002, 0.02)
        k1, k2 = rng.uniform(0.01, 3.0) / K, rng.uniform(0.1, 300.0) / K
        used = (k1 + h / 2 * k2) * K * np.tanh(h / (2 * tau))
        factor = float(numbers(answer(k1, k2, tau, K, h), (), "the factor"))
        expect(0.0 < factor <= 1.0, f"the factor should be in (0, 1], it is {factor:.3g}")
        expect(
            _radius(factor * k1, factor * k2, tau, K, h) < 1.0,
            f"the scaled loop is unstable for K = {K:.3g} N/m, h = {1e3 * h:.3g} ms: it uses "
            f"{factor * used:.0%} of its bound",
        )
        expect_close(factor * used, min(used, 0.98), "the used share of the bound")


@check("09-period")
def period(answer: Any) -> None:
    """Judge `my_period(k1, k2, tau, K)`: stable just below, unstable just above."""
    for loop in ((0.02, 4.0, 0.01, 62.0), (0.06, 1.0, 0.01, 31.0), (3.0, 20.0, 0.04, 1.0)):
        h = float(numbers(answer(*loop), (), "the period"))
        expect(1e-4 < h < 0.2, f"wanted seconds between 0.0001 and 0.2, yours is {h:.3g}")
        expect(_radius(*loop, 0.99 * h) < 1.0, f"at {1e3 * h:.3g} ms it rattles already")
        expect(_radius(*loop, 1.01 * h) > 1.0, f"beyond {1e3 * h:.3g} ms it is still calm")


def _radius(k1: float, k2: float, tau: float, K: float, h: float) -> float:
    """Spectral radius of the held loop."""
    return float(np.abs(np.linalg.eigvals(sampled_matrix(k1, k2, -1 / tau, K / tau, h))).max())
