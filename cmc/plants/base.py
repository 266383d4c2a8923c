"""What every plant offers: the dynamics of its latent signal and their two Jacobians."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.simulate import equilibrium

Array = NDArray[np.float64]


class Plant(ABC):
    """A system y' = f(y, u, t) with as many commands as latent signals.

    Arrays carry any leading batch axes: `y` and `u` are (..., n), Jacobians (..., n, n).

    Attributes:
        name: The name under which `cmc.plants.get` builds it.
        n: Number of latent signals and of commands.
        state_names: One name per latent signal.
        units: One unit per latent signal.
        y_low: Lower end of the region of interest, (n,).
        y_high: Upper end of the region of interest, (n,).
        u_low: Smallest admissible command, (n,).
        u_high: Largest admissible command, (n,).
        constant: Whether f_y and f_u are the same everywhere, so that the transforms are as well.
    """

    name: ClassVar[str]
    n: int = 2
    constant: ClassVar[bool] = False
    state_names: Sequence[str] = ("y1", "y2")
    units: Sequence[str] = ("1", "1")
    y_low: Array
    y_high: Array
    u_low: Array
    u_high: Array

    @abstractmethod
    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Time derivative of the latent signal, (..., n)."""

    @abstractmethod
    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Jacobian of `f` in the latent signal, (..., n, n)."""

    @abstractmethod
    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Jacobian of `f` in the command, (..., n, n)."""

    def hold(self, y: ArrayLike, t: float = 0.0) -> Array:
        """Command that holds the plant still at `y`; see `cmc.theory.simulate.equilibrium`."""
        return equilibrium(self, y, t)

    def space(self, y: ArrayLike = 0.0, u: ArrayLike = 0.0) -> AuxiliarySpace:
        """`decompose` of f_y and f_u at a state and a command, numbers or (..., n)."""
        at = [np.asarray(value, dtype=float) for value in (y, u)]
        y, u = (np.broadcast_to(v, (self.n,)) if v.ndim == 0 else v for v in at)
        return decompose(self.f_y(y, u), self.f_u(y, u))

    def _pair(self, y: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """Check the last axes and broadcast the batch axes of `y` and `u`."""
        y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
        for symbol, value in (("y", y), ("u", u)):
            if value.ndim == 0 or value.shape[-1] != self.n:
                raise ValueError(
                    f"{self.name}: {symbol} needs shape (..., {self.n}), got {value.shape}"
                )
        shape = np.broadcast_shapes(y.shape, u.shape)
        return np.broadcast_to(y, shape), np.broadcast_to(u, shape)

    def _box(self, y: Sequence[float], u: Sequence[float]) -> None:
        """Set symmetric bounds |y| <= y, |u| <= u."""
        self.y_high, self.u_high = np.array(y, dtype=float), np.array(u, dtype=float)
        self.y_low, self.u_low = -self.y_high, -self.u_high

    def __repr__(self) -> str:
        return f"{type(self).__name__}(name={self.name!r}, n={self.n})"


def finite_matrix(name: str, value: ArrayLike, n: int | None = None) -> Array:
    """Return `value` as a finite square matrix, (n, n).

    Raises:
        ValueError: if it is not square, not of size `n`, or not finite.
    """
    matrix = np.array(value, dtype=float)
    wanted = "square matrix" if n is None else f"{n} x {n} matrix"
    square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
    if not square or n not in (None, matrix.shape[0]):
        raise ValueError(f"{name} needs a {wanted}, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} needs finite entries, got {matrix.tolist()}")
    return matrix


def parameter(name: str, value: ArrayLike, *, positive: bool = False) -> Array:
    """Return a scalar or batched parameter as a finite array.

    Raises:
        ValueError: if it is not finite, or not positive where it must be.
    """
    array = np.array(value, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} needs finite values, got {array}")
    if positive and (array <= 0).any():
        raise ValueError(f"{name} needs positive values, got a minimum of {array.min()}")
    return array
