"""Solve differential equations, and simulate a plant under a policy, many starts in one call.

    z = T_y (y - y_ref),   I' = z,   a = pi(z, I),   u = u0 + T_a a,   y' = f(y, u, t)

The command acts at once or is held. The step size is chosen for the whole batch, so that
trajectories stay comparable sample by sample. `cmc.theory.exact` differentiates the same loop, and
so cannot speak of another one. Wrong shapes, numbers and times raise ValueError, or TypeError.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.arrays import Array, checked, increasing, need, not_overflown, number, together
from cmc.theory.auxiliary import AuxiliarySpace, applied, decompose
from cmc.theory.identification import equilibrium
from cmc.theory.sampled import hold
from cmc.theory.slopes import action_of, inner
from cmc.theory.tracking import aligned

Transforms = Callable[[Array], AuxiliarySpace]

_MOST_STEPS = 100_000
# Dormand and Prince 1980: y + h sum b_i k_i of order 5; _E is its difference to order 4.
_A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_C = (0.2, 0.3, 0.8, 8 / 9, 1.0, 1.0)
_E = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


def flow(
    rhs: Callable[[float, Array], Array], start: ArrayLike, t: ArrayLike, *, tol: float = 1e-8
) -> Array:
    """Solve s' = rhs(t, s) by Dormand and Prince's adaptive method, one step size for the batch.

    From the states `start`, (..., n), at t[0] to those at the increasing times t [s], (time,):
    (time, ..., n). `tol` is the largest error of a step, relative to the largest size of that
    signal so far. States that explode or need more than 100,000 steps are a ValueError.
    """
    times, s = increasing("t", t), checked("start", start, "... n").copy()
    tol = number("tol", tol, above=0.0)
    need(callable(rhs), "rhs", "a function", rhs)
    path = np.empty((len(times), *s.shape))
    path[0], now, steps = s, float(times[0]), 0
    first = checked("rhs(t, start)", rhs(now, s))
    if first.shape != s.shape:
        raise ValueError(f"rhs(t, start) needs shape {s.shape}, got {first.shape}")
    batch = tuple(range(s.ndim - 1))
    largest = np.abs(s).max(axis=batch, initial=0.0)
    speed = np.abs(first).max(axis=batch, initial=0.0)
    # a first step that moves nothing by more than a hundredth of the whole state
    step = float(times[1] - times[0])
    step = min(step, 0.01 * float(largest.max() / max(speed.max(), 1e-300)) or step)
    for i, end in enumerate(times[1:], 1):
        while now < end:
            h, k = min(step, end - now), [first]
            with np.errstate(over="ignore", invalid="ignore"):
                for row, c in zip(_A, _C, strict=True):
                    new = s + h * sum(a * d for a, d in zip(row, k, strict=True) if a)
                    k.append(rhs(now + c * h, new))
                error = h * sum(e * d for e, d in zip(_E, k, strict=True) if e)
                size = np.maximum(largest, np.abs(new).max(axis=batch, initial=0.0))
                size = np.maximum(size, 1e-6 * size.max()) + 1e-300
                worst = float(np.max(np.abs(error) / (tol * size), initial=0.0))
            if worst <= 1.0:
                now = float(end) if h == end - now else now + h
                s, first, largest = new, k[-1], size
            elif h < 1e-13 * max(abs(now), end - times[0]):
                steps = _MOST_STEPS
            steps += 1
            if steps > _MOST_STEPS:
                raise ValueError(f"the states explode or are too stiff to follow at t = {now:.6g}")
            if h == step or not worst <= 1.0:  # not where the interval's end cut the step short
                step = h * float(np.clip(0.9 * max(worst, 1e-9) ** -0.2, 0.1, 5.0))
                step = step if np.isfinite(worst) else 0.1 * h
        path[i] = s
    return path


def linear_flow(A: ArrayLike, t: ArrayLike, start: ArrayLike | None = None) -> Array:
    """Solve x' = A x exactly: x(t) = e^(A (t - t_0)) x(t_0), (time, ..., n).

    A is (n, n) in 1/s, t (time,) in s, `start` (..., n) at t[0]; without it the maps themselves are
    returned, (time, n, n).
    """
    A, times = checked("A", A, "n n"), checked("t", t, "time")
    x = None if start is None else checked("start", start, "... n", n=len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        maps = expm(A * (times - times[0])[:, None, None])
        found = np.asarray(maps if x is None else np.einsum("tij,...j->t...i", maps, x))
    not_overflown("A and t", found)
    return found


@dataclass(frozen=True)
class Path:
    """Trajectories of a loop, (time, ..., n) each, at the times t [s], (time,).

    z = T_y (y - y_ref), integral = int z dt; u is the command that acts from each time on.
    """

    t: Array
    y: Array
    z: Array
    integral: Array
    u: Array


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
    known = transforms is None or isinstance(transforms, AuxiliarySpace)
    need(known, "transforms", "an AuxiliarySpace or a function", transforms)

    def jacobians(y: Array) -> tuple[Array, Array]:
        u = np.zeros(plant.n) if plant.constant else equilibrium(plant, y)
        return plant.f_y(y, u), plant.f_u(y, u)

    def build(y: Array) -> AuxiliarySpace:
        if transforms is None:
            return decompose(*jacobians(y))
        return AuxiliarySpace.from_transforms(transforms.T_y, transforms.T_a, *jacobians(y))

    if plant.constant:
        found = build(np.zeros(plant.n))
        return lambda y: found
    if transforms is not None:
        return build
    if centre is None:
        centre = (np.asarray(plant.y_low) + np.asarray(plant.y_high)) / 2
    first = build(np.asarray(centre, dtype=float))
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
            the sign rule: see `cmc.theory.slopes.action_of`.
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
    loop, times = Loop(plant, policy, transforms, y_ref, u0, clip), increasing("t", t, 1)
    y = checked("y0", y0, "... n", n=plant.n)
    y, I, *_ = together(
        y0=y, integral=_vector("integral", integral, plant.n), u0=loop.u0, y_ref=loop.y_ref
    )
    start = np.concatenate([y, I], axis=-1)
    if h is None:
        s = flow(loop.field, start, times)
        rows = [loop.signals(*_halves(x), float(now)) for x, now in zip(s, times, strict=True)]
        z, I, u = (np.stack(part) for part in zip(*rows, strict=True))
        return Path(times, _halves(s)[0], z, I, u)
    h = number("h", h, above=0.0)
    if times[-1] - times[0] > 1e6 * h:
        raise ValueError(f"h = {h:g} s needs more than 1,000,000 samples up to t = {times[-1]:g} s")
    return _held(loop, start, times, h)


def _vector(name: str, value: ArrayLike, n: int) -> Array:
    """A number or an array (..., n)."""
    array = checked(name, value)
    return checked(name, array, "... n", n=n) if array.ndim else array


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
            if now >= times[0] + k * h - tiny:
                _, I, u = loop.signals(y, I, now, h)
                k += 1
            if now >= end - tiny:
                break
            until = float(min(times[0] + k * h, end))
            y, now = loop.hold(y, u, now, until), until
            if not np.isfinite(y).all():
                raise ValueError(f"the states explode at t = {now:.6g}")
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
        self.u0 = _vector("u0", u0, self.n) + own
        self.spaces = transforms_of(plant, transforms)
        self.goal = y_ref if callable(y_ref) else None
        self.y_ref = np.zeros(()) if callable(y_ref) else _vector("y_ref", y_ref, self.n)

    def signals(
        self, y: Array, I: Array, t: float = 0.0, h: float | None = None
    ) -> tuple[Array, Array, Array]:
        """Auxiliary signal z, its integral and command u, (..., n) each; with `h` I + h z first."""
        space = self.spaces(y)
        goal = self.y_ref if self.goal is None else _vector("y_ref", self.goal(t), self.n)
        z = applied(space.T_y, y - goal)
        I = I if h is None else I + h * z
        a = self.action(np.stack([z, I], axis=-1), space.gains)
        if a.shape[-1:] != (self.n,) or a.ndim > z.ndim:
            raise ValueError(f"policy needs to return shape {z.shape}, got {a.shape}")
        u = self.u0 + applied(space.T_a, a)
        return z, I, np.clip(u, self.plant.u_low, self.plant.u_high) if self.clip else u

    def field(self, t: float, s: Array) -> Array:
        """Right-hand side in (y, int z), (..., 2n)."""
        y = _halves(s)[0]
        z, _, u = self.signals(*_halves(s), t)
        return np.concatenate([self.plant.f(y, u, t), z], axis=-1)

    def step(self, s: Array, h: float, t: float = 0.0) -> Array:
        """One sample of length h in (y_k, I_{k-1}), (..., 2n)."""
        y = _halves(s)[0]
        _, I, u = self.signals(*_halves(s), t, h)
        return np.concatenate([self.hold(y, u, t, t + h), I], axis=-1)

    def hold(self, y: Array, u: Array, t: float, until: float) -> Array:
        """The plant from `t` to `until` under a held command: exact where it is linear."""
        plant = self.plant
        if not plant.constant:
            return flow(lambda at, x: plant.f(x, u, at), y, [t, until])[-1]
        # y' = A (y - y_t) + f(y_t, u), and y - y_t starts from rest
        A = plant.f_y(np.zeros(self.n), np.zeros(self.n))
        return y + plant.f(y, u, t) @ hold(A, np.eye(self.n), until - t)[1].T
