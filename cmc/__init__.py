"""Contracting modular control: theory, policies, tasks and studies.

Importing `cmc` alone is light: subpackages are loaded when they are first used,
so the theory needs no torch and the robot no plotting.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

__version__ = "0.1.0"

_SUBMODULES = tuple(part.name for part in pkgutil.iter_modules(__path__) if part.name[0] != "_")

__all__ = ["__version__", *_SUBMODULES]


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return importlib.import_module(f"cmc.{name}")
    raise AttributeError(f"module 'cmc' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
