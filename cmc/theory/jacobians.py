"""Jacobians by differences, and whether a plant's own Jacobians belong to its f."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.arrays import Array

_POINTS = 24


def differences(function: Callable[[Array], Array], x: ArrayLike, step: ArrayLike = 1e-5) -> Array:
    """Jacobian of a function of (..., m) by central differences, (..., k, m).

    Args:
        function: Maps (..., m) to (..., k).
        x: Points, (..., m).
        step: Half width of the difference, one number or one for each entry, (m,).
    """
    x = np.asarray(x, dtype=float)
    step = np.broadcast_to(np.asarray(step, dtype=float), x.shape[-1:])
    shift = np.diag(step)
    up, down = function(x[..., None, :] + shift), function(x[..., None, :] - shift)
    return np.swapaxes((up - down) / (2 * step[:, None]), -1, -2)


def complex_step(function: Callable[[NDArray[np.complex128]], Any], x: ArrayLike) -> Array:
    """Jacobian Im f(x + i h e_j) / h of an analytic function, exact to rounding, (..., k, m).

    Squire and Trapp 1998: no difference is taken, so h may be tiny. A function that branches on a
    value or takes its size is not analytic; compare with `differences`.
    """
    x = np.asarray(x, dtype=float)
    found = function(x[..., None, :] + 1e-30j * np.eye(x.shape[-1]))
    return np.swapaxes(np.imag(found) / 1e-30, -1, -2)


def require_square(plant: Any) -> None:
    """Refuse a plant with another number of commands than of signals, and say where to go.

    Raises:
        ValueError: If the numbers differ.
    """
    n = plant.n
    shape = np.shape(plant.f_u(np.zeros(n), np.zeros(getattr(plant, "m", n))))
    if shape[-2:] != (n, n):
        raise ValueError(not_square(n, shape[-1]))


def not_square(n: int, m: int) -> str:
    """The sentence for a plant with n signals and m commands."""
    signals, commands = f"{n} signal{'s' * (n != 1)}", f"{m} command{'s' * (m != 1)}"
    return (
        f"the plant has {signals} and {commands}; the theory wants as many signals as commands. "
        "Command a composite signal instead, a combination of signals with one entry for each "
        "command (cmc.theory.composite, lesson 06), or a learned one (cmc.policies.latent_signal)"
    )


def jacobian_fault(plant: Any, low: Array, high: Array) -> str:
    """Why a plant's f_y or f_u cannot be right, or "": differences of f at points of its box.

    Also whether they move with time, and whether Jacobians that are said to be constant are.
    """
    n, rng = plant.n, np.random.default_rng(0)
    centre, width = (high + low) / 2, high - low
    u_low, u_high = (
        np.where(np.isfinite(u), u, fallback)
        for u, fallback in (
            (np.asarray(getattr(plant, "u_low", -np.inf), dtype=float) + np.zeros(n), -1.0),
            (np.asarray(getattr(plant, "u_high", np.inf), dtype=float) + np.zeros(n), 1.0),
        )
    )
    y = rng.uniform(low, high, (_POINTS, n))
    u = rng.uniform(u_low, u_high, (_POINTS, n))
    y[0], u[0] = centre, (u_low + u_high) / 2
    u_width = np.where(u_high > u_low, u_high - u_low, 1.0)
    values = np.asarray(plant.f(y, u, 0.0), dtype=float)
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))[0]
        return f"f is not finite at y = {_text(y[bad])}, u = {_text(u[bad])}"
    for name, given, x, step, f in (
        ("f_y", plant.f_y, y, 1e-5 * width, lambda x: plant.f(x, u[:, None], 0.0)),
        ("f_u", plant.f_u, u, 1e-5 * u_width, lambda x: plant.f(y[:, None], x, 0.0)),
    ):
        stated = np.broadcast_to(np.asarray(given(y, u, 0.0), dtype=float), (_POINTS, n, n))
        later = np.asarray(given(y, u, 0.618), dtype=float)
        if not np.isfinite(stated).all():
            bad = np.flatnonzero(~np.isfinite(stated).all(axis=(1, 2)))[0]
            return f"{name} is not finite at y = {_text(y[bad])}, u = {_text(u[bad])}"
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
                f"{name}[{i}, {j}] is {stated[k, i, j]:.6g} at y = {_text(y[k])}, u = "
                f"{_text(u[k])}, where differences of f give {found[k, i, j]:.6g}: the Jacobian "
                "does not belong to f"
            )
        if not np.allclose(stated, later, rtol=1e-9, atol=0.0):
            return f"{name} moves with time: only Jacobians that depend on y and u alone are judged"
        if plant.constant and not np.allclose(stated, stated[0], rtol=1e-9, atol=0.0):
            return f"{name} is not constant, though the plant says so (`constant` is True)"
    return ""


def _text(vector: Array) -> str:
    return "[" + ", ".join(f"{x:.4g}" for x in vector) + "]"
