"""Exercises of lessons 05 to 07."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.linalg import expm

from cmc.exercises import check, expect, expect_close, numbers
from cmc.plants import LinearPlant
from cmc.theory.certify import certify
from cmc.theory.identification import fit_latent
from cmc.theory.sampled import LagLoop

# ---- lesson 05: slopes, a pumped swing, another quadrature, a plant of one's own


def _slopes(weights: list[np.ndarray], biases: list[np.ndarray], s: np.ndarray) -> list[float]:
    """Slopes of a tanh network by differences, (2,)."""

    def pi(x: np.ndarray) -> float:
        for W, b in zip(weights[:-1], biases, strict=True):
            x = np.tanh(W @ x + b)
        return float((weights[-1] @ x)[0])

    return [(pi(s + d) - pi(s - d)) / 2e-6 for d in 1e-6 * np.eye(2)]


@check("05-slopes")
def slopes(answer: Any) -> None:
    """Judge `my_slopes(weights, biases, s)`: d pi / d s of a tanh network, by `product`.

    Weights are (out, in); the last layer is linear, has one output and no bias; s is (2,).
    """
    rng = np.random.default_rng(0)
    for hidden in ((4,), (5, 3), (4, 4, 4)):
        sizes = (2, *hidden, 1)
        weights = [rng.uniform(0, 1.5, (b, a)) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
        biases = [rng.normal(size=len(W)) for W in weights[:-1]]
        s = rng.normal(size=2)
        found = answer([W.copy() for W in weights], [b.copy() for b in biases], s.copy())
        expect(np.size(found) == 2, "two slopes are wanted, one for each input")
        name = f"the slopes of a network with {len(hidden)} hidden layer(s)"
        straight = "this is W_l ... W_1 alone; put D_j = diag(1 - tanh^2) between them"
        slips = {
            "the biases are missing inside tanh": _slopes(weights, [0 * b for b in biases], s),
            straight: np.linalg.multi_dot(weights[::-1])[0],
        }
        expect_close(np.ravel(found), _slopes(weights, biases, s), name, slips, atol=1e-8)


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


@check("05-quadrature")
def quadrature(answer: Any) -> None:
    """Judge `my_step(p, q, Lambda, R, h)`: the held step in (z_k, I_k), I_{k+1} = I_k + h z_k."""
    for p, q, Lambda, R, h in ((0.5, 0.2, -1.0, 2.0, 0.3), (3.0, 1.0, 0.4, 0.7, 0.1)):
        phi, G = expm(h * np.array([[Lambda, R], [0.0, 0.0]]))[0]
        hint = "this is the matrix of the text: the new error must not be in the command's sum"
        slips = {hint: [[phi - G * (p + h * q), -G * q], [h, 1.0]]}
        wanted = [[phi - G * p, -G * q], [h, 1.0]]
        expect_close(answer(p, q, Lambda, R, h), wanted, "the step in (z_k, I_k)", slips)


@check("05-own-plant")
def own_plant(answer: Any) -> None:
    """Judge `my_plant()`: f_y, f_u, floor, ceiling and the sample time where `certify` gives up."""
    found = answer()
    expect(len(found) == 5, "return f_y, f_u, floor, ceiling, h")
    names = ("f_y", "f_u", "floor", "ceiling")
    f_y, f_u, floor, ceiling = (
        numbers(v, (2, 2), name) for v, name in zip(found[:4], names, strict=True)
    )
    h = float(found[4])
    for name, M in (("f_y", f_y), ("f_u", f_u)):
        expect(np.count_nonzero(M - np.diag(np.diag(M))), f"{name} is diagonal: nothing is coupled")
    expect((ceiling > floor).all(), "every ceiling should lie above its floor")
    plant = LinearPlant(f_y, f_u)
    interval = SimpleNamespace(slope_bounds=lambda: (floor, ceiling))
    for share in (None, 0.9, 1.1):
        verdict = certify(interval, plant, h=None if share is None else share * h)
        when = "without sampling" if share is None else f"at {share:g} h = {share * h:.3g} s"
        said = f"no ({verdict.reason})" if not verdict else f"yes, {verdict.rate:.3g} 1/s"
        expect(bool(verdict) == (share != 1.1), f"{when} certify says {said}")


# ---- lesson 06: gains and a hold for two rates, a verdict for every gain, better data


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
        swapped = np.isclose(K_p, slow + fast) and np.isclose(K_d, slow * fast)
        expect(not swapped, "K_p is the product of the rates and K_d their sum, not the reverse")
        poles = np.sort(np.roots([1.0, K_d, K_p]).real)
        expect_close(poles, [-fast, -slow], f"the poles for rates {slow:g} and {fast:g}")
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
        low, high = np.round(np.sort(values.real), 3)
        expect(
            found == wanted,
            f"K_p = {K_p:g}, K_d = {K_d:g}, g = {g:g}, dt = {dt:g}: {wanted!r} (eigenvalues "
            f"{low}, {high}), yours {found!r}; the level alone does not tell",
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


# ---- lesson 07: the worst disturbance, the edge of a delayed loop, anti-windup


Array = np.ndarray


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
        wanted = float(loop.largest_gain(late))
        found = float(answer(partial(loop.spectral_radius, late), 30.0))
        hint = "" if found < wanted else "; the radius crosses 1 before"
        expect(
            abs(found - wanted) < 1e-4 * wanted,
            f"with a delay of {late:g} the edge is at {wanted:.6g}, yours is {found:.6g}{hint}",
        )
    found = float(answer(lambda slope: 1.2 if 1.0 <= slope < 2.0 or slope > 20.0 else 0.9, 30.0))
    expect(abs(found - 1.0) < 1e-3, f"a radius above 1 from 1 to 2 was missed: {found:.4g}")


def _respond(rule: Callable[..., float], limit: float, goal: float) -> tuple[Array, bool]:
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
