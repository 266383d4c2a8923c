"""One switch, `CMC_FAST=1`, that shortens what a notebook trains and samples."""

from __future__ import annotations

import os
from typing import TypeVar

T = TypeVar("T")


def fast_mode() -> bool:
    """Whether `CMC_FAST` is set to anything but `0` or the empty string."""
    return os.environ.get("CMC_FAST", "0") not in ("", "0")


def budget(full: T, fast: T) -> T:
    """Return `fast` in fast mode and `full` otherwise."""
    return fast if fast_mode() else full
