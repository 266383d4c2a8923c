"""Lesson 11, from the shipped results: arrays for the figures, tables, and verdicts.

Every sentence about a result is made here from the file, and says the opposite where the file does.
A method that the file lacks is left out.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc import store
from cmc.studies.old.peg_maze import STUDY

Array = NDArray[np.float64]
Method = dict[str, Any]
FILES = {"soft": "peg_maze", "stiff": "peg_maze_stiff"}
ASKED = 5.0
"""Length of the step by which consistency is measured, mm."""
PAPER = {"TD3/C-TD3": (0.6424, 0.9993, "about 1M"), "HIRO": (0.0622, 0.6588, "2 to 2.3M")}
"""Shares of steps without contact and below 1 N over six policies, and steps (section VII-A)."""
PAPER_STEPS = {"ctd3": 1_000_000, "hiro": 2_300_000}
GROUPS = (
    ("ctd3", "frozen", "gain", "ctd3_paper"),
    ("td3", "td3_corrected", "control", "ppo_control", "hiro", "hiro_matched"),
)
"""Methods that figures show together: constrained low levels, and the others."""
RULES = {"at_50_hz": "at 50 Hz", "largest": "largest of each tick"}


@cache
def methods(regime: str = "soft") -> dict[str, Method]:
    """Answers of every method by name; none if the regime's file is not shipped."""
    found: dict[str, Method] = store.result(FILES[regime]).get("methods", {})
    return found


def groups(regime: str = "soft") -> list[list[str]]:
    """Names of the methods that are there, in the groups of the figures; no empty group."""
    there = methods(regime)
    known = [[name for name in group if name in there] for group in GROUPS]
    return [group for group in known if group]


def training(names: list[str], regime: str = "soft") -> dict[str, tuple[Array, Array]]:
    """By title: steps (points,) and mean distance to the goal in training (seeds, points), mm.

    All worlds of a seed start their episodes together, so that raw curves show the time within an
    episode; this is the moving average over about a whole number of episodes.
    """
    found = (methods(regime)[name] for name in names)
    return {m["title"]: averaged(m["training"]) for m in found}


def averaged(training: dict[str, Any]) -> tuple[Array, Array]:
    """A stored learning curve, averaged over episodes; see `training`."""
    step = np.array(training["step"], dtype=float)
    distance = -1e3 * np.array(training["reward"], dtype=float).T
    width = _window(step[0]) if len(step) > 1 else 1
    if width < len(step):
        kernel = np.ones(width) / width
        distance = np.array([np.convolve(row, kernel, "valid") for row in distance])
        step = np.convolve(step, kernel, "valid")
    return step, distance


def _window(spacing: float, longest: int = 12, tolerance: float = 0.03) -> int:
    """The fewest points, that many steps apart, that nearly cover whole episodes of all worlds."""
    episode = STUDY.task.ticks * STUDY.hierarchy.worlds
    covered = np.arange(1, longest + 1) * spacing / episode
    whole = np.maximum(np.round(covered), 1)
    wrong = np.abs(covered / whole - 1)
    near = np.flatnonzero(wrong <= tolerance)
    return 1 + int(near[0] if near.size else np.argmin(wrong))


def success(names: list[str], regime: str = "soft") -> dict[str, tuple[Array, Array, Array, Array]]:
    """By title: steps of the kept policies, success over seeds, and the ends of its interval."""
    answer = {}
    for name in names:
        tests = methods(regime)[name]["tests"]
        step = np.array([t["step"] for t in tests], dtype=float)
        mean = np.array([np.mean(t["success"]) for t in tests])
        low, high = np.array([t["success_interval"] for t in tests], dtype=float).T
        answer[methods(regime)[name]["title"]] = (step, mean, low, high)
    return answer


def force_bands(
    name: str, regime: str = "soft", rule: str = "largest"
) -> tuple[Array, dict[str, Array]]:
    """Steps of the kept policies, and shares of ticks by contact force; they add up to 1."""
    tests = methods(regime)[name]["tests"]
    rows = [[t["force"][rule][key] for key in ("zero", "below_1_N", "below_5_N")] for t in tests]
    zero, one, five = np.array(rows, dtype=float).T
    bands = {"no contact": zero, "below 1 N": one - zero, "1 to 5 N": five - one}
    bands["above 5 N"] = 1.0 - five
    return np.array([t["step"] for t in tests], dtype=float), bands


def measured(key: str, name: str, regime: str = "soft") -> Array | None:
    """A consistency figure of the last policies by seed, mm; None if it was not measured."""
    found = methods(regime)[name]
    value = found.get(key, found["final"]["consistency_mm"].get(key))
    return None if value is None else np.asarray(value, dtype=float)


def miss(name: str, regime: str = "soft") -> Array:
    """Root mean square distance between where a step of 5 mm ends and where it should, mm."""
    found = methods(regime)[name]["final"]["consistency_mm"]
    mean, spread = np.asarray(found["mean"], float), np.asarray(found["spread"], float)
    if "mean_vector" in found:
        offset = np.asarray(found["mean_vector"], float) + np.array([ASKED, 0.0, 0.0])
        return np.sqrt((offset**2).sum(-1) + spread**2)
    return np.hypot(mean - ASKED, spread)


