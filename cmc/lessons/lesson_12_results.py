"""Lesson 12, from the shipped results: arrays for the figures, and tables.

Methods that the file lacks are left out; steps of training are always read from it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cmc import store
from cmc.envs.peg_push import PUSH
from cmc.lessons.lesson_11_results import percent, span, with_interval

Array = NDArray[np.float64]
Method = dict[str, Any]
GROUPS = (
    ("ctd3", "ctd3_paper", "frozen", "gain"),
    ("td3", "td3_corrected", "control", "ppo_control"),
)
"""Methods that figures show together: positive low levels, and the others."""
NEAR, FAR = 1.0, 2.0
"""An episode passes by if it comes nearer than NEAR and ends farther than FAR, mm (our choice)."""


@cache
def methods() -> dict[str, Method]:
    """Answers of every method by name; none if no result is shipped."""
    found: dict[str, Method] = store.result("peg_push").get("methods", {})
    return found


def groups() -> list[list[str]]:
    """Names of the methods that are there, in the groups of the figures; no empty group."""
    known = [[name for name in group if name in methods()] for group in GROUPS]
    return [group for group in known if group]


def training(names: list[str]) -> dict[str, tuple[Array, Array]]:
    """By title: steps (points,) and mean rewards of training as returns (seeds, points)."""
    answer = {}
    for name in names:
        curve = methods()[name]["training"]
        returns = PUSH.ticks * np.array(curve["reward"], dtype=float).T
        answer[methods()[name]["title"]] = (np.array(curve["step"], dtype=float), returns)
    return answer


def by_checkpoint(key: str, names: list[str]) -> dict[str, tuple[Array, Array]]:
    """By title: steps of the kept policies (points,) and a figure of theirs (seeds, points)."""
    answer = {}
    for name in names:
        tests = methods()[name]["tests"]
        step = np.array([test["step"] for test in tests], dtype=float)
        answer[methods()[name]["title"]] = (
            step,
            np.array([test[key] for test in tests], dtype=float).T,
        )
    return answer


def by_seed(key: str) -> dict[str, Array]:
    """A figure of the last policies (seeds,), by title and steps of training."""
    return {
        f"{m['title']}, {thousands(m['final']['step'])}": np.asarray(m["final"][key], dtype=float)
        for m in methods().values()
    }


def distances(names: list[str]) -> dict[str, tuple[Array, Array]]:
    """By title: smallest and last distance to the target of episodes (or medians of seeds), mm."""
    answer = {}
    for m in (methods()[name] for name in names):
        ends = "_all" if "nearest_mm_all" in m["final"] else ""
        near, far = (np.ravel(m["final"][f"{k}_mm{ends}"]) for k in ("nearest", "final"))
        answer[m["title"]] = (near.astype(float), far.astype(float))
    return answer


def passing(test: dict[str, Any]) -> Array | None:
    """Share of episodes that pass by the target, (seeds,); None if the file does not say."""
    if "nearest_mm_all" in test:
        near, far = (np.array(test[f"{k}_mm_all"], dtype=float) for k in ("nearest", "final"))
        share: Array = ((near < NEAR) & (far > FAR)).mean(-1)
        return share
    return np.asarray(test["passed_by"], dtype=float) if "passed_by" in test else None


# -- intervals over seeds ------------------------------------------------------------------------


def mean_interval(values: Any, level: float = 0.95) -> tuple[float, float, float]:
    """Mean over seeds and Student's interval of it; the whole line for a single seed."""
    x = np.asarray(values, dtype=float)
    if x.size < 2:
        return float(x.mean()), -np.inf, np.inf
    half = stdtrit(x.size - 1, 0.5 + level / 2) * x.std(ddof=1) / np.sqrt(x.size)
    return float(x.mean()), float(x.mean() - half), float(x.mean() + half)


