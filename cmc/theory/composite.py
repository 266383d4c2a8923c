"""Composite variables: a second-order error equation read as two first-order contracting systems.

A task-space controller leaves the error equation (`2nd_sys`)

    lambda_d e'' + K_d e' + K_p e + u = 0,        e = x_d - x,

whose gains we chose ourselves. With y = K1 e + K2 e' (`mapping_pos`) it becomes (`LTI`)

    A_lat y' + B_lat y + u = 0     and     K2 e' + K1 e = y,

the latent system driving the composition. Nothing about the robot is left: the latent model is made
of gains. Matching coefficients gives A_lat K2 = lambda_d, A_lat K1 + B_lat K2 = K_d and
B_lat K1 = K_p, a quadratic with two roots; the two rates K1/K2 and B_lat/A_lat are the two poles of
the error equation, and the root says which of them belongs to the latent system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from cmc.theory.arrays import Array, checked
from cmc.theory.certificates import Certificate, common_metric

Root = Literal["small", "large"]


class InfeasibleGainsError(ValueError):
    """Gains with K_d^2 < 4 K_p lambda_d: the error oscillates, and no real K2 exists."""


@dataclass(frozen=True)
class CompositeModel:
    """Composite gains and the latent model that follows from them, one entry per axis.

    Every field is an array of the same shape (...,); diagonal matrices of the paper are stored as
    their diagonals. Build it with `composite`.

    Attributes:
        lambda_d: coefficient of e'' (1 for acceleration-based control).
        K_p: stiffness gain, 1/s^2 times the unit of `lambda_d`.
        K_d: damping gain, 1/s times the unit of `lambda_d`.
        K1: weight of the error in y, 1/s^2.
        K2: weight of the error velocity in y, 1/s.
        A_lat: coefficient of y' in the latent model.
        B_lat: coefficient of y in the latent model.
    """

    lambda_d: Array
    K_p: Array
    K_d: Array
    K1: Array
    K2: Array
    A_lat: Array
    B_lat: Array

    @property
    def latent_rate(self) -> Array:
        """Contraction rate B_lat / A_lat of the latent system with u = 0, 1/s."""
        return self.B_lat / self.A_lat

    @property
    def composition_rate(self) -> Array:
        """Contraction rate K1 / K2 of K1 e + K2 e' = 0, 1/s; zero on an axis with K_p = 0.

        At zero the velocity error converges and the position error merely stops somewhere.
        """
        return self.K1 / self.K2

    @property
    def f_y(self) -> Array:
        """Latent Jacobian df/dy = -B_lat / A_lat, negative, 1/s."""
        return -self.B_lat / self.A_lat

    @property
    def f_u(self) -> Array:
        """Latent Jacobian df/du = -1 / A_lat, negative; it is R with T_y = T_a = I."""
        return -1.0 / self.A_lat

    @property
    def slope_sign(self) -> Array:
        """Sign that dpi/ds must have on every axis: opposite to R, hence +1 (`inequal_1`)."""
        return -np.sign(self.f_u)

    def y(self, e: ArrayLike, e_dot: ArrayLike) -> Array:
        """Composite variable K1 e + K2 e' (`mapping_pos`), (..., n), unit of e times 1/s^2."""
        return self.K1 * np.asarray(e, dtype=float) + self.K2 * np.asarray(e_dot, dtype=float)

    def y_dot(self, y: ArrayLike, u: ArrayLike) -> Array:
        """Latent dynamics y' = -(B_lat y + u) / A_lat (`LTI`), shapes (..., n)."""
        y = np.asarray(y, dtype=float)
        return -(self.B_lat * y + np.asarray(u, dtype=float)) / self.A_lat  # LTI

    def slope_cap(self, dt: float) -> Array:
        """Largest gain g = dpi/dy of u = g y that a torque held for `dt` seconds tolerates.

        Holding K_p e + K_d e' + u over a step makes the error a sampled double integrator, stable
        only if (K_d + g K2) dt < 2 lambda_d (Jury's condition at z = -1). Beyond it the loop
        chatters at half the sampling rate. The sign rule alone knows no such bound.

        Raises:
            ValueError: unless `dt` is positive and finite.
        """
        return (2.0 * self.lambda_d / _step(dt) - self.K_d) / self.K2

    def sampled_stable(self, g: ArrayLike, dt: float) -> NDArray[np.bool_]:
        """Whether u = g y, held for `dt` seconds, is stable on each axis: both Jury conditions.

        (K_d + g K2) dt < 2 lambda_d and (K_p + g K1) dt < 2 (K_d + g K2); where K_p = 0 the
        velocity alone is judged.

        Raises:
            ValueError: unless `dt` is positive and finite.
        """
        g = np.asarray(g, dtype=float)
        k_v, k_x = self.K_d + g * self.K2, self.K_p + g * self.K1
        slow = np.where(self.K_p > 0.0, (k_x > 0.0) & (k_x * dt < 2.0 * k_v), k_v > 0.0)
        return (k_v * _step(dt) < 2.0 * self.lambda_d) & slow


