"""The ball around the point of rest that no trajectory leaves, inside a box and off the limits.

A metric in which a loop contracts shrinks the distance of every trajectory to the point of rest.
So a ball around it stays, if the loop contracts in all of it: if it lies in the box that was looked
at, and if no command is clipped in it. Under a hold that is said of the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array
from cmc.theory.certificates import Certificate
from cmc.theory.contraction import metric_factor
from cmc.theory.identification import command_limits, differences, root
from cmc.theory.simulate import Loop
from cmc.theory.slopes import BlockLoop

_SAMPLES = 2048


def _rest_point(loop: Loop, keep: Array) -> Array | None:
    """State (y, int z), (2n,), in which the loop rests; None where Newton's method finds none.

    `keep` says which states the loop has: an integral that nothing uses is free.
    """
    n = loop.n
    start = np.concatenate([loop.y_ref + np.zeros(n), np.zeros(n)])

    def residual(x: Array) -> Array:
        s = np.broadcast_to(start, (*x.shape[:-1], 2 * n)).copy()
        s[..., keep] = x
        return loop.field(0.0, s)[..., keep]

    def jacobian(x: Array) -> Array:
        return differences(residual, x, 1e-6 * (np.abs(x) + 1e-3 * np.abs(x).max() + 1e-6))

    try:
        start[keep], lost = root(residual, jacobian, start[keep], 1e-12)
    except (ValueError, TypeError, np.linalg.LinAlgError):
        return None
    return None if lost else start


def ball_everywhere(
    answer: Certificate, blocks: BlockLoop, policy: Any, plant: Any, y_ref: ArrayLike
) -> Certificate:
    """Add the ball to a certificate in (z, int z) that holds for all commands within the limits.

    |du_j| <= sum_i |T_a,ji| (|p_i| |dz_i| + |q_i| |dI_i|) over the interval of the slopes, and in a
    ball of radius r each |dx_i| is at most r |row i of Theta^-1|.
    """
    low, high = command_limits(plant)
    if not np.isfinite([low, high]).any():
        return replace(answer, ball=np.inf)
    caution = "while no command is clipped at the plant's limits"
    space, keep, h = blocks.space, blocks.keep, blocks.h
    try:
        loop = Loop(plant, policy, space, y_ref)
        rest = _rest_point(loop, keep)
    except (ValueError, TypeError):  # slopes alone say nothing about commands
        rest = None
    if rest is None:
        return replace(answer, reason=f"{answer.reason}; {caution}")
    n, rows = space.n, np.zeros(2 * space.n)
    rows[keep] = np.linalg.norm(_spread_of(answer), axis=1)
    size = np.abs([blocks.low, blocks.high]).max(axis=0)
    p = size[:, 0] + (0.0 if h is None else h * size[:, 1])
    speed = np.abs(space.T_a) @ (p * rows[:n] + size[:, 1] * rows[n:])
    u = loop.signals(rest[:n], rest[n:])[-1]
    radius = float((np.minimum(u - low, high - u) / speed).min())
    state = np.concatenate([space.to_z(rest[:n] - loop.y_ref), rest[n:]])[keep]
    return _noted(replace(answer, rest=state), radius, caution)


def ball_in_box(
    answer: Certificate, loop: Loop, keep: Array, low: Array, high: Array, h: float | None
) -> Certificate:
    """Add the ball to a certificate in (y, int z) over a box; commands are looked at on points."""
    caution, rest = "nothing says that they do", _rest_point(loop, keep)
    if rest is None:
        return replace(answer, reason=f"{answer.reason} ({caution}: no point of rest was found)")
    n, m, spread, limits = loop.n, len(keep), _spread_of(answer), command_limits(loop.plant)
    room = np.minimum(rest - low, high - rest)[keep] / np.linalg.norm(spread, axis=1)
    radius = 0.99 * float(room.min())  # rest itself is not exact

    def left(x: Array) -> Array:
        """How far the commands are from the plant's limits, (N,)."""
        s = np.broadcast_to(rest, (len(x), 2 * n)).copy()
        s[:, keep] += radius * x @ spread.T
        u = loop.signals(s[:, :n], s[:, n:], h=h)[-1]
        return np.asarray(np.minimum(u - limits[0], limits[1] - u).min(axis=-1))

    start = _in_ball(np.random.default_rng(3).normal(size=(_SAMPLES, m)))
    while radius > 0 and np.isfinite(limits).any():
        _, found, margin = lowest(left, start, _in_ball, np.full(m, 0.3))
        if found.min() > margin:
            break
        radius = 0.8 * radius if radius > 1e-3 * room.min() else 0.0
    return _noted(replace(answer, rest=rest[keep]), radius, caution)


def _in_ball(x: Array) -> Array:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1.0))


def lowest(
    value: Callable[[Array], Array], points: Array, place: Callable[[Array], Array], width: Array
) -> tuple[Array, Array, float]:
    """Go downhill from the lowest of some points (N, m), in clouds half as wide as the one before.

    `place` brings points back to where they may be. Returns all points, their values, (N,), and by
    how much the last three clouds lowered the smallest. A value that bends evenly, or has a kink,
    is lowered less by all clouds that could follow: that much is left as a margin.
    """
    rng, values, smallest = np.random.default_rng(0), value(points), []
    for k in range(5):
        smallest.append(values.min())
        near = points[np.argsort(values)[:32]]
        cloud = near + rng.normal(size=(8, *near.shape)) * width / 2**k
        cloud = place(cloud.reshape(-1, near.shape[-1]))
        points, values = np.concatenate([points, cloud]), np.concatenate([values, value(cloud)])
    return points, values, float(smallest[-3] - values.min())


def _spread_of(answer: Certificate) -> Array:
    """Theta^-1 of the metric, (m, m)."""
    assert answer.metric is not None
    return np.asarray(np.linalg.inv(metric_factor(answer.metric)), dtype=float)


def _noted(answer: Certificate, radius: float, caution: str) -> Certificate:
    if not radius > 0:
        why = "the point of rest lies outside of the box or of the command limits"
        return replace(answer, reason=f"{answer.reason} ({caution}: {why})")
    note = f"no trajectory leaves the ball of radius {radius:.3g} around rest in this metric"
    return replace(answer, ball=radius, reason=f"{answer.reason}; {note}, nor is clipped in it")
