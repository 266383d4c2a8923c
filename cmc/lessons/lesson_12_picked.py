"""Lesson 12: the course's aim, for last policies and for those picked on validation episodes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from cmc import store
from cmc.lessons.lesson_11_results import with_interval
from cmc.lessons.lesson_12_results import methods, table

TOUCH, TOUCH_SEEDS, DEEPEST = 0.9, 4, 0.2
"""Our own aim: strict touch in this share of episodes, in so many of 5 seeds; penetration, mm."""
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


def aim_verdict(name: str = "ctd3") -> str:
    """Markdown: whether a method meets the course's own aim for this task."""
    if name not in methods():
        return f"No result of `{name}` is shipped."
    m = methods()[name]
    test = m["final"]
    good = int(np.sum(np.asarray(test["success"]) >= TOUCH))
    shallow = max(test["penetration_mm"]) <= DEEPEST
    any_time = int(np.sum(np.asarray(test["touched"]) >= TOUCH))
    return (
        f"Our own aim was a strict touch in at least {TOUCH:.0%} of the episodes in {TOUCH_SEEDS} "
        f"seeds. {m['title']} after {test['step']:,} steps: "
        f"**{'met' if good >= TOUCH_SEEDS else 'not met'}** at the end of the episode ({good} of "
        f"{len(m['seeds'])} seeds, all episodes {with_interval(test, 'success')}), "
        f"{'met' if any_time >= TOUCH_SEEDS else 'not met'} at any time ({any_time} seeds, "
        f"{with_interval(test, 'touched')}). No penetration above {DEEPEST} mm: "
        f"**{'met' if shallow else 'not met'}** (deepest {max(test['penetration_mm']):.3f} mm)."
    )
