"""Verdicts on the paper's claims, computed from the shipped tables; `claims` has the rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

import pandas as pd

from cmc.results import at, compare, share, spread, tidy

Verdict = Literal["holds", "does not hold", "open", "not testable at this length"]
HOLDS: Final = "holds"
FAILS: Final = "does not hold"
OPEN: Final = "open"
SHORT: Final = "not testable at this length"
EARLIER = {"peg_maze": "peg_maze_tuned", "peg_push": "peg_push_half"}
"""Studies of earlier runs, for arms that were not run again."""
BAND = {"peg_push": -400.0, "peg_push_half": -400.0}
"""Lowest return of the paper's band, [-400, -200]."""


@dataclass(frozen=True)
class Answer:
    """What we found: the figure with its interval, the verdict, and what decides it."""

    ours: str
    verdict: Verdict
    because: str = ""


# -- figures -----------------------------------------------------------------


@cache
def table(study: str) -> pd.DataFrame:
    """A study's table of tests."""
    return tidy(study).assign(study=study)


def arm(study: str, name: str) -> pd.DataFrame:
    """The last policies of a method in the nominal test, a row for each seed."""
    data = at(table(study))
    return data[data["method"] == name]


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


def length(data: pd.DataFrame) -> str:
    """How long the arm was trained."""
    return f"{data['step'].max():,} steps"


def in_words(data: pd.DataFrame) -> str:
    """Success, return and length of an arm's last policies."""
    return (
        f"success {said(data, 'success', True)}, return {said(data, 'return')}, "
        f"{seeds_learned(data)} of {len(data)} seeds have learned, {length(data)}"
    )


def difference(data: pd.DataFrame, one: str, other: str, key: str) -> pd.Series:
    """One method's mean minus another's, with interval and exact p."""
    return compare(data, [(one, other, key)]).iloc[0]


# -- peg touch -----------------------------------------------------------------


def similar_return() -> Answer:
    """Both marks of the paper's test."""
    parts, close = [], []
    for mark in (5000, 15_000):
        data = at(table("peg_touch"), mark)
        found = difference(data, "cppo", "ppo", "return")
        base = data.loc[data["method"] == "ppo", "return"].mean()
        close.append(abs(found["difference"]) <= 0.1 * abs(base))
        parts.append(
            f"episode {mark:,}: PPO {base:.2f}, C-PPO minus PPO {found['difference']:+.2f} "
            f"[{found['low']:.2f}, {found['high']:.2f}]"
        )
    return Answer("; ".join(parts), HOLDS if all(close) else FAILS)


def similar_efficiency() -> Answer:
    """Episodes of each seed until its training return stays above -15 once."""
    curves = tidy("peg_touch", "curves")
    reached = curves[curves["return"] >= -15.0].groupby(["method", "seed"])["episode"].min()
    first = {name: reached[name].median() for name in ("ppo", "cppo")}
    ratio = first["cppo"] / first["ppo"]
    text = f"median episode PPO {first['ppo']:.0f}, C-PPO {first['cppo']:.0f}"
    return Answer(text, HOLDS if 0.5 <= ratio <= 2.0 else FAILS)


def there(study: str) -> bool:
    """Whether a study's table is shipped."""
    try:
        return not table(study).empty
    except ValueError:
        return False


def unstable(name: str, study: str = "peg_touch") -> pd.DataFrame:
    """Share that oscillates or drifts, from episode 5000 on, at the training's control period."""
    data = table(study)
    data = data[(data["test"] == "nominal") & (data["method"] == name)]
    data = data[(data["episode"] >= 5000) & (data["h"] == data["h"].mode()[0])]
    return data.assign(unstable=data["oscillation"] + data["drift"])


