"""Studies, found by their names: `cmc.studies.get("peg_push")`."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cmc.studies.study import Study

WHERE = {
    "peg_touch": "peg_touch",
    "peg_touch_caps": "peg_touch",
    "peg_touch_2ms": "peg_touch",
    "peg_touch_5ms": "peg_touch",
    "peg_maze": "peg_maze",
    "peg_maze_stiff": "peg_maze",
    "peg_maze_paper_sizes": "peg_maze",
    "peg_push": "peg_push",
    "peg_push_contact_x0.4": "peg_push",
}
"""Names, and the module of this package whose `STUDY`, or whose `VARIANTS`, holds the study."""

TABLES = ("composition", "low_level", "own_plant", "softness")
"""Modules with a `table` that is computed at once, without a training that is kept."""


def get(name: str) -> Study:
    """The study of this name; a ValueError names the others if there is none."""
    if not isinstance(name, str) or name not in WHERE:
        raise ValueError(f"unknown study {name!r}; wanted one of {', '.join(WHERE)}")
    module = importlib.import_module(f"cmc.studies.{WHERE[name]}")
    study: Study = module.STUDY if module.STUDY.name == name else module.VARIANTS[name]
    return study