def difference(a: Any, b: Any, level: float = 0.95) -> tuple[float, float, float]:
    """Mean of a minus mean of b over seeds, and Welch's interval of it.

    Seeds that are all alike on both sides give an interval without width.
    """
    x, y = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    gap = float(x.mean() - y.mean())
    if min(x.size, y.size) < 2:
        return gap, -np.inf, np.inf
    parts = x.var(ddof=1) / x.size, y.var(ddof=1) / y.size
    if sum(parts) == 0.0:
        return gap, gap, gap
    below = parts[0] ** 2 / (x.size - 1) + parts[1] ** 2 / (y.size - 1)
    half = stdtrit(sum(parts) ** 2 / below, 0.5 + level / 2) * np.sqrt(sum(parts))
    return gap, float(gap - half), float(gap + half)


# -- tables --------------------------------------------------------------------------------------


def thousands(step: int) -> str:
    """Steps of training, short."""
    return f"{step / 1e6:g}M" if step >= 1_000_000 else f"{step / 1e3:g}k"


def table(columns: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    head = f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}\n"
    return head + "\n".join(f"| {' | '.join(row)} |" for row in rows)


def method_table() -> str:
    """Markdown: strict touch and return of the last policies of every method."""
    columns = ["method", "steps trained", "seeds x episodes", "touch at the end [95 %]"]
    columns += ["by seed", "touch at any time [95 %]", "touched, then left", "return [range]"]
    longest = max((m["final"]["step"] for m in methods().values()), default=0)
    rows = []
    for m in methods().values():
        test = m["final"]
        steps = f"{test['step']:,}"
        rows.append(
            [
                m["title"],
                steps if test["step"] == longest else f"**{steps}**",
                f"{len(m['seeds'])} x {test['episodes']}",
                with_interval(test, "success"),
                ", ".join(f"{100 * share:.0f}" for share in test["success"]) + " %",
                with_interval(test, "touched"),
                percent(float(np.mean(left))) if (left := test.get("passed_by")) else "",
                span(test["return"], ".0f"),
            ]
        )
    return table(columns, rows)


def contact_table() -> str:
    """Markdown: penetration and contact force of the last policies."""
    columns = ["method", "steps trained", "deepest penetration (mm)", "ticks without contact"]
    columns += ["below 1 N", "below 5 N", "below 1 N, sampled at 50 Hz", "largest force (N)"]
    rows = []
    for m in methods().values():
        test, force = m["final"], m["final"]["force"]["largest"]
        shares = [force[key] for key in ("zero", "below_1_N", "below_5_N")]
        shares.append(test["force"]["at_50_hz"]["below_1_N"])
        rows.append(
            [
                m["title"],
                f"{test['step']:,}",
                f"{max(test['penetration_mm']):.3f}",
                *(percent(share) for share in shares),
                f"{force['largest_N']:.1f}",
            ]
        )
    return table(columns, rows)


def consistency_table() -> str:
    """Markdown: what a step of 5 mm along -x makes of the low level, and its slopes at rest."""
    columns = ["method", "moves along the step (mm)", "spread over starts (mm)"]
    columns += ["a 2 N push moves its end by (mm)", "spread over kept policies (mm)"]
    columns += ["slope at rest / cap, translation", "rotation", "capped by design"]
    rows = []
    for m in methods().values():
        found, gains = m["final"]["consistency_mm"], m["final"].get("gains")
        late = m.get("consistency_over_training_mm")
        cells = [found.get("mean"), found.get("spread"), found.get("pushed"), late]
        row = [m["title"], *("" if c is None else span(np.round(c, 6), ".2g") for c in cells)]
        if gains is None:
            rows.append([*row, "no low level", "", ""])
            continue
        share = np.asarray(gains["slope"], float) / np.asarray(gains["bound"], float)
        bounded = "yes" if gains["bounded"] else "no"
        rows.append([*row, span(share[:, :3]), span(share[:, 3:]), bounded])
    return table(columns, rows)
