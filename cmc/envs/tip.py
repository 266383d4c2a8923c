"""The peg's tip in a scene: how it points, forces on it, and the contact that sensors remember."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.robot.batched import cross

Array = NDArray[np.float64]
UP = np.array([0.0, -1.0, 0.0, 0.0])
"""Conjugate of `DOWN`: times it, an orientation is told from pointing straight down."""


def lever(model: mujoco.MjModel) -> Array:
    """From the hand's center of mass, where MuJoCo applies forces, to the nominal tip, (3,), m."""
    arm: Array = model.site("tip_nominal").pos - model.body("hand").ipos
    return arm


def wrench(force: Array, lever: Array) -> Array:
    """Force and moment (N, 6) on the hand of forces (N, 3) at the ends of levers (N, 3)."""
    force = np.asarray(force, dtype=float)
    if force.shape != lever.shape:
        raise ValueError(f"push: wanted shape {lever.shape}, got {force.shape}")
    if not np.isfinite(force).all():
        raise ValueError(f"push: wanted finite numbers, got {force.tolist()}")
    return np.concatenate([force, cross(lever, force)], -1)


def is_compliant(model: mujoco.MjModel) -> bool:
    """Whether the peg sits on lateral springs."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "peg_x") >= 0


def contact_log(model: mujoco.MjModel, steps: int, buffer: Array) -> tuple[Array, Array]:
    """Views of the contact forces (..., steps, 3) and distances (..., steps) of a tick.

    A sensor's history is two numbers of bookkeeping, `steps` times, and a ring of `steps` values.
    """
    names = ("peg_force", "peg_distance")
    first, second = (int(model.sensor_historyadr[model.sensor(name).id]) for name in names)
    start = first + 2 + steps
    forces = buffer[..., start : start + 3 * steps].reshape(*buffer.shape[:-1], steps, 3)
    start = second + 2 + steps
    return forces, buffer[..., start : start + steps]
