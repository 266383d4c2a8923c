"""Lesson 11: what the shipped results say about the claims, as sentences made from the file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc import store
from cmc.lessons.lesson_11_results import (
    FILES,
    PAPER,
    PAPER_STEPS,
    averaged,
    gain_shares,
    measured,
    methods,
    miss,
    percent,
    with_interval,
)

Array = NDArray[np.float64]
WANTED, SOFT_SHARE = 0.95, 0.999
"""Success that counts as solved, and share of ticks below 1 N that counts as soft."""


def success_verdict(name: str = "ctd3", regime: str = "soft") -> str:
    """Markdown: whether a method solves the maze, and from which kept policy on."""
    if name not in methods(regime):
        return ""
    m = methods(regime)[name]
    final, tests = m["final"], m["tests"]
    mean = float(np.mean(final["success"]))
    reached = [t["step"] for t in tests if np.mean(t["success"]) >= WANTED]
    text = (
        f"**{m['title']}, {regime}**: {with_interval(final)} of {len(final['success'])} x "
        f"{final['episodes']} episodes end within 5 mm after {final['step']:,} steps"
    )
    text += "" if mean >= WANTED else f", short of the {WANTED:.0%} asked for"
    text += (
        f"; the first kept policies with at least {WANTED:.0%} are those of step {reached[0]:,}"
        if reached
        else f"; no kept policy reaches {WANTED:.0%}"
    )
    if name in PAPER_STEPS:
        text += f" (the paper: converged after about {PAPER_STEPS[name]:,} steps)"
    return text + "."


def force_verdict() -> str:
    """Markdown: the soft regime's forces beside the paper's, by both sampling rules."""
    if "ctd3" not in methods():
        return ""
    m, (zero, one, _) = methods()["ctd3"], PAPER["TD3/C-TD3"]
    shares = m["force_over_tests"]
    light = {rule: shares[rule]["below_1_N"] for rule in shares}
    held = all(value >= SOFT_SHARE for value in light.values())
    word = "Met" if held else "**Not met**"
    return (
        f"{word}: over all {len(m['tests'])} kept policies {percent(light['at_50_hz'])} of the "
        f"ticks are below 1 N sampled at 50 Hz, {percent(light['largest'])} by the largest force "
        f"of each tick (asked: {SOFT_SHARE:.1%}; the paper: {one:.2%}). Without contact are "
        f"{percent(shares['at_50_hz']['zero'])} and {percent(shares['largest']['zero'])} (the "
        f"paper: {zero:.2%}); the largest force is {shares['largest']['largest_N']:.2f} N."
    )


def softness_verdict() -> str:
    """Markdown: whether force separates methods, in the soft and in the stiff regime."""
    lines = []
    for regime in FILES:
        light = {
            m["title"]: m["force_over_tests"]["largest"]["below_1_N"]
            for name, m in methods(regime).items()
            if not name.startswith("hiro")
        }
        if len(light) < 2:
            continue
        worst, best = min(light, key=light.__getitem__), max(light, key=light.__getitem__)
        apart = light[best] - light[worst]
        line = f"In the **{regime}** regime "
        line += (
            f"{percent(light[best])} of the ticks are below 1 N with each of {len(light)} methods"
            if apart == 0.0
            else f"the largest share of ticks below 1 N is {percent(light[best])} ({best}), the "
            f"smallest {percent(light[worst])} ({worst})"
        )
        if light[worst] >= SOFT_SHARE:
            line += ": every method is soft, whatever it learned, so force says nothing about them."
        elif apart < 0.01:
            line += ": less than one percent apart."
        else:
            line += f": {100 * apart:.1f} percentage points apart."
        lines.append(line)
    return "\n\n".join(lines)


def learned_verdict(name: str, other: str, regime: str = "soft") -> str:
    """Markdown: one low level against another, seed by seed: success, tracking, force, return."""
    there = methods(regime)
    if name not in there or other not in there:
        return ""
    a, b = there[name]["final"], there[other]["final"]
    seeds = min(len(a["success"]), len(b["success"]))

    def wins(first: Any, second: Any) -> int:
        return int(np.sum(np.asarray(first)[:seeds] >= np.asarray(second)[:seeds]))

    counts = {
        "success": wins(a["success"], b["success"]),
        "tracking": wins(-miss(name, regime), -miss(other, regime)),
        "return": wins(a["return"], b["return"]),
    }
    force = [t["force"]["largest"]["below_1_N"] for t in (a, b)]
    everywhere = force[0] >= force[1] and counts["success"] == counts["tracking"] == seeds
    parts = [f"{key} in {n} of {seeds} seeds" for key, n in counts.items()]
    verdict = "at least as good in every seed" if everywhere else "not better throughout"
    return (
        f"**{there[name]['title']} against {there[other]['title']}, {regime}**: {verdict} on "
        f"success, tracking and force. At least as good on {', '.join(parts)}; a step of 5 mm "
        f"misses by {miss(name, regime).mean():.2f} against {miss(other, regime).mean():.2f} mm; "
        f"below 1 N are {percent(force[0])} against {percent(force[1])} of the last policies' "
        "ticks."
    )


def hiro_verdict() -> str:
    """Markdown: the joint-space baseline, its steps, and what can be compared."""
    lines = []
    for name in ("hiro", "hiro_matched"):
        if name not in methods():
            continue
        m, (zero, one, _) = methods()[name], PAPER["HIRO"]
        final, shares = m["final"], m["force_over_tests"]["at_50_hz"]
        part = final["step"] / PAPER_STEPS["hiro"]
        lines.append(
            f"**{m['title']}**: {len(m['seeds'])} seeds, {final['step']:,} steps ({part:.0%} of "
            f"the paper's). Success {with_interval(final)}; "
            f"{percent(shares['below_1_N'])} of the ticks below 1 N, {percent(shares['zero'])} "
            f"without contact (the paper's HIRO: {one:.2%} and {zero:.2%})."
        )
    if not lines:
        return "No HIRO policies are shipped."
    rival = methods("stiff").get("ctd3")
    if rival is not None:
        shares = rival["force_over_tests"]["at_50_hz"]
        lines.append(
            f"With the same rigid peg, {rival['title']}: {percent(shares['below_1_N'])} and "
            f"{percent(shares['zero'])}."
        )
    return "\n\n".join(lines)


def gain_verdict() -> str:
    """Markdown: which low levels keep their slopes, which lose them, which break their bound."""
    lines = []
    for regime in FILES:
        for m in methods(regime).values():
            if "gains" not in m["final"]:
                continue
            share = gain_shares(m)
            text = f"**{m['title']}, {regime}**: "
            text += _sign_text(share)
            text += (
                f", the largest is {share.max():.2f} of its bound"
                if share.max() <= 1.0
                else f", {int((share > 1.0).sum())} exceed their bound (largest {share.max():.2f})"
            )
            lines.append(text + ".")
    return "\n\n".join(lines)


def _sign_text(share: Array) -> str:
    wrong, flat = int((share < 0).sum()), int((np.abs(share) < 0.01).sum())
    parts = []
    if wrong:
        parts.append(f"{wrong} of {share.size} slopes at rest have the wrong sign")
    if flat:
        parts.append(f"{flat} of {share.size} are below one percent of their bound")
    return " and ".join(parts) or f"all {share.size} slopes at rest are positive"


def consistency_verdict(regime: str = "soft") -> str:
    """Markdown: who moves most alike for one sub-goal, by start, push and training."""
    words = {
        "spread": "over starts",
        "pushed": "under a push",
        "consistency_over_training_mm": "over its own training",
    }
    names = [n for n in methods(regime) if methods(regime)[n]["seeds"]]
    lines = []
    for key, word in words.items():
        found = {n: measured(key, n, regime) for n in names if n != "gain"}
        values = {n: float(v.mean()) for n, v in found.items() if v is not None}
        if len(values) < 2:
            continue
        order = sorted(values, key=values.__getitem__)
        titles = [f"{methods(regime)[n]['title']} ({values[n]:.2f} mm)" for n in order]
        lines.append(f"- most consistent {word}: {titles[0]}; least: {titles[-1]}")
    if not lines:
        return ""
    still = [n for n in names if miss(n, regime).mean() > 2.5]
    text = f"Consistency in the {regime} regime:\n\n" + "\n".join(lines)
    if still:
        listed = ", ".join(methods(regime)[n]["title"] for n in still)
        text += (
            f"\n\nConsistent is not yet useful: these miss the step by more than half: {listed}."
        )
    return text


def paper_sizes() -> dict[str, Any]:
    """Cost and one curve at the paper's network sizes; empty where they are not shipped.

    Returns:
        `text` (Markdown), `step` (points,) and `distance` (seeds, points), mm.
    """
    found = store.result("peg_maze_paper_sizes")
    if not found:
        return {}
    ours, words = found["ours"], []
    for name, part in (("the paper's", found), ("ours", ours)):
        sizes = "; ".join(f"{k} {', '.join(map(str, v))}" for k, v in part["sizes"].items())
        words.append(f"- {name} ({sizes}): {part['cpu_ms_per_step']:.2f} ms of CPU a step")
    ratio = found["cpu_ms_per_step"] / ours["cpu_ms_per_step"]
    final = found["final"]
    text = (
        f"One seed at the paper's network sizes costs {ratio:.1f} times as much:\n\n"
        + "\n".join(words)
        + f"\n\nAfter {final['step']:,} steps it succeeds in {with_interval(final)} of "
        f"{final['episodes']} episodes."
    )
    step, distance = averaged(found["training"])
    return {"text": text, "step": step, "distance": distance}
