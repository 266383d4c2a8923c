"""Lesson 12: what each part buys and how the paper's claims fare, by rules fixed here.

Every sentence is made from the result file and says the opposite where the file does. Nobody
trained for the paper's 12M steps, so a failure is a failure so far.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cmc.lessons.lesson_11_results import percent
from cmc.lessons.lesson_12_results import (
    FAR,
    NEAR,
    Array,
    Method,
    difference,
    mean_interval,
    methods,
    passing,
    table,
    thousands,
)

LEARNED, BETTER = -400.0, -200.0
"""The paper's band of returns of a learned task."""
PAPER_STEPS, PAPER_FIRST, PAPER_SEEDS = 12_000_000, 3_000_000, 2
"""Steps of the paper's runs, those near which its first seeds converged, and how many of 5."""
OURS = ("ctd3_paper", "ctd3")
"""Arms that are TD3/C-TD3: the paper's scheme, and the one of this course."""
THEIRS = ("td3", "control", "ppo_control")
"""Arms that the paper compares with; all others are ours."""


class Part(NamedTuple):
    """What one arm has and the other lacks."""

    bought: str
    arm: str
    other: str


PARTS = (
    Part("everything of ours (sign, cap, oddness, gradient of the model)", "ctd3", "td3"),
    Part("positive weights alone (the paper's scheme)", "ctd3_paper", "td3"),
    Part("cap, oddness and gradient of the model, on top of the sign", "ctd3", "ctd3_paper"),
    Part("learning the low level, instead of a frozen random start", "ctd3", "frozen"),
    Part("learning the low level, instead of a hand-tuned gain", "ctd3", "gain"),
    Part("a corrected critic, for free weights", "td3_corrected", "td3"),
    Part("any low level at all: frozen, against none", "frozen", "control"),
    Part("a learned low level, against none", "ctd3", "control"),
    Part("planning by TD3 instead of PPO, without a low level", "control", "ppo_control"),
)
"""Pairs of arms; rows of `parts_table`."""


