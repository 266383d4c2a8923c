"""Exercises of lesson 07: the worst disturbance, the edge of a delayed loop, anti-windup."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from cmc.exercises import check, expect
from cmc.theory.delay import LagLoop, largest_gain, spectral_radius

Array = np.ndarray


@check("07-worst-disturbance")
def worst_disturbance(answer: Callable[[float, Array, Array, Array, float], Array]) -> None:
    """Judge `my_disturbance(t, J, B, row, end)`: |d| <= 1, row xi(end) as large as it can be."""
    J = np.array([[-0.3, -2.0, 0.4], [2.0, -0.3, 0.0], [0.0, 0.5, -1.0]])
    B, row, end, steps = np.array([[1.0, 0.2], [0.0, 1.0], [0.5, 0.0]]), np.eye(3)[0], 6.0, 240
    dt = end / steps
    times = dt * (np.arange(steps) + 0.5)
    weights = np.array([row @ expm(J * (end - t)) @ B for t in times])
    best = float(np.linalg.norm(weights, axis=-1).sum() * dt)

    def reached(signal: Array) -> float:
        return float((weights * signal).sum() * dt)

    found = np.array([np.asarray(answer(t, J, B, row, end), dtype=float) for t in times])
    expect(found.shape == (steps, 2), f"d(t) should have shape (2,), got {found.shape[1:]}")
    longest = float(np.linalg.norm(found, axis=-1).max())
    expect(longest <= 1 + 1e-9, f"|d| goes up to {longest:.3g}; divide by its length")
    share = reached(found) / best
    if share < -0.9:
        expect(False, "this makes row xi as negative as it can be: the sign is wrong")
    backwards = reached(found[::-1]) / best
    if backwards > 0.98 > share:
        expect(False, "the time runs the wrong way: what acts at t has end - t left to decay")
    still = float(np.abs(np.diff(found, axis=0)).max()) == 0.0
    hint = "a constant; let it turn with the loop" if still else "point along B^T e^(J^T (end - t))"
    expect(share > 0.98, f"yours reaches {share:.0%} of the worst ({hint})")


@check("07-edge")
def edge(answer: Callable[[Callable[[float], float], float], float]) -> None:
    """Judge `my_edge(radius, top)`: the first slope at which the spectral radius reaches 1."""
    loop = LagLoop(tau=1.0, gain=1.0, period=0.25, integral_time=2.5)
    for late in (0.0, 0.1, 0.5, 1.3):
        wanted = float(largest_gain(loop, late))

        def radius(slope: float, late: float = late) -> float:
            return spectral_radius(loop, late, float(slope))

        found = float(answer(radius, 30.0))
        hint = "" if found < wanted else "; the radius crosses 1 before"
        expect(
            abs(found - wanted) < 1e-4 * wanted,
            f"with a delay of {late:g} the edge is at {wanted:.6g}, yours is {found:.6g}{hint}",
        )

    def returns(slope: float) -> float:
        return 1.2 if 1.0 <= slope < 2.0 or slope > 20.0 else 0.9

    found = float(answer(returns, 30.0))
    expect(abs(found - 1.0) < 1e-3, f"a radius above 1 from 1 to 2 was missed: {found:.4g}")


Rule = Callable[[float, float, float, float, float, float, float], float]


def _respond(rule: Rule, limit: float, goal: float) -> tuple[Array, bool]:
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
def anti_windup(answer: Rule) -> None:
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
