"""Exercises of lesson 08: gains for a range of surfaces, a turned tool, the best average."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cmc.exercises import check, expect, expect_close
from cmc.plants import Peg

Array = np.ndarray

H, TAU_Z = 0.01, 0.01


def _force_errors(K: float, k1: float, k2: float, targets: Array) -> Array:
    """|f - f_d| of touches that start at the surface, sample by sample, (60, targets)."""
    z, integral, log = np.zeros_like(targets), np.zeros_like(targets), []
    for _ in range(60):
        e = K * np.minimum(z, 0.0) - targets
        log.append(np.abs(e))
        integral = integral + H * e
        u = np.clip(-0.5 - k1 * e - k2 * integral, -3.0, 1.0)
        z = u + (z - u) * np.exp(-H / TAU_Z)
    return np.array(log)


@check("08-gains")
def gains(answer: Callable[[], tuple[float, float]]) -> None:
    """Judge `my_gains()`: k1, k2 that settle 5 to 31 N/m in 0.15 s and stay stable on 62 N/m."""
    found = answer()
    expect(np.shape(found) == (2,), "return two numbers, k1 and k2")
    k1, k2 = (float(v) for v in found)
    expect(k2 > 0, "k2 <= 0: without an integral of the right sign the force keeps an offset")
    expect(k1 > -1 / 62, "k1 has the wrong sign: u_z = ... - k1 e_f - k2 int e_f")
    for K in (5.0, 15.0, 31.0, 62.0):
        used = (k1 + H / 2 * k2) * K * np.tanh(H / (2 * TAU_Z))
        expect(used < 1, f"on {K:g} N/m you use {used:.0%} of the limit: the loop rattles there")
        errors = _force_errors(K, k1, k2, np.linspace(-2.5, -0.5, 9))
        late = errors[15:].max()
        if K <= 31.0:
            speed = "too slow" if K < 20 else "still ringing, or too slow"
            expect(late < 0.2, f"on {K:g} N/m {late:.2f} N are left after 0.15 s: {speed}")


@check("08-turned-tool")
def turned_tool(answer: Callable[[float, float, float], tuple[Array, Array]]) -> None:
    """Judge `my_transforms(K, slope, angle)`: T_y (unit diagonal) and T_a of a turned tool."""
    rng = np.random.default_rng(0)
    for K, size, angle in zip((1.0, 12.0, 31.0), (0.01, 0.2, -0.3), (0.4, -1.2, 2.5), strict=True):
        peg = Peg(K_sur=K, surface_sin=size, surface_cos=-0.5 * size)
        x = rng.uniform(1.0, 3.0)
        y = np.array([x, -1.0])
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin], [sin, cos]])
        found = answer(K, float(peg.surface_slope(x)), angle)
        expect(found is not None and len(found) == 2, "return two matrices, T_y and T_a")
        T_y, T_a = (np.asarray(matrix, dtype=float) for matrix in found)
        expect(T_y.shape == T_a.shape == (2, 2), f"wanted 2 x 2, got {T_y.shape}, {T_a.shape}")
        expect_close(np.diag(T_y), [1.0, 1.0], "the diagonal of T_y")
        Lambda = T_y @ peg.f_y(y, peg.hold(y)) @ np.linalg.inv(T_y)
        if np.isclose(T_y[1, 0], -K * peg.surface_slope(x)):
            expect(False, "this is V: the corner of T_y = V^-1 has the other sign")
        wanted = np.diag([-1.0 / peg.tau_x, -1.0 / peg.tau_z])
        expect_close(Lambda, wanted, "T_y f_y T_y^-1, slow mode first")
        expect_close(T_a.T @ T_a, np.eye(2), "T_a^T T_a")
        R = T_y @ peg.f_u(y, peg.hold(y)) @ turn @ T_a
        if np.allclose(T_a, turn):
            expect(False, "T_a turns the command once more; it has to turn it back")
        expect(abs(R[1, 0]) < 1e-9 * abs(R).max(), f"R_21 should be 0, it is {R[1, 0]:.3g}")
        expect((np.diag(R) > 0).all(), f"the diagonal of R should be positive, it is {np.diag(R)}")


@check("08-best-average")
def best_average(answer: Callable[[Array, Array, Array], float]) -> None:
    """Judge `my_best(returns, factors, weights)`: the factor with the best weighted average."""
    rng = np.random.default_rng(0)
    for count in (5, 12):
        returns, factors = rng.normal(size=(count, 31)), np.geomspace(0.1, 5.0, count)
        weights = rng.dirichlet(np.ones(31))
        found = answer(returns.copy(), factors.copy(), weights.copy())
        average = returns @ weights
        expect(np.ndim(found) == 0 and found is not None, "return one number, a factor")
        if found == np.argmax(average):
            expect(False, "this is the place of the best factor in the list; return factors[place]")
        if np.isclose(found, average.max()):
            expect(False, "this is the best average; return the factor that has it")
        expect_close(found, factors[np.argmax(average)], "the best factor")
