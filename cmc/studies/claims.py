"""The paper, claim by claim: its figure, ours with an interval over seeds, a rule, a verdict.

`python -m cmc.studies.claims` writes the page `site/claims.md` from the shipped tables. Rules come
before results and are the same for every arm:

- a seed *has learned* a task if the strict goal holds at the last tick in at least half of its test
  episodes (on peg push the return must also be in the paper's band); an arm has if at least two in
  five of its seeds have. A return in the band without any touch is not learned;
- an arm that has not learned says nothing about what it would do once it has, nor beyond the length
  of its training: *not testable at this length*;
- intervals are bootstraps over seeds, 95 %; a difference whose interval holds 0 leaves a claim
  *open*.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from cmc.results import at, compare
from cmc.studies import verdicts
from cmc.studies.verdicts import Answer, table


@dataclass(frozen=True)
class Claim:
    """One sentence of the paper.

    Attributes:
        study: whose tables answer it.
        text: the claim, and where it stands.
        paper: its figure.
        rule: what decides, said beforehand.
        judge: applies the rule.
    """

    study: str
    text: str
    paper: str
    rule: str
    judge: Callable[[], Answer]

    @property
    def command(self) -> str:
        """What makes the tables anew."""
        return f"python -m cmc train {self.study}; python -m cmc ship {self.study} FOLDER"


CHOICES = """Choices of ours stand behind several rows. In peg touch commands are held for 10 ms,
and T_y departs from appendix F (it undoes the slope of the surface). On peg push the planner's
discount is .9, the paper's .5, and the paper does not say what its low-level critic sees."""
DISCOUNT = "the planner's discount is .9, the paper's .5"
LEARNED = "the one rule of *has learned* (above)"
BESIDE = "no: the rival has learned; yes: it has not, while C-TD3 has after as many steps"
CLAIMS: tuple[Claim, ...] = (
    Claim(
        "peg_touch",
        "PPO and C-PPO learn with similar return (fig. 1a)",
        "similar",
        "at episodes 5000 and 15,000 the means differ by at most a tenth",
        verdicts.similar_return,
    ),
    Claim(
        "peg_touch",
        "... and with similar data efficiency (fig. 1a)",
        "similar",
        "episodes to a training return of -15 differ by at most a factor of 2 (median seed)",
        verdicts.similar_efficiency,
    ),
    Claim(
        "peg_touch",
        "PPO's share of oscillation and drift grows with learning (fig. 1b), on C-PPO's inputs",
        "grows",
        "last minus first kept policy from episode 5000 on: the interval is above 0",
        lambda: verdicts.share_grows("ppo"),
    ),
    Claim(
        "peg_touch",
        "... PPO on raw inputs",
        "grows",
        "as above",
        lambda: verdicts.share_grows("ppo_raw"),
    ),
    Claim(
        "peg_touch",
        "C-PPO's share remains zero (fig. 1b)",
        "0",
        "0 in every seed at every kept policy from episode 5000 on",
        verdicts.stays_zero,
    ),
    Claim(
        "peg_touch",
        "... and of C-PPO with slopes below the sampled-data bound",
        "-",
        "as above",
        lambda: verdicts.stays_zero("cppo_capped"),
    ),
    Claim(
        "peg_touch",
        "... at a control period of 2 ms, trained and tested: C-PPO's share remains zero",
        "0",
        "as above",
        lambda: verdicts.stays_zero("cppo", "peg_touch_2ms"),
    ),
    Claim(
        "peg_touch",
        "... and the share of PPO on raw inputs grows",
        "grows",
        "last minus first kept policy from episode 5000 on: the interval is above 0",
        lambda: verdicts.share_grows("ppo_raw", "peg_touch_2ms"),
    ),
    Claim(
        "peg_touch",
        "Under shifts C-PPO's tracking errors at episode 5000 are dramatically smaller (fig. 1c), "
        "on equal inputs",
        "dramatic",
        "the median force error is at least 10 times smaller under every shift",
        lambda: verdicts.smaller_errors("ppo"),
    ),
    Claim(
        "peg_touch",
        "... against PPO on raw inputs",
        "dramatic",
        "as above",
        lambda: verdicts.smaller_errors("ppo_raw"),
    ),
    Claim(
        "peg_touch",
        "The constraints lose some optimality (V-C)",
        "no figure",
        "the interval of the difference in return lies below 0",
        verdicts.caps_cost,
    ),
    Claim(
        "peg_maze",
        "TD3/C-TD3 finds the path with a high success rate (VII-A), our scheme",
        "high, about 1M steps",
        LEARNED,
        lambda: verdicts.learns("peg_maze", "ctd3", 1_000_000),
    ),
    Claim(
        "peg_maze",
        "... with our reading of the paper's scheme",
        "high, about 1M steps",
        LEARNED,
        lambda: verdicts.learns("peg_maze", "ctd3_paper", 1_000_000),
    ),
    Claim(
        "peg_maze",
        "HIRO finds the path with a high success rate (VII-A)",
        "high, about 2M steps",
        LEARNED,
        lambda: verdicts.learns("peg_maze", "hiro", 2_300_000),
    ),
    Claim(
        "peg_maze",
        "TD3/C-TD3 explores with soft touches (VII-A)",
        "99.93 % of the steps below 1 N, 64.24 % without contact",
        "at least 99 % of the ticks of all kept policies below 1 N",
        verdicts.soft_touches,
    ),
    Claim(
        "peg_maze",
        "HIRO's touches are harder (VII-A)",
        "65.88 % below 1 N",
        "with equal pegs, C-TD3 has at least 10 points more ticks below 1 N, once HIRO has learned",
        verdicts.softer_than_hiro,
    ),
    Claim(
        "peg_push",
        "TD3/C-TD3 learns the task (VII-B), our scheme",
        "[-400, -200], 2 of 5 seeds after 3M steps",
        LEARNED,
        lambda: verdicts.learns("peg_push", "ctd3", 3_000_000, DISCOUNT),
    ),
    Claim(
        "peg_push",
        "... with the paper's scheme as we read it",
        "[-400, -200], 2 of 5 seeds after 3M steps",
        LEARNED,
        lambda: verdicts.learns("peg_push", "ctd3_paper", 3_000_000),
    ),
    Claim(
        "peg_push",
        "TD3/Control fails: it has not figured out the entire path (VII-B)",
        "-700 after 12M steps",
        BESIDE,
        lambda: verdicts.fails_beside("control"),
    ),
    Claim(
        "peg_push",
        "PPO/Control fails: it has not figured out the entire path (VII-B)",
        "-700 after 12M steps",
        BESIDE,
        lambda: verdicts.fails_beside("ppo_control"),
    ),
    Claim(
        "peg_push",
        "TD3/TD3 fails (VII-B)",
        "-700 after 12M steps",
        BESIDE,
        lambda: verdicts.fails_beside("td3"),
    ),
    Claim(
        "peg_push",
        "... TD3/TD3 with a critic that sees the full state",
        "-",
        BESIDE,
        lambda: verdicts.fails_beside("td3_corrected"),
    ),
    Claim(
        "peg_push",
        "TD3/TD3's trajectories pass by the goal (VII-B)",
        "pictures",
        "at least 10 % of the episodes come within 1 mm and end farther than 2 mm",
        verdicts.passes_by,
    ),
    Claim(
        "peg_push",
        "Soft contact may highly simplify the task (VII-B, a question)",
        "open",
        "learned under 6.25 times stiffer contact: the interval of the loss is beyond 20 points "
        "(yes), or within (no)",
        verdicts.softness_simplifies,
    ),
)

