"""Studies: a frozen configuration, `train`, `evaluate` and `load` each."""

from __future__ import annotations

import importlib
from types import ModuleType

STUDIES = ("peg_touch", "peg_maze", "peg_maze_stiff", "peg_push")
"""Names under which `get` finds a study; a module of this package each."""


def get(name: str) -> ModuleType:
    """The study of this name: a module with `METHODS`, `train`, `evaluate` and `load`.

    Raises:
        ValueError: if there is none.
    """
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}; wanted one of {', '.join(STUDIES)}")
    return importlib.import_module(f"cmc.studies.{name}")
