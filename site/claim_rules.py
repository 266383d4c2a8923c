"""Rules by which a claim of the paper holds, does not, stays open, or is not testable.

`make claims` writes the page `site/claims.md` from the shipped tables. Rules come before results
and are the same for every arm:

- a seed *has learned* a task if the strict goal holds at the last tick in at least half of its test
  episodes (on peg push its return must also be above the lower end of the paper's band); an arm has
  if at least two in five of its seeds have. A return in the band without any touch is not learned;
- an arm that has not learned says nothing about what it would do once it has, nor beyond the length
  of its training: *not testable at this length*;
- that a rival *fails* is a statement beside C-TD3: it holds if the rival has not learned after as
  many steps as C-TD3 had;
- intervals are bootstraps over seeds, 95 %; a difference whose interval holds 0 leaves a claim
  *open*.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import pandas as pd

from cmc.results import at, compare, share, spread, tidy

HOLDS, FAILS, OPEN = "holds", "does not hold", "open"
SHORT = "not testable at this length"
BAND = {"peg_push": -400.0}
"""Lowest return of the paper's band, [-400, -200]."""


class Answer(NamedTuple):
    """What we found: the figure with its interval, the verdict, and what decides it."""

    ours: str
    verdict: str
    because: str = ""


# -- figures ------------------------------------------------------------------


@cache
def table(study: str) -> pd.DataFrame:
    """A study's table of tests."""
    return tidy(study).assign(study=study)


def arm(study: str, name: str) -> pd.DataFrame:
    """The last policies of a method in the nominal test, a row for each seed."""
    return at(table(study)).query("method == @name")


def said(data: pd.DataFrame, key: str, percent: bool = False, digits: int = 3) -> str:
    """Mean over seeds [interval], of data of one method; no interval where all seeds are alike."""
    row = (share if percent else spread)(data, key).iloc[0]
    mean, low, high = (f"{row[name]:.{digits}g}" for name in ("mean", "low", "high"))
    return f"{mean}{' %' if percent else ''}" + (f" [{low}, {high}]" if low != high else "")


def seeds_learned(data: pd.DataFrame) -> int:
    """How many seeds have learned, by the one rule."""
    lowest = data["study"].map(BAND).fillna(float("-inf"))
    return int(((data["success"] >= 0.5) & (data["return"] >= lowest)).sum())


def has_learned(data: pd.DataFrame) -> bool:
    """Whether at least two in five seeds have learned."""
    return seeds_learned(data) >= 0.4 * len(data)


def in_words(data: pd.DataFrame) -> str:
    """Success, return and length of an arm's last policies."""
    return (
        f"success {said(data, 'success', True)}, return {said(data, 'return')}, "
        f"{seeds_learned(data)} of {len(data)} seeds have learned, {data['step'].max():,} steps"
    )


def difference(data: pd.DataFrame, one: str, other: str, key: str) -> tuple[float, float, float]:
    """One method's mean minus another's, and the ends of its interval."""
    return tuple(compare(data, [(one, other, key)]).iloc[0][["difference", "low", "high"]])


# -- peg touch ----------------------------------------------------------------


def similar_return() -> Answer:
    """Both marks of the paper's test."""
    parts, close = [], []
    for mark in (5000, 15_000):
        data = at(table("peg_touch"), mark)
        gap, low, high = difference(data, "cppo", "ppo", "return")
        base = data.loc[data["method"] == "ppo", "return"].mean()
        close.append(abs(gap) <= 0.1 * abs(base))
        ends = f"[{low:.2f}, {high:.2f}]"
        parts.append(f"episode {mark:,}: PPO {base:.2f}, C-PPO minus PPO {gap:+.2f} {ends}")
    return Answer("; ".join(parts), HOLDS if all(close) else FAILS)


