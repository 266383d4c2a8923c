"""What a plant's f, or its data, say: f_y and f_u, whether given ones fit, and what holds it still.

The method needs df/dy and df/du only (`inverse_solution`). Where f can be called, they are its
differences. Where no model exists, one can excite the plant with held commands and fit
y' = f_y y + f_u u + f_0 to what was measured. Wrong shapes and numbers raise ValueError, or
TypeError, with the argument's name.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import logm

from cmc.theory.arrays import Array, checked, filled, need, not_overflown, not_square, number

_POINTS = 24


def differences(function: Callable[[Array], Array], x: ArrayLike, step: ArrayLike = 1e-5) -> Array:
    """Jacobian of a function from (..., m) to (..., k) by central differences, (..., k, m).

    `step` is half the width of the difference, one number or one for each entry of x, (m,).
    """
    need(callable(function), "function", "a function", function)
    x = checked("x", x, "... m")
    step = filled("step", step, x.shape[-1], above=0.0)
    shift = np.diag(step)
    # both ends in one call: a solver inside then takes the same steps for both
    up, down = function(np.stack([x[..., None, :] + shift, x[..., None, :] - shift]))
    return np.swapaxes((up - down) / (2 * step[:, None]), -1, -2)


def complex_step(function: Callable[[NDArray[np.complex128]], Any], x: ArrayLike) -> Array:
    """Jacobian Im f(x + i h e_j) / h of an analytic function, exact to rounding, (..., k, m).

    Squire and Trapp 1998: no difference is taken, so h may be tiny. A function that branches on a
    value or takes its size is not analytic; compare with `differences`.
    """
    need(callable(function), "function", "a function", function)
    x = checked("x", x, "... m")
    found = function(x[..., None, :] + 1e-30j * np.eye(x.shape[-1]))
    return np.swapaxes(np.imag(found) / 1e-30, -1, -2)


def command_limits(plant: Any) -> tuple[Array, Array]:
    """Smallest and largest command, (n,) each; infinite where a plant states none."""
    ends = getattr(plant, "u_low", -np.inf), getattr(plant, "u_high", np.inf)
    low, high = (np.zeros(plant.n) + np.asarray(end, dtype=float) for end in ends)
    return low, high


def jacobian_fault(plant: Any, low: Array, high: Array) -> str:
    """Why a plant's f_y or f_u cannot be right, or "": differences of f at points of its box.

    Also whether they move with time, and whether Jacobians that are said to be constant are. A
    plant with another number of commands than of signals is a ValueError.
    """
    n, rng = plant.n, np.random.default_rng(0)
    shape = np.shape(plant.f_u(np.zeros(n), np.zeros(getattr(plant, "m", n))))
    if shape[-2:] != (n, n):
        raise ValueError(not_square(n, shape[-1]))
    u_low, u_high = command_limits(plant)
    u_low = np.where(np.isfinite(u_low), u_low, -1.0)
    u_high = np.where(np.isfinite(u_high), u_high, 1.0)
    y, u = rng.uniform(low, high, (_POINTS, n)), rng.uniform(u_low, u_high, (_POINTS, n))
    y[0], u[0] = (high + low) / 2, (u_low + u_high) / 2
    u_width = np.where(u_high > u_low, u_high - u_low, 1.0)
    values = np.asarray(plant.f(y, u, 0.0), dtype=float)

    def at(k: int) -> str:
        pair = (np.array2string(v[k], precision=4, separator=", ") for v in (y, u))
        return "at y = {}, u = {}".format(*pair)

    if not np.isfinite(values).all():
        return f"f is not finite {at(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])}"
    for name, given, x, step, f in (
        ("f_y", plant.f_y, y, 1e-5 * (high - low), lambda x: plant.f(x, u[:, None], 0.0)),
        ("f_u", plant.f_u, u, 1e-5 * u_width, lambda x: plant.f(y[:, None], x, 0.0)),
    ):
        stated = np.broadcast_to(np.asarray(given(y, u, 0.0), dtype=float), (_POINTS, n, n))
        if not np.isfinite(stated).all():
            bad = np.flatnonzero(~np.isfinite(stated).all(axis=(1, 2)))[0]
            return f"{name} is not finite {at(bad)}"
        found = differences(f, x, step)
        # differences round like f itself, whose terms may cancel
        size = np.abs(stated) * step + np.abs(found) * step
        rounding = 1e-13 * (np.abs(values)[..., None] + (np.abs(stated) @ np.abs(x)[..., None]))
        wrong = ~(np.abs(found - stated) * step <= 1e-4 * size + 10 * rounding)
        # a kink in f may fall between the two ends of a difference: most points have none
        share = wrong.mean(axis=0)
        if share.max() > 0.2:
            i, j = np.unravel_index(np.argmax(share), share.shape)
            k = int(np.flatnonzero(wrong[:, i, j])[0])
            return (
                f"{name}[{i}, {j}] is {stated[k, i, j]:.6g} {at(k)}, where differences of f give "
                f"{found[k, i, j]:.6g}: the Jacobian does not belong to f"
            )
        if not np.allclose(stated, np.asarray(given(y, u, 0.618)), rtol=1e-9, atol=0.0):
            return f"{name} moves with time: only Jacobians that depend on y and u alone are judged"
        if plant.constant and not np.allclose(stated, stated[0], rtol=1e-9, atol=0.0):
            return f"{name} is not constant, though the plant says so (`constant` is True)"
    return ""


def root(
    f: Callable[[Array], Array], jacobian: Callable[[Array], Array], x: Array, floor: float = 0.0
) -> tuple[Array, NDArray[np.bool_]]:
    """Newton's method with halved steps from x (..., m): what it finds, and where it finds no root.

    A residual of `floor` counts as none. A singular Jacobian (..., m, m) is a LinAlgError.
    """
    r = np.asarray(f(x), dtype=float)
    scale = size = np.linalg.norm(r, axis=-1)
    for _ in range(60):
        J = jacobian(x)
        move = -np.linalg.solve(J, r[..., None])[..., 0]
        length = np.ones_like(size)
        met = size <= floor + 1e-13 * (scale + np.linalg.norm(J @ x[..., None], axis=(-2, -1)))
        for _ in range(30):
            ahead = np.asarray(f(x + length[..., None] * move), dtype=float)
            worse = ~(np.linalg.norm(ahead, axis=-1) < size) & ~met
            if not worse.any():
                break
            length = np.where(worse, length / 2, length)
        step = np.where((length > 1e-8)[..., None], length[..., None] * move, 0.0)
        x = x + step
        r = np.asarray(f(x), dtype=float)
        size = np.linalg.norm(r, axis=-1)
        if met.all() or (np.abs(step) <= 1e-14 * np.abs(x)).all():
            break
    rounding = 1e-13 * np.linalg.norm(J, axis=(-2, -1)) * np.linalg.norm(x, axis=-1)
    return x, ~(size <= 1e-9 * scale + rounding + floor)


def equilibrium(plant: Any, y: ArrayLike, t: float = 0.0) -> Array:
    """Command that holds a plant still at `y`: the root u of f(y, u, t) = 0, (..., n).

    Newton's method from u = 0; one step where f is affine in u. A `y` that cannot be held (f_u is
    singular, no root is found) is a ValueError.
    """
    y, t = checked("y", y, "... n", n=plant.n), number("t", t)
    try:
        u, bad = root(lambda u: plant.f(y, u, t), lambda u: plant.f_u(y, u, t), np.zeros_like(y))
    except np.linalg.LinAlgError:
        raise ValueError(f"{plant!r} cannot be held still: f_u is singular") from None
    if bad.any():
        where = np.array2string(y[bad][0], precision=4)
        raise ValueError(f"{plant!r} cannot be held still at y = {where}: no u makes f(y, u) zero")
    return u


class PoorDataError(ValueError):
    """Data from which the Jacobians cannot be told."""


@dataclass(frozen=True)
class LatentFit:
    """A local model y' = f_y y + f_u u + f_0 learned from data."""

    f_y: Array
    """(n, n), 1/s."""
    f_u: Array
    """(n, m)."""
    f_0: Array
    """What is left at y = u = 0, (n,)."""
    residual: Array
    """Root mean square of the one-step prediction error, (n,), in units of y."""


