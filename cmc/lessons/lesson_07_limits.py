"""Lesson 07, third part: noise, delay and saturation, where the guarantee ends.

The loop is the x axis of the peg: a lag of 43.7 ms, sampled every 10 ms, with the slope on the
integral ten times the slope on the error (our choice).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from cmc.fast import budget
from cmc.theory.contraction import metric_factor
from cmc.theory.delay import (
    DelayMap,
    LagLoop,
    class_gain,
    delay_map,
    largest_gain,
    sample_matrix,
    simulate,
)
from cmc.theory.noise import disturbance_gain, noise_gain
from cmc.theory.saturation import (
    ANTI_WINDUP,
    SaturatedLoop,
    overshoot,
    settling_time,
    simulate_saturated,
)

Array = NDArray[np.float64]

LOOP = LagLoop()
SLOPE = 3.0
"""Slope of the policy that the first figure breaks: certified without delay."""


def fails() -> dict[str, Array]:
    """A certified slope as designed and with a late command; an unstable mode, command limited."""
    steps = 100
    found: dict[str, Array] = {"t": np.asarray(LOOP.period * np.arange(steps), float)}
    for name, late in (("as designed", 0.0), ("30 ms late", 0.03)):
        found[name] = np.array(list(simulate(LOOP, late, SLOPE, steps, limit=2.0)))
    found["longer t"] = np.asarray(0.01 * np.arange(301), float)
    for start in (0.45, 0.55):
        path = simulate_saturated(_unstable(2.0), start, 300, anti_windup="clamp")[0]
        found[f"start {start}"] = np.where(path < 3.0, path, np.nan)
    return found


def _unstable(rate: float) -> SaturatedLoop:
    """A growing mode with the slope floor that theorem 2 asks for, and a limited command."""
    return SaturatedLoop(lam=rate, r=1.0, k1=12.0, k2=10.0, low=-1.0, high=1.0)


def _saturated(limit: float) -> SaturatedLoop:
    return SaturatedLoop(k1=1.0, k2=20.0, low=-limit, high=limit)


def noise_price(late: float = 0.02, points: int = 25) -> dict[str, Array]:
    """What a larger slope costs in noise and buys against disturbances, predicted and measured.

    Args:
        late: delay, s.
        points: number of slopes.
    """
    slopes = np.geomspace(0.2, 0.97 * float(largest_gain(LOOP, late)), points)
    some, rng = slopes[::4], np.random.default_rng(0)
    steps = budget(6000, 2000)
    noise = rng.normal(size=(steps, 50, 1))
    wide = np.broadcast_to(some, (50, len(some)))
    path = simulate(LOOP, late, wide, steps, noise=noise, start=0.0)
    measured = np.array(list(path))[steps // 4 :].std(axis=(0, 1))
    return {
        "slopes": slopes,
        "noise": np.array([noise_gain(LOOP, late, k) for k in slopes]),
        "disturbance": np.array([disturbance_gain(LOOP, late, k) for k in slopes]),
        "measured at": some,
        "measured": measured,
    }


@cache
def limits_map(points: int = 40) -> DelayMap:
    """Delay against log gain, 40 x 40 cells, predicted and measured (0.3 s)."""
    return delay_map(LOOP, np.linspace(0.0, 0.1, points), np.geomspace(0.3, 40.0, points))


def late_response(delay: float, log_slope: float, tanh: bool) -> dict[str, Any]:
    """Slider: error of the delayed loop, its poles, and the verdicts.

    Args:
        delay: ms.
        log_slope: log10 of the slope.
        tanh: whether the command saturates smoothly at 1.
    """
    late, slope = 1e-3 * delay, 10.0**log_slope
    steps = 120
    limit = 1.0 if tanh else np.inf
    error = np.array(list(simulate(LOOP, late, slope, steps, limit=limit)))
    poles = np.linalg.eigvals(sample_matrix(LOOP, late, slope))
    edge, safe = float(largest_gain(LOOP, late)), float(class_gain(LOOP, late))
    verdict = (
        "unstable"
        if slope >= edge
        else "stable, not guaranteed for changing slopes"
        if slope >= safe
        else "every policy up to this slope contracts"
    )
    return {
        "t": 1e3 * LOOP.period * np.arange(steps),
        "e": np.clip(error, -10.0, 10.0),
        "poles": poles.astype(complex),
        "circle": np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)[:, None],
        "text": f"slope {slope:.2f}: {verdict} (edge {edge:.2f}, guarantee {safe:.2f})",
    }


_TURN = np.linspace(0.0, 2.0 * np.pi, 181)


def unclipped_set(limit: float = 0.5, count: int = 4000) -> dict[str, Array]:
    """Starts (z, int z), which of them ever clip the command, and the ball that never does.

    Returns:
        `starts` (count, 2), `clipped` (count,), and `edge` (181, 2), the border of the ball.
    """
    loop = _saturated(limit)
    metric = solve_discrete_lyapunov(loop.transition().T, np.eye(2))
    level = loop.unclipped_level(metric)
    circle = level * np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)
    edge = circle @ np.linalg.inv(metric_factor(metric)).T
    rng = np.random.default_rng(0)
    starts = rng.uniform(-1.6, 1.6, (count, 2)) * np.abs(edge).max(axis=0)
    _, raw, _ = simulate_saturated(loop, starts[:, 0], 300, integral=starts[:, 1])
    clipped = ((raw < loop.low) | (raw > loop.high)).any(axis=0)
    inside = np.linalg.norm(starts @ metric_factor(metric).T, axis=-1) <= level
    return {"starts": starts, "clipped": clipped, "inside": inside, "edge": edge}


def windup(limit: float, remedy: str) -> dict[str, Any]:
    """Slider: a step of 1 under a limited command.

    Args:
        limit: largest command around the one that holds the target.
        remedy: one of `ANTI_WINDUP`.
    """
    loop, steps = _saturated(limit), 200
    path, raw, total = simulate_saturated(loop, 1.0, steps, anti_windup=remedy)
    late = float(settling_time(path, 0.02, loop.period))
    past = float(overshoot(path))
    return {
        "t": loop.period * np.arange(steps),
        "z": path[:-1],
        "wanted": np.clip(raw, -4.0, 4.0),
        "applied": np.clip(raw, loop.low, loop.high),
        "integral": total,
        "text": f"within 2 % after {late:.2f} s, overshoot {100 * past:.0f} %",
    }


def windup_curves(points: int = 30) -> dict[str, Any]:
    """Settling time and overshoot against the limit, for each remedy."""
    limits = np.geomspace(0.1, 3.0, points)
    late: dict[str, Array] = {}
    past: dict[str, Array] = {}
    for remedy in ANTI_WINDUP:
        paths = [
            simulate_saturated(_saturated(limit), 1.0, 1000, anti_windup=remedy)[0]
            for limit in limits
        ]
        late[remedy] = np.array([settling_time(path, 0.02, 0.01) for path in paths])
        past[remedy] = np.array([100.0 * overshoot(path) for path in paths])
    return {"limits": limits, "settling": late, "overshoot": past}


def rescue(points: int = 20) -> dict[str, Any]:
    """An unstable mode under a limited command: the largest start that comes back.

    Returns:
        `growth` (1/s), the predicted largest recoverable |z|, and the largest start from which the
        loop with each remedy came back, on a grid of starts.
    """
    growth = np.linspace(0.3, 4.0, points)
    starts = np.linspace(0.02, 3.5, 175)
    predicted, largest = [], {remedy: [] for remedy in ANTI_WINDUP}  # type: ignore[var-annotated]
    for rate in growth:
        loop = _unstable(float(rate))
        predicted.append(loop.recoverable()[1])
        for remedy in ANTI_WINDUP:
            path, _, _ = simulate_saturated(loop, starts, 1500, anti_windup=remedy)
            back = np.abs(path[-1]) < 1e-2
            largest[remedy].append(starts[back].max(initial=0.0))
    reached = {remedy: np.array(values) for remedy, values in largest.items()}
    return {"growth": growth, "predicted": np.array(predicted), "reached": reached}
