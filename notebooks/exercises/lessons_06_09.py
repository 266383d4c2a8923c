"""Exercises of lessons 06 to 09."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import expm

from cmc.plants import Peg
from cmc.theory.identification import fit_latent
from cmc.theory.sampled import LagLoop, sampled_matrix
from exercises import check, compare, expect, expect_close, numbers


def _poles(K_p: float, K_d: float, g: float, dt: float) -> np.ndarray:
    """Poles of the held step of e'' = -(K_p + g K_1) e - (K_d + g K_2) e', small root."""
    K1, K2 = K_p, 2 * K_p / (K_d + np.sqrt(K_d**2 - 4 * K_p))
    hold = expm(np.diag([dt, dt], 1))  # of (e, e', e'')
    return np.linalg.eigvals(hold[:2, :2] - np.outer(hold[:2, 2], [K_p + g * K1, K_d + g * K2]))


@check("06-design")
def design(answer: Any) -> None:
    """Judge `my_design(slow, fast, g)`: gains with these rates, and the largest smooth dt."""
    for slow, fast, g in ((2.0, 20.0, 3.0), (5.0, 20.0, 0.0), (1.0, 8.0, 10.0)):
        K_p, K_d, dt = numbers(answer(slow, fast, g), (3,), "K_p, K_d, dt")
        hint = "K_p is the product of the rates and K_d their sum, not the reverse"
        slips, right = {hint: [slow + fast, slow * fast]}, [slow * fast, slow + fast]
        expect_close([K_p, K_d], right, f"K_p, K_d for rates {slow:g} and {fast:g}", slips)
        here, beyond = (_poles(K_p, K_d, g, share * dt).real.min() for share in (1.0, 1.05))
        expect(here >= -1e-9, f"dt = {dt:.4g} s is too long: an eigenvalue is {here:.3g}")
        expect(beyond < -1e-9, f"dt = {dt:.4g} s can be longer still; where is det(step) zero?")


@check("06-verdict")
def verdict(answer: Any) -> None:
    """Judge `my_verdict(K_p, K_d, g, dt)`: settles, alternates or diverges, by the eigenvalues."""
    gains, holds = (0.0, 20.0, 60.0), (0.002, 0.02, 0.045, 0.08)
    for (K_p, K_d), g, dt in product(((40.0, 20.0), (20.0, 30.0)), gains, holds):
        values = _poles(K_p, K_d, g, dt)
        wanted = "alternates" if values.real.min() < 0 else "settles"
        wanted = "diverges" if np.abs(values).max() >= 1 else wanted
        found = answer(K_p, K_d, g, dt)
        expect(
            found == wanted,
            f"K_p = {K_p:g}, K_d = {K_d:g}, g = {g:g}, dt = {dt:g}: {wanted!r} (eigenvalues "
            f"{np.round(np.sort(values.real), 3)}), yours {found!r}; the level alone does not tell",
        )


@check("06-commands")
def commands(answer: Any) -> None:
    """Judge `my_commands(count)`: commands in [-3, 3] that tell f_u better than uniform ones."""
    f_y, f_u = np.array([[-2.0, 1.0], [0.5, -1.0]]), np.array([[1.0, 2.0], [1.5, 1.0]])
    step = expm(0.05 * np.block([[f_y, f_u], [np.zeros((2, 4))]]))[:2]

    def error(u: np.ndarray, seed: int) -> float:
        rng = np.random.default_rng(seed)
        y = rng.normal(size=u.shape)
        after = np.column_stack([y, u]) @ step.T + 0.01 * rng.normal(size=u.shape)
        return float(np.abs(fit_latent(y, u, after, 0.05).f_u - f_u).max())

    for count in (40, 200):
        u = numbers(answer(count), (count, 2), "the array of commands")
        expect(np.abs(u).max() <= 3.0 + 1e-12, f"|u| goes up to {np.abs(u).max():.3g}, beyond 3")
        condition = np.linalg.cond(np.column_stack([u, np.ones(count)]))
        hint = "the columns (or a column and the constant 1) look alike: no fit tells them apart"
        expect(condition < 1e6, hint)
        uniform = [np.random.default_rng(1000 + k).uniform(-3, 3, u.shape) for k in range(30)]
        mine = np.mean([error(u, k) for k in range(30)])
        ratio = mine / np.mean([error(v, k) for k, v in enumerate(uniform)])
        expect(ratio <= 0.7, f"with {count} commands the error is {ratio:.2f} of the random ones'")