def common(a: Method, b: Method) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Tests of two methods after the largest number of steps at which both were tested."""
    steps = {t["step"] for t in a["tests"]} & {t["step"] for t in b["tests"]}
    if not steps:
        return None
    first, second = (next(t for t in m["tests"] if t["step"] == max(steps)) for m in (a, b))
    return first, second


def word(low: float, high: float) -> str:
    """What an interval of a difference says."""
    return "helps" if low > 0 else "hurts" if high < 0 else "not shown"


def gap_text(found: tuple[float, float, float], scale: float = 1.0, form: str = "+.0f") -> str:
    """A difference and its interval."""
    if not np.isfinite(found[1]):
        return f"{scale * found[0]:{form}} [one seed: no interval]"
    return f"{scale * found[0]:{form}} [{scale * found[1]:{form}}, {scale * found[2]:{form}}]"


def parts_table() -> str:
    """Markdown: differences between arms in strict touch and return, with intervals over seeds."""
    columns = ["what is bought", "arms", "after", "touch at the end (points) [95 %]"]
    columns += ["touch at any time (points) [95 %]", "return [95 %]"]
    rows = []
    for part in PARTS:
        if part.arm not in methods() or part.other not in methods():
            continue
        a, b = methods()[part.arm], methods()[part.other]
        names = f"{a['title']} against {b['title']}"
        tests = common(a, b)
        if tests is None:
            rows.append([part.bought, names, "no common step", "", "", ""])
            continue
        cells = []
        for key, scale in (("success", 100.0), ("touched", 100.0), ("return", 1.0)):
            gap = difference(*(test[key] for test in tests))
            cells.append(f"{gap_text(gap, scale)}: **{word(*gap[1:])}**")
        rows.append([part.bought, names, thousands(tests[0]["step"]), *cells])
    return table(columns, rows)


def parts_verdict() -> str:
    """Markdown: which parts help, hurt, or show nothing, measure by measure."""
    measures = {
        "success": "a touch at the end",
        "touched": "a touch at any time",
        "return": "return",
    }
    pairs = [p for p in PARTS if p.arm in methods() and p.other in methods()]
    lines = []
    for key, name in measures.items():
        found: dict[str, list[str]] = {"help": [], "hurt": []}
        compared = 0
        for part in pairs:
            tests = common(methods()[part.arm], methods()[part.other])
            if tests is None:
                continue
            compared += 1
            verdict = word(*difference(*(test[key] for test in tests))[1:])
            if verdict != "not shown":
                found[verdict.removesuffix("s")].append(part.bought)
        if compared:
            said = [f"these {end}: {'; '.join(names)}" for end, names in found.items() if names]
            rest = compared - sum(len(names) for names in found.values())
            said.append(f"not shown either way with this many seeds: {rest} of {compared} parts")
            lines.append(f"- On {name}: {' · '.join(said)}.")
    return "\n".join(lines) if lines else "The file holds no two arms to compare."


# -- the paper's claims ---------------------------------------------------------------------------


def state(test: dict[str, Any]) -> str:
    """Whether a method learned the task by its return: "learned", "not learned" or "open"."""
    _, low, high = mean_interval(test["return"])
    return "learned" if low >= LEARNED else "not learned" if high < LEARNED else "open"


def _returns(name: str) -> str:
    m = methods()[name]
    mean, low, high = mean_interval(m["final"]["return"])
    around = f" [{low:.0f}, {high:.0f}]" if np.isfinite(low) else ""
    seeds = int(np.sum(np.asarray(m["final"]["return"]) >= LEARNED))
    return (
        f"{m['title']} after {thousands(m['final']['step'])}: {mean:.0f}{around}, "
        f"{seeds} of {len(m['seeds'])} seeds at {LEARNED:.0f} or above"
    )


def claim_learns() -> tuple[str, str]:
    """TD3/C-TD3 learns, with a return in the paper's band: figures and verdict."""
    there = [name for name in OURS if name in methods()]
    if not there:
        return "not in the file", "not tested"
    words = []
    for name in there:
        test = methods()[name]["final"]
        _, low, high = mean_interval(test["return"])
        found = state(test)
        if found == "learned":
            found = "holds" if high <= BETTER else "holds, and better than the band"
        elif found == "not learned":
            found = "does not hold so far"
        words.append(f"{found} ({'ours' if name == 'ctd3' else 'the paper-like scheme'})")
    return "; ".join(_returns(name) for name in there), ", ".join(words)


def claim_others() -> tuple[str, str]:
    """The paper's other methods fail: figures and verdict."""
    others = [name for name in THEIRS if name in methods()]
    if not others:
        return "not in the file", "not tested"
    states = {name: state(methods()[name]["final"]) for name in others}
    learned = [methods()[n]["title"] for n in others if states[n] == "learned"]
    unclear = [methods()[n]["title"] for n in others if states[n] == "open"]
    verdict = "holds so far"
    if learned:
        verdict = f"does not hold: {', '.join(learned)} learned it too"
    elif unclear:
        verdict = f"open: {', '.join(unclear)}"
    return "; ".join(_returns(name) for name in others), verdict


def claim_left_out() -> tuple[str, str]:
    """Whether arms that the paper does not have learned the task too: figures and verdict."""
    extra = [name for name in methods() if name not in (*OURS, *THEIRS)]
    if not extra:
        return "not in the file", "not tested"
    states = {methods()[n]["title"]: state(methods()[n]["final"]) for n in extra}
    lists = [
        f"{found}: {', '.join(t for t, s in states.items() if s == found)}"
        for found in ("learned", "not learned", "open")
        if found in states.values()
    ]
    return "; ".join(_returns(name) for name in extra), "; ".join(lists)


