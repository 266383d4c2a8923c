"""The paper's three claims about peg touch beside our figures, judged by rules fixed beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cmc.studies.peg_touch_evaluation import SHIFTS

PAPER_EPISODE = 5000
"""The episode whose policies the paper's generalization test uses (fig:1 c)."""


def paper_mark(marks: Sequence[int]) -> int:
    """The kept policy of the paper's generalization test; in a shorter run the last one."""
    return PAPER_EPISODE if PAPER_EPISODE in marks else marks[-1]


def select(
    answer: dict[str, Any], *, shift: str = "nominal", h: float = 0.01
) -> list[dict[str, Any]]:
    """The tests of one method under one shift and control period, by episode."""
    return [t for t in answer["tests"] if t["shift"] == shift and t["h"] == h]


def at(
    answer: dict[str, Any], episode: int | None, *, shift: str = "nominal", h: float = 0.01
) -> dict[str, Any]:
    """The test of one method at one episode.

    Raises:
        ValueError: if it was not made.
    """
    for test in select(answer, shift=shift, h=h):
        if test["episode"] == episode:
            return test
    raise ValueError(f"no test of episode {episode}, shift {shift!r}, {1000 * h:g} ms")


def claims(methods: dict[str, Any]) -> dict[str, Any]:
    """The paper's three claims beside our figures; verdicts follow rules fixed before the runs."""
    ppo, cppo = methods["ppo"], methods["cppo"]
    return {
        "similar return": _similar_return(ppo, cppo),
        "unstable share": _unstable_share(ppo, cppo),
        "generalization": _generalization(ppo, cppo),
    }


def _similar_return(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    marks = [test["episode"] for test in select(ppo)]
    rows = {}
    for mark in sorted({paper_mark(marks), marks[-1]}):
        a, b = np.array(at(ppo, mark)["return"]), np.array(at(cppo, mark)["return"])
        spread = float(np.sqrt(0.5 * (a.var(ddof=1) + b.var(ddof=1)))) if len(a) > 1 else 0.0
        rows[str(mark)] = {
            "ppo": float(a.mean()),
            "cppo": float(b.mean()),
            "ppo_spread": float(a.std()),
            "cppo_spread": float(b.std()),
            "similar": bool(abs(a.mean() - b.mean()) <= max(spread, 0.1 * abs(a.mean()))),
        }
    reach = {name: _episodes_to(m, -15.0) for name, m in (("ppo", ppo), ("cppo", cppo))}
    return {
        "paper": "Both learn the task with similar return and similar data efficiency.",
        "rule": "means differ by less than the pooled spread over seeds, or less than 10 %",
        "return": rows,
        "episodes_to_-15": reach,
        "verdict": "holds" if all(row["similar"] for row in rows.values()) else "does not hold",
    }


def _episodes_to(answer: dict[str, Any], level: float) -> list[int | None]:
    curve = np.array(answer["training"]["return"])
    episode = answer["training"]["episode"]
    firsts = [np.flatnonzero(curve[:, s] >= level) for s in range(curve.shape[1])]
    return [int(episode[first[0]]) if len(first) else None for first in firsts]


def _unstable_share(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    series: dict[str, Any] = {}
    for name, answer in (("ppo", ppo), ("cppo", cppo)):
        start = paper_mark([test["episode"] for test in select(answer)])
        tests = [test for test in select(answer) if test["episode"] >= start]
        share = np.array([np.add(t["oscillation"], t["drift"]) for t in tests])
        episode = np.array([t["episode"] for t in tests], dtype=float)
        slope = np.polyfit(episode / 1000.0, share, 1)[0] if len(tests) > 1 else np.zeros(1)
        series[name] = {
            "first": float(share[0].mean()),
            "last": float(share[-1].mean()),
            "largest": float(share.max()),
            "growth_per_1000": [float(f"{s:.4g}") for s in np.atleast_1d(slope)],
            "largest_oscillation": max(max(t["oscillation"]) for t in tests),
            "largest_drift": max(max(t["drift"]) for t in tests),
        }
    grows = series["ppo"]["last"] > series["ppo"]["first"] + 0.01
    zero = series["cppo"]["largest"] == 0.0
    return {
        "paper": "PPO's share of oscillation and drift grows from episode 5000; C-PPO's stays 0.",
        "rule": "growth: mean share of the last policies exceeds that of episode 5000 by 1 %",
        **series,
        "ppo_grows": bool(grows),
        "cppo_zero": bool(zero),
        "verdict": "holds" if grows and zero else "holds in part" if grows or zero else "does not",
    }


def _generalization(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    rows = {}
    mark = paper_mark([test["episode"] for test in select(ppo)])
    for shift in SHIFTS:
        a, b = at(ppo, mark, shift=shift), at(cppo, mark, shift=shift)
        ratio = float(np.median(a["error_f"]) / np.median(b["error_f"]))
        rows[shift] = {
            "ppo_error_f": float(np.median(a["error_f"])),
            "cppo_error_f": float(np.median(b["error_f"])),
            "ratio": ratio,
            "ppo_unstable": float(np.mean(np.add(a["oscillation"], a["drift"]))),
            "cppo_unstable": float(np.mean(np.add(b["oscillation"], b["drift"]))),
        }
    better = [rows[shift]["ratio"] >= 10.0 for shift in SHIFTS if shift != "nominal"]
    return {
        "paper": "Under shifted parameters C-PPO's tracking errors are dramatically smaller.",
        "rule": "dramatic: the median force error is at least 10 times smaller under a shift",
        "shifts": rows,
        "verdict": "holds" if all(better) else "holds in part" if any(better) else "does not hold",
    }
