"""What every plant offers: the dynamics of its latent signal and their two Jacobians."""

from __future__ import annotations

import inspect
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.jacobians import complex_step, differences, jacobian_fault, not_square
from cmc.theory.simulate import equilibrium

Function = Callable[..., Any]
Box = tuple[ArrayLike, ArrayLike]


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
        constant: Whether f_y and f_u are the same everywhere and f does not depend on time, so that
            the transforms are the same as well.
    """

    name: str
    n: int = 2
    constant: bool = False
    state_names: Sequence[str] = ("y1", "y2")
    units: Sequence[str] = ("1", "1")
    y_low: Array
    y_high: Array
    u_low: Array
    u_high: Array

    @classmethod
    def from_function(
        cls,
        f: Function,
        *,
        y: Box,
        u: Box,
        f_y: Function | None = None,
        f_u: Function | None = None,
        name: str = "own",
        state_names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
    ) -> FunctionPlant:
        """A plant from its right-hand side alone.

            plant = Plant.from_function(
                lambda y, u: [u[0] - y[0], y[0] - y[1] ** 3 + u[1]], y=([-1, -1], [1, 1]), u=(-1, 1)
            )

        Args:
            f: Maps y (n, N), u (n, N), and the time if it takes three arguments, to n rows: signals
                come first, so `y1, y2 = y` and `A @ y` both work. A function of single vectors is
                called point by point.
            y: Smallest and largest latent signal of interest, (n,) each.
            u: Smallest and largest command, numbers or (n,) each.
            f_y: Its Jacobian in y, arguments as of `f`, (n, n) or (n, n, N); by a complex step
                where f allows it, else by central differences.
            f_u: Its Jacobian in u, likewise.
            name: For messages.
            state_names: One name per latent signal.
            units: One unit per latent signal.

        Raises:
            ValueError: If there are not as many commands as signals, shapes do not fit, f is not
                finite in the box, or a given Jacobian does not belong to f.
        """
        return FunctionPlant(f, y, u, (f_y, f_u), name, state_names, units)

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


class FunctionPlant(Plant):
    """A plant that `Plant.from_function` made; `how` says where its Jacobians come from."""

    def __init__(
        self,
        f: Function,
        y: Box,
        u: Box,
        jacobians: tuple[Function | None, Function | None],
        name: str,
        state_names: Sequence[str] | None,
        units: Sequence[str] | None,
    ) -> None:
        self.y_low, self.y_high = checked("y[0]", y[0], "n"), checked("y[1]", y[1], "n")
        self.name, self.n = name, len(self.y_low)
        commands = [np.asarray(end, dtype=float) for end in u]
        m = max([end.shape[0] for end in commands if end.ndim == 1] or [self.n])
        if m != self.n:
            raise ValueError(not_square(self.n, m))
        self.u_low, self.u_high = (
            np.broadcast_to(checked(f"u[{k}]", end), (m,)).copy() for k, end in enumerate(commands)
        )
        if (self.y_low >= self.y_high).any() or (self.u_low >= self.u_high).any():
            raise ValueError("y and u each need (low, high) with low < high")
        self.state_names = tuple(state_names or (f"y{i + 1}" for i in range(self.n)))
        self.units = tuple(units or ("1",) * self.n)
        self._f, self._own = f, jacobians
        self._timed = _takes_time(f)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            self._batched = self._batches()
            self.how = "given"
            if None in jacobians:
                self.how = "complex step"
                if self._fault():
                    self.how = "central differences"
            if fault := self._fault():
                raise ValueError(f"{name}: {fault}")
            self.constant = self._is_affine()

    def _fault(self) -> str:
        try:
            return jacobian_fault(self, self.y_low, self.y_high)
        except TypeError as error:  # a function of plain floats, given complex numbers
            if self.how == "complex step":
                return str(error)
            raise

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """The function itself, (..., n)."""
        return self._rows(*self._pair(y, u), t, float)

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Its Jacobian in y, (..., n, n)."""
        y, u = self._pair(y, u)
        if self._own[0] is not None:
            return self._given(self._own[0], y, u, t)
        if self.how == "complex step":
            return complex_step(lambda x: self._rows(x, u[..., None, :], t, complex), y)
        width = self.y_high - self.y_low
        return differences(lambda x: self.f(x, u[..., None, :], t), y, 1e-6 * width)

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Its Jacobian in u, (..., n, n)."""
        y, u = self._pair(y, u)
        if self._own[1] is not None:
            return self._given(self._own[1], y, u, t)
        if self.how == "complex step":
            return complex_step(lambda x: self._rows(y[..., None, :], x, t, complex), u)
        width = self.u_high - self.u_low
        return differences(lambda x: self.f(y[..., None, :], x, t), u, 1e-6 * width)

    def _rows(self, y: Any, u: Any, t: float, kind: type) -> Any:
        """Call f on signals-first arrays and bring its rows back, (..., n)."""
        shape = np.broadcast_shapes(y.shape, u.shape)
        Y, U = (np.broadcast_to(x, shape).reshape(-1, self.n).T for x in (y, u))
        time = (t,) if self._timed else ()
        if self._batched:
            found = [self._checked(self._f(Y, U, *time), Y.shape[1], kind)]
        else:
            points = zip(Y.T, U.T, strict=True)
            found = [self._checked(self._f(a, b, *time), 1, kind) for a, b in points]
        return np.concatenate(found, axis=1).T.reshape(shape)

    def _checked(self, rows: Any, width: int, kind: type) -> Any:
        """What f returned as (n, width)."""
        if not hasattr(rows, "__len__") or len(rows) != self.n:
            raise ValueError(f"{self.name}: f needs to return {self.n} rows, got {rows!r}")
        return np.stack([np.broadcast_to(np.asarray(row, dtype=kind), (width,)) for row in rows])

    def _given(self, f: Function, y: Array, u: Array, t: float) -> Array:
        flat = [x.reshape(-1, self.n) for x in (y, u)]
        time = (t,) if _takes_time(f) else ()
        rows = [np.asarray(f(a, b, *time), dtype=float) for a, b in zip(*flat, strict=True)]
        return np.stack(rows).reshape(*y.shape, self.n)

    def _batches(self) -> bool:
        """Whether f takes many points at once, and says the same of them as one by one."""
        points = np.random.default_rng(0).uniform(size=(2, 3, self.n))
        y = self.y_low + points[0] * (self.y_high - self.y_low)
        u = self.u_low + points[1] * (self.u_high - self.u_low)
        results, single = [], False
        for self._batched in (False, True):
            try:
                results.append(self._rows(y, u, 0.0, float))
                single = single or not self._batched
            except (TypeError, ValueError, IndexError):
                if self._batched and not results:
                    raise
        # `A @ y + b` with a column b works on batches alone, `math.sin(y[0])` on points alone
        if len(results) == 2:
            return bool(np.allclose(results[0], results[1], rtol=1e-9))
        return not single

    def _is_affine(self) -> bool:
        """Whether f is affine and free of time, on points of the boxes and far beyond them."""
        rng, n, reach = np.random.default_rng(1), self.n, 10.0 ** np.arange(3).repeat(8)[:, None]
        y = (self.y_high + self.y_low) / 2 + reach * (self.y_high - self.y_low) * rng.uniform(
            -0.5, 0.5, (24, n)
        )
        u = (self.u_high + self.u_low) / 2 + reach * (self.u_high - self.u_low) * rng.uniform(
            -0.5, 0.5, (24, n)
        )
        A, B = self.f_y(y[0], u[0]), self.f_u(y[0], u[0])
        try:
            found, later = self.f(y, u), self.f(y, u, 0.618)
        except (ValueError, ArithmeticError):
            return False
        wanted = self.f(y[0], u[0]) + (y - y[0]) @ A.T + (u - u[0]) @ B.T
        tol = 1e-9 if self.how != "central differences" else 1e-6
        size = tol * (np.abs(y) @ np.abs(A).T + np.abs(u) @ np.abs(B).T)
        return bool((np.abs(found - wanted) <= size).all() and (found == later).all())


def _takes_time(f: Function) -> bool:
    try:
        inspect.signature(f).bind(None, None, 0.0)
    except TypeError:
        return False
    return True


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
