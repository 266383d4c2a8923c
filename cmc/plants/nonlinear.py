"""Two systems most readers have met before, with one command per latent signal.

The auxiliary space needs f_u to be invertible, so both get a second command u1 on the first
equation. Leave it at zero for the textbook system.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.plants.base import Array, Plant, parameter


class VanDerPol(Plant):
    """Van der Pol's oscillator: y1' = y2 + u1, y2' = mu (1 - y1^2) y2 - y1 + u2.

    Every trajectory but the origin joins one limit cycle. The cycle attracts in all directions but
    along itself, where two points keep their phase difference: not contracting.

    Args:
        mu: Strength of the nonlinear damping, 1/s.
    """

    name = "van_der_pol"
    state_names = ("position", "velocity")
    units = ("1", "1/s")

    def __init__(self, mu: float = 1.0) -> None:
        self.mu = float(parameter("mu", mu, positive=True))
        self._box([3.0, 4.0], [10.0, 10.0])

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The right-hand side above, (..., 2)."""
        y, u = self._pair(y, u)
        y1, y2 = y[..., 0], y[..., 1]
        return np.stack([y2, self.mu * (1 - y1**2) * y2 - y1], axis=-1) + u

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Jacobian in y, (..., 2, 2)."""
        y, u = self._pair(y, u)
        y1, y2 = y[..., 0], y[..., 1]
        jac = np.zeros((*y1.shape, 2, 2))
        jac[..., 0, 1] = 1.0
        jac[..., 1, 0] = -1 - 2 * self.mu * y1 * y2
        jac[..., 1, 1] = self.mu * (1 - y1**2)
        return jac

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The identity, (..., 2, 2)."""
        y, u = self._pair(y, u)
        return np.broadcast_to(np.eye(2), (*y.shape[:-1], 2, 2)).copy()


class Pendulum(Plant):
    """A damped pendulum: angle' = rate + u1, rate' = -stiffness sin(angle) - damping rate + u2.

    u2 is a torque over the inertia; u1 turns the mount. The default is overdamped, so that both
    eigenvalues of f_y are real at every angle; the upper half has one positive eigenvalue.

    Args:
        damping: Damping over inertia, 1/s.
        stiffness: Gravity over length, 1/s^2.
    """

    name = "pendulum"
    state_names = ("angle", "rate")
    units = ("rad", "rad/s")

    def __init__(self, damping: float = 3.0, stiffness: float = 1.0) -> None:
        self.damping = float(parameter("damping", damping))
        self.stiffness = float(parameter("stiffness", stiffness))
        self._box([np.pi, 4.0], [10.0, 10.0])

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The right-hand side above, (..., 2)."""
        y, u = self._pair(y, u)
        angle, rate = y[..., 0], y[..., 1]
        acceleration = -self.stiffness * np.sin(angle) - self.damping * rate
        return np.stack([rate, acceleration], axis=-1) + u

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
        y, u = self._pair(y, u)
        return np.broadcast_to(np.eye(2), (*y.shape[:-1], 2, 2)).copy()
