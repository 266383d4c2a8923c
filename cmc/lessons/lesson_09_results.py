"""Lesson 09, from the shipped results: arrays and tables that the figures show."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc import store
from cmc.studies import peg_touch
from cmc.studies.peg_touch_evaluation import ERROR_BINS

Array = NDArray[np.float64]
EDGES: Array = np.log10(ERROR_BINS)
"""Edges of the stored error histograms, log10 of m or N."""


@cache
def methods() -> dict[str, Any]:
    """Answers of every method, by name."""
    return peg_touch.results()["methods"]


def training(names: tuple[str, ...] = ("ppo", "cppo")) -> tuple[Array, dict[str, Array]]:
    """Episodes (points,) and, by title, smoothed training returns (seeds, points)."""
    episode = np.array(methods()[names[0]]["training"]["episode"], dtype=float)
    curves = {name: methods()[name] for name in names}
    return episode, {
        found["title"]: np.array(found["training"]["return"]).T for found in curves.values()
    }


def over_training(key: str, names: tuple[str, ...]) -> dict[str, tuple[Array, Array]]:
    """By title: episodes (points,) and a figure of the nominal tests (seeds, points).

    Args:
        key: an entry of a test such as `oscillation`, or `unstable` for oscillation and drift.
        names: methods.
    """
    answer = {}
    for name in names:
        tests = peg_touch.select(methods()[name])
        rows = [
            np.add(t["oscillation"], t["drift"]) if key == "unstable" else t[key] for t in tests
        ]
        episode = np.array([t["episode"] for t in tests], dtype=float)
        answer[methods()[name]["title"]] = (episode, np.array(rows, dtype=float).T)
    return answer


def errors(name: str, shift: str, episode: int | None = 5000) -> Array:
    """log10 of the mean force error of each test's last second, from the stored histogram."""
    counts = np.array(peg_touch.at(methods()[name], episode, shift=shift)["histogram_f"])
    return np.repeat(0.5 * (EDGES[1:] + EDGES[:-1]), counts)


def predictions() -> tuple[Array, Array]:
    """Share that oscillates, predicted from the weights and measured, one pair for each test."""
    pairs = [
        (p, m)
        for answer in methods().values()
        for test in answer["tests"]
        if test.get("prediction") == "weights"
        for p, m in zip(test["predicted_oscillation"], test["oscillation"], strict=True)
    ]
    predicted, measured = np.array(pairs, dtype=float).T
    return predicted, measured


def share_sentence() -> str:
    """Markdown: the unstable shares in words, ordinary and stress setting."""
    pairs = peg_touch.results()["claims"]["unstable share"]["pairs"]
    a, b = pairs["ppo vs cppo"]["baseline"], pairs["ppo vs cppo"]["constrained"]
    text = (
        f"From episode 5000 on, PPO's share is {a['first']:.2%} at first and {a['last']:.2%} at "
        f"last (largest in one seed {a['largest']:.1%}). C-PPO's drift is at most "
        f"{b['largest_drift']:.1%}; its oscillation at most {b['largest_oscillation']:.1%} in one "
        "seed."
    )
    if "ppo_stress vs cppo_stress" in pairs:
        c = pairs["ppo_stress vs cppo_stress"]
        a, b = c["baseline"], c["constrained"]
        text += (
            f" In the stress setting the largest shares in one seed are {a['largest']:.0%} for PPO "
            f"and {b['largest']:.0%} for C-PPO (drift {a['largest_drift']:.0%} and "
            f"{b['largest_drift']:.0%})."
        )
    return text


def cap_sentence() -> str:
    """Markdown: what the caps cost in return."""
    free = methods()["cppo"]
    costs = []
    for name in ("cppo_capped", "cppo_bypass"):
        parts = []
        for mark in (5000, 15_000):
            a, b = (np.mean(peg_touch.at(m, mark)["return"]) for m in (free, methods()[name]))
            change = (b - a) / abs(a)
            word = "better" if change > 0 else "worse"
            parts.append(f"{b:.2f} against {a:.2f} ({abs(change):.0%} {word}) at episode {mark:,}")
        worst = peg_touch.results()["totals"]["worst"][name]
        costs.append(
            f"**{methods()[name]['title']}**: return {' and '.join(parts)}; in "
            f"{worst['tests']} tests, at every kept episode and under every shift, the largest "
            f"share that oscillates is {worst['largest_oscillation']:.1%} and that drifts "
            f"{worst['largest_drift']:.1%}."
        )
    return "\n\n".join(costs)


def caps_table() -> str:
    """Markdown: every cap that was tried, its cost in return and its worst share."""
    found = store.read_json(store.asset("results", "peg_touch_caps.json"))
    head = (
        "| cap | return, mean [lowest, highest seed] | cost | largest oscillation over shifts |\n"
        "|---|---|---|---|\n"
    )
    rows = sorted(found["variants"].values(), key=lambda v: -float(np.mean(v["return"])))
    return head + "\n".join(
        f"| {v['title']} | {_range(v['return'])} | {v['cost']:+.0%} "
        f"| {max(v['oscillation'].values()):.0%} |"
        for v in rows
    )


