"""Lesson 12: policies picked for each seed on validation episodes, judged on fresh ones."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from cmc import store
from cmc.lessons.lesson_11_results import with_interval
from cmc.lessons.lesson_12_results import methods, table
from cmc.lessons.lesson_12_verdicts import DEEPEST, TOUCH, TOUCH_SEEDS

NOTHING = "No picked policies are shipped."


@cache
def picked() -> dict[str, dict[str, Any]]:
    """Answers of `cmc.studies.selection` by method; none if no result is shipped."""
    found: dict[str, dict[str, Any]] = store.result("peg_push_selected").get("methods", {})
    return found


def _shares(values: list[float]) -> str:
    return " · ".join(f"{100 * value:.0f}" for value in values)


def picked_table() -> str:
    """Markdown: strict touches seed by seed, of picked policies and of the last ones."""
    columns = ["method", "picked steps (1000), by seed", "touch at any time, by seed (%)"]
    columns += ["all seeds [95 %]", "the last policies, by seed (%)", "at the end, picked [95 %]"]
    rows = [
        [
            m["title"],
            " · ".join(f"{step / 1000:.0f}" for step in m["picked"]),
            _shares(m["touched"]),
            with_interval(m, "touched"),
            _shares(methods()[name]["final"]["touched"]) if name in methods() else "",
            with_interval(m, "success"),
        ]
        for name, m in picked().items()
    ]
    return table(columns, rows) if rows else NOTHING


def picked_verdict() -> str:
    """Markdown: which methods meet the course's aim with picked policies."""
    lines = []
    for m in picked().values():
        good = int(np.sum(np.asarray(m["touched"]) >= TOUCH))
        deepest = max(m["penetration_mm"])
        met = good >= TOUCH_SEEDS and deepest <= DEEPEST
        lines.append(
            f"- {m['title']}: aim **{'met' if met else 'not met'}**. A strict touch in at least "
            f"{TOUCH:.0%} of the fresh episodes in {good} of {len(m['picked'])} seeds "
            f"({TOUCH_SEEDS} wanted), deepest penetration {deepest:.3f} mm ({DEEPEST} allowed)."
        )
    return "\n".join(lines) if lines else NOTHING
