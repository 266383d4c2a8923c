"""Arguments of environments: finite numbers of the wanted shape, or one sentence about them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def checked(value: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """`value` as a finite float array of the given shape.

    Raises:
        ValueError: on another shape, NaN, infinity, or what is no number.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what}: wanted numbers, got {value!r}") from None
    if array.shape != shape:
        raise ValueError(f"{what}: wanted shape {shape}, got {array.shape}")
    flat = array.ravel()
    if not math.isfinite(flat.dot(flat)) and not np.isfinite(array).all():  # the first is faster
        raise ValueError(f"{what}: wanted finite numbers, got {array.tolist()}")
    return array


def set_numbers(config: Any, sizes: dict[str, int]) -> None:
    """Turn fields of a frozen dataclass into tuples of finite floats; size 0 means one number.

    Lists and arrays are welcome: a configuration that was written as JSON comes back with lists.

    Raises:
        ValueError: on None, text, NaN, infinity or another length.
    """
    for name, size in sizes.items():
        value = getattr(config, name)
        if value is None or isinstance(value, (str, bytes)):
            raise ValueError(f"{name}: wanted {size or 1} finite numbers, got {value!r}")
        numbers = checked(value, (size,) if size else (), name).tolist()
        object.__setattr__(config, name, tuple(numbers) if size else numbers)


def whole(name: str, value: Any, least: int = 1) -> int:
    """`value` as an integer of at least `least`.

    Raises:
        ValueError: if it is none.
    """
    number = isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)
    if not number or isinstance(value, bool) or value != int(value) or value < least:
        raise ValueError(f"{name}: wanted a whole number, {least} or more, got {value!r}")
    return int(value)