COMPARISONS: dict[str, tuple[tuple[str, str, str], ...]] = {
    study: tuple(
        ("ctd3", other, "success") for other in ("frozen", "gain", "td3_corrected", "control")
    )
    for study in ("peg_maze", "peg_push")
}
"""What each part buys, named before the runs: C-TD3 against four arms on each task."""


# -- the page -----------------------------------------------------------------


def rows() -> list[tuple[Claim, Answer]]:
    """Every claim and its answer."""
    return [(claim, claim.judge()) for claim in CLAIMS]


def named(study: str) -> pd.DataFrame:
    """The named comparisons of a task whose arms are there, with Holm's correction."""
    data = at(table(study))
    there = set(data["method"])
    return compare(data, [c for c in COMPARISONS[study] if {c[0], c[1]} <= there])


def page() -> str:
    """The page in Markdown."""
    rules = (__doc__ or "").split("\n\n", 1)[1]
    lines = ["# The paper, claim by claim", "", _escaped(rules), _escaped(CHOICES), ""]
    found = rows()
    for study in dict.fromkeys(claim.study for claim in CLAIMS):
        lines += [f"## {study.replace('_', ' ').capitalize()}", ""]
        lines += ["| the paper says | its figure | here, mean over seeds [95 %] | rule | verdict |"]
        lines += ["|---|---|---|---|---|"]
        own = [(claim, answer) for claim, answer in found if claim.study == study]
        for claim, answer in own:
            here = answer.ours + (f". {answer.because}" if answer.because else "")
            cells = (claim.text, claim.paper, here, claim.rule, f"**{answer.verdict}**")
            lines.append("| " + " | ".join(_escaped(cell) for cell in cells) + " |")
        lines += ["", f"Tables are made by `{own[0][0].command}`.", ""]
        if study in COMPARISONS:
            lines += ["What each part buys: success of C-TD3 minus that of", ""]
            lines += [
                "| arm | difference, points [95 %] | p, exact | p, Holm |",
                "|---|---|---|---|",
            ]
            for (_, other, _), row in named(study).iterrows():
                gap, low, high = (100 * row[key] for key in ("difference", "low", "high"))
                p = f"{row['p']:.3f} | {row['p_holm']:.3f}"
                lines.append(f"| {other} | {gap:+.0f} [{low:.0f}, {high:.0f}] | {p} |")
            lines.append("")
    counts = pd.Series([answer.verdict for _, answer in found]).value_counts()
    total = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    return "\n".join([*lines, f"In all: {total}.", ""])


def _escaped(text: str) -> str:
    return text.replace("T_y", "$T_y$").replace("tau_z", r"$\tau_z$")


def main() -> None:
    """Write the page into the site's sources."""
    path = Path("site") / "claims.md"
    if not path.parent.is_dir():
        raise SystemExit("wanted to be started in the repository, beside its folder `site`")
    path.write_text(page(), encoding="utf-8")
    print(path)


if __name__ == "__main__":
    main()
