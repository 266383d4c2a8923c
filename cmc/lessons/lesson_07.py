"""Lesson 07, first part: the error ball of a certified loop.

The loop is the one of the lessons before: two coupled lags, T_y and T_a, one positive network per
dimension with a floor under its slopes, so that a certificate with a rate exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc import plants
from cmc.fast import budget
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import Certificate, common_metric, loop_jacobian
from cmc.theory.certify import certify
from cmc.theory.disturbance import (
    peak_gain,
    random_disturbances,
    worst_constant,
    worst_signal,
)
from cmc.theory.reach import Ellipsoid, reach, shape_metric
from cmc.theory.robustness import ErrorBall, respond

Array = NDArray[np.float64]

SLOPES = ((1.0, 1.0), (2.0, 3.0))
"""Slopes in (z, int z), at least and at most: our choice."""
STEP = 0.1
"""Step of the integrator, s."""


@dataclass(frozen=True)
class Example:
    """A certified loop in the coordinates (z, int z)."""

    space: AuxiliarySpace
    certificate: Certificate
    """Proved from the slope bounds, one metric per dimension joined as a hierarchy."""
    common: Certificate
    """One metric searched for all corners of the slopes at once."""
    shaped: Ellipsoid
    """A metric shaped for the error of y_1."""
    corners: Array
    """Jacobians at the corners of the slopes, (16, 4, 4)."""
    channel: Array
    """How a disturbance of y' enters (z, int z): [T_y; 0], (4, 2)."""
    row: Array
    """y_1 as a row of (z, int z), (4,)."""
    rhs: Any
    """Right-hand side of the real, nonlinear loop."""


@cache
def example() -> Example:
    """Build the loop and its three metrics."""
    plant = plants.get("coupled_lags")
    network = PositiveNetwork(2, hidden=(8, 8), slope_min=SLOPES[0], slope_max=SLOPES[1])
    policy = ModularPolicy(network)
    at = np.zeros(2)
    space = decompose(plant.f_y(at, at), plant.f_u(at, at))
    low, high = policy.slope_bounds()
    ends = np.stack([low.ravel(), high.ravel()], axis=-1)
    slopes = np.array(list(product(*ends))).reshape(-1, 2, 2)
    sign = -np.sign(space.gains)
    corners = loop_jacobian(space.Lambda, space.R, sign * slopes[..., 0], sign * slopes[..., 1])
    channel = np.vstack([space.T_y, np.zeros((2, 2))])
    row = np.concatenate([np.linalg.inv(space.T_y)[0], np.zeros(2)])
    common = common_metric(corners)
    if common.metric is None:
        raise RuntimeError(f"the example needs a common metric: {common}")
    pi = _in_numpy(network)

    def rhs(t: float, s: Array) -> Array:
        z, integral = s[..., :2], s[..., 2:]
        a = sign * pi(z, integral)  # constraint_sign
        return np.concatenate([z @ space.Lambda.T + a @ space.R.T, z], axis=-1)

    shaped = shape_metric(corners, common.metric, channel, row)
    certificate = certify(policy, plant)
    return Example(space, certificate, common, shaped, corners, channel, row, rhs)


def _in_numpy(network: PositiveNetwork) -> Callable[[Array, Array], Array]:
    """The network as a function of z and int z, (..., n) each: fast in small batches."""
    weights = [w.detach().double().numpy() for w in network.positive_weights()]
    biases = [b.detach().double().numpy()[:, 0] for b in network.mlp.biases]
    bypass = network.slope_min.double().numpy()

    def pi(z: Array, integral: Array) -> Array:
        s = np.stack([z, integral], axis=-1)
        x = s
        for layer, (W, b) in enumerate(zip(weights, biases, strict=True)):
            x = np.einsum("...ni,nij->...nj", x, W) + b
            x = np.tanh(x) if layer < len(weights) - 1 else x
        return x[..., 0] + (bypass * s).sum(axis=-1)

    return pi


def differences(
    size: float, count: int, seconds: float, *, seed: int = 0, apart: float = 1.0
) -> tuple[Array, Array]:
    """Disturbed minus undisturbed trajectories of the nonlinear loop.

    Args:
        size: bound on ||d||, added to y'.
        count: number of pairs; half of them start together.
        seconds: length, s.
        seed: of starts and disturbances.
        apart: spread of the starts of the other half.

    Returns:
        Times (T,) and differences in (z, int z), (T, count, 4).
    """
    this, rng = example(), np.random.default_rng(seed)
    steps = round(seconds / STEP)
    times = STEP * np.arange(steps + 1)
    d = random_disturbances(rng, steps, count, size, step=STEP, m=2)
    first = rng.normal(size=(count, 4))
    second = first + apart * rng.normal(size=(count, 4)) * (np.arange(count) % 2)[:, None]
    pair = np.concatenate([first, second])
    push = np.concatenate([np.zeros((steps, count, 4)), d @ this.channel.T], axis=1)
    path = respond(this.rhs, pair, times, push)
    drift: Array = np.subtract(path[:, count:], path[:, :count])
    return np.asarray(times, dtype=np.float64), drift


