"""Composite variables: a second-order error equation read as two first-order contracting systems.

A task-space controller leaves the error equation (`2nd_sys`)

    lambda_d e'' + K_d e' + K_p e + u = 0,        e = x_d - x,

whose gains we chose ourselves. With y = K1 e + K2 e' (`mapping_pos`) it becomes (`LTI`)

    A_lat y' + B_lat y + u = 0     and     K2 e' + K1 e = y,

the latent system driving the composition. Nothing about the robot is left: the latent model is made
of gains. Matching coefficients gives A_lat K2 = lambda_d, A_lat K1 + B_lat K2 = K_d and
B_lat K1 = K_p, a quadratic with two roots; the two rates K1/K2 and B_lat/A_lat are the two poles of
the error equation, and the root says which of them belongs to the latent system.

Wrong shapes, signs and sizes raise ValueError, or TypeError, with the argument's name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from cmc.theory.arrays import Array, checked, filled, need, not_overflown, number, together
from cmc.theory.certificates import Certificate, common_metric, corners

Root = Literal["small", "large"]


class InfeasibleGainsError(ValueError):
    """Gains with K_d^2 < 4 K_p lambda_d: the error oscillates, and no real K2 exists."""


@dataclass(frozen=True)
class CompositeModel:
    """Composite gains and the latent model that follows, one entry per axis, (...,) each.

    lambda_d is the coefficient of e'' (1 for acceleration-based control), K_p [1/s^2] and K_d [1/s]
    in its unit are stiffness and damping; y = K1 e + K2 e' with K1 in 1/s^2 and K2 in 1/s, and
    A_lat y' + B_lat y + u = 0. Diagonal matrices of the paper are stored as their diagonals. Build
    it with `composite`.
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
        """Latent Jacobian df/dy = -B_lat / A_lat, negative, 1/s (`LTI`)."""
        return -self.latent_rate

    @property
    def f_u(self) -> Array:
        """Latent Jacobian df/du = -1 / A_lat: R with T_y = T_a = I, so slopes are positive."""
        return -1.0 / self.A_lat

    def y(self, e: ArrayLike, e_dot: ArrayLike) -> Array:
        """Composite variable K1 e + K2 e' (`mapping_pos`), (..., n), unit of e times 1/s^2."""
        e, v = checked("e", e, finite=False), checked("e_dot", e_dot, finite=False)
        e, v, K1, K2 = together(e=e, e_dot=v, K1=self.K1, K2=self.K2)
        return K1 * e + K2 * v  # a signal that has run away stays what it is

    def slope_cap(self, dt: float) -> Array:
        """Largest gain g = dpi/dy of u = g y that a torque held for `dt` seconds tolerates.

        Holding K_p e + K_d e' + u over a step makes the error a sampled double integrator, stable
        only if (K_d + g K2) dt < 2 lambda_d (Jury's condition at z = -1). Beyond it the loop
        chatters at half the sampling rate. The sign rule alone knows no such bound.
        """
        with np.errstate(over="ignore"):
            cap = (2.0 * self.lambda_d / number("dt", dt, above=0.0) - self.K_d) / self.K2
        not_overflown("dt and K2", cap)
        return cap


