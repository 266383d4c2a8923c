"""The one door for arrays: what is wrong with an argument, said with its name; and compiling."""

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
    **sizes: int,
) -> Array:
    """Return `value` as finite float64 of a wanted shape.

    Args:
        name: What the argument is called.
        value: Numbers.
        shape: Axes by name or size, such as "... n n" or "time 2"; "..." is any batch, "" a number.
        least: Smallest value allowed.
        above: Every value is larger than this.
        **sizes: Sizes of named axes; a name without a size takes the first that comes, at least 1.

    Raises:
        TypeError: If the entries are not real numbers.
        ValueError: If the shape is another one, or a value is not finite or out of range.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        raise TypeError(f"{name} needs an array of real numbers, got {value!r}") from None
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
    bad, wish = ~np.isfinite(array), "finite values"
    if least is not None and not bad.any():
        bad, wish = array < least, f"values of at least {least:g}"
    if above is not None and not bad.any():
        bad = array <= above
        wish = "positive values" if above == 0 else f"values above {above:g}"
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        where = f" at index {index[0] if len(index) == 1 else index}" if index else ""
        raise ValueError(f"{name} needs {wish}, got {array[index]}{where}")
    return array


def number(
    name: str, value: ArrayLike, *, least: float | None = None, above: float | None = None
) -> float:
    """Return `value` as one finite number, as `checked` does."""
    return float(checked(name, value, "", least=least, above=above))


def count(name: str, value: int, most: int = 1_000_000) -> int:
    """Return `value` as a whole number from 1 to `most`.

    Raises:
        ValueError: If it is another one.
    """
    if isinstance(value, bool) or value != value or int(value) != value or not 1 <= value <= most:
        raise ValueError(f"{name} needs a whole number from 1 to {most}, got {value!r}")
    return int(value)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile on the first call; keep it on disk where there is a place to keep it."""
    try:
        return numba.njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # a read-only installation without a home
        return numba.njit(error_model="numpy")(function)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:57]}..."
