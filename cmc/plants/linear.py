"""Linear plants y' = f_y y + f_u u, each chosen because one idea of the theory shows on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.plants.base import Array, Plant, finite_matrix, parameter
from cmc.theory.jacobians import not_square


class LinearPlant(Plant):
    """y' = A y + B u with constant matrices.

    Args:
        A: State matrix f_y, (n, n), 1/s.
        B: Command matrix f_u, (n, n), 1/s.
    """

    name = "linear"
    constant = True

    def __init__(self, A: ArrayLike, B: ArrayLike) -> None:
        self.A = finite_matrix("A", A)
        self.n = len(self.A)
        if np.ndim(B) == 2 and len(B) == self.n != np.shape(B)[1]:  # type: ignore[arg-type]
            raise ValueError(not_square(self.n, np.shape(B)[1]))
        self.B = finite_matrix("B", B, self.n)
        self.state_names = tuple(f"y{i + 1}" for i in range(self.n))
        self.units = ("1",) * self.n
        self._box([3.0] * self.n, [10.0] * self.n)

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """A y + B u, (..., n)."""
        y, u = self._pair(y, u)
        return y @ self.A.T + u @ self.B.T

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """A, repeated over the batch, (..., n, n)."""
        y, u = self._pair(y, u)
        return np.broadcast_to(self.A, y.shape[:-1] + self.A.shape).copy()

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """B, repeated over the batch, (..., n, n)."""
        y, u = self._pair(y, u)
        return np.broadcast_to(self.B, y.shape[:-1] + self.B.shape).copy()


class Lags(LinearPlant):
    """Two separate first-order lags, tau_i y_i' = -y_i + gain_i u_i: nothing to transform.

    Args:
        tau: Time constants, s, (n,).
        gain: Static gains, (n,).
    """

    name = "lags"

    def __init__(self, tau: ArrayLike = (0.5, 0.2), gain: ArrayLike = (1.0, 2.0)) -> None:
        tau = parameter("tau", tau, positive=True)
        gain = parameter("gain", gain)
        super().__init__(np.diag(-1 / tau), np.diag(gain / tau))


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
        coupling, crossing = float(coupling), float(crossing)
        super().__init__(
            [[-2.0, 1.0 * coupling], [0.5 * coupling, -1.0]],
            [[1.0, 2.0 * crossing], [1.5 * crossing, 1.0]],
        )


class Spiral(LinearPlant):
    """A complex pair, f_y = V [[s, w], [-w, s]] V^-1: no real T_y makes it triangular.

    Args:
        sigma: Real part s, 1/s; negative is stable.
        omega: Imaginary part w, rad/s, not zero.
    """

    name = "spiral"

    def __init__(self, sigma: float = -0.4, omega: float = 2.0) -> None:
        if not omega:
            raise ValueError("omega needs a value other than 0: the pair would not be complex")
        V = np.array([[1.0, 0.4], [0.2, 0.8]])
        block = np.array([[sigma, omega], [-omega, sigma]], dtype=float)
        super().__init__(V @ block @ np.linalg.inv(V), [[1.0, 0.3], [-0.5, 1.2]])


class UnstableMode(LinearPlant):
    """One mode grows by itself, so a right sign is not enough: the slope needs a floor.

    Eigenvalues growth and -2 along skewed eigenvectors; theorem 2 (`eq_theorem2`) then demands
    |d pi_1 / d s_11| > growth / |R_11|.

    Args:
        growth: Eigenvalue of the growing mode, 1/s, above -2.
    """

    name = "unstable_mode"

    def __init__(self, growth: float = 0.8) -> None:
        if growth <= -2.0:
            raise ValueError(f"growth needs a value above -2, the other mode, got {growth}")
        V = np.array([[1.0, 0.5], [0.6, 1.0]])
        A = V @ np.diag([float(growth), -2.0]) @ np.linalg.inv(V)
        super().__init__(A, [[1.0, 0.4], [-0.3, 0.8]])
