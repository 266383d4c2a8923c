"""Lesson 05, from inequality to weights: parameters in, arrays out."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from cmc import plants
from cmc.policies import IndependentNetwork, ModularPolicy, PositiveNetwork
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import circle_criterion
from cmc.theory.contraction import floquet_multipliers
from cmc.theory.exact import closed_loop
from cmc.theory.sampled import largest_slope, sampled_margin, sampled_matrix
from cmc.theory.simulate import rk4

Array = NDArray[np.float64]
Picture = dict[str, Any]

# The peg's force loop: tau_z = 10 ms, and the stiffest surface of the paper
FORCE_TAU, FORCE_GAIN = 0.01, 31.0


def auxiliary_space(plant: plants.Plant) -> AuxiliarySpace:
    """T_y, T_a, Lambda and R of a plant with constant Jacobians."""
    rest = np.zeros(plant.n)
    return decompose(plant.f_y(rest, rest), plant.f_u(rest, rest))


def untrained_loops(number: int = 60) -> Picture:
    """Loops of the coupled lags with untrained networks: weights of any sign, and positive ones.

    Both have T_y, T_a and the sign rule around them and start at y = (1.5, -1).

    Returns:
        `t` (m,) and the distances |y| to the goal, `free` and `positive`, (m, number) each.
    """
    plant, seeds = plants.get("coupled_lags"), tuple(range(number))
    free = IndependentNetwork(2, hidden=(16, 16), seeds=seeds, last=3.0, dtype=torch.float64)
    positive = PositiveNetwork(2, hidden=(16, 16), seeds=seeds, dtype=torch.float64)
    t = np.linspace(0, 20, 401)
    loops = {
        name: _seeded_loop(net, plant, t) for name, net in (("free", free), ("positive", positive))
    }
    return {"t": t, **loops}


def _seeded_loop(network: Any, plant: plants.Plant, t: Array) -> Array:
    """|y| over time with one network per seed, (m, seeds)."""
    space = auxiliary_space(plant)

    def field(_: float, s: Array) -> Array:
        y, I = s[..., :2], s[..., 2:]
        z = space.to_z(y)
        inputs = torch.as_tensor(np.stack([z, I], axis=-1)[:, None])
        with torch.no_grad():
            a = -network(inputs)[:, 0].numpy() * np.sign(space.gains)
        return np.concatenate([plant.f(y, space.to_u(a)), z], axis=-1)

    start = np.tile([1.5, -1.0, 0.0, 0.0], (network.seeds, 1))
    return np.linalg.norm(rk4(field, start, t)[..., :2], axis=-1)


def slopes(weight: float, bypass: float, cap: float) -> Picture:
    """One positive network, its slope in z, and the interval that its construction guarantees.

    Args:
        weight: Factor on the first layer's weights.
        bypass: Slope m of the linear bypass.
        cap: Largest slope M above the bypass; 0 for no cap.

    Returns:
        `s` (m,), the output `pi` (m,), its `slope` (m,), and the interval's ends `low`, `high`.
    """
    limit = bypass + cap if cap > 0 else None
    network = PositiveNetwork(
        1, hidden=(8, 8), seeds=(3,), slope_min=bypass, slope_max=limit, dtype=torch.float64
    )
    with torch.no_grad():
        network.mlp.weights[0].mul_(weight)
        s = np.linspace(-6, 6, 241)
        inputs = torch.as_tensor(np.stack([s, 0 * s], axis=-1)[None, :, None])
        pi, slope = network(inputs)[0, :, 0].numpy(), network.jacobian(inputs)[0, :, 0, 0].numpy()
    low, high = (float(end[0, 0, 0]) for end in network.slope_bounds())
    text = f"guaranteed slope {low:.3f} to {high:.3f}; found {slope.min():.4f} to {slope.max():.3f}"
    return {"s": s, "pi": pi, "slope": slope, "low": low, "high": high, "text": text}


def module_transfer(plant: plants.Plant, dimension: int, ratio: float) -> Any:
    """Open loop R (s + ratio) / (s (s - Lambda)) of one module, for the `control` package.

    Closing it with gain p gives s^2 + (R p - Lambda) s + R p ratio: the slopes are p and ratio p.
    """
    import control

    space = auxiliary_space(plant)
    R, Lambda = float(space.gains[dimension]), float(space.eigenvalues[dimension])
    return control.tf([R, R * ratio], [1.0, -Lambda, 0.0])


def loop_growth(gains: ArrayLike, ratio: float) -> dict[str, Array]:
    """Largest real part of the coupled lags' loop over a common slope, with and without transforms.

    Args:
        gains: Slopes p in z of both dimensions, (m,).
        ratio: Slope in int z over p, 1/s.

    Returns:
        Growth in 1/s by the name of the transforms, (m,) each.
    """
    plant, rest = plants.get("coupled_lags"), np.zeros(2)
    f_y, f_u = plant.f_y(rest, rest), plant.f_u(rest, rest)
    answer = {}
    for name, space in (
        ("identity transforms", AuxiliarySpace.identity(f_y, f_u)),
        ("T_y and T_a", decompose(f_y, f_u)),
    ):
        p = -np.sign(space.gains) * np.asarray(gains, dtype=float)[:, None]
        top = np.concatenate(
            [space.Lambda + space.R * p[:, None], space.R * (ratio * p[:, None])], axis=-1
        )
        below = np.broadcast_to(np.eye(2, 4), top.shape)
        answer[name] = np.linalg.eigvals(np.concatenate([top, below], axis=-2)).real.max(-1)
    return answer


def breathing(damping: float, depth: float) -> Picture:
    """A loop whose integral slope breathes, k(t) = 1 + depth cos 2t: frozen view against truth.

    Args:
        damping: -(Lambda + R p), 1/s.
        depth: How deep the slope breathes, 0 to below 1.

    Returns:
        `t`, `w` (m, 3) the integral of z from three starts, `k` (m,), `frozen` (m,) the largest
        real part of J(t) at each instant, the size of the largest `multiplier` over a period, and
        `certified`.
    """
    loop = plants.FloquetLoop(lag=-damping / 2, p=-damping / 2, depth=depth)
    t = np.linspace(0, 12 * loop.period, 481)
    w = rk4(loop.rhs, [[0.0, 1.0], [1.0, 0.0], [0.5, -0.8]], t)[..., 1]
    k = 1 + depth * np.cos(2 * t)
    multipliers = floquet_multipliers(lambda time: loop.jacobian(time, np.zeros(2)), loop.period)
    proof = circle_criterion(damping, 1 - depth, 1 + depth)
    largest = float(np.abs(multipliers[0]))
    frozen = (-damping + np.sqrt((damping**2 - 4 * k).astype(complex))).real / 2
    return {
        "t": t,
        "w": np.clip(w, -1e3, 1e3),
        "k": k,
        "frozen": frozen,
        "multiplier": largest,
        "certified": bool(proof),
        "text": f"largest eigenvalue at any instant {frozen.max():.3f} 1/s; grows by {largest:.3f} "
        f"a period; certificate: {'holds' if proof else 'refused'}",
    }


def verdicts(points: int = 41) -> Picture:
    """Truth and certificate of the breathing loop over damping and depth.

    Returns:
        `damping` (p,), `depth` (p,), `growth` (p, p) the logarithm of the largest multiplier with
        depth along the first axis, and `limit` (p,), the damping from which the circle criterion
        holds, by depth.
    """
    damping, depth = np.linspace(0.02, 1.0, points), np.linspace(0.0, 0.95, points)
    c, a = np.meshgrid(damping, depth)
    t = np.linspace(0, np.pi, 201)

    def field(time: float, s: Array) -> Array:
        k = 1 + a * np.cos(2 * time)
        z_dot = -c[..., None] * s[..., 0, :] - k[..., None] * s[..., 1, :]
        return np.stack([z_dot, s[..., 0, :]], axis=-2)

    end = rk4(field, np.broadcast_to(np.eye(2), (*c.shape, 2, 2)), t)[-1]
    growth = np.log(np.abs(np.linalg.eigvals(end)).max(axis=-1))
    limit = np.sqrt(1 + depth) - np.sqrt(1 - depth)
    return {"damping": damping, "depth": depth, "growth": growth, "limit": limit}


def two_attractors() -> Picture:
    """The tanh policy that keeps two attractors, and the same loop with more damping.

    Returns:
        `t` of the last periods, `light` and `heavy` (m, 2): int z from two starts.
    """
    found = {}
    for name, lag in (("light", -0.05), ("heavy", -0.95)):
        loop = plants.TwoAttractorLoop(lag=lag)
        t = np.linspace(0, 30 * loop.period, 6001)
        found[name] = rk4(loop.rhs, [[0.0, 0.0], [0.0, 6.0]], t)[-801:, :, 1]
    return {"t": t[-801:], **found}


@lru_cache(maxsize=8)
def bounded_policy(floor: float, ceiling: float, integral: float = 0.5) -> ModularPolicy:
    """Random positive networks with slopes from `floor` to `ceiling`, and `integral` times that."""
    low, high = [floor, integral * floor], [ceiling, integral * ceiling]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = PositiveNetwork(
            2, hidden=(16, 16), slope_min=low, slope_max=high, dtype=torch.float64
        )
    return ModularPolicy(network)


def loop_paths(policy: ModularPolicy, number: int = 12) -> tuple[Array, Array]:
    """Times (m,) and paths (m, number, 4) in (z, int z) of the coupled lags under a policy."""
    plant = plants.get("coupled_lags")
    space = auxiliary_space(plant)
    field = closed_loop(policy, plant, lambda y: space)
    starts = np.random.default_rng(0).uniform(-2, 2, (number, 4))
    t = np.linspace(0, 12, 301)
    paths = rk4(lambda _, s: field(s), starts, t)
    return t, np.concatenate([paths[..., :2] @ space.T_y.T, paths[..., 2:]], axis=-1)


class TurningInterface:
    """A policy whose interface T_a = Rot(3 y1) turns with the state, on two plain lags.

    Its slopes are constant, 0.5 in z and 0.1 in int z, about the command a = (0, -5).
    """

    u0 = 0.0

    def slope_bounds(self) -> tuple[Array, Array]:
        """The slopes, which are constant, (2, 2) each."""
        bounds = np.tile([0.5, 0.1], (2, 1))
        return bounds, bounds

    def pi(self, s: Array) -> Array:
        """0.5 z + 0.1 int z + (0, 5), (..., 2, 2) to (..., 2); the sign rule turns it round."""
        return 0.5 * s[..., 0] + 0.1 * s[..., 1] - np.array([0.0, -5.0])

    @staticmethod
    def spaces(y: Array) -> AuxiliarySpace:
        """Transforms at y (..., 2): T_y = I, T_a = R = Rot(3 y1), Lambda = -I."""
        cos, sin = np.cos(3 * y[..., 0]), np.sin(3 * y[..., 0])
        rot = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
        eye = np.broadcast_to(np.eye(2), rot.shape)
        return AuxiliarySpace(eye, rot, -eye, rot)


def turning() -> Picture:
    """The loop of `TurningInterface`: neighbors part inside the region that looked contracting.

    Returns:
        `t` (m,), `y1` (m, 9) from starts close to 0, and `distance` (m, 8) to the middle one in
        (y, int z), NaN once a trajectory has left |y1| <= 0.35; `y1` is NaN beyond 0.5.
    """
    policy, plant = TurningInterface(), plants.Lags(tau=(1.0, 1.0), gain=(1.0, 1.0))
    field = closed_loop(policy, plant, policy.spaces)
    starts = np.zeros((9, 4))
    starts[:, 0] = 0.002 * np.arange(-4, 5)
    t = np.linspace(0, 0.4, 101)
    paths = rk4(lambda _, s: field(s), starts, t)
    others = np.delete(paths, 4, axis=1)
    distance = np.linalg.norm(others - paths[:, 4:5], axis=-1)
    distance[np.abs(others[..., 0]) > 0.35] = np.nan
    y1 = np.where(np.abs(paths[..., 0]) > 0.5, np.nan, paths[..., 0])
    return {"t": t, "y1": y1, "distance": distance}


def sampled_lag(period: float, slope: float, ratio: float) -> Picture:
    """The peg's force lag under u = -(k1 e + k2 I), sampled and held.

    Args:
        period: Sample time, ms.
        slope: k1.
        ratio: k2 / k1, 1/s.

    Returns:
        `t` (m,) in ms and `e` (m,) at the samples, `eig` (2,), `circle` (k, 2), `margin`.
    """
    h = period / 1000
    k2 = ratio * slope
    step = sampled_matrix(slope, k2, -1 / FORCE_TAU, FORCE_GAIN / FORCE_TAU, h)
    path = [np.array([1.0, 0.0])]
    for _ in range(40):
        path.append(np.clip(step @ path[-1], -1e6, 1e6))
    margin = float(sampled_margin(slope, k2, FORCE_TAU, FORCE_GAIN, h))
    limit = float(largest_slope(FORCE_TAU, FORCE_GAIN, h, ratio=ratio))
    angle = np.linspace(0, 2 * np.pi, 121)
    verdict = "stable" if margin > 0 else "unstable"
    return {
        "t": period * np.arange(41),
        "e": np.stack(path)[:, 0],
        "eig": np.linalg.eigvals(step).astype(complex),
        "circle": np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        "margin": margin,
        "limit": limit,
        "text": f"predicted {verdict}; largest stable slope at this period: {limit:.3f}",
    }


def predicted_and_measured(periods: ArrayLike, ratio: float = 2.0) -> dict[str, Array]:
    """Largest stable slope of the force lag by the formula and by running loops.

    The measured one is found by bisection over loops that are run sample by sample (measure,
    integrate, hold, let the lag move) and judged by whether the error has grown.

    Args:
        periods: Sample times, ms, (m,).
        ratio: k2 / k1, 1/s.

    Returns:
        `predicted` and `measured`, (m,) each.
    """
    h = np.asarray(periods, dtype=float) / 1000
    predicted = largest_slope(FORCE_TAU, FORCE_GAIN, h, ratio=ratio)
    low, high = np.zeros_like(h), 3 * predicted
    for _ in range(12):
        slope = (low + high) / 2
        stable = _settles(slope, ratio * slope, h)
        low, high = np.where(stable, slope, low), np.where(stable, high, slope)
    return {"predicted": predicted, "measured": (low + high) / 2}


def _settles(k1: Array, k2: Array, h: Array) -> NDArray[np.bool_]:
    """Whether the late error of a run loop is smaller than its early one."""
    e, I, sizes = np.ones_like(h), np.zeros_like(h), []
    phi = np.exp(-h / FORCE_TAU)
    for _ in range(1200):
        I = I + h * e
        u = -(k1 * e + k2 * I)
        e = np.clip(FORCE_GAIN * u + (e - FORCE_GAIN * u) * phi, -1e6, 1e6)
        sizes.append(np.abs(e))
    history = np.stack(sizes)
    return history[-100:].max(axis=0) < history[200:300].max(axis=0)
