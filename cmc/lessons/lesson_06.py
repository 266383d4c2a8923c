"""Lesson 06: composite signals on a point mass, the latent model made of gains, and learning it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cmc import plants
from cmc.fast import budget
from cmc.theory.composite import InfeasibleGainsError, Root, composite
from cmc.theory.identification import fit_latent
from cmc.theory.simulate import rk4

Array = NDArray[np.float64]

#: The gains the paper publishes (maze: appendix G; push: `tab:para`), (K_p, K_d) in 1/s^2 and 1/s.
PAPER_GAINS = {
    "maze, translation": (40.0, 20.0),
    "maze, rotation": (20.0, 10.0),
    "push, translation": (20.0, 30.0),
    "push, rotation": (30.0, 40.0),
}


def error_motion(K_p: float, K_d: float, lambda_d: float, start: Array, t: Array) -> Array:
    """Exact (e, e') of lambda_d e'' + K_d e' + K_p e = 0 from starts (..., 2), (T, ..., 2)."""
    generator = np.array([[0.0, 1.0], [-K_p / lambda_d, -K_d / lambda_d]])
    step = expm(generator * (t[1] - t[0]))
    path = np.empty((len(t), *np.shape(start)))
    path[0] = start
    for k in range(1, len(t)):
        path[k] = path[k - 1] @ step.T
    return path


def point_mass(K_p: float, K_d: float, lambda_d: float = 1.0, root: Root = "small") -> dict:
    """Error e, latent signal y and their envelopes for one set of gains; the slider's picture.

    Gains in the infeasible zone give the error alone and the reason in the text.
    """
    t = np.linspace(0.0, 3.0, 400)
    path = error_motion(K_p, K_d, lambda_d, np.array([1.0, 0.0]), t)
    poles = np.roots([lambda_d, K_d, K_p]).astype(complex)
    out = {"t": t, "e": path[:, 0], "poles": poles, "edge": feasible_edge(lambda_d)}
    out |= {"gains": np.array([[K_p, K_d]])}
    try:
        model = composite(K_p, K_d, lambda_d, root)
    except InfeasibleGainsError:
        gap = np.full_like(t, np.nan)
        limit = 2.0 * np.sqrt(K_p * lambda_d)
        return out | {"y": gap, "latent": gap, "text": f"refused: K_d must be at least {limit:.2f}"}
    y = model.y(path[:, 0], path[:, 1])
    latent, rest = float(model.latent_rate), float(model.composition_rate)
    return out | {
        "y": y / y[0],
        "latent": np.exp(-latent * t),
        "text": f"latent {latent:.2f} 1/s, composition {rest:.2f} 1/s, K2 = {float(model.K2):.3f}",
    }


def feasible_edge(lambda_d: float) -> Array:
    """Points (K_p, K_d) on K_d^2 = 4 K_p lambda_d, (100, 2)."""
    K_p = np.linspace(0.0, 60.0, 100)
    return np.stack([K_p, 2.0 * np.sqrt(K_p * lambda_d)], axis=-1)


def wrong_composition() -> dict[str, Array]:
    """A latent signal y = e - e'/3 driven to zero at 2 1/s: y converges, the error does not."""
    t = np.linspace(0.0, 1.5, 200)

    def rate(time: float, s: Array) -> Array:
        return np.stack([3.0 * (s[..., 0] - s[..., 1]), -2.0 * s[..., 1]], axis=-1)

    path = rk4(rate, [0.7, 1.0], t)
    return {"t": t, "e": path[:, 0], "y": path[:, 1]}


def hierarchy(root: Root = "small", number: int = 40) -> dict[str, Array]:
    """Distances between motions of the point mass (maze gains), in y and in e, and envelopes."""
    model, t = composite(*PAPER_GAINS["maze, translation"], root=root), np.linspace(0.0, 1.5, 300)
    starts = np.random.default_rng(0).normal(size=(number, 2)) * [1.0, 10.0]
    path = error_motion(*PAPER_GAINS["maze, translation"], 1.0, starts, t)
    y = model.y(path[..., 0], path[..., 1])
    return {
        "t": t,
        "y": np.abs(y - y[:, :1])[:, 1:],
        "e": np.abs(path[..., 0] - path[:, :1, 0])[:, 1:],
        "latent": np.exp(-model.latent_rate * t),
        "composition": np.exp(-model.composition_rate * t),
    }


def velocity_only() -> dict[str, Array]:
    """K_p = 0 and y = e': every velocity error dies, every position error stays where it is."""
    t = np.linspace(0.0, 2.0, 200)
    starts = np.stack([np.linspace(-1.0, 1.0, 9), np.linspace(4.0, -4.0, 9) ** 3 / 16], axis=-1)
    path = error_motion(0.0, 5.0, 1.0, starts, t)
    return {"t": t, "e": path[..., 0], "y": path[..., 1]}


def policy_loop(slope: float, number: int = 30) -> dict[str, Any]:
    """Point mass (maze gains) under u = slope * tanh(y): positive slopes contract, others may not.

    f_u = -1/A is negative, so the sign rule asks for a positive slope; down to -B_lat the latent
    system still contracts by itself (`inequal_1`).
    """
    K_p, K_d = PAPER_GAINS["maze, translation"]
    model, t = composite(K_p, K_d), np.linspace(0.0, 2.5, 250)
    starts = np.random.default_rng(1).normal(size=(number, 2)) * [0.3, 3.0]

    def rate(time: float, s: Array) -> Array:
        u = slope * np.tanh(model.y(s[..., 0], s[..., 1]))
        return np.stack([s[..., 1], -(K_d * s[..., 1] + K_p * s[..., 0] + u)], axis=-1)  # 2nd_sys

    path = rk4(rate, starts, t)
    y = model.y(path[..., 0], path[..., 1])
    return {"t": t, "e": path[..., 0], "y": y, "spread": float(np.ptp(y[-1]))}


def chatter(gain: float, dt_ms: float, K_p: float = 40.0, K_d: float = 20.0) -> dict[str, Any]:
    """Point mass under u = gain y held for `dt_ms` milliseconds; exact at the samples."""
    model, dt = composite(K_p, K_d), dt_ms * 1e-3
    count = int(round(1.2 / dt)) + 1
    hold, push = np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt**2 / 2, dt])
    feedback = np.array([K_p + gain * model.K1, K_d + gain * model.K2])
    step = hold - np.outer(push, feedback)
    path = np.empty((count, 2))
    path[0] = [1.0, 0.0]
    for k in range(1, count):
        path[k] = step @ path[k - 1]
    level = float((K_d + gain * model.K2) * dt)
    radius = float(np.abs(np.linalg.eigvals(step)).max())
    verdict = "chatters" if radius > 1 else ("rings" if level > 1 else "settles")
    return {
        "t": dt * np.arange(count),
        "e": np.clip(path[:, 0], -3.0, 3.0),
        "v": np.clip(path[:, 1], -60.0, 60.0),
        "level": level,
        "radius": radius,
        "cap": float(model.slope_cap(dt)),
        "text": f"(K_d + g K2) dt = {level:.2f}: the loop {verdict}",
    }


def data_needed(noise: float = 0.01, seeds: int | None = None) -> dict[str, Array]:
    """Error of the learned f_u of the coupled lags against the number of noisy transitions.

    Returns the counts and, per seed and count, the largest error as a share of the largest entry.
    """
    plant, dt = plants.get("coupled_lags"), 0.05
    f_y, f_u = plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0])
    generator = np.zeros((4, 4))
    generator[:2] = np.column_stack([f_y, f_u])
    step = expm(generator * dt)[:2]
    counts = np.array([20, 50, 100, 300, 1000, 3000])
    error = np.empty((seeds or budget(20, 5), len(counts)))
    for i in range(len(error)):
        rng = np.random.default_rng(i)
        for j, count in enumerate(counts):
            y, u = rng.normal(size=(2, int(count), 2))
            after = np.column_stack([y, u]) @ step.T + noise * rng.normal(size=y.shape)
            fit = fit_latent(y, u, after, dt)
            error[i, j] = np.abs(fit.f_u - f_u).max() / np.abs(f_u).max()
    return {"count": counts, "error": error}