def claim_only(arm: str) -> tuple[str, str]:
    """The ordering: this arm's return above that of the paper's other methods, at common steps."""
    others = [name for name in THEIRS if name in methods()]
    if arm not in methods() or not others:
        return "not in the file", "not tested"
    cells, words = [], []
    for name in others:
        tests = common(methods()[arm], methods()[name])
        if tests is None:
            continue
        gap = difference(tests[0]["return"], tests[1]["return"])
        words.append(word(*gap[1:]))
        step = thousands(tests[0]["step"])
        cells.append(f"over {methods()[name]['title']} at {step}: {gap_text(gap)}")
    if not words:
        return "no common step", "not tested"
    verdict = "open"
    if all(found == "helps" for found in words):
        verdict = "holds"
    elif "hurts" in words:
        verdict = "does not hold: another method is better"
    return "; ".join(cells), verdict


def claim_early(arm: str) -> tuple[str, str]:
    """Two of five seeds learned near 3M steps: when this arm's seeds did, by kept policies."""
    if arm not in methods():
        return "not in the file", "not tested"
    m = methods()[arm]
    step = np.array([t["step"] for t in m["tests"]])
    good = np.array([t["return"] for t in m["tests"]], dtype=float) >= LEARNED
    first = sorted(int(step[column.argmax()]) for column in good.T if column.any())
    listed = ", ".join(thousands(mark) for mark in first) or "none"
    text = f"{m['title']}: seeds first at {LEARNED:.0f} at {listed} (of {len(m['seeds'])})"
    if len(first) >= PAPER_SEEDS:
        sooner = first[PAPER_SEEDS - 1] < PAPER_FIRST
        return text, "sooner than reported" if sooner else "holds"
    last = int(step[-1])
    ran = f"only {thousands(last)} steps were run" if last < PAPER_FIRST else "fewer seeds"
    return text, f"not seen: {ran}"


def claim_passing() -> tuple[str, str]:
    """TD3/TD3 passes by the goal, more often than TD3/C-TD3: figures and verdict."""
    found = {n: passing(methods()[n]["final"]) for n in ("td3", "ctd3") if n in methods()}
    shares: dict[str, Array] = {n: x for n, x in found.items() if x is not None}
    text = "; ".join(
        f"{methods()[n]['title']} {percent(float(x.mean()))} of the episodes"
        for n, x in shares.items()
    )
    if len(shares) < 2:
        return text or "not in the file", "not tested"
    gap = difference(shares["td3"], shares["ctd3"])
    verdict = {"helps": "holds", "hurts": "does not hold", "not shown": "open"}[word(*gap[1:])]
    if not shares["td3"].any():
        verdict = "does not hold: it never does"
    return f"{text}; difference {gap_text(gap, 100.0)} points", verdict


def claims_table() -> str:
    """Markdown: the paper's claims on peg push, our rule for each, our figures, verdicts."""
    band = f"[{LEARNED:.0f}, {BETTER:.0f}]"
    rows = [
        (
            f"TD3/C-TD3 learns the task, with returns in {band}",
            f"95 % interval of the mean return over seeds at {LEARNED:.0f} or above",
            claim_learns(),
        ),
        (
            "TD3/TD3, TD3/Control and PPO/Control fail, with returns of about -700",
            f"none of their intervals reaches {LEARNED:.0f}",
            claim_others(),
        ),
        (
            "(arms that the paper left out)",
            "the same rule as in the first row",
            claim_left_out(),
        ),
        (
            "only TD3/C-TD3 learns (the paper-like scheme)",
            "its return is above each of those three at a common step, intervals above 0",
            claim_only("ctd3_paper"),
        ),
        ("the same for ours", "the same", claim_only("ctd3")),
        (
            "two of five seeds have converged near 3M steps",
            f"two seeds of the paper-like scheme have kept policies at {LEARNED:.0f} or above",
            claim_early("ctd3_paper"),
        ),
        ("the same for ours", "the same", claim_early("ctd3")),
        (
            "TD3/TD3 passes by the goal",
            f"nearer than {NEAR:g} mm, then farther than {FAR:g} mm at the end, in more episodes "
            "than TD3/C-TD3, interval of the difference above 0",
            claim_passing(),
        ),
    ]
    columns = ["the paper says (12M steps)", "rule", "found", "verdict"]
    return table(columns, [[says, rule, text, f"**{end}**"] for says, rule, (text, end) in rows])