def composite(
    K_p: ArrayLike, K_d: ArrayLike, lambda_d: ArrayLike = 1.0, root: Root = "small"
) -> CompositeModel:
    """Composite gains K1, K2 and the latent model A_lat, B_lat of a second-order error equation.

    K1 = K_p / lambda_d and K2 = 2 K_p / (K_d +- sqrt(K_d^2 - 4 K_p lambda_d)), which gives
    B_lat = lambda_d and A_lat = lambda_d / K2 (`lambda_b_2`). Where K_p = 0: y = e', A_lat =
    lambda_d, B_lat = K_d (`lambda_b_1`).

    K_p >= 0, K_d > 0 and lambda_d > 0 (1 for acceleration-based control) broadcast to (...,). The
    root "small" takes the paper's plus sign (smaller K2: y is mostly position, the fast pole is the
    composition, the slow one latent), "large" the minus sign (larger K2: the fast pole is latent).
    """
    if not isinstance(root, str) or root not in ("small", "large"):
        raise ValueError(f"root must be 'small' or 'large', got {root!r}")
    K_p, K_d = checked("K_p", K_p, least=0.0), checked("K_d", K_d, above=0.0)
    lambda_d = checked("lambda_d", lambda_d, above=0.0)
    kp, kd, lam = (gain.copy() for gain in together(K_p=K_p, K_d=K_d, lambda_d=lambda_d))
    with np.errstate(all="ignore"):
        square, twin = kd**2, 4.0 * kp * lam
        not_overflown("K_d", square, 1.0 / square)
        not_overflown("K_p and lambda_d", twin)
        discriminant = square - twin
        if np.any(discriminant < 0.0):
            worst = np.unravel_index(np.argmin(discriminant), discriminant.shape)
            axis = "" if not worst else f" on axis {', '.join(map(str, worst))}"
            raise InfeasibleGainsError(
                f"K_d^2 < 4 K_p lambda_d{axis}: K_p = {kp[worst]:g}, K_d = {kd[worst]:g}, "
                f"lambda_d = {lam[worst]:g}; no real composite variable exists below "
                f"K_d = {np.sqrt(twin[worst]):g}"
            )
        sum_, rigid = kd + np.sqrt(discriminant), kp == 0.0
        # 2 K_p / (K_d - s) loses digits for small K_p; (K_d + s) / (2 lambda_d) is the same number.
        K2 = np.where(rigid, 1.0, 2.0 * kp / sum_ if root == "small" else sum_ / (2.0 * lam))
        K1, A_lat, B_lat = kp / lam, lam / K2, np.where(rigid, kd, lam)  # lambda_b_1, lambda_b_2
        model = CompositeModel(lam, kp, kd, K1, K2, A_lat, B_lat)
        rates = (model.latent_rate, model.composition_rate, model.f_u)
    not_overflown("K_p, K_d and lambda_d", K1, K2, A_lat, *rates)
    return model


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

    `slope_bounds() -> (lower, upper)` gives slopes of the signal in (e, e'), (n, 2), positive (a
    `CompositeModel` is the hand-made one), and of the policy's u in (y, int y), the second zero
    without integral; gains broadcast to (n,), h in s. The certificate is in (e_1, e_1', int y_1,
    e_2, ...), its rate that of the slowest axis.
    """
    low, high = _slopes("signal", signal)
    least, most = _slopes("policy", policy, n=len(low))
    h = None if h is None else number("h", h, above=0.0)
    n = len(low)
    K_p, K_d = filled("K_p", K_p, n), filled("K_d", K_d, n)
    lambda_d = filled("lambda_d", lambda_d, n, above=0.0)
    metrics, rates = [], []
    for i, (kp, kd, lam) in enumerate(zip(K_p, K_d, lambda_d, strict=True)):
        jacobians = [
            _latent_jacobian(kp / lam, kd / lam, phi, pq / lam, h)
            for phi, pq in corners(np.stack([low[i], least[i]]), np.stack([high[i], most[i]]))
        ]
        size = 3 if most[i, 1] > 0 else 2
        axis = common_metric(np.array(jacobians)[:, :size, :size], h=h)
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


def _slopes(name: str, part: Any, **sizes: Any) -> tuple[Array, Array]:
    """Lower and upper slopes, (n, 2) each."""
    if isinstance(part, CompositeModel):
        bounds = [np.stack([np.atleast_1d(part.K1), np.atleast_1d(part.K2)], axis=-1)] * 2
    else:
        need(hasattr(part, "slope_bounds"), name, "slope_bounds() -> (lower, upper)", part)
        bounds = part.slope_bounds()
    low, high = (checked(f"{name}.slope_bounds()", bound, "n 2", **sizes) for bound in bounds)
    return low, high


def _latent_jacobian(kp: float, kd: float, phi: Array, pq: Array, h: float | None) -> Array:
    """Jacobian in (e, e', int y), or with h the step in (e_k, e_k', I_{k-1}), (3, 3)."""
    (a, b), (p, q) = phi, pq
    if h is None:
        return np.array([[0, 1, 0], [-(kp + p * a), -(kd + p * b), -q], [a, b, 0]], dtype=float)
    p = p + h * q
    command = np.array([kp + p * a, kd + p * b, q])
    free = np.array([[1, h, 0], [0, 1, 0], [h * a, h * b, 1]], dtype=float)
    return free - np.array([[h * h / 2], [h], [0]]) * command
