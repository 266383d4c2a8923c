"""Lesson 02: the auxiliary space, theorem 1, and a frame that moves."""

from __future__ import annotations

from typing import Any

import numpy as np

from cmc import plants
from cmc.fast import budget
from cmc.lessons.linear_loop import (
    circle,
    growth,
    largest_real_part,
    loop_matrix,
    loop_paths,
    signed_slopes,
)
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.differential import F1, F2
from cmc.theory.margins import (
    FrameMotion,
    frame_motion,
    symmetric_bound,
    theorem1_margin,
    transient_factor,
)
from cmc.theory.simulate import rk4
from cmc.theory.spectrum import Array
from cmc.theory.tracking import track

TRANSFORMS = ("identity", "explicit")


def space_of(transforms: str = "explicit", **parameters: float) -> AuxiliarySpace:
    """Auxiliary space of the coupled lags: "identity" transforms, or the "explicit" solution.

    Raises:
        ValueError: if the name of the transforms is neither.
    """
    plant = plants.get("coupled_lags", **parameters)
    f_y, f_u = plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0])
    if transforms not in TRANSFORMS:
        raise ValueError(f"wanted transforms 'identity' or 'explicit', got {transforms!r}")
    return AuxiliarySpace.identity(f_y, f_u) if transforms == "identity" else decompose(f_y, f_u)


def random_verdicts(transforms: str, number: int | None = None, seed: int = 0) -> Array:
    """Largest real part of the loop for random slopes of the right sign, 0.01 to 10, (number,)."""
    number = number or budget(20_000, 5_000)
    sizes = 10.0 ** np.random.default_rng(seed).uniform(-2.0, 1.0, (2, number, 2))
    space = space_of(transforms)
    return largest_real_part(loop_matrix(space, signed_slopes(space, *sizes)))


def coordinates(crossing: float, kp: float, ki: float, transforms: str) -> dict[str, Any]:
    """Closed loop of the coupled lags in the chosen coordinates, for constant slopes."""
    space = space_of(transforms, crossing=crossing)
    slopes = signed_slopes(space, kp, ki)
    t = np.linspace(0.0, 8.0, 300)
    J = loop_matrix(space, slopes)
    worst = float(largest_real_part(J))
    verdict = "decays" if worst < 0.0 else "GROWS"
    return {
        "t": t,
        "y": loop_paths(space, slopes, circle(12), t)[..., 0],
        "eig": np.linalg.eigvals(J).astype(complex),
        "R": space.R,
        "worst": worst,
        "text": f"largest real part {worst:.3f} 1/s: the loop {verdict}",
    }


def transient(shear: float) -> dict[str, Any]:
    """Distances in z and y of z' = diag(-1, -8) z seen through y = [[1, shear], [0, 1]] z."""
    V = np.array([[1.0, shear], [0.0, 1.0]])
    Lambda, t = np.diag([-1.0, -8.0]), np.linspace(0.0, 4.0, 200)
    space = AuxiliarySpace(np.linalg.inv(V), np.eye(2), Lambda, np.eye(2))
    factor = float(transient_factor(space))
    in_y = growth(Lambda, t, left=V, right=space.T_y)
    return {
        "t": t,
        "z": growth(Lambda, t),
        "y": in_y,
        "bound": factor * np.exp(-t),
        "peak": float(in_y.max()),
        "text": f"cond(Theta_M) = {factor:.2f}, largest growth in y {in_y.max():.2f}",
    }


def rate_readings() -> dict[str, Any]:
    """One loop that meets theorem 1, and both readings of its rate beta against what it does."""
    space = AuxiliarySpace(np.eye(1), np.eye(1), np.array([[-2.0]]), np.array([[1.0]]))
    slopes, t = np.array([[-1.0, -3.0]]), np.linspace(0.0, 2.5, 200)
    rate = float(theorem1_margin(space, slopes))
    return {
        "t": t,
        "distance": growth(F1(space, slopes), t),
        "proof": np.exp(-rate * t),
        "text": np.exp(-2.0 * rate * t),
        "rate": rate,
    }


def theorem1_share(number: int | None = None, seed: int = 0) -> float:
    """Share of random slopes of the right sign, 0.1 to 10, whose F1 meets theorem 1."""
    number = number or budget(20_000, 5_000)
    space = space_of("explicit")
    sizes = 10.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0, (2, number, 2))
    return float(np.mean(theorem1_margin(space, signed_slopes(space, *sizes)) > 0.0))


def turning_frame(speed: float, shear: float) -> dict[str, Any]:
    """Let the eigenvectors of y' = f_y(t) y turn at `speed` (rad/s), eigenvalues always -1, -10.

    With V(t) = Rot(speed t) S the frame's own rate T_y' T_y^-1 is constant, so that the growth in
    z is known exactly.
    """
    S = np.array([[1.0, shear], [0.0, 1.0]])
    turn = speed * np.linalg.inv(S) @ np.array([[0.0, -1.0], [1.0, 0.0]]) @ S
    T_y, eye = np.linalg.inv(S), np.eye(2)
    space = AuxiliarySpace(T_y, eye, np.diag([-1.0, -10.0]), eye)
    slopes, T_y_dot = np.zeros((2, 2)), -turn @ T_y  # V' = Rot' S gives T_y' = -turn T_y
    A_blk, t = space.Lambda - turn, np.linspace(0.0, 4.0, 200)
    exact = float(largest_real_part(A_blk))
    return {
        "t": t,
        "frozen": growth(space.Lambda, t),
        "moving": np.minimum(growth(A_blk, t), 1e6),
        "norm": float(np.linalg.norm(F2(space, slopes, T_y_dot), ord=2)),
        "allowed": -float(symmetric_bound(space.Lambda)),
        "exact": exact,
        "text": f"frozen rate 1 1/s, true rate {-exact:.2f} 1/s",
    }


def pendulum_frame(angle: float = 2.8) -> tuple[Array, FrameMotion]:
    """Let an overdamped pendulum fall from `angle` (rad): its path, and how its frame moves."""
    plant, t = plants.get("pendulum", damping=3.0, stiffness=1.0), np.linspace(0.0, 40.0, 4001)
    zero = np.zeros(2)
    y = rk4(lambda time, s: plant.f(s, zero, time), np.array([angle, 0.0]), t)
    space = track(plant.f_y(y, zero), plant.f_u(y, zero))
    return y, frame_motion(space.T_y, t, np.full((2, 2), -1.0))


def stopping_frame(stop: float = 2.0) -> FrameMotion:
    """A frame that turns by one radian and stops at time `stop` (s), as the theorem assumes."""
    t = np.linspace(0.0, 4.0, 2001)
    share = np.minimum(t / stop, 1.0)
    angle = share * share * (3.0 - 2.0 * share)
    c, s = np.cos(angle), np.sin(angle)
    T_y = np.stack([np.stack([1.5 * c, -s], -1), np.stack([s, c], -1)], -2)
    return frame_motion(T_y, t, np.full((2, 2), -1.0))