def composite(
    K_p: ArrayLike, K_d: ArrayLike, lambda_d: ArrayLike = 1.0, root: Root = "small"
) -> CompositeModel:
    """Composite gains K1, K2 and the latent model A_lat, B_lat of a second-order error equation.

    K1 = K_p / lambda_d and K2 = 2 K_p / (K_d +- sqrt(K_d^2 - 4 K_p lambda_d)), which gives
    B_lat = lambda_d and A_lat = lambda_d / K2 (`lambda_b_2`). Where K_p = 0: y = e', A_lat =
    lambda_d, B_lat = K_d (`lambda_b_1`).

    Args:
        K_p: stiffness gains >= 0, broadcastable to (...,).
        K_d: damping gains > 0.
        lambda_d: inertia-like coefficient > 0; 1 for acceleration-based control.
        root: "small" takes the paper's plus sign (smaller K2: y is mostly position, the fast pole
            is the composition, the slow one latent); "large" the minus sign (larger K2: the fast
            pole is latent).

    Raises:
        InfeasibleGainsError: where K_d^2 < 4 K_p lambda_d.
        ValueError: for gains that are not finite, of the wrong sign, or do not broadcast.
    """
    if root not in ("small", "large"):
        raise ValueError(f"root must be 'small' or 'large', got {root!r}")
    kp, kd, lam = _gains(K_p, K_d, lambda_d)
    discriminant = kd**2 - 4.0 * kp * lam
    if np.any(discriminant < 0.0):
        worst = np.unravel_index(np.argmin(discriminant), discriminant.shape)
        axis = "" if not worst else f" on axis {', '.join(map(str, worst))}"
        raise InfeasibleGainsError(
            f"K_d^2 < 4 K_p lambda_d{axis}: K_p = {kp[worst]:g}, K_d = {kd[worst]:g}, "
            f"lambda_d = {lam[worst]:g}; no real composite variable exists below "
            f"K_d = {np.sqrt(4.0 * kp[worst] * lam[worst]):g}"
        )
    sum_ = kd + np.sqrt(discriminant)
    # 2 K_p / (K_d - s) loses digits for small K_p; (K_d + s) / (2 lambda_d) is the same number.
    k2 = 2.0 * kp / sum_ if root == "small" else sum_ / (2.0 * lam)
    rigid = kp == 0.0
    K2 = np.where(rigid, 1.0, k2)
    return CompositeModel(
        lambda_d=lam,
        K_p=kp,
        K_d=kd,
        K1=kp / lam,
        K2=K2,
        A_lat=lam / K2,  # lambda_b_1, lambda_b_2
        B_lat=np.where(rigid, kd, lam),  # lambda_b_1, lambda_b_2
    )