def fit_latent(y: ArrayLike, u: ArrayLike, y_next: ArrayLike, dt: float) -> LatentFit:
    """Fit f_y and f_u to transitions under commands held for `dt` seconds.

    Least squares gives y_next = Phi y + Gamma u + c; the logarithm of the augmented matrix
    [[Phi, Gamma, c], [0, I, 0], [0, 0, 1]] is dt times [[f_y, f_u, f_0], [0, 0, 0], [0, 0, 0]], so
    noise-free data of a linear plant give the exact Jacobians; those of a nonlinear one belong to
    the region the data came from.

    The sample time needs to be below pi / w for every mode that turns at w rad/s: beyond, a mode
    looks like one at 2 pi / dt - w (aliasing), and no data at this `dt` can tell them apart. Below
    four samples a turn, dt > pi / (2 w), a warning says so.

    Signals y (N, n), commands u (N, m), the signals one sample later y_next (N, n), dt in s. A
    PoorDataError says that the data do not tell all coefficients apart, or that no continuous-time
    model has the fitted map (an eigenvalue of Phi on the negative real axis).
    """
    y = checked("y", y, "N n")
    u = checked("u", u, "N m", N=len(y))
    after = checked("y_next", y_next, "N n", N=len(y), n=y.shape[1])
    dt, n, m = number("dt", dt, above=0.0), y.shape[1], u.shape[1]
    regressors = np.concatenate([y, u, np.ones((len(y), 1))], axis=1)
    scale = np.abs(regressors).max(axis=0)
    scale[scale == 0.0] = 1.0
    singular = np.linalg.svd(regressors / scale, compute_uv=False)
    if len(y) < n + m + 1 or singular[-1] < 1e-9 * singular[0]:
        raise PoorDataError(
            f"{len(y)} transitions do not tell {n + m + 1} coefficients per signal apart: "
            "vary y and every command independently"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        solution = np.linalg.lstsq(regressors / scale, after, rcond=None)[0] / scale[:, None]
        residual = np.sqrt(np.mean((after - regressors @ solution) ** 2, axis=0))
    not_overflown("y, u and y_next", solution, residual)
    step = np.eye(n + m + 1)
    step[:n] = solution.T
    poles = np.linalg.eigvals(step[:n, :n])
    if np.any((np.abs(poles.imag) < 1e-12) & (poles.real <= 1e-14)):
        raise PoorDataError(f"the fitted map has poles {poles}: sample faster than dt = {dt:g} s")
    turn = float(np.abs(np.angle(poles)).max())
    if turn > np.pi / 2:
        warnings.warn(
            f"dt = {dt:g} s may be too long: a mode turns by {turn:.3g} rad a sample, and one that "
            f"turns by {2 * np.pi - turn:.3g} rad looks the same; sample faster to tell them apart",
            stacklevel=2,
        )
    with np.errstate(over="ignore"):
        generator = np.real(logm(step)) / dt
    not_overflown("y, u, y_next and dt", generator)
    return LatentFit(generator[:n, :n], generator[:n, n : n + m], generator[:n, -1], residual)
