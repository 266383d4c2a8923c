"""What every plant offers: the dynamics of its latent signal and their two Jacobians."""

from __future__ import annotations

import inspect
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.theory.arrays import Array, checked, filled, need, not_square, together
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.identification import complex_step, differences, equilibrium, jacobian_fault

Function = Callable[..., Any]
Box = tuple[ArrayLike, ArrayLike]


class Plant(ABC):
    """A system y' = f(y, u, t) with as many commands as latent signals.

    Arrays carry any leading batch axes: `y` and `u` are (..., n), Jacobians (..., n, n).
    """

    name: str
    """The name under which `cmc.plants.get` builds it."""
    n: int = 2
    """Number of latent signals and of commands."""
    constant: bool = False
    """Whether f_y and f_u are the same everywhere and f does not depend on time."""
    state_names: Sequence[str] = ("y1", "y2")
    units: Sequence[str] = ("1", "1")
    y_low: Array
    """Lower end of the region of interest, (n,); `y_high` is the upper one."""
    y_high: Array
    u_low: Array
    """Smallest admissible command, (n,); `u_high` is the largest."""
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

        Another number of commands than of signals, an f that is not finite in the box, and a given
        Jacobian that does not belong to f are refused by a ValueError.

        Args:
            f: Maps y (n, N), u (n, N), and the time if it takes three arguments, to n rows: signals
                come first, so `y1, y2 = y` and `A @ y` both work. A function of single vectors is
                called point by point.
            y: Smallest and largest latent signal of interest, (n,) each.
            u: Smallest and largest command, numbers or (n,) each.
            f_y: Its Jacobian in y at single vectors, and the time if it takes that, (n, n); by a
                complex step where f allows it, else by central differences.
            f_u: Its Jacobian in u, likewise.
            name: For messages.
            state_names: One name per latent signal.
            units: One unit per latent signal.
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
        """Command that holds the plant still at `y`; see `theory.identification.equilibrium`."""
        return equilibrium(self, y, t)

    def space(self, y: ArrayLike = 0.0, u: ArrayLike = 0.0) -> AuxiliarySpace:
        """`decompose` of f_y and f_u at a state and a command, numbers or (..., n)."""
        at = checked("y", y), checked("u", u)
        y, u = (np.broadcast_to(v, (self.n,)) if v.ndim == 0 else v for v in at)
        return decompose(self.f_y(y, u), self.f_u(y, u))

    def _pair(self, y: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        """Check and broadcast `y` and `u`; where a simulation explodes they are not finite."""
        pair = {
            name: checked(f"{self.name}: {name}", value, "... n", n=self.n, finite=False)
            for name, value in (("y", y), ("u", u))
        }
        y, u = together(**pair)
        return y, u

    def _box(self, y: Sequence[float], u: Sequence[float]) -> None:
        """Set symmetric bounds |y| <= y, |u| <= u."""
        self.y_high, self.u_high = np.array(y, dtype=float), np.array(u, dtype=float)
        self.y_low, self.u_low = -self.y_high, -self.u_high

    def __repr__(self) -> str:
        return f"{type(self).__name__}(name={self.name!r}, n={self.n})"


class LinearPlant(Plant):
    """y' = A y + B u with constant matrices f_y = A and f_u = B, (n, n) each, in 1/s."""

    name = "linear"
    constant = True

    def __init__(self, A: ArrayLike, B: ArrayLike) -> None:
        self.A, B = checked("A", A, "n n").copy(), checked("B", B)
        self.n = len(self.A)
        if B.ndim == 2 and len(B) == self.n != B.shape[1]:
            raise ValueError(not_square(self.n, B.shape[1]))
        self.B = checked("B", B, "n n", n=self.n).copy()
        self.state_names = tuple(f"y{i + 1}" for i in range(self.n))
        self.units = ("1",) * self.n
        self._box([3.0] * self.n, [10.0] * self.n)

    def f(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """A y + B u, (..., n)."""
        y, u = self._pair(y, u)
        return y @ self.A.T + u @ self.B.T

    def f_y(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """A, repeated over the batch, (..., n, n)."""
        return np.tile(self.A, (*self._pair(y, u)[0].shape[:-1], 1, 1))

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """B, repeated over the batch, (..., n, n)."""
        return np.tile(self.B, (*self._pair(y, u)[0].shape[:-1], 1, 1))


class FunctionPlant(Plant):
    """A plant that `Plant.from_function` made; `how` says where its Jacobians come from."""

    def __init__(self, f: Any, y: Any, u: Any, own: Any, name: Any, words: Any, units: Any) -> None:
        if not all(isinstance(box, (list, tuple, np.ndarray)) and len(box) == 2 for box in (y, u)):
            raise ValueError(f"y and u each need (low, high), got y = {y!r}, u = {u!r}")
        need(isinstance(name, str), "name", "a string", name)
        need(callable(f), "f", "a function", f)
        for word, given in zip(("f_y", "f_u"), own, strict=True):
            need(given is None or callable(given), word, "a function", given)
        self.y_low = checked("y[0]", y[0], "n").copy()
        self.name, self.n = name, len(self.y_low)
        self.y_high = checked("y[1]", y[1], "n", n=self.n).copy()
        m = max([np.size(end) for end in u if np.ndim(end) == 1] or [self.n])
        if m != self.n:
            raise ValueError(not_square(self.n, m))
        self.u_low, self.u_high = (filled(f"u[{k}]", end, m) for k, end in enumerate(u))
        if (self.y_low >= self.y_high).any() or (self.u_low >= self.u_high).any():
            raise ValueError("y and u each need (low, high) with low < high")
        self.state_names = _words("state_names", words, [f"y{i + 1}" for i in range(self.n)])
        self.units = _words("units", units, ["1"] * self.n)
        self._f, self._own, self._timed = f, own, _takes_time(f)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            self._batched = self._batches()
            self.how = "given"
            if None in own:
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
        return self._jacobian(0, y, u, t)

    def f_u(self, y: ArrayLike, u: ArrayLike, t: float = 0.0) -> Array:
        """Its Jacobian in u, (..., n, n)."""
        return self._jacobian(1, y, u, t)

    def _jacobian(self, which: int, y: ArrayLike, u: ArrayLike, t: float) -> Array:
        """Given, by a complex step, or by differences; in y (0) or u (1)."""
        pair = y, u = self._pair(y, u)
        if (given := self._own[which]) is not None:
            return self._given(given, y, u, t)
        other = pair[1 - which][..., None, :]
        kind = complex if self.how == "complex step" else float

        def along(x: Any) -> Any:
            a, b = (x, other) if which == 0 else (other, x)
            return self._rows(a, b, t, kind)

        if self.how == "complex step":
            return complex_step(along, pair[which])
        width = (self.y_high - self.y_low, self.u_high - self.u_low)[which]
        return differences(along, pair[which], 1e-6 * width)

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
        found: dict[bool, Any] = {}
        for self._batched in (False, True):
            try:
                found[self._batched] = self._rows(y, u, 0.0, float)
            except (TypeError, ValueError, IndexError):
                if self._batched and not found:
                    raise
        # `A @ y + b` with a column b works on batches alone, `math.sin(y[0])` on points alone
        if len(found) == 2:
            return bool(np.allclose(found[False], found[True], rtol=1e-9))
        return True in found

    def _is_affine(self) -> bool:
        """Whether f is affine and free of time, on points of the boxes and far beyond them."""
        rng, n, reach = np.random.default_rng(1), self.n, 10.0 ** np.arange(3).repeat(8)[:, None]
        y, u = (
            (high + low) / 2 + reach * (high - low) * rng.uniform(-0.5, 0.5, (24, n))
            for low, high in ((self.y_low, self.y_high), (self.u_low, self.u_high))
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


def _words(name: str, given: Sequence[str] | None, usual: list[str]) -> tuple[str, ...]:
    """One word for each signal."""
    words = usual if given is None else given
    fits = isinstance(words, (list, tuple)) and all(isinstance(word, str) for word in words)
    if not fits or len(words) != len(usual):
        raise ValueError(f"{name} needs {len(usual)} strings, got {given!r:.60}")
    return tuple(words)


def _takes_time(f: Function) -> bool:
    try:
        inspect.signature(f).bind(None, None, 0.0)
    except TypeError:
        return False
    return True
