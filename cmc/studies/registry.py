"""Where a study is found by its name."""

from __future__ import annotations

import importlib

from cmc.studies.study import Study

WHERE = {
    "peg_touch": "peg_touch",
    "peg_touch_caps": "peg_touch_caps",
    "peg_touch_2ms": "peg_touch",
    "peg_touch_5ms": "peg_touch",
    "peg_maze": "peg_maze",
    "peg_maze_tuned": "peg_maze",
    "peg_maze_stiff": "peg_maze",
    "peg_maze_paper_sizes": "peg_maze",
    "peg_push": "peg_push",
    "peg_push_half": "peg_push",
    "peg_push_contact_x0.4": "peg_push",
    "peg_push_contact_x4": "peg_push",
}
"""Names, and the module of this package whose `STUDY`, or whose `VARIANTS`, holds the study."""


def get(name: str) -> Study:
    """The study of this name.

    Raises:
        ValueError: if there is none.
    """
    if name not in WHERE:
        raise ValueError(f"unknown study {name!r}; wanted one of {', '.join(WHERE)}")
    module = importlib.import_module(f"cmc.studies.{WHERE[name]}")
    study: Study = module.STUDY if module.STUDY.name == name else module.VARIANTS[name]
    return study
