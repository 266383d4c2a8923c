"""Small named plants, each chosen because one idea of the theory shows on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.plants.base import LinearPlant, Plant
from cmc.theory.arrays import Array, checked, not_overflown, number


class Lags(LinearPlant):
    """Two separate first-order lags, tau_i y_i' = -y_i + gain_i u_i: nothing to transform.

    Time constants tau in s and static gains, (n,) each.
    """

    name = "lags"

    def __init__(self, tau: ArrayLike = (0.5, 0.2), gain: ArrayLike = (1.0, 2.0)) -> None:
        tau = checked("tau", tau, "n", above=0.0)
        gain = checked("gain", gain, "n", n=len(tau))
        with np.errstate(over="ignore"):
            A, B = np.diag(-1 / tau), np.diag(gain / tau)
        not_overflown("tau and gain", A, B)
        super().__init__(A, B)


class CoupledLags(LinearPlant):
    """Two coupled lags fed crosswise: each command acts more on the other signal.

    Both Jacobians are full and det f_u < 0 while its diagonal is positive. The rule "slope against
    the sign of R_ii" with identity transforms reads the diagonal only, and the loop

        J = [[f_y - f_u K_p, -f_u K_i], [I, 0]],   det J = det(f_u) det(K_i) < 0

    then has a positive real eigenvalue for EVERY choice of positive slopes (the Niederlinski index
    of decentralised integral control is negative). With T_y and T_a every positive slope is stable.

    Args:
        coupling: Factor on the off-diagonal entries of f_y; 0 separates the lags.
        crossing: Factor on the off-diagonal entries of f_u; below 0.58 the determinant is positive.
    """

    name = "coupled_lags"

    def __init__(self, coupling: float = 1.0, crossing: float = 1.0) -> None:
        c, x = number("coupling", coupling), number("crossing", crossing)
        super().__init__([[-2.0, c], [0.5 * c, -1.0]], [[1.0, 2.0 * x], [1.5 * x, 1.0]])


class Spiral(LinearPlant):
    """A complex pair, f_y = V [[s, w], [-w, s]] V^-1: no real T_y makes it triangular.

    Real part sigma in 1/s, negative is stable; imaginary part omega in rad/s, not zero.
    """

    name = "spiral"

    def __init__(self, sigma: float = -0.4, omega: float = 2.0) -> None:
        sigma, omega = number("sigma", sigma), number("omega", omega)
        if omega == 0.0:
            raise ValueError("omega needs a value other than 0: the pair would not be complex")
        V = np.array([[1.0, 0.4], [0.2, 0.8]])
        block = np.array([[sigma, omega], [-omega, sigma]])
        super().__init__(V @ block @ np.linalg.inv(V), [[1.0, 0.3], [-0.5, 1.2]])


class UnstableMode(LinearPlant):
    """One mode grows by itself, so a right sign is not enough: the slope needs a floor.

    Eigenvalues growth and -2 along skewed eigenvectors; theorem 2 (`eq_theorem2`) then demands
    |d pi_1 / d s_11| > growth / |R_11|.
    """

    name = "unstable_mode"

    def __init__(self, growth: float = 0.8) -> None:
        growth = number("growth", growth, above=-2.0)  # the other mode
        V = np.array([[1.0, 0.5], [0.6, 1.0]])
        A = V @ np.diag([growth, -2.0]) @ np.linalg.inv(V)
        super().__init__(A, [[1.0, 0.4], [-0.3, 0.8]])


class Pendulum(Plant):
    """A damped pendulum: angle' = rate + u1, rate' = -stiffness sin(angle) - damping rate + u2.

    u2 is a torque over the inertia; u1 turns the mount, because f_u has to be invertible: leave it
    at zero for the textbook system. The default is overdamped, so that both eigenvalues of f_y are
    real at every angle; the upper half has one positive eigenvalue.
    Damping is over inertia, in 1/s; stiffness is gravity over length, in 1/s^2.
    """

    name = "pendulum"
    state_names = ("angle", "rate")
    units = ("rad", "rad/s")

    def __init__(self, damping: float = 3.0, stiffness: float = 1.0) -> None:
        self.damping = number("damping", damping)
        self.stiffness = number("stiffness", stiffness)
        self._box([np.pi, 4.0], [10.0, 10.0])

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The right-hand side above, (..., 2)."""
        y, u = self._pair(y, u)
        rate = y[..., 1]
        return np.stack([rate, -self.stiffness * np.sin(y[..., 0]) - self.damping * rate], -1) + u

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Jacobian in y, (..., 2, 2)."""
        y, u = self._pair(y, u)
        jac = np.zeros((*y.shape[:-1], 2, 2))
        jac[..., 0, 1] = 1.0
        jac[..., 1, 0] = -self.stiffness * np.cos(y[..., 0])
        jac[..., 1, 1] = -self.damping
        return jac

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The identity, (..., 2, 2)."""
        return np.tile(np.eye(2), (*self._pair(y, u)[0].shape[:-1], 1, 1))