@check("07-worst-disturbance")
def worst_disturbance(answer: Any) -> None:
    """Judge `my_disturbance(t, J, B, row, end)`: |d| <= 1, row xi(end) as large as it can be."""
    J = np.array([[-0.3, -2.0, 0.4], [2.0, -0.3, 0.0], [0.0, 0.5, -1.0]])
    B, row, end, steps = np.array([[1.0, 0.2], [0.0, 1.0], [0.5, 0.0]]), np.eye(3)[0], 6.0, 240
    times = end / steps * (np.arange(steps) + 0.5)
    weights = np.array([row @ expm(J * (end - t)) @ B for t in times])
    found = np.array([numbers(answer(t, J, B, row, end), (2,), "d(t)") for t in times])
    longest = float(np.linalg.norm(found, axis=-1).max())
    expect(longest <= 1 + 1e-9, f"|d| goes up to {longest:.3g}; divide by its length")
    best = np.linalg.norm(weights, axis=-1).sum()
    share, backwards = ((weights * d).sum() / best for d in (found, found[::-1]))
    expect(share >= -0.9, "this makes row xi as negative as it can be: the sign is wrong")
    late = "the time runs the wrong way: what acts at t has end - t left to decay"
    expect(not backwards > 0.98 > share, late)
    still = not np.ptp(found, axis=0).any()
    hint = "a constant; let it turn with the loop" if still else "point along B^T e^(J^T (end - t))"
    expect(share > 0.98, f"yours reaches {share:.0%} of the worst ({hint})")


@check("07-edge")
def edge(answer: Any) -> None:
    """Judge `my_edge(radius, top)`: the first slope at which the spectral radius reaches 1."""
    loop = LagLoop(tau=1.0, gain=1.0, period=0.25, integral_time=2.5)
    for late in (0.0, 0.1, 0.5, 1.3):
        found, name = answer(partial(loop.spectral_radius, late), 30.0), f"the edge {late:g} s late"
        expect_close(found, loop.largest_gain(late), name, rtol=1e-4)
    found = answer(lambda slope: 1.2 if 1.0 <= slope < 2.0 or slope > 20.0 else 0.9, 30.0)
    expect_close(found, 1.0, "the edge of a radius above 1 from 1 to 2 and beyond 20", rtol=1e-3)


def _respond(rule: Callable[..., float], limit: float, goal: float) -> tuple[np.ndarray, bool]:
    """Path of a lag to a goal, and whether an unclipped integral was ever changed."""
    a, h, p, q = float(np.exp(-0.25)), 0.25, 1.0, 4.0
    z, integral, path, touched = goal, 0.0, [], False
    for _ in range(160):
        ahead = integral + h * z
        wanted = -(p * z + q * ahead)
        integral = float(rule(ahead, integral, z, wanted, limit, p, q))
        touched |= abs(wanted) <= limit and abs(integral - ahead) > 1e-9
        path.append(z)
        z = a * z + (1 - a) * float(np.clip(-(p * z + q * integral), -limit, limit))
    return np.array(path), touched


@check("07-anti-windup")
def anti_windup(answer: Any) -> None:
    """Judge `my_integral(...)`: half of the plain overshoot, no offset, idle within the limits."""
    for limit, goal in ((0.3, 1.0), (0.5, -1.0)):
        plain, _ = _respond(lambda ahead, *rest: ahead, limit, goal)
        mine, touched = _respond(answer, limit, goal)
        expect(not touched, "the integral was changed although the command was within its limits")
        over, before = (max(0.0, float(-(path * np.sign(goal)).min())) for path in (mine, plain))
        left = float(np.abs(mine[-20:]).max())
        expect(left < 0.02, f"an error of {left:.2g} is left: the integral must work again later")
        expect(
            over <= before / 2,
            f"overshoot {over:.0%} at a limit of {limit:g}, plain {before:.0%}: stop the integral "
            "while the command is clipped and the error would push it further",
        )


