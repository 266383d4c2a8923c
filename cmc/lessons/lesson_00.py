"""Lesson 00, a first look: parameters in, arrays out."""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc import __version__, plants
from cmc.fast import budget
from cmc.lessons.linear_loop import circle, largest_real_part, loop_matrix, loop_paths
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.simulate import rk4

Array = NDArray[np.float64]

PACKAGES = ("numpy", "scipy", "matplotlib", "torch", "jupyterlab", "ipywidgets", "anywidget")
_WIDTH, _TURN = 2.4, 0.4  # of the target's figure of eight, and its angular speed in rad/s
_GAIN = 4.0  # common factor of all networks


def installation() -> str:
    """One line a package that the course stands on: its name and version.

    Raises:
        ImportError: if one of them is not installed, with the command that installs it.
    """
    lines = [f"cmc {__version__} on Python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError as error:
            raise ImportError(f"{name} is not installed: run  make course") from error
    return "\n".join(lines)


def space_of_lags() -> AuxiliarySpace:
    """The auxiliary space of the plant that lessons 01 to 07 share."""
    plant = plants.get("coupled_lags")
    zero = np.zeros(plant.n)
    return decompose(plant.f_y(zero, zero), plant.f_u(zero, zero))


def target(t: ArrayLike) -> Array:
    """A target that runs along a figure of eight: (..., 2) at times (...), s."""
    angle = _TURN * np.asarray(t, dtype=float)
    return _WIDTH * np.stack([np.sin(angle), 0.6 * np.sin(2.0 * angle)], axis=-1)


def random_networks(
    number: int | None = None, starts: int = 8, horizon: float = 25.0, steps: int = 501
) -> dict[str, Any]:
    """Random networks steer the plant after a moving target: weights of any sign, or positive.

    All loops have the same transforms, the same sizes and the same starts; the latent signal is
    y - target. They differ in the networks alone.

    Args:
        number: how many networks of each kind are drawn.
        starts: starting points on a circle for each of them.
        horizon: length of the motion, s.
        steps: points in time.

    Returns:
        `t` (steps,); `target` (steps, 2); `any` and `positive`, trajectories
        (steps, number, starts, 2); `apart_any` and `apart_positive`, the largest distance between
        trajectories of each loop at the end, (number,); `example`, the first network of any sign
        whose trajectories stay near but apart.
    """
    import torch

    from cmc.policies import IndependentNetwork, PositiveNetwork

    number = budget(60, 30) if number is None else number
    t = np.linspace(0.0, horizon, steps)
    shape: dict[str, Any] = {"hidden": (16,), "seeds": list(range(number)), "dtype": torch.float64}
    networks = {
        "any": IndependentNetwork(2, last=3.0, **shape),
        "positive": PositiveNetwork(2, bias=False, slope_min=(1.0, 1.0), **shape),
    }
    result: dict[str, Any] = {"t": t, "target": target(t)}
    for kind, network in networks.items():

        def run(s: Array, network: torch.nn.Module = network) -> Array:
            with torch.inference_mode():
                return np.asarray(network(torch.from_numpy(s)).numpy())

        paths = _closed_loop(run, t, circle(starts, 3.2), number)
        result[kind] = paths
        gaps = paths[-1, :, :, None] - paths[-1, :, None, :]
        result[f"apart_{kind}"] = np.linalg.norm(gaps, axis=-1).max(axis=(1, 2))
    near = np.abs(result["any"]).max(axis=(0, 2, 3)) < 8.0
    result["example"] = int(np.argmax(near & (result["apart_any"] > 1.0)))
    return result


def _closed_loop(run: Callable[[Array], Array], t: Array, y0: Array, number: int) -> Array:
    """Trajectories (time, number, starts, 2) of u = T_a (-gain sign(R_ii) pi_i(z_i, int z_i))."""
    plant, space = plants.get("coupled_lags"), space_of_lags()
    signs = np.sign(space.gains)

    def rhs(time: float, state: Array) -> Array:
        y, integral = state[..., :2], state[..., 2:]
        z = space.to_z(y - target(time))
        a = -_GAIN * signs * run(np.stack([z, integral], axis=-1))  # constraint_sign
        return np.concatenate([plant.f(y, space.to_u(a), time), z], axis=-1)

    start = np.concatenate([y0, np.zeros_like(y0)], axis=-1)
    return rk4(rhs, np.broadcast_to(start, (number, *start.shape)), t)[..., :2]


def forgetting(slope: float, memory: float) -> dict[str, Any]:
    """Twenty trajectories of the plant under one slope in z and one in int z for both modules.

    Args:
        slope: slope in z, before the sign rule; negative breaks the rule.
        memory: slope in int z, before the sign rule.

    Returns:
        `t` (m,); `y` (m, 20), the first signal; `distance` (m, 19) to the first trajectory;
        `eig`, eigenvalues of the loop, 1/s; `rate`, how fast the slowest of them decays, 1/s.
    """
    space = space_of_lags()
    t = np.linspace(0.0, 12.0, 241)
    sizes = np.broadcast_to(np.array([slope, memory]), (2, 2))
    slopes = -np.sign(space.gains)[:, None] * sizes  # constraint_sign
    J = loop_matrix(space, slopes)
    paths = loop_paths(space, slopes, circle(20, 2.0), t)
    rate = -float(largest_real_part(J))
    if rate > 1e-9:
        verdict = f"they forget where they started, at {rate:.2f} 1/s"
    elif rate > -1e-9:
        verdict = "they neither approach nor part for good"
    else:
        verdict = f"they part, at {-rate:.2f} 1/s"
    return {
        "t": t,
        "y": paths[..., 0],
        "distance": np.linalg.norm(paths[:, 1:] - paths[:, :1], axis=-1),
        "eig": np.linalg.eigvals(J),
        "rate": rate,
        "text": verdict,
    }
