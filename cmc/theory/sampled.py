"""Sampled control: zero-order hold puts the upper bound on the slopes that theory leaves out.

A lag tau y' = -y + K u is sampled every h seconds under u = -(k1 e_k + k2 I_k) with
I_k = I_{k-1} + h e_k, the new error included. In (e_k, I_{k-1}) one step is

    e_{k+1} = phi e_k - G (k1 + h k2) e_k - G k2 I_{k-1},    I_k = I_{k-1} + h e_k,

with phi = e^{-h/tau}, G = K (1 - phi). Jury's conditions on this 2x2 matrix are exactly

    k2 > 0,      k1 > -1/K,      k1 + (h/2) k2 < coth(h / (2 tau)) / K.

Another quadrature of the integral has another bound: forward Euler or the trapezoid rule decide
more than a third of random samples differently. The bound is exact for constant slopes; slopes that
vary need a common metric (`certificates.common_metric` with `h`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from cmc.theory.arrays import Array, checked, number


def hold_lag(Lambda: ArrayLike, R: ArrayLike, h: float) -> tuple[Array, Array]:
    """Exact step of z' = Lambda z + R a under a held a: z_{k+1} = phi z_k + G a_k, (...,) each.

    phi = e^{Lambda h}, G = R (e^{Lambda h} - 1) / Lambda, and R h where Lambda is 0; Lambda (...,)
    of any sign in 1/s, R (...,), h in s.
    """
    h, Lambda, R = number("h", h, above=0.0), checked("Lambda", Lambda), checked("R", R)
    flat = np.abs(Lambda * h) < 1e-12
    if (Lambda * h > 700).any():
        raise ValueError(f"Lambda h needs to be below 700, e^700 is the largest float; got h = {h}")
    growth = np.expm1(Lambda * h) / np.where(flat, 1.0, Lambda)
    return np.exp(Lambda * h), R * np.where(flat, h, growth)


def hold(Lambda: ArrayLike, R: ArrayLike, h: float) -> tuple[Array, Array]:
    """Exact step for matrices Lambda (n, n) in 1/s and R (n, m): z_{k+1} = Phi z_k + Gamma a_k.

    Phi = e^{Lambda h} and Gamma = int_0^h e^{Lambda s} ds R, both blocks of one exponential.
    """
    Lambda = checked("Lambda", Lambda, "n n")
    R = checked("R", R, "n m", n=len(Lambda))
    h, (n, m) = number("h", h, above=0.0), R.shape
    size = max(float(np.abs(R).max()), 1e-300)  # an exponential knows no units
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = Lambda * h, R / size
    if np.abs(block).max() < 1e150:
        step = expm(block)
    if np.abs(block).max() >= 1e150 or not np.isfinite(step).all():
        raise ValueError(
            f"Lambda h is too large for e^(Lambda h); got {np.abs(Lambda * h).max():g}"
        )
    return step[:n, :n], step[:n, n:] * size * h


def sampled_matrix(
    k1: ArrayLike, k2: ArrayLike, Lambda: ArrayLike, R: ArrayLike, h: float
) -> Array:
    """One step in (z_k, I_{k-1}) of a_k = -(k1 z_k + k2 I_k), I_k = I_{k-1} + h z_k, (..., 2, 2).

    Args:
        k1: Slope in z, signed so that positive damps for R > 0, (...,).
        k2: Slope in the integral, (...,).
        Lambda: Open-loop rate, 1/s, (...,); -1/tau for a lag.
        R: Gain, (...,); K/tau for a lag.
        h: Sample time, s.
    """
    phi, G = hold_lag(Lambda, R, h)
    phi, G, k1, k2 = np.broadcast_arrays(phi, G, checked("k1", k1), checked("k2", k2))
    step = np.empty((*phi.shape, 2, 2))
    step[..., 0, 0], step[..., 0, 1] = phi - G * (k1 + h * k2), -G * k2
    step[..., 1, 0], step[..., 1, 1] = h, 1.0
    return step


def _top(tau: ArrayLike, K: ArrayLike, h: ArrayLike) -> tuple[Array, Array, Array]:
    """coth(h / (2 tau)) / K, and K and h as arrays, all positive."""
    tau, K, h = (checked(*x, above=0.0) for x in (("tau", tau), ("K", K), ("h", h)))
    return 1 / (np.tanh(h / (2 * tau)) * K), K, h


def sampled_margin(
    k1: ArrayLike, k2: ArrayLike, tau: ArrayLike, K: ArrayLike, h: ArrayLike
) -> Array:
    """Distance to the edge of stability of a sampled lag, (...,): positive means stable.

    The smallest of the three slacks, each relative to the range coth(h/(2 tau))/K + 1/K of k1 (the
    one in k2 times h/2): 0 at the edge, and of order 1 in the middle. Slopes k1 and k2 (1/s), time
    constant tau (s), static gain K and sample time h (s), (...,) each.
    """
    top, K, h = _top(tau, K, h)
    k1, k2 = checked("k1", k1), checked("k2", k2)
    slack = np.broadcast_arrays(h / 2 * k2, k1 + 1 / K, top - k1 - h / 2 * k2)
    return np.asarray(np.min(slack, axis=0) / (top + 1 / K))


def largest_slope(
    tau: ArrayLike,
    K: ArrayLike,
    h: ArrayLike,
    *,
    ratio: ArrayLike | None = None,
    k2: ArrayLike | None = None,
) -> Array:
    """Largest slope k1 in the error for which a sampled lag is stable, (...,).

    k1 < coth(h/(2 tau))/K - (h/2) k2, divided by 1 + h ratio/2 where k2 = ratio k1.
    For the bare loop (k2 = 0) it is (1 + phi)/((1 - phi) K) with phi = e^{-h/tau}.

    Args:
        tau: Time constant, s, (...,).
        K: Static gain, positive, (...,).
        h: Sample time, s, (...,).
        ratio: k2 / k1, 1/s, (...,); give this or `k2`.
        k2: A bound on the integral's own slope, 1/s, (...,).

    Raises:
        ValueError: if both `ratio` and `k2` are given, one is negative, or k2 leaves no room.
    """
    if ratio is not None and k2 is not None:
        raise ValueError("give ratio or k2, not both")
    top, K, h = _top(tau, K, h)
    other = checked("ratio", 0.0 if ratio is None else ratio, least=0.0)
    fixed = checked("k2", 0.0 if k2 is None else k2, least=0.0)
    limit = np.asarray((top - h / 2 * fixed) / (1 + h / 2 * other))
    if (limit <= 0).any():
        raise ValueError(
            f"k2 leaves no room for k1: (h/2) k2 reaches coth(h/(2 tau))/K = {np.min(top):.4g}"
        )
    return limit
