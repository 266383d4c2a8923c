"""The one door for arguments: what is wrong with one, said with its name; and compiling."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def checked(
    name: str,
    value: ArrayLike,
    shape: str = "...",
    *,
    least: float | None = None,
    above: float | None = None,
    finite: bool = True,
    **sizes: int,
) -> Array:
    """Return `value` as finite float64 of a wanted shape.

    Args:
        name: What the argument is called.
        value: Numbers.
        shape: Axes by name or size, such as "... n n" or "time 2"; "..." is any batch, "" a number.
        least: Smallest value allowed.
        above: Every value is larger than this.
        finite: Whether infinity is refused, and NaN; where there are bounds NaN always is.
        **sizes: Sizes of named axes; a name without a size takes the first that comes, at least 1.

    Raises:
        TypeError: If the entries are not real numbers.
        ValueError: If the shape is another one, or a value is not finite or out of range.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, a strange object
        raise TypeError(f"{name} needs an array of real numbers, got {_short(value)}") from None
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} needs real numbers, got {_short(value)} (dtype {array.dtype})")
    array = array.astype(np.float64, copy=False)
    axes = shape.split()
    batch = axes[:1] == ["..."]
    wanted, found = axes[1:] if batch else axes, array.shape
    tail = found[len(found) - len(wanted) :] if wanted else ()
    known = dict(sizes)
    fits = len(found) >= len(wanted) and (batch or len(found) == len(wanted))
    for axis, size in zip(wanted, tail, strict=False):
        fits = fits and size == (int(axis) if axis.isdigit() else known.setdefault(axis, size))
    if not fits or 0 in tail:
        words = ", ".join(["..."] * batch + [str(sizes.get(axis, axis)) for axis in wanted])
        comma = "," if len(axes) == 1 and not batch else ""
        wish = f"shape ({words}{comma})" if axes else "a single number"
        raise ValueError(f"{name} needs {wish}, got shape {found}")
    if least is above is None and (not finite or np.isfinite(array).all()):
        return array
    bad, wish = finite & ~np.isfinite(array), "finite values"
    if least is not None and not bad.any():
        bad, wish = ~(array >= least), f"values of at least {least:g}"
    if above is not None and not bad.any():
        bad = ~(array > above)
        wish = "positive values" if above == 0 else f"values above {above:g}"
    if bad.any():
        raise ValueError(f"{name} needs {wish}, got {array[bad][0]}{first_index(bad)}")
    return array


def first_index(bad: NDArray[np.bool_]) -> str:
    """Where the first True of an array stands, as a clause; "" in a single number."""
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    return f" at index {index[0] if len(index) == 1 else index}" if index else ""


def number(name: str, value: ArrayLike, **bounds: Any) -> float:
    """Return `value` as one finite number; bounds as in `checked`."""
    return float(checked(name, value, "", **bounds))


def filled(name: str, value: ArrayLike, *shape: int, **bounds: Any) -> Array:
    """Return `value`, a number or the last axes of a shape, as a new array of it; see `checked`."""
    array = checked(name, value, **bounds)
    if array.ndim and array.shape != shape[-array.ndim :]:
        raise ValueError(f"{name} needs a number or shape {shape}, got {array.shape}")
    return np.broadcast_to(array, shape).copy()


def count(name: str, value: float, most: int = 1_000_000) -> int:
    """Return `value` as a whole number from 1 to `most`, or raise a ValueError."""
    whole = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not whole or not 1 <= value <= most or int(value) != value:
        raise ValueError(f"{name} needs a whole number from 1 to {most}, got {_short(value)}")
    return int(value)


def need(fits: bool, name: str, wish: str, value: Any) -> None:
    """Raise a TypeError where `value` is not of the kind that was wished for."""
    if not fits:
        raise TypeError(f"{name} needs {wish}, got {_short(value)}")


def increasing(name: str, value: ArrayLike, least: int = 2) -> Array:
    """Return `value` as at least `least` increasing numbers, (time,)."""
    times = checked(name, value, "time")
    if len(times) < least or not (np.diff(times) > 0).all():
        raise ValueError(f"{name} needs at least {least} increasing values, got {_short(value)}")
    return times


def together(**arrays: NDArray[Any]) -> list[NDArray[Any]]:
    """Broadcast arrays to one shape, or raise a ValueError that names them."""
    try:
        return list(np.broadcast_arrays(*arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"these need to fit together (broadcast), got {shapes}") from None


def inverse(name: str, matrix: NDArray[Any]) -> NDArray[Any]:
    """Return the inverse of (..., n, n), or raise a ValueError that names it."""
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(f"{name} needs to be invertible, got a singular matrix") from None


def not_overflown(names: str, *arrays: NDArray[Any]) -> None:
    """Raise a ValueError where arithmetic left the range of floats."""
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"{names}: too large or too small to compute with; choose other units")


def not_square(n: int, m: int) -> str:
    """The sentence for a plant with n signals and m commands."""
    signals, commands = f"{n} signal{'s' * (n != 1)}", f"{m} command{'s' * (m != 1)}"
    return (
        f"the plant has {signals} and {commands}; the theory wants as many signals as commands. "
        "Command a composite signal instead, a combination of signals with one entry for each "
        "command (cmc.theory.composite, lesson 06), or a learned one (cmc.policies.latent_signal)"
    )


def compiled(function: Callable[..., Any]) -> Any:
    """Compile on the first call; keep it on disk where there is a place to keep it."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # a read-only installation without a home
        return numba.njit(nogil=True, error_model="numpy")(function)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:57]}..."