def agreement_sentence() -> str:
    """Markdown: how often the prediction is right."""
    found = peg_touch.results()["totals"]
    return (
        f"Prediction and measurement agree on {found['agreement']:.2%} of the trajectories "
        f"({found['policies']} tests of one seed each), and on "
        f"{found['agreement_where_some_oscillate']:.2%} in the "
        f"{found['policies_where_some_oscillate']} tests in which some oscillate. Capped methods, "
        "which never do, are not counted."
    )


def _range(values: Any, form: str = ".1f") -> str:
    v = np.asarray(values, dtype=float)
    return f"{v.mean():{form}} [{v.min():{form}}, {v.max():{form}}]"


def method_table() -> str:
    """Markdown: return, stability shares at their worst, and offset of every method."""
    head = (
        "| method | return at 5000 | return at the end | largest oscillation, nominal / any shift |"
        " largest drift | offset at the end |\n|---|---|---|---|---|---|\n"
    )
    rows = []
    for answer in methods().values():
        nominal = peg_touch.select(answer)
        tests = [t for t in answer["tests"] if t["h"] == 0.01 and (t["episode"] or 5000) >= 5000]
        later = [t for t in tests if t["shift"] == "nominal"]
        early = next((t for t in nominal if t["episode"] in (5000, None)), nominal[-1])
        shaken = max(max(t["oscillation"]) for t in tests)
        rows.append(
            f"| {answer['title']} | {_range(early['return'])} | {_range(nominal[-1]['return'])} "
            f"| {max(max(t['oscillation']) for t in later):.1%} / {shaken:.1%} "
            f"| {max(max(t['drift']) for t in tests):.1%} | {np.mean(nominal[-1]['offset']):.1%} |"
        )
    return head + "\n".join(rows)


def certificate_table(episode: int = 15_000) -> str:
    """Markdown: what holds for every seed of each contracting method at one episode."""
    head = (
        "| method | right signs everywhere | no oscillation up to (N/m) "
        "| nor on the design's worst plant | contraction in one metric | why not |\n"
        "|---|---|---|---|---|---|\n"
    )
    rows = []
    for answer in methods().values():
        found = [c for c in answer["certificates"] if c["episode"] in (episode, None)]
        if not found:
            continue
        c = found[-1]
        stiffest = "any nominal" if c["stiffest"] is None else f"{min(c['stiffest']):.0f}"
        held = f"{sum(c['contracting'])} of {len(c['contracting'])}"
        rates = [rate for rate in c["rate"] if rate is not None]
        rate = f", rate {min(rates):.2g} 1/s" if any(c["contracting"]) else ""
        reason = "" if all(c["contracting"]) else c["reason"]
        design = f"{sum(c['design'])} of {len(c['design'])}"
        signs = "yes" if c["signs"] else "no"
        rows.append(
            f"| {answer['title']} | {signs} | {stiffest} | {design} | {held}{rate} | {reason} |"
        )
    return head + "\n".join(rows)


def claims_table() -> str:
    """Markdown: the paper's three claims, our figures with seeds and spread, verdicts.

    The fair partner differs from C-PPO in the signs alone; PPO on raw inputs also lacks T_y, the
    error and its integral.
    """
    claims = peg_touch.results()["claims"]
    text = {
        "similar return": _claim_return,
        "unstable share": _claim_share,
        "generalization": _claim_shift,
    }
    head = (
        "| the paper says | rule, fixed before the tests | PPO on the same inputs, five seeds "
        "| PPO on raw inputs |\n|---|---|---|---|\n"
    )
    rows = []
    for name, claim in claims.items():
        cells = [claim["paper"], claim["rule"]]
        for pair in ("ppo vs cppo", "ppo_raw vs cppo"):
            found = claim["pairs"][pair]
            cells.append(f"**{found['verdict']}**: {text[name](found)}")
        rows.append("| " + " | ".join(cells) + " |")
    return head + "\n".join(rows)


def _claim_return(pair: dict[str, Any]) -> str:
    parts = [
        f"episode {mark}: PPO {row['baseline']:.2f} ± {row['baseline_spread']:.2f}, "
        f"C-PPO {row['constrained']:.2f} ± {row['constrained_spread']:.2f}"
        for mark, row in pair["return"].items()
    ]
    reach = pair["episodes_to_-15"]
    parts.append(f"episodes to -15: PPO {reach['baseline']}, C-PPO {reach['constrained']}")
    return "; ".join(parts)


def _claim_share(pair: dict[str, Any]) -> str:
    a, b = pair["baseline"], pair["constrained"]
    return (
        f"PPO {a['first']:.2%} at episode 5000, {a['last']:.2%} at the end, at most "
        f"{a['largest']:.1%} in one seed; C-PPO drift at most {b['largest_drift']:.1%}, "
        f"oscillation at most {b['largest_oscillation']:.1%} in one seed"
    )


def _claim_shift(pair: dict[str, Any]) -> str:
    parts = []
    for shift, row in pair["shifts"].items():
        if shift != "nominal":
            ratio = f"{row['ratio']:,.0f}" if row["ratio"] >= 10 else f"{row['ratio']:.2f}"
            shares = f"{row['baseline_unstable']:.0%} / {row['constrained_unstable']:.0%}"
            parts.append(f"{shift}: {ratio} (unstable {shares})")
    return "PPO's median force error over C-PPO's, " + "; ".join(parts)