def similar_efficiency() -> Answer:
    """Episodes of each seed until its training return is above -15 once."""
    curves = tidy("peg_touch", "curves").query("`return` >= -15")
    reached = curves.groupby(["method", "seed"])["episode"].min()
    ppo, cppo = (reached[name].median() for name in ("ppo", "cppo"))
    text = f"median episode PPO {ppo:.0f}, C-PPO {cppo:.0f}"
    return Answer(text, HOLDS if 0.5 <= cppo / ppo <= 2.0 else FAILS)


def unstable(name: str, study: str) -> pd.DataFrame:
    """Share that oscillates or drifts, from episode 5000 on, at the training's control period."""
    data = table(study).query("test == 'nominal' and method == @name and episode >= 5000")
    data = data[data["h"] == data["h"].mode()[0]]
    return data.assign(unstable=data["oscillation"] + data["drift"])


def share_grows(name: str, study: str = "peg_touch") -> Answer:
    """Last minus first kept policy of each seed."""
    data = unstable(name, study).pivot(index="seed", columns="episode", values="unstable")
    grown = (data.iloc[:, -1] - data.iloc[:, 0]).rename("x").reset_index().assign(method=name)
    row, (first, *_, last) = share(grown, "x").iloc[0], 100 * data.mean()
    begin, *_, end = data.columns
    text = (
        f"{first:.2f} % at episode {begin:,}, {last:.2f} % at {end:,}: "
        f"{row['mean']:+.2f} points [{row['low']:.2f}, {row['high']:.2f}]"
    )
    return Answer(text, HOLDS if row["low"] > 0 else FAILS if row["high"] <= 0 else OPEN)


def stays_zero(name: str, study: str = "peg_touch") -> Answer:
    """Largest share of any seed at any kept policy from episode 5000 on."""
    data, because = unstable(name, study), ""
    worst = data.loc[data["oscillation"].idxmax()]
    text = (
        f"drift at most {100 * data['drift'].max():.1f} %, oscillation at most "
        f"{100 * worst['oscillation']:.1f} % (seed {worst['seed']}, episode {worst['episode']:,})"
    )
    if study == "peg_touch":
        fast = at(table(study), 5000, h=0.002).query("method == @name")
        because = (
            "the control period is ours, 10 ms, as long as the lag tau_z: at 2 ms the policies of "
            f"episode 5,000 oscillate in {100 * fast['oscillation'].max():.1f} % of the tests"
        )
    verdict = HOLDS if data["unstable"].max() == 0.0 else FAILS
    if study == "peg_touch_2ms" and (again := unstable(name, f"{study}_10000")["unstable"].max()):
        because = f"another run of the same seeds, 10,000 episodes: at most {100 * again:.1f} %"
        verdict = OPEN if verdict == HOLDS else verdict
    return Answer(text, verdict, because)


def smaller_errors(other: str) -> Answer:
    """Median force errors at episode 5000 under each shift."""
    ratios = {}
    for shift in table("peg_touch")["test"].unique():
        error = at(table("peg_touch"), 5000, test=shift).groupby("method")["error_f"].median()
        ratios[shift] = error[other] / error["cppo"]
    del ratios["nominal"]
    found = ", ".join(f"{name} {ratio:,.3g}" for name, ratio in ratios.items())
    fast = at(table("peg_touch"), 5000, test="lags x 0.5").query("method == 'cppo'")
    because = (
        f"with lags halved C-PPO itself oscillates in {said(fast, 'oscillation', True)} of the "
        "tests at our period of 10 ms"
    )
    verdict = HOLDS if min(ratios.values()) >= 10.0 else FAILS
    return Answer(f"error of PPO over that of C-PPO: {found}", verdict, because)


def caps_cost() -> Answer:
    """Return of the capped arm minus that of the free one, last policies."""
    gap, low, high = difference(at(table("peg_touch")), "cppo_capped", "cppo", "return")
    text = f"C-PPO capped minus C-PPO: {gap:+.2f} [{low:.2f}, {high:.2f}]"
    return Answer(text, HOLDS if high < 0 else FAILS if low > 0 else OPEN)


# -- the two Panda tasks ------------------------------------------------------


