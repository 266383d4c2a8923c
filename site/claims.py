"""The paper, claim by claim: its figure, ours with an interval over seeds, a rule, a verdict."""

from __future__ import annotations

from collections import Counter
from functools import partial as of
from pathlib import Path

import claim_rules
import pandas as pd
from claim_rules import (
    Answer,
    caps_cost,
    fails_beside,
    learns,
    passes_by,
    share_grows,
    similar_efficiency,
    similar_return,
    smaller_errors,
    soft_touches,
    softer_than_hiro,
    softness_simplifies,
    stays_zero,
    table,
)

from cmc.results import at, compare

PAGE = Path(__file__).with_name("claims.md")

CHOICES = """Choices of ours stand behind several rows. In peg touch commands are held for 10 ms,
and T_y departs from appendix F (it undoes the slope of the surface). On peg push the planner's
discount is .9, the paper's .5, and the paper does not say what its low-level critic sees."""
DISCOUNT = "the planner's discount is .9, the paper's .5"
SHORTER = "the planner's discount is .9; at the paper's .5 it was not tried"
SAME_CRITIC = "positive weights with the same critic do no better (the paper's scheme, above)"
LEARNED = "the one rule of *has learned* (above)"
BESIDE = "no: the rival has learned; yes: it has not, while C-TD3 has after as many steps"
GROWS = "last minus first kept policy from episode 5000 on: the interval is above 0"
ZERO = "0 in every seed at every kept policy from episode 5000 on"
ERRORS = "the median force error is at least 10 times smaller under every shift"
PATH = "finds the path with a high success rate (VII-A)"
FAILED = "fails: it has not figured out the entire path (VII-B)"
TWO_OF_FIVE, LONG = "[-400, -200], 2 of 5 seeds after 3M steps", "-700 after 12M steps"
# fmt: off
CLAIMS = {
    "peg_touch": (
        ("PPO and C-PPO learn with similar return (fig. 1a)", "similar",
         "at episodes 5000 and 15,000 the means differ by at most a tenth", similar_return),
        ("... and with similar data efficiency (fig. 1a)", "similar",
         "episodes to a training return of -15 differ by at most a factor of 2 (median seed)",
         similar_efficiency),
        ("PPO's share of oscillation and drift grows with learning (fig. 1b), on C-PPO's inputs",
         "grows", GROWS, of(share_grows, "ppo")),
        ("... PPO on raw inputs", "grows", "as above", of(share_grows, "ppo_raw")),
        ("C-PPO's share remains zero (fig. 1b)", "0", ZERO, of(stays_zero, "cppo")),
        ("... and of C-PPO with slopes below the sampled-data bound", "-", "as above",
         of(stays_zero, "cppo_capped")),
        ("... at a control period of 2 ms, trained and tested: C-PPO's share remains zero", "0",
         "as above", of(stays_zero, "cppo", "peg_touch_2ms")),
        ("... at 2 ms: the share of PPO on raw inputs grows", "grows", GROWS,
         of(share_grows, "ppo_raw", "peg_touch_2ms")),
        ("... at 5 ms: C-PPO's share remains zero", "0", ZERO,
         of(stays_zero, "cppo", "peg_touch_5ms")),
        ("... at 5 ms: the share of PPO on raw inputs grows", "grows", GROWS,
         of(share_grows, "ppo_raw", "peg_touch_5ms")),
        ("Under shifts C-PPO's tracking errors at episode 5000 are dramatically smaller (fig. 1c), "
         "on equal inputs", "dramatic", ERRORS, of(smaller_errors, "ppo")),
        ("... against PPO on raw inputs", "dramatic", "as above", of(smaller_errors, "ppo_raw")),
        ("The constraints lose some optimality (V-C)", "no figure",
         "the interval of the difference in return lies below 0", caps_cost),
    ),
    "peg_maze": (
        (f"TD3/C-TD3 {PATH}, our scheme", "high, about 1M steps", LEARNED,
         of(learns, "peg_maze", "ctd3", 1_000_000)),
        ("... with our reading of the paper's scheme", "high, about 1M steps", LEARNED,
         of(learns, "peg_maze", "ctd3_paper", 1_000_000)),
        (f"HIRO {PATH}", "high, about 2M steps", LEARNED,
         of(learns, "peg_maze", "hiro", 2_300_000)),
        ("TD3/C-TD3 explores with soft touches (VII-A)",
         "99.93 % of the steps below 1 N, 64.24 % without contact",
         "at least 99 % of the ticks of all kept policies below 1 N", soft_touches),
        ("HIRO's touches are harder (VII-A)", "65.88 % below 1 N",
         "with equal pegs, C-TD3 has at least 10 points more ticks below 1 N, once HIRO has "
         "learned", softer_than_hiro),
    ),
    "peg_push": (
        ("TD3/C-TD3 learns the task (VII-B), our scheme", TWO_OF_FIVE, LEARNED,
         of(learns, "peg_push", "ctd3", 3_000_000, DISCOUNT)),
        ("... with the paper's scheme as we read it", TWO_OF_FIVE, LEARNED,
         of(learns, "peg_push", "ctd3_paper", 3_000_000)),
        (f"TD3/Control {FAILED}", LONG, BESIDE, of(fails_beside, "control", note=SHORTER)),
        (f"PPO/Control {FAILED}", LONG, BESIDE, of(fails_beside, "ppo_control")),
        ("TD3/TD3 fails (VII-B)", LONG, BESIDE, of(fails_beside, "td3", note=SAME_CRITIC)),
        ("... TD3/TD3 with a critic that sees the full state", "-", BESIDE,
         of(fails_beside, "td3_corrected")),
        ("TD3/TD3's trajectories pass by the goal (VII-B)", "pictures",
         "at least 10 % of the episodes come within 1 mm and end farther than 2 mm", passes_by),
        ("Soft contact may highly simplify the task (VII-B, a question)", "open",
         "learned under 6.25 times stiffer contact: the interval of the loss is beyond 20 points "
         "(yes), or within (no)", softness_simplifies),
    ),
}
# fmt: on
COMPARED = {
    "peg_maze": [("frozen", "success"), ("frozen", "return"), ("gain", "return")],
    "peg_push": [
        *((rival, "success") for rival in ("frozen", "control", "td3_corrected", "ctd3_positive")),
        *((rival, "return") for rival in ("frozen", "gain")),
    ],
}
"""C-TD3 against other arms, as in lessons 11 and 12; named before the tests."""


