"""Simulate a plant under a policy: continuous or with a held command, many starts in one call.

    z = T_y (y - y_ref),   I' = z,   a = pi(z, I),   u = u0 + T_a a,   y' = f(y, u, t)

The step size is chosen for the whole batch at once, so that trajectories stay comparable sample by
sample. `cmc.theory.exact` differentiates the same loop, and so cannot speak of another one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.action import action_of, inner
from cmc.theory.arrays import Array, checked, number
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.flow import flow, linear_flow, rk4
from cmc.theory.tracking import aligned

__all__ = [
    "Loop",
    "Path",
    "closed_loop",
    "equilibrium",
    "flow",
    "linear_flow",
    "rk4",
    "transforms_of",
]

Transforms = Callable[[Array], AuxiliarySpace]


@dataclass(frozen=True)
class Path:
    """Trajectories of a loop, (time, ..., n) each.

    Attributes:
        t: Times, s, (time,).
        y: Latent signal.
        z: Auxiliary signal T_y (y - y_ref).
        integral: int z dt.
        u: Command that acts from each time on.
    """

    t: Array
    y: Array
    z: Array
    integral: Array
    u: Array


def equilibrium(plant: Any, y: ArrayLike, t: float = 0.0) -> Array:
    """Command that holds a plant still at `y`: the root u of f(y, u, t) = 0, (..., n).

    Newton's method with halved steps, from u = 0; one step where f is affine in u.

    Raises:
        ValueError: If some `y` cannot be held: f_u is singular, or no root is found.
    """
    y = checked("y", y, "... n", n=plant.n)
    u = np.zeros_like(y)
    f = np.asarray(plant.f(y, u, t), dtype=float)
    scale = size = np.linalg.norm(f, axis=-1)
    for _ in range(60):
        try:
            f_u = plant.f_u(y, u, t)
            move = -np.linalg.solve(f_u, f[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise ValueError(f"{plant!r} cannot be held still: f_u is singular") from None
        length = np.ones_like(size)
        for _ in range(30):
            ahead = np.asarray(plant.f(y, u + length[..., None] * move, t), dtype=float)
            worse = ~(np.linalg.norm(ahead, axis=-1) < size) & (size > 0)
            if not worse.any():
                break
            length = np.where(worse, length / 2, length)
        step = np.where((length > 1e-8)[..., None], length[..., None] * move, 0.0)
        u = u + step
        f = np.asarray(plant.f(y, u, t), dtype=float)
        size = np.linalg.norm(f, axis=-1)
        if (np.abs(step) <= 1e-14 * np.abs(u)).all():
            break
    rounding = 1e-13 * np.linalg.norm(f_u, axis=(-2, -1)) * np.linalg.norm(u, axis=-1)
    bad = ~(size <= 1e-9 * scale + rounding)
    if bad.any():
        where = np.array2string(y[bad][0], precision=4)
        raise ValueError(f"{plant!r} cannot be held still at y = {where}: no u makes f(y, u) zero")
    return u


def transforms_of(
    plant: Any,
    transforms: AuxiliarySpace | Transforms | None = None,
    centre: ArrayLike | None = None,
) -> Transforms:
    """The auxiliary space as a function of y: given, fixed, or by `decompose` at equilibrium.

    Where Jacobians vary, eigenvectors keep the order and the signs that they have at `centre`, the
    middle of the plant's box by default, so that no module changes its meaning on the way.
    """
    if callable(transforms):
        return transforms

    def jacobians(y: Array) -> tuple[Array, Array]:
        u = np.zeros(plant.n) if plant.constant else equilibrium(plant, y)
        return plant.f_y(y, u), plant.f_u(y, u)

    if transforms is not None:
        T_y, T_a = transforms.T_y, transforms.T_a
        at = np.zeros(plant.n)
        space = AuxiliarySpace.from_transforms(T_y, T_a, *jacobians(at)) if plant.constant else None
        return lambda y: space or AuxiliarySpace.from_transforms(T_y, T_a, *jacobians(y))
    if plant.constant:
        found = decompose(*jacobians(np.zeros(plant.n)))
        return lambda y: found
    if centre is None:
        centre = (np.asarray(plant.y_low) + np.asarray(plant.y_high)) / 2
    first = decompose(*jacobians(np.asarray(centre, dtype=float)))
    return lambda y: aligned(*jacobians(y), first)


def closed_loop(
    plant: Any,
    policy: Any,
    y0: ArrayLike,
    t: ArrayLike,
    *,
    transforms: AuxiliarySpace | Transforms | None = None,
    y_ref: ArrayLike | Callable[[float], ArrayLike] = 0.0,
    h: float | None = None,
    integral: ArrayLike = 0.0,
    u0: ArrayLike = 0.0,
    clip: bool = False,
) -> Path:
    """Simulate the loop of the module's first lines.

    Args:
        plant: Has `n`, `f`, `f_y`, `f_u`, `constant`.
        policy: Signed slopes (n, 2), a function from s (..., n, 2) to a, or any policy with
            the sign rule: see `cmc.theory.action`.
        y0: Starts, (..., n); a network with seeds needs their axis in front.
        t: Increasing times, s, (time,).
        transforms: The auxiliary space, fixed or as a function of y; by default `decompose`, at
            each state where the plant's Jacobians vary.
        y_ref: Where y is to go, (..., n), or a function of time.
        h: Sample time, s: the command is held and I_k = I_{k-1} + h z_k. Continuous without it.
        integral: I at the start, broadcast to y0.
        u0: Command to which T_a a (and the policy's own `u0`) is added.
        clip: Whether the plant's limits `u_low`, `u_high` act.
    """
    loop = Loop(plant, policy, transforms, y_ref, u0, clip)
    y = checked("y0", y0, "... n", n=plant.n)
    I, times = np.broadcast_to(checked("integral", integral), y.shape), checked("t", t, "time")
    start = np.concatenate([y, I], axis=-1)
    if h is None:
        s = flow(loop.field, start, times)
        rows = [loop.signals(*_halves(x), float(now)) for x, now in zip(s, times, strict=True)]
        z, u = (np.stack(part) for part in zip(*rows, strict=True))
        return Path(times, _halves(s)[0], z, _halves(s)[1], u)
    return _held(loop, start, times, number("h", h, above=0.0))


def _halves(s: Array) -> tuple[Array, Array]:
    n = s.shape[-1] // 2
    return s[..., :n], s[..., n:]


def _held(loop: Loop, start: Array, times: Array, h: float) -> Path:
    """Samples at times[0] + k h; `times` may fall anywhere between them."""
    y, I = _halves(start)
    ys, zs, Is, us = np.empty((4, len(times), *y.shape))
    now, k, tiny = float(times[0]), 0, 1e-9 * h
    for i, end in enumerate(times):
        while True:
            if now >= times[0] + k * h - tiny:  # measure, integrate, hold
                z = loop.signals(y, I, now)[0]
                I, k = I + h * z, k + 1
                u = loop.signals(y, I, now, z)[1]
            if now >= end - tiny:
                break
            until = float(min(times[0] + k * h, end))
            y, now = loop.hold(y, u, now, until), until
        ys[i], zs[i], Is[i], us[i] = y, loop.signals(y, I, now)[0], I, u
    return Path(times, ys, zs, Is, us)


class Loop:
    """A plant under a policy, ready to be integrated; arguments as in `closed_loop`."""

    def __init__(
        self,
        plant: Any,
        policy: Any,
        transforms: AuxiliarySpace | Transforms | None = None,
        y_ref: ArrayLike | Callable[[float], ArrayLike] = 0.0,
        u0: ArrayLike = 0.0,
        clip: bool = False,
    ) -> None:
        self.plant, self.n, self.clip = plant, plant.n, clip
        policy = inner(policy)
        self.action = action_of(policy, plant.n)
        own = np.asarray(getattr(policy, "u0", 0.0), dtype=float)
        self.u0 = checked("u0", u0) + own
        self.spaces = transforms_of(plant, transforms)
        self.goal = y_ref if callable(y_ref) else None
        self.y_ref = np.zeros(()) if callable(y_ref) else checked("y_ref", y_ref)

    def signals(
        self, y: Array, I: Array, t: float = 0.0, z: Array | None = None
    ) -> tuple[Array, Array]:
        """Auxiliary signal z and command u, (..., n) each."""
        space = self.spaces(y)
        if z is None:
            goal = self.y_ref if self.goal is None else checked("y_ref", self.goal(t))
            z = space.to_z(y - goal)
        u = self.u0 + space.to_u(self.action(np.stack([z, I], axis=-1), space.gains))
        return z, np.clip(u, self.plant.u_low, self.plant.u_high) if self.clip else u

    def field(self, t: float, s: Array) -> Array:
        """Right-hand side in (y, int z), (..., 2n)."""
        y, I = _halves(s)
        z, u = self.signals(y, I, t)
        return np.concatenate([self.plant.f(y, u, t), z], axis=-1)

    def step(self, s: Array, h: float, t: float = 0.0) -> Array:
        """One sample of length h in (y_k, I_{k-1}), (..., 2n)."""
        y, I = _halves(s)
        z = self.signals(y, I, t)[0]
        I = I + h * z
        return np.concatenate([self.hold(y, self.signals(y, I, t, z)[1], t, t + h), I], axis=-1)

    def hold(self, y: Array, u: Array, t: float, until: float) -> Array:
        """The plant from `t` to `until` under a held command: exact where it is linear."""
        plant, h = self.plant, until - t
        if not plant.constant:
            return flow(lambda at, x: plant.f(x, u, at), y, [t, until])[-1]
        # y' = A (y - y_t) + f(y_t, u) from rest at y_t: h phi_1(A h) f
        A, n = plant.f_y(np.zeros(self.n), np.zeros(self.n)), self.n
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:] = A * h, h * np.eye(n)
        return np.asarray(y + plant.f(y, u, t) @ expm(block)[:n, n:].T)