def learns(study: str, name: str, paper_steps: int, note: str = "") -> Answer:
    """An arm that the paper says learns."""
    data = arm(study, name)
    short = SHORT if data["step"].max() < paper_steps else FAILS
    return Answer(in_words(data), HOLDS if has_learned(data) else short, note)


def fails_beside(name: str, study: str = "peg_push", note: str = "") -> Answer:
    """A rival that the paper says does not learn, beside C-TD3 after as many steps."""
    rival = arm(study, name)
    if has_learned(rival):
        return Answer(in_words(rival), FAILS, note)
    ours = table(study).query("method == 'ctd3' and test == 'nominal'")
    ours = ours[ours["step"] <= rival["step"].max()]
    ours = ours[ours["step"] == ours["step"].max()]
    if ours.empty or not has_learned(ours):
        because = "C-TD3 has not learned either after as many steps"
        return Answer(in_words(rival), SHORT, because)
    because = f"C-TD3 after {ours['step'].max():,} steps: success {said(ours, 'success', True)}"
    because += f"; {note}" if note else ""
    return Answer(in_words(rival), HOLDS, because)


def soft_touches() -> Answer:
    """Shares over all kept policies, as the paper counts them, at each tick's largest force."""
    data = table("peg_maze").query("method == 'ctd3' and test == 'nominal'")
    mean = data.groupby(["method", "seed"])[["below_1_N", "no_contact"]].mean().reset_index()
    text = f"{said(mean, 'below_1_N', True, 4)}, no contact {said(mean, 'no_contact', True)}"
    verdict = HOLDS if mean["below_1_N"].mean() >= 0.99 else FAILS
    rigid = table("peg_maze_stiff").query("method == 'ctd3' and test == 'nominal'")
    because = (
        "our soft regime, a compliant peg and limited pull, in which every arm is as soft; with a "
        f"rigid peg {100 * rigid['below_1_N'].mean():.1f} %"
    )
    return Answer(text, verdict, because)


def softer_than_hiro() -> Answer:
    """HIRO has a rigid peg here: it is compared with a rigid one."""
    hiro, rigid = arm("peg_maze", "hiro"), arm("peg_maze_stiff", "ctd3")
    text = (
        f"below 1 N, both with a rigid peg: C-TD3 {said(rigid, 'below_1_N', True)}, "
        f"HIRO {said(hiro, 'below_1_N', True)}"
    )
    if not has_learned(hiro):
        because = f"HIRO: {in_words(hiro)}; it has not found the path yet"
        return Answer(text, SHORT, because)
    gap = rigid["below_1_N"].mean() - hiro["below_1_N"].mean()
    return Answer(text, HOLDS if gap >= 0.1 else FAILS)


def passes_by() -> Answer:
    """Episodes of TD3/TD3 that come within 1 mm and end farther than 2 mm."""
    data = tidy("peg_push", "episodes").query("method == 'td3'")
    near, far = data["nearest_mm"], data["final_mm"]
    passing = 100 * float(((near < 1.0) & (far > 2.0)).mean())
    median = float(data.groupby("seed")["nearest_mm"].median().median())
    text = f"{passing:.1f} % of the episodes; median of the nearest distance {median:.1f} mm"
    if passing >= 10.0 or median <= 5.0:
        return Answer(text, HOLDS if passing >= 10.0 else FAILS)
    return Answer(text, SHORT, "it does not come near the target")


def softness_simplifies() -> Answer:
    """C-TD3 learned under contact 6.25 times as stiff, beside the paper's."""
    stiff = arm("peg_push_contact_x0.4", "ctd3").assign(method="stiff")
    data = pd.concat([arm("peg_push", "ctd3"), stiff])
    gap, low, high = (100 * part for part in difference(data, "stiff", "ctd3", "success"))
    text = f"success under stiff contact {gap:+.0f} [{low:+.0f}, {high:+.0f}] points"
    verdict = HOLDS if high < -20 else FAILS if low > -20 else OPEN
    because = "the sliders weigh .5 kg here, so that nothing is pressed through; no other was tried"
    return Answer(text, verdict, because)