# -- the page -----------------------------------------------------------------


def answers() -> dict[str, Answer]:
    """The answer to every claim, by its text."""
    return {text: judge() for rows in CLAIMS.values() for text, _, _, judge in rows}


def named(study: str) -> pd.DataFrame:
    """The named comparisons of a task whose arms are there, with Holm's correction."""
    data = at(table(study))
    return compare(data, [("ctd3", rival, key) for rival, key in COMPARED[study]])


def page() -> str:
    """The page in Markdown."""
    lines = [
        "# The paper, claim by claim",
        "",
        (claim_rules.__doc__ or "").split("\n\n", 1)[1],
        CHOICES,
        "",
    ]
    found = answers()
    for study, claims in CLAIMS.items():
        lines += [f"## {study.replace('_', ' ').capitalize()}", ""]
        lines += ["| the paper says | its figure | here, mean over seeds [95 %] | rule | verdict |"]
        lines += ["|---|---|---|---|---|"]
        for text, figure, rule, _ in claims:
            ours, verdict, because = found[text]
            here = ours + (f". {because}" if because else "")
            lines.append(f"| {text} | {figure} | {here} | {rule} | **{verdict}** |")
        made = f"python -m cmc train {study}; python -m cmc ship {study} FOLDER"
        lines += ["", f"Tables are made by `{made}`.", ""]
        if study != "peg_touch":
            lines += ["What each part buys: C-TD3 minus another arm (success in points)", ""]
            lines += ["| arm | of | difference [95 %] | p, exact | p, Holm |"]
            lines += ["|---|---|---|---|---|"]
            for (_, other, key), row in named(study).iterrows():
                parts = (100 if key == "success" else 1) * row[["difference", "low", "high"]]
                gap, low, high = (f"{part:+.3g}" for part in parts)
                p = f"{row['p']:.3f} | {row['p_holm']:.3f}"
                lines.append(f"| {other} | {key} | {gap} [{low}, {high}] | {p} |")
            lines.append("")
    counts = Counter(answer.verdict for answer in found.values()).most_common()
    total = ", ".join(f"{count} {verdict}" for verdict, count in counts)
    text = "\n".join([*lines, f"In all: {total}.", ""])
    return text.replace("T_y", "$T_y$").replace("tau_z", r"$\tau_z$")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
