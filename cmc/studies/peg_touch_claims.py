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


PAIRS = (
    ("ppo", "cppo"),
    ("ppo_joint", "cppo"),
    ("ppo_raw", "cppo"),
    ("ppo_stress", "cppo_stress"),
    ("ppo", "cppo_capped"),
    ("ppo", "cppo_bounded"),
)
"""Baseline and constrained method. The first pair differs in the sign of the weights alone and
gives the verdict; the others show what else could be behind the paper's figure."""


def claims(methods: dict[str, Any]) -> dict[str, Any]:
    """The paper's three claims: statement, rule, our figures for each pair, verdict.

    Args:
        methods: answers of `peg_touch_results.evaluate_method` by name, `ppo` and `cppo` at least.
    """
    stated = {
        "similar return": (
            "Both learn the task with similar return and similar data efficiency.",
            "means differ by less than the pooled spread over seeds, or less than 10 %",
            _similar_return,
        ),
        "unstable share": (
            "From episode 5000 on, PPO's share of oscillation and drift grows; C-PPO's stays 0.",
            "growth: the last policies' mean share exceeds that of episode 5000 by 0.01 or more",
            _unstable_share,
        ),
        "generalization": (
            "At episode 5000, under shifts, C-PPO's tracking errors are dramatically smaller.",
            "dramatic: the median force error is at least 10 times smaller under every shift",
            _generalization,
        ),
    }
    answer: dict[str, Any] = {}
    for name, (paper, rule, judge) in stated.items():
        found = {
            f"{a} vs {b}": judge(methods[a], methods[b])
            for a, b in PAIRS
            if a in methods and b in methods
        }
        verdict = found["ppo vs cppo"]["verdict"]
        answer[name] = {"paper": paper, "rule": rule, "verdict": verdict, "pairs": found}
    return answer


def _verdict(parts: Sequence[bool]) -> str:
    return "holds" if all(parts) else "holds in part" if any(parts) else "does not hold"


def _marks(a: dict[str, Any], b: dict[str, Any]) -> list[int]:
    """Episodes at which both methods were tested."""
    return sorted({t["episode"] for t in select(a)} & {t["episode"] for t in select(b)})


def _similar_return(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    marks = _marks(ppo, cppo)
    rows: dict[str, dict[str, Any]] = {}
    for mark in sorted({paper_mark(marks), marks[-1]}):
        a, b = np.array(at(ppo, mark)["return"]), np.array(at(cppo, mark)["return"])
        spread = float(np.sqrt(0.5 * (a.var(ddof=1) + b.var(ddof=1)))) if len(a) > 1 else 0.0
        gap = abs(a.mean() - b.mean())
        rows[str(mark)] = {
            "baseline": float(a.mean()),
            "constrained": float(b.mean()),
            "baseline_spread": float(a.std()),
            "constrained_spread": float(b.std()),
            "similar": bool(gap <= max(spread, 0.1 * abs(a.mean()))),
        }
    reach = [_episodes_to(answer, -15.0) for answer in (ppo, cppo)]
    return {
        "return": rows,
        "episodes_to_-15": {"baseline": reach[0], "constrained": reach[1]},
        "verdict": _verdict([row["similar"] for row in rows.values()]),
    }


def _episodes_to(answer: dict[str, Any], level: float) -> list[int | None]:
    """First episode at which each seed's training return, smoothed, reaches `level`."""
    curve = np.array(answer["training"]["return"])
    episode = answer["training"]["episode"]
    firsts = [np.flatnonzero(curve[:, s] >= level) for s in range(curve.shape[1])]
    return [int(episode[first[0]]) if len(first) else None for first in firsts]


def _unstable_share(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    series: dict[str, Any] = {}
    for name, answer in (("baseline", ppo), ("constrained", cppo)):
        start = paper_mark([test["episode"] for test in select(answer)])
        tests = [test for test in select(answer) if test["episode"] >= start]
        share = np.array([np.add(t["oscillation"], t["drift"]) for t in tests])
        episode = np.array([t["episode"] for t in tests], dtype=float)
        growth = np.polyfit(episode / 1000.0, share, 1)[0] if len(tests) > 1 else np.zeros(1)
        series[name] = {
            "first": float(share[0].mean()),
            "last": float(share[-1].mean()),
            "largest": float(share.max()),
            "growth_per_1000": [float(f"{value:.4g}") for value in np.atleast_1d(growth)],
            "largest_oscillation": max(max(t["oscillation"]) for t in tests),
            "largest_drift": max(max(t["drift"]) for t in tests),
        }
    grows = series["baseline"]["last"] >= series["baseline"]["first"] + 0.01
    zero = series["constrained"]["largest"] == 0.0
    verdict = _verdict([grows, zero])
    return {**series, "baseline_grows": grows, "constrained_zero": zero, "verdict": verdict}


def _generalization(ppo: dict[str, Any], cppo: dict[str, Any]) -> dict[str, Any]:
    rows: dict[str, dict[str, Any]] = {}
    mark = paper_mark(_marks(ppo, cppo))
    for shift in SHIFTS:
        a, b = at(ppo, mark, shift=shift), at(cppo, mark, shift=shift)
        error = [float(np.median(test["error_f"])) for test in (a, b)]
        rows[shift] = {
            "baseline_error_f": error[0],
            "constrained_error_f": error[1],
            "ratio": float(f"{error[0] / error[1]:.4g}"),
            "baseline_unstable": float(np.mean(np.add(a["oscillation"], a["drift"]))),
            "constrained_unstable": float(np.mean(np.add(b["oscillation"], b["drift"]))),
        }
    better = [row["ratio"] >= 10.0 for shift, row in rows.items() if shift != "nominal"]
    return {"shifts": rows, "verdict": _verdict(better)}