def share_grows(name: str, study: str = "peg_touch") -> Answer:
    """Last minus first kept policy of each seed."""
    if not there(study):
        return Answer("not run", OPEN)
    data = unstable(name, study).pivot_table(index="seed", columns="episode", values="unstable")
    grown = pd.DataFrame({"method": name, "seed": data.index, "x": data.iloc[:, -1].to_numpy()})
    grown["x"] -= data.iloc[:, 0].to_numpy()
    row = share(grown, "x").iloc[0]
    first, last = 100 * data.iloc[:, 0].mean(), 100 * data.iloc[:, -1].mean()
    text = (
        f"{first:.2f} % at episode {data.columns[0]:,}, {last:.2f} % at {data.columns[-1]:,}: "
        f"{row['mean']:+.2f} points [{row['low']:.2f}, {row['high']:.2f}]"
    )
    verdict: Verdict = HOLDS if row["low"] > 0 else FAILS if row["mean"] < 1.0 else OPEN
    return Answer(text, verdict)


def stays_zero(name: str = "cppo", study: str = "peg_touch") -> Answer:
    """Largest share of any seed at any kept policy from episode 5000 on."""
    if not there(study):
        return Answer("not run", OPEN)
    data = unstable(name, study)
    worst = data.loc[data["oscillation"].idxmax()]
    fast = at(table(study), 5000, h=0.002)
    fast = fast[fast["method"] == name]
    text = (
        f"drift at most {100 * data['drift'].max():.1f} %, oscillation at most "
        f"{100 * worst['oscillation']:.1f} % (seed {worst['seed']}, episode {worst['episode']:,})"
    )
    because = ""
    if not fast.empty and study == "peg_touch":
        because = (
            "the control period is ours, 10 ms, as long as the lag tau_z: at 2 ms the policies of "
            f"episode 5,000 oscillate in {100 * fast['oscillation'].max():.1f} % of the tests"
        )
    zero = data["unstable"].max() == 0.0
    return Answer(text, HOLDS if zero else FAILS, because)


def smaller_errors(other: str) -> Answer:
    """Median force errors at episode 5000 under each shift."""
    ratios = {}
    for shift in table("peg_touch")["test"].unique():
        data = at(table("peg_touch"), 5000, test=shift)
        error = data.groupby("method")["error_f"].median()
        ratios[shift] = error[other] / error["cppo"]
    shifts = {name: ratio for name, ratio in ratios.items() if name != "nominal"}
    text = "error of PPO over that of C-PPO: " + ", ".join(
        f"{name} {ratio:,.3g}" for name, ratio in shifts.items()
    )
    held = [ratio >= 10.0 for ratio in shifts.values()]
    fast = at(table("peg_touch"), 5000, test="lags x 0.5")
    fast = fast[fast["method"] == "cppo"]
    because = (
        f"with lags halved C-PPO itself oscillates in {said(fast, 'oscillation', True)} of the "
        "tests at our period of 10 ms"
    )
    return Answer(text, HOLDS if all(held) else FAILS, because)


def caps_cost() -> Answer:
    """Return of the capped arm minus that of the free one, last policies."""
    found = difference(at(table("peg_touch")), "cppo_capped", "cppo", "return")
    low, high = found["low"], found["high"]
    text = f"C-PPO capped minus C-PPO: {found['difference']:+.2f} [{low:.2f}, {high:.2f}]"
    return Answer(text, HOLDS if high < 0 else FAILS if low > 0 else OPEN)


# -- the two Panda tasks -----------------------------------------------------------------


def learns(study: str, name: str, paper_steps: int, note: str = "") -> Answer:
    """An arm that the paper says learns."""
    data = arm(study, name)
    if data.empty:
        data, note = arm(EARLIER[study], name), "with an earlier planner"
    if data.empty:
        return Answer("not run", OPEN)
    if has_learned(data):
        return Answer(in_words(data), HOLDS, note)
    short = data["step"].max() < paper_steps
    return Answer(in_words(data), SHORT if short else FAILS, note)