@check("08-gains")
def gains(answer: Any) -> None:
    """Judge `my_gains()`: k1, k2 that settle 5 to 31 N/m in 0.15 s and stay stable on 62 N/m."""
    h, tau = 0.01, 0.01
    k1, k2 = numbers(answer(), (2,), "the pair of two numbers, k1 and k2,")
    expect(k2 > 0, "k2 <= 0: without an integral of the right sign the force keeps an offset")
    expect(k1 > -1 / 62, "k1 has the wrong sign: u_z = ... - k1 e_f - k2 int e_f")
    targets = np.linspace(-2.5, -0.5, 9)
    for K in (5.0, 15.0, 31.0, 62.0):
        used = _used(k1, k2, tau, K, h)
        expect(used < 1, f"on {K:g} N/m you use {used:.0%} of the limit: the loop rattles there")
        z, integral, log = np.zeros_like(targets), np.zeros_like(targets), []
        for _ in range(60):  # touches from the surface, N
            e = K * np.minimum(z, 0.0) - targets
            log.append(np.abs(e).max())
            integral = integral + h * e
            u = np.clip(-0.5 - k1 * e - k2 * integral, -3.0, 1.0)
            z = u + (z - u) * np.exp(-h / tau)
        late, speed = max(log[15:]), "too slow" if K < 20 else "still ringing, or too slow"
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
        V = np.array([[1.0, 0.0], [-K * slope, 1.0]])
        slips = {"this is V: the corner of T_y = V^-1 has the other sign": V}
        T_y = expect_close(found[0], np.linalg.inv(V), "T_y", slips)
        T_a = numbers(found[1], (2, 2), "T_a")
        expect_close(T_a.T @ T_a, np.eye(2), "T_a^T T_a")
        hint = "T_a turns the command once more; it has to turn it back"
        expect(not np.allclose(T_a, turn), hint)
        R = T_y @ peg.f_u(y, peg.hold(y)) @ turn @ T_a
        expect(abs(R[1, 0]) < 1e-9 * abs(R).max(), f"R_21 should be 0, it is {R[1, 0]:.3g}")
        expect((np.diag(R) > 0).all(), f"the diagonal of R should be positive, it is {np.diag(R)}")


@compare("08-best-average", "the best factor")
def best_average() -> Iterator[Any]:
    """`my_best(returns, factors, weights)`: the factor with the best weighted average."""
    rng = np.random.default_rng(0)
    for count in (5, 12):
        returns, factors = rng.normal(size=(count, 31)), np.geomspace(0.1, 5.0, count)
        weights = rng.dirichlet(np.ones(31))
        average, place = returns @ weights, int(np.argmax(returns @ weights))
        slips = {
            "this is the place of the best factor in the list; return factors[place]": place,
            "this is the best average; return the factor that has it": average[place],
        }
        yield (returns, factors, weights), factors[place], slips


@compare("09-surrogate", "the surrogate at r = {0}")
def surrogate() -> Iterator[Any]:
    """`my_surrogate(r, A, clip)`: the mean of min(r A, clip(r, 1 - c, 1 + c) A)."""
    rng = np.random.default_rng(0)
    cases = [([r], [A], 0.2) for r in (1.5, 0.5) for A in (1.0, -1.0)]
    for r, A, c in (*cases, (rng.lognormal(sigma=0.4, size=50), rng.normal(size=50), 0.3)):
        r, A = np.array(r), np.array(A)
        cut = np.clip(r, 1 - c, 1 + c) * A
        slips = {
            "the gain of a likelier good action stops at 1 + c, of an unlikelier bad one at 1 - c: "
            "it is cut": (r * A).mean(),
            "likelier and bad, unlikelier and good: nothing is cut, or it could not be undone": (
                cut.mean()
            ),
        }
        yield (r, A, c), np.minimum(r * A, cut).mean(), slips


def _used(k1: float, k2: float, tau: float, K: float, h: float) -> float:
    """Used share of the sampled-data bound."""
    return float((k1 + h / 2 * k2) * K * np.tanh(h / (2 * tau)))


def _radius(k1: float, k2: float, tau: float, K: float, h: float) -> float:
    """Spectral radius of the held loop."""
    return float(np.abs(np.linalg.eigvals(sampled_matrix(k1, k2, -1 / tau, K / tau, h))).max())


@check("09-slope-cap")
def slope_cap(answer: Any) -> None:
    """Judge `my_factor(k1, k2, tau, K, h)`: at most 1, and at most 98 % of the sampled limit."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        tau, K, h = rng.uniform(0.005, 0.05), rng.uniform(1.0, 60.0), rng.uniform(0.002, 0.02)
        k1, k2 = rng.uniform(0.01, 3.0) / K, rng.uniform(0.1, 300.0) / K
        used = _used(k1, k2, tau, K, h)
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