def certify_latent(
    signal: Any,
    policy: Any,
    K_p: ArrayLike,
    K_d: ArrayLike,
    lambda_d: ArrayLike = 1.0,
    *,
    h: float | None = None,
) -> Certificate:
    """Judge e'' = -(K_p e + K_d e' + u) / lambda_d, u = pi(y, int y), y = phi(e, e'), per axis.

    With slopes phi_1, phi_2 of the signal and p, q of the policy the Jacobian in (e, e', int y) is

        [[0, 1, 0], [-(K_p + p phi_1), -(K_d + p phi_2), -q] / lambda_d, [phi_1, phi_2, 0]],

    multi-affine in the four, so that it lies in the hull of its 16 corners: one metric for these
    proves contraction for every signal and policy within the intervals, everywhere. With `h` the
    whole command is held, I_k = I_{k-1} + h y_k, and the step is multi-affine as well.

    Args:
        signal: Has `slope_bounds() -> (lower, upper)`, slopes in (e, e'), (n, 2), positive; a
            `CompositeModel` is the hand-made one.
        policy: Has `slope_bounds()`, slopes of u in (y, int y), (n, 2); without integral where the
            second are zero.
        K_p: Stiffness gains, broadcast to (n,).
        K_d: Damping gains, broadcast to (n,).
        lambda_d: Coefficient of e'', broadcast to (n,).
        h: Sample time, s.

    Returns:
        A certificate in (e_1, e_1', int y_1, e_2, ...), the rate that of the slowest axis.
    """
    low, high = (checked("signal", x, "n 2") for x in _slopes(signal))
    least, most = (checked("policy", x, "n 2", n=len(low)) for x in _slopes(policy))
    gains = [
        np.broadcast_to(checked(name, x), (len(low),))
        for name, x in (("K_p", K_p), ("K_d", K_d), ("lambda_d", lambda_d))
    ]
    metrics, rates = [], []
    for i, (kp, kd, lam) in enumerate(zip(*gains, strict=True)):
        ends = [
            np.unique([a[i, m], b[i, m]]) for a, b in ((low, high), (least, most)) for m in (0, 1)
        ]
        corners = [
            _latent_jacobian(kp / lam, kd / lam, phi, (p / lam, q / lam), h)
            for *phi, p, q in product(*ends)
        ]
        size = 3 if most[i, 1] > 0 else 2
        axis = common_metric(np.array(corners)[:, :size, :size], h=h)
        if not axis.holds or axis.metric is None:
            return replace(axis, reason=f"axis {i + 1}: {axis.reason}", region="everywhere")
        metrics.append(axis.metric)
        rates.append(axis.rate)
    return replace(
        axis,
        rate=min(rates),
        metric=block_diag(*metrics),
        region="everywhere",
        reason="every signal and policy within the slopes, axis by axis",
    )


def _slopes(part: Any) -> tuple[ArrayLike, ArrayLike]:
    if isinstance(part, CompositeModel):
        weights = np.stack([np.atleast_1d(part.K1), np.atleast_1d(part.K2)], axis=-1)
        return weights, weights
    return part.slope_bounds()  # type: ignore[no-any-return]


def _latent_jacobian(
    kp: float, kd: float, phi: Sequence[float], pq: tuple[float, float], h: float | None
) -> Array:
    """Jacobian in (e, e', int y), or with h the step in (e_k, e_k', I_{k-1}), (3, 3)."""
    a, b = phi
    p, q = pq
    if h is None:
        return np.array([[0, 1, 0], [-(kp + p * a), -(kd + p * b), -q], [a, b, 0]], dtype=float)
    p = p + h * q
    command = np.array([kp + p * a, kd + p * b, q])
    free = np.array([[1, h, 0], [0, 1, 0], [h * a, h * b, 1]], dtype=float)
    return free - np.array([[h * h / 2], [h], [0]]) * command


def feasible(K_p: ArrayLike, K_d: ArrayLike, lambda_d: ArrayLike = 1.0) -> NDArray[np.bool_]:
    """Whether a real composite variable exists: K_d^2 >= 4 K_p lambda_d, elementwise.

    Raises:
        ValueError: as `composite`.
    """
    kp, kd, lam = _gains(K_p, K_d, lambda_d)
    return kd**2 >= 4.0 * kp * lam


def _gains(K_p: ArrayLike, K_d: ArrayLike, lambda_d: ArrayLike) -> tuple[Array, Array, Array]:
    """Three gains as float arrays of one shape, checked."""
    try:
        kp, kd, lam = np.broadcast_arrays(
            *(np.asarray(gain, dtype=float) for gain in (K_p, K_d, lambda_d))
        )
    except ValueError as error:
        shapes = [np.shape(gain) for gain in (K_p, K_d, lambda_d)]
        raise ValueError(f"K_p, K_d, lambda_d must broadcast together, got {shapes}") from error
    for name, gain in (("K_p", kp), ("K_d", kd), ("lambda_d", lam)):
        if not np.all(np.isfinite(gain)):
            raise ValueError(f"{name} must be finite, got {gain}")
        if np.any(gain < 0.0) or (name != "K_p" and np.any(gain == 0.0)):
            wanted = ">= 0" if name == "K_p" else "> 0"
            raise ValueError(f"{name} must be {wanted}, got {gain}")
    return kp.copy(), kd.copy(), lam.copy()


def _step(dt: float) -> float:
    if not (np.isfinite(dt) and dt > 0.0):
        raise ValueError(f"dt must be positive and finite, got {dt}")
    return float(dt)