def fails_beside(name: str, study: str = "peg_push") -> Answer:
    """A rival that the paper says does not learn, beside C-TD3 after as many steps."""
    rival, ours = arm(study, name), table(study)
    if rival.empty:
        earlier = arm(EARLIER[study], name)
        because = "not run with the planner of C-TD3; this is an earlier planner, discount .5"
        return Answer("not run" if earlier.empty else in_words(earlier), OPEN, because)
    if has_learned(rival):
        return Answer(in_words(rival), FAILS)
    ours = ours[(ours["method"] == "ctd3") & (ours["test"] == "nominal")]
    ours = ours[ours["step"] <= rival["step"].max()]
    ours = ours[ours["step"] == ours["step"].max()]
    if ours.empty or not has_learned(ours):
        because = "C-TD3 has not learned either after as many steps"
        return Answer(in_words(rival), SHORT, because)
    because = f"C-TD3 after {length(ours)}: success {said(ours, 'success', True)}"
    return Answer(in_words(rival), HOLDS, because)


def soft_touches() -> Answer:
    """Shares over all kept policies, as the paper counts them, at each tick's largest force."""
    data = table("peg_maze")
    data = data[(data["method"] == "ctd3") & (data["test"] == "nominal")]
    mean = data.groupby(["method", "seed"])[["below_1_N", "no_contact"]].mean().reset_index()
    text = f"{said(mean, 'below_1_N', True, 4)}, no contact {said(mean, 'no_contact', True)}"
    soft = mean["below_1_N"].mean() >= 0.99
    return Answer(text, HOLDS if soft else FAILS, "our soft regime: a compliant peg, limited pull")


def softer_than_hiro() -> Answer:
    """HIRO has a rigid peg here: it is compared with a rigid one."""
    hiro, rigid = arm("peg_maze", "hiro"), arm("peg_maze_stiff", "ctd3")
    if hiro.empty or rigid.empty:
        return Answer("not run", OPEN)
    text = (
        f"below 1 N, both with a rigid peg: C-TD3 {said(rigid, 'below_1_N', True)}, "
        f"HIRO {said(hiro, 'below_1_N', True)}"
    )
    if not has_learned(hiro):
        because = f"HIRO: {in_words(hiro)}; most of its ticks are far from any wall"
        return Answer(text, SHORT, because)
    gap = rigid["below_1_N"].mean() - hiro["below_1_N"].mean()
    return Answer(text, HOLDS if gap >= 0.1 else FAILS)


def passes_by() -> Answer:
    """Episodes of TD3/TD3 that come within 1 mm and end farther than 2 mm."""
    study = "peg_push" if not arm("peg_push", "td3").empty else "peg_push_half"
    data = tidy(study, "episodes")
    data = data[data["method"] == "td3"]
    if data.empty:
        return Answer("not run", OPEN)
    near, far = data["nearest_mm"], data["final_mm"]
    passing = 100 * float(((near < 1.0) & (far > 2.0)).mean())
    median = float(data.groupby("seed")["nearest_mm"].median().median())
    text = f"{passing:.1f} % of the episodes; median of the nearest distance {median:.1f} mm"
    if passing >= 10.0:
        return Answer(text, HOLDS)
    because = "it does not come near the target" if median > 5.0 else ""
    return Answer(text, SHORT if median > 5.0 else FAILS, because)


def softness_simplifies() -> Answer:
    """C-TD3 learned under contact 6.25 times as stiff, beside the paper's."""
    data = pd.concat(
        [arm("peg_push_half", "ctd3"), arm("peg_push_contact_x0.4", "ctd3").assign(method="stiff")]
    )
    found = difference(data, "stiff", "ctd3", "success")
    low, high = 100 * found["low"], 100 * found["high"]
    text = f"success under stiff contact {100 * found['difference']:+.0f} [{low:.0f}, {high:.0f}]"
    verdict: Verdict = HOLDS if high < -20 else FAILS if low > -20 else OPEN
    return Answer(f"{text} points", verdict, "other materials or motion were not tried")