def in_metric(size: float = 1.0, seconds: float = 15.0) -> dict[str, Any]:
    """Distances in the certificate's metric under the worst disturbances, beside the bound.

    The worst constant is exact for slopes fixed at the worst corner; the worst signal is aimed at
    the same displacement. Both are then applied to the real loop.

    Returns:
        Times `t`, the `bound`, and the distances `courses` by name, (T,) each.
    """
    this = example()
    ball = balls()["certificate"]
    corner = max(this.corners, key=lambda J: worst_constant(J, this.channel, ball.metric)[0])
    length, d = worst_constant(corner, this.channel, ball.metric)
    row = ball.metric @ np.linalg.solve(corner, -this.channel @ d) / length
    times = STEP * np.arange(round(seconds / STEP) + 1)
    signal, _ = worst_signal(corner, this.channel, row, times)
    constant = np.broadcast_to(d, signal.shape)
    calm = np.zeros((len(times) - 1, 4))
    push = np.stack([calm, size * constant @ this.channel.T, size * signal @ this.channel.T], 1)
    fixed = respond(lambda t, s: s @ corner.T, np.zeros((3, 4)), times, push)
    real = respond(this.rhs, np.zeros((3, 4)), times, push)
    random = differences(size, budget(2000, 500), seconds, apart=0.0)[1]
    courses = {
        "worst signal, worst fixed slopes": ball.distance(fixed[:, 2]),
        "worst constant, worst fixed slopes": ball.distance(fixed[:, 1]),
        "worst signal, real loop": ball.distance(real[:, 2] - real[:, 0]),
        "worst constant, real loop": ball.distance(real[:, 1] - real[:, 0]),
        "largest of the random ones": ball.distance(random).max(axis=1),
    }
    return {"t": times, "bound": ball.bound(times, 0.0, size), "courses": courses}


@cache
def containment(size: float = 1.0) -> dict[str, Any]:
    """Ten thousand disturbed trajectories against every bound.

    Returns:
        `count`; per bound the number of trajectories that it contains at all times (`inside`) and
        the largest share of it that is used after the transient (`used`); for `shares` the largest
        share per trajectory.
    """
    this = example()
    count = budget(10_000, 1_000)
    times, apart = differences(size, count, 12.0)
    inside, used, shares = {}, {}, {}
    output = np.abs(apart @ this.row)
    for name, ball in balls().items():
        start = ball.distance(apart[0])
        bound = ball.output_bound(this.row, times[:, None], start, size)
        share = output[1:] / bound[1:]
        inside[name] = int((output <= bound * (1 + 1e-9) + 1e-12).all(axis=0).sum())
        shares[name] = share.max(axis=0)
        used[name] = float(share[len(share) // 2 :].max())
    late = float(output[len(times) // 2 :].max())
    return {"count": count, "inside": inside, "used": used, "shares": shares, "largest": late}


def balls() -> dict[str, ErrorBall | Ellipsoid]:
    """The same loop, four promises: certificate, common metric, its ellipsoid, shaped one."""
    this = example()
    assert this.common.metric is not None
    return {
        "certificate": ErrorBall.of(this.certificate, this.channel),
        "one metric": ErrorBall.of(this.common, this.channel),
        "its ellipsoid": reach(this.corners, this.common.metric, this.channel),
        "shaped ellipsoid": this.shaped,
    }


@cache
def ladder() -> dict[str, float]:
    """Promised and reached |y_1| per unit of disturbance, from the loosest to what happens."""
    this, found = example(), balls()
    certificate = found["certificate"]
    assert isinstance(certificate, ErrorBall)
    # |y_1| <= ||row|| times the Euclidean length: what the paper's inequality says about y_1
    paper = float(np.linalg.norm(this.row) * certificate.euclidean_bound(np.inf, 0.0, 1.0))
    steps = {"the paper's inequality": paper}
    for name, ball in found.items():
        steps[name] = float(ball.output_bound(this.row, np.inf, 0.0, 1.0))
    worst = max(peak_gain(J, this.channel, this.row) for J in this.corners)
    steps["worst signal, slopes fixed"] = worst
    steps[f"largest of {containment()['count']}"] = containment()["largest"]
    return steps


def ball(size: float, metric: str) -> dict[str, Any]:
    """Slider: differences of y_1 inside the promise of one metric.

    Args:
        size: bound on the disturbance of y'.
        metric: a name of `balls`.
    """
    this, chosen = example(), balls()[metric]
    times, apart = differences(size, 24, 8.0, seed=1, apart=0.0)
    bound = chosen.output_bound(this.row, times, 0.0, size)
    largest = float(np.abs(apart @ this.row).max())
    text = f"promised {bound[-1]:.2f}, largest seen {largest:.2f}"
    return {"t": times, "y": apart @ this.row, "low": -bound, "high": bound, "text": text}
