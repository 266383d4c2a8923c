"""The paper's two-dimensional peg: two lags behind a surface that pushes back (appendix F)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cmc.plants.base import Plant
from cmc.theory.arrays import Array, checked, not_overflown, number, together


class Peg(Plant):
    """Slide a peg along x and press it on a surface with a wanted force.

        tau_x x' + x = u_x,   tau_z z' + z = u_z,   force = K_sur min(z - g(x), 0) <= 0

    with the surface g(x) = surface_sin sin x + surface_cos cos x. The latent signal is (x, force).
    `f`, `f_y` and `f_u` are the model IN CONTACT: out of contact the force stays zero, its row of
    f_u vanishes and no theorem about f_u^-1 applies. `step` is the plant itself, contact or not.

    Time constants tau_x along and tau_z across the surface are in s, its stiffness K_sur in force
    per length (the paper gives no units). All parameters may be arrays that broadcast over y.
    """

    name = "peg"
    state_names = ("x", "force")
    units = ("length", "force")
    x_range = (1.0, 3.0)
    z_range = (-3.0, 1.0)

    def __init__(
        self,
        tau_x: ArrayLike = 0.0437,
        tau_z: ArrayLike = 0.01,
        K_sur: ArrayLike = 16.0,
        surface_sin: ArrayLike = 0.01,
        surface_cos: ArrayLike = -0.01,
    ) -> None:
        self.tau_x = checked("tau_x", tau_x, above=0.0).copy()
        self.tau_z = checked("tau_z", tau_z, above=0.0).copy()
        self.K_sur = checked("K_sur", K_sur, above=0.0).copy()
        self.surface_sin = checked("surface_sin", surface_sin).copy()
        self.surface_cos = checked("surface_cos", surface_cos).copy()
        names = ("tau_x", "tau_z", "K_sur", "surface_sin", "surface_cos")
        self._batch = together(**{name: getattr(self, name) for name in names})[0]
        steepest = self.K_sur * (self.z_range[0] - np.hypot(self.surface_sin, self.surface_cos))
        not_overflown("K_sur and the surface", steepest)
        self.y_low = np.array([self.x_range[0], float(np.min(steepest, initial=0.0))])
        self.y_high = np.array([self.x_range[1], 0.0])
        self.u_low = np.array([self.x_range[0], self.z_range[0]])
        self.u_high = np.array([self.x_range[1], self.z_range[1]])

    def surface(self, x: ArrayLike) -> Array:
        """Height of the surface g(x)."""
        return self._g(*self._fitting(x=x))

    def surface_slope(self, x: ArrayLike) -> Array:
        """Slope of the surface g'(x)."""
        return self._g_slope(*self._fitting(x=x))

    def contact_force(self, x: ArrayLike, z: ArrayLike) -> Array:
        """Force of the surface on the peg, K_sur min(z - g(x), 0): never positive."""
        x, z = self._fitting(x=x, z=z)
        return self.K_sur * np.minimum(z - self._g(x), 0.0)

    def height(self, x: ArrayLike, force: ArrayLike) -> Array:
        """Height z that gives `force` in contact: z = force / K_sur + g(x)."""
        x, force = self._fitting(x=x, force=force)
        return force / self.K_sur + self._g(x)

    def _g(self, x: Array) -> Array:
        return self.surface_sin * np.sin(x) + self.surface_cos * np.cos(x)

    def _g_slope(self, x: Array) -> Array:
        return self.surface_sin * np.cos(x) - self.surface_cos * np.sin(x)

    def _fitting(self, **given: ArrayLike) -> list[Array]:
        """Arguments as finite arrays that fit one another and the parameters, or an error."""
        arrays = {name: checked(name, value) for name, value in given.items()}
        if len({self._batch.shape, *(array.shape for array in arrays.values())} - {()}) > 1:
            together(**arrays, parameters=self._batch)
        return list(arrays.values())

    def _pair(self, y: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        y, u = super()._pair(y, u)
        if self._batch.ndim:
            together(y=y[..., 0], parameters=self._batch)
        return y, u

    def step(self, x: ArrayLike, z: ArrayLike, u: ArrayLike, h: float) -> tuple[Array, Array]:
        """Positions after `h` seconds under a held command: exact, since both lags are linear.

        x and z are (...), u = (u_x, u_z) is (..., 2); returns the new x and z, each (...).
        """
        h, u = number("h", h, above=0.0), checked("u", u, "... 2")
        x, z, u_x = self._fitting(x=x, z=z, u_x=u[..., 0])
        x_new = u_x + (x - u_x) * np.exp(-h / self.tau_x)
        z_new = u[..., 1] + (z - u[..., 1]) * np.exp(-h / self.tau_z)
        return x_new, z_new

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Derivative of (x, force) in contact, (..., 2)."""
        y, u = self._pair(y, u)
        x, force = y[..., 0], y[..., 1]
        x_dot = (u[..., 0] - x) / self.tau_x
        z_dot = (u[..., 1] - (force / self.K_sur + self._g(x))) / self.tau_z
        force_dot = self.K_sur * (z_dot - self._g_slope(x) * x_dot)
        return np.stack(np.broadcast_arrays(x_dot, force_dot), axis=-1)

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Exact Jacobian in (x, force), lower triangular, (..., 2, 2).

        The paper replaces g'(x) in the lower left entry by g(x)/x and drops the terms with g'';
        `f_y_paper` keeps that form for comparison.
        """
        y, u = self._pair(y, u)
        x, slope = y[..., 0], self._g_slope(y[..., 0])
        bend = -self._g(x)  # g'' = -g for this surface
        lower = self.K_sur * ((bend * (x - u[..., 0]) + slope) / self.tau_x - slope / self.tau_z)
        return _lower_triangular(-1 / self.tau_x, lower, -1 / self.tau_z)

    def f_y_paper(self, y: ArrayLike) -> Array:
        """The paper's approximation of f_y (appendix F); its lower left sign is often wrong."""
        x = checked("y", y, "... 2")[..., 0]
        slope, secant = self.surface_slope(x), self.surface(x) / x
        lower = self.K_sur * (slope / self.tau_x - secant / self.tau_z)
        return _lower_triangular(-1 / self.tau_x, lower, -1 / self.tau_z)

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Jacobian in (u_x, u_z) in contact, lower triangular, (..., 2, 2)."""
        y, u = self._pair(y, u)
        lower = -self.K_sur * self._g_slope(y[..., 0]) / self.tau_x
        return _lower_triangular(1 / self.tau_x, lower, self.K_sur / self.tau_z)


def _lower_triangular(first: ArrayLike, lower: Array, second: ArrayLike) -> Array:
    """[[first, 0], [lower, second]] with broadcast batch axes, (..., 2, 2)."""
    a, b, c = np.broadcast_arrays(first, lower, second)
    matrix = np.zeros((*b.shape, 2, 2))
    matrix[..., 0, 0], matrix[..., 1, 0], matrix[..., 1, 1] = a, b, c
    return matrix