# -- tables --------------------------------------------------------------------------------------


def percent(share: float) -> str:
    """A share in percent, told from 0 and 100 % wherever it is neither."""
    if share in (0.0, 1.0):
        return f"{share:.0%}"
    rest = min(share, 1.0 - share)
    if rest < 5e-5:
        return "< 0.01%" if share < 0.5 else "> 99.99%"
    return f"{share:.2%}" if rest < 0.01 else f"{share:.1%}"


def with_interval(test: dict[str, Any], key: str = "success") -> str:
    """A share over all episodes with its interval."""
    low, high = test[f"{key}_interval"]
    return f"{percent(float(np.mean(test[key])))} [{100 * low:.1f}, {100 * high:.1f}]"


def span(values: Any, form: str = ".2f") -> str:
    """Mean of some numbers and their range."""
    v = np.asarray(values, dtype=float)
    return f"{v.mean():{form}} [{v.min():{form}}, {v.max():{form}}]"


def _table(columns: list[str], rows: list[list[str]]) -> str:
    head = f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}\n"
    return head + "\n".join(f"| {' | '.join(row)} |" for row in rows)


def method_table(regime: str = "soft") -> str:
    """Markdown: success, return and distance of the last policies of every method."""
    columns = [
        "method",
        "seeds x episodes",
        "steps",
        "success [95 % interval]",
        "success, worst and best seed",
        "return",
        "distance at the end (mm)",
    ]
    rows = []
    for m in methods(regime).values():
        test, share = m["final"], np.asarray(m["final"]["success"], float)
        rows.append(
            [
                m["title"],
                f"{len(share)} x {test['episodes']}",
                f"{test['step']:,}",
                with_interval(test),
                f"{share.min():.0%}, {share.max():.0%}",
                span(test["return"]),
                span(test["final_mm"], ".1f"),
            ]
        )
    return _table(columns, rows)


def force_table() -> str:
    """Markdown: shares of ticks by force over all kept policies, both regimes and the paper's."""
    columns = ["method", "peg", "steps"]
    columns += [
        f"{what}, {rule}" for rule in RULES.values() for what in ("no contact", "< 1 N", "< 5 N")
    ]
    columns.append("largest (N)")
    rows = [
        [f"paper: {name}", "", steps, f"{zero:.2%}", f"{one:.2%}", "", "", "", "", ""]
        for name, (zero, one, steps) in PAPER.items()
    ]
    for regime in FILES:
        for name, m in methods(regime).items():
            shares = m["force_over_tests"]
            row = [m["title"], _peg(name, regime), f"{m['final']['step']:,}"]
            for rule in RULES:
                row += [percent(shares[rule][k]) for k in ("zero", "below_1_N", "below_5_N")]
            rows.append([*row, f"{shares['largest']['largest_N']:.2f}"])
    return _table(columns, rows)


def _peg(name: str, regime: str) -> str:
    """HIRO has a rigid peg in either file."""
    return "rigid" if regime == "stiff" or name.startswith("hiro") else "on springs"


def consistency_table() -> str:
    """Markdown: what one sub-goal, a step of 5 mm, makes of the low level."""
    columns = [
        "method",
        "peg",
        "moves along the step (mm)",
        "misses its end by (mm)",
        "spread over starts (mm)",
        "a push moves the end by (mm)",
        "spread over kept policies (mm)",
    ]
    rows = []
    for regime in FILES:
        for name, m in methods(regime).items():
            keys = ("spread", "pushed", "consistency_over_training_mm")
            cells = [measured(key, name, regime) for key in keys]
            row = [m["title"], _peg(name, regime), span(m["final"]["consistency_mm"]["mean"])]
            row.append(span(miss(name, regime)))
            rows.append([*row, *("" if c is None else span(c) for c in cells)])
    return _table(columns, rows)


def gain_table() -> str:
    """Markdown: slopes du/dy at rest of the last policies, as shares of the sampled-data bound."""
    columns = ["method", "regime", "translation", "rotation", "smallest share", "capped by design"]
    rows = []
    for regime in FILES:
        for m in methods(regime).values():
            if "gains" not in m["final"]:
                continue
            share = gain_shares(m)
            rows.append(
                [
                    m["title"],
                    regime,
                    span(share[:, :3]),
                    span(share[:, 3:]),
                    f"{share.min():.3f}",
                    "yes" if m["final"]["gains"]["bounded"] else "no",
                ]
            )
    return _table(columns, rows)


def gain_shares(method: Method) -> Array:
    """Slopes at rest over their bounds, (seeds, 6)."""
    gains = method["final"]["gains"]
    shares: Array = np.asarray(gains["slope"], float) / np.asarray(gains["bound"], float)
    return shares
