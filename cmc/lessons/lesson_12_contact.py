"""Lesson 12: does soft contact make the task easy? Policies tested and trained under other contact.

Rules of the second question, fixed before its results existed: a training under other contact is
compared with that under the paper's by the share of episodes with a strict touch at any time,
averaged over the policies kept at the steps that both have; intervals are over seeds.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from cmc import store
from cmc.lessons.lesson_11_results import span, with_interval
from cmc.lessons.lesson_12_results import Array, Method, difference, mean_interval, methods, table
from cmc.lessons.lesson_12_verdicts import gap_text, word

NO_SWEEP = "No stiffness sweep is shipped."
NOT_TRAINED = "No training under other contact is shipped."
Run = dict[str, Any]


@cache
def stiffness() -> dict[str, Method]:
    """Tests of every method under other contact stiffness; none if no result is shipped."""
    found: dict[str, Method] = store.result("peg_push_stiffness").get("methods", {})
    return found


@cache
def trained() -> tuple[Run, ...]:
    """Trainings under other contact, softest first; none if no result is shipped."""
    runs = store.result("peg_push_contact_training").get("runs", [])
    return tuple(sorted(runs, key=lambda run: float(run["stiffness"])))


def stiffness_curves(key: str = "success") -> dict[str, tuple[Array, Array]]:
    """By title: relative contact stiffness (cells,), and a figure of each cell (seeds, cells)."""
    answer = {}
    for m in stiffness().values():
        cells = sorted(m["cells"], key=lambda cell: float(cell["stiffness"]))
        x = np.array([cell["stiffness"] for cell in cells], dtype=float)
        answer[m["title"]] = (x, np.array([cell[key] for cell in cells], dtype=float).T)
    return answer


def stiffness_table() -> str:
    """Markdown: strict touch, return and penetration at every stiffness of the contact."""
    columns = ["method", "steps trained", "time constant (ms)", "stiffness, relative"]
    columns += ["touch at the end [95 %]", "return [range of seeds]", "deepest penetration (mm)"]
    rows = [
        [
            m["title"],
            f"{m['step']:,}",
            f"{cell['time_constant_ms']:g}",
            f"{cell['stiffness']:.3g}",
            with_interval(cell, "success"),
            span(cell["return"], ".0f"),
            f"{max(cell['penetration_mm']):.3f}",
        ]
        for m in stiffness().values()
        for cell in m["cells"]
    ]
    return table(columns, rows) if rows else NO_SWEEP


def stiffness_verdict() -> str:
    """Markdown: what stiffer contact does to policies trained at the nominal one."""
    lines = []
    for m in stiffness().values():
        cells = sorted(m["cells"], key=lambda cell: float(cell["stiffness"]))
        nominal = min(cells, key=lambda cell: abs(float(cell["stiffness"]) - 1.0))
        for cell in (cells[-1], cells[0]):
            if cell is nominal:
                continue
            gap = mean_interval(np.subtract(cell["success"], nominal["success"]))
            what = _said(gap, "more touches", "fewer touches")
            lines.append(
                f"- {m['title']}, contact {cell['stiffness']:.3g} times as stiff: **{what}**, "
                f"{gap_text(gap, 100.0)} points seed by seed; deepest penetration "
                f"{max(cell['penetration_mm']):.3f} against {max(nominal['penetration_mm']):.3f} mm"
            )
    return "\n".join(lines) if lines else NO_SWEEP


def _said(gap: tuple[float, float, float], more: str, less: str) -> str:
    """A difference in words, by its interval."""
    return {"helps": more, "hurts": less}.get(word(*gap[1:]), "no difference shown")


# -- trained under other contact -------------------------------------------------------------------


def pairs() -> list[tuple[Run, list[Run], list[Run]]]:
    """Every training under other contact, and the tests that it and the nominal one both have."""
    found = []
    for run in trained():
        nominal = methods().get(run["method"])
        if nominal is None:
            continue
        steps = {t["step"] for t in run["tests"]} & {t["step"] for t in nominal["tests"]}
        own, usual = ([t for t in m["tests"] if t["step"] in steps] for m in (run, nominal))
        if steps:
            found.append((run, own, usual))
    return found


def trained_curves(key: str = "touched") -> dict[str, tuple[Array, Array]]:
    """By contact: steps of the kept policies (points,), and a figure of theirs (seeds, points)."""
    answer: dict[str, tuple[Array, Array]] = {}
    for run, own, usual in pairs():
        many = len({r["method"] for r in trained()}) > 1
        title = f"{run['title']}, " if many else ""
        cells = {f"{title}{run['stiffness']:.3g} times as stiff": own, f"{title}the paper's": usual}
        for name, tests in cells.items():
            steps = np.array([t["step"] for t in tests], dtype=float)
            answer[name] = (steps, np.array([t[key] for t in tests], dtype=float).T)
    return answer


def trained_table() -> str:
    """Markdown: touches, return and penetration of trainings under other contact and the usual."""
    columns = ["method", "learned and tested with stiffness", "steps trained"]
    columns += ["touch at any time, mean of the kept policies [range of seeds] (%)"]
    columns += ["the last policies: at any time, by seed (%)", "return [range of seeds]"]
    columns += ["deepest penetration (mm)"]
    rows = []
    for run, own, usual in pairs():
        for stiff, tests in ((f"{run['stiffness']:.3g}", own), ("1 (the paper's)", usual)):
            last, over = tests[-1], np.mean([t["touched"] for t in tests], axis=0)
            rows.append(
                [
                    run["title"],
                    stiff,
                    f"{last['step']:,}",
                    span(100 * over, ".0f"),
                    " · ".join(f"{100 * share:.0f}" for share in last["touched"]),
                    span(last["return"], ".0f"),
                    f"{max(max(t['penetration_mm']) for t in tests):.3f}",
                ]
            )
    unique = [row for k, row in enumerate(rows) if row not in rows[:k]]
    return table(columns, unique) if rows else NOT_TRAINED


def trained_verdict() -> str:
    """Markdown: whether learning was easier or harder under other contact."""
    lines = []
    for run, own, usual in pairs():
        shares = [np.mean([t["touched"] for t in tests], axis=0) for tests in (own, usual)]
        gap = difference(*shares)
        what = _said(gap, "easier to learn", "harder to learn")
        lines.append(
            f"- {run['title']}, contact {run['stiffness']:.3g} times as stiff: **{what}**, "
            f"{gap_text(gap, 100.0)} points of touches at any time, over {len(own)} kept policies "
            f"up to {own[-1]['step']:,} steps."
        )
    return "\n".join(lines) if lines else NOT_TRAINED
