"""The page of claims is current, its numbers are the tables', its rules treat all arms alike."""

from __future__ import annotations

import csv
import importlib
import itertools
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cmc import store

SITE = Path(__file__).resolve().parent.parent / "site"
sys.path.append(str(SITE))
rules: Any = importlib.import_module("claim_rules")
claims: Any = importlib.import_module("claims")
HOLDS, FAILS, OPEN, SHORT = rules.HOLDS, rules.FAILS, rules.OPEN, rules.SHORT
FOUND = claims.answers()


def raw(study: str, method: str, **wanted: str) -> list[dict[str, str]]:
    """Rows of a table, read without pandas."""
    path = store.asset("results", f"{study}.csv")
    with path.open() as file:
        file.readline()
        rows = [row for row in csv.DictReader(file) if row["method"] == method]
    wanted = {"test": "nominal", **wanted}
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def by_seed(study: str, method: str, key: str) -> list[float]:
    return [float(row[key]) for row in raw(study, method, last="True")]


def numbers(text: str) -> list[float]:
    return [float(x.replace(",", "")) for x in re.findall(r"-?\d[\d,]*\.?\d*(?:e[+-]\d+)?", text)]


def test_the_page_is_current_and_has_a_rule_and_a_verdict_for_every_claim() -> None:
    page = claims.page()
    assert claims.PAGE.read_text(encoding="utf-8") == page, "run make claims"
    for text, figure, rule, _ in (row for rows in claims.CLAIMS.values() for row in rows):
        assert text
        assert figure
        assert rule
        assert FOUND[text].verdict in (HOLDS, FAILS, OPEN, SHORT)
    assert len(FOUND) == sum(map(len, claims.CLAIMS.values()))
    for study in claims.CLAIMS:
        assert f"`python -m cmc train {study}; python -m cmc ship {study} FOLDER`" in page


FAILED = "fails: it has not figured out the entire path (VII-B)"
LEARNING = {
    "TD3/C-TD3 finds the path with a high success rate (VII-A), our scheme": ("peg_maze", "ctd3"),
    "HIRO finds the path with a high success rate (VII-A)": ("peg_maze", "hiro"),
    "TD3/C-TD3 learns the task (VII-B), our scheme": ("peg_push", "ctd3"),
    f"TD3/Control {FAILED}": ("peg_push", "control"),
    f"PPO/Control {FAILED}": ("peg_push", "ppo_control"),
    "TD3/TD3 fails (VII-B)": ("peg_push", "td3"),
}


@pytest.mark.parametrize("text", LEARNING)
def test_success_and_return_are_those_of_the_table_over_seeds(text: str) -> None:
    ours, (study, name) = FOUND[text].ours, LEARNING[text]
    success, returns = (by_seed(study, name, key) for key in ("success", "return"))
    for part, values in (
        (ours.split(", return")[0], [100 * value for value in success]),
        (ours.split("return")[1].split(", ")[0], returns),
    ):
        found = numbers(part)
        assert found[0] == pytest.approx(np.mean(values), rel=5e-3, abs=1e-9)
        if len(found) > 1 and len(values) == 5:
            drawn = [np.mean(x) for x in itertools.product(values, repeat=5)]
            width = max(values) - min(values)
            close = 0.04 * width + 5e-3 * abs(found[1])
            assert found[1] == pytest.approx(np.quantile(drawn, 0.025), abs=close)
    lowest = -400.0 if study == "peg_push" else -np.inf
    learned = sum(s >= 0.5 and r >= lowest for s, r in zip(success, returns, strict=True))
    assert f"{learned} of {len(success)} seeds have learned" in ours
    steps = max(int(row["step"]) for row in raw(study, name))
    assert f"{steps:,} steps" in ours


def test_shares_of_instability_are_those_of_the_table() -> None:
    answers = {
        "cppo": FOUND["C-PPO's share remains zero (fig. 1b)"],
        "cppo_capped": FOUND["... and of C-PPO with slopes below the sampled-data bound"],
    }
    for name, answer in answers.items():
        rows = [r for r in raw("peg_touch", name, h="0.01") if int(r["episode"]) >= 5000]
        worst = 100 * max(float(row["oscillation"]) for row in rows)
        assert f"oscillation at most {worst:.1f} %" in answer.ours
        zero = worst == 0 and all(float(row["drift"]) == 0 for row in rows)
        assert answer.verdict == (HOLDS if zero else FAILS)
    ends = {
        mark: 100 * np.mean([float(r["oscillation"]) + float(r["drift"]) for r in rows])
        for mark in (5000, 15_000)
        if (rows := raw("peg_touch", "ppo_raw", h="0.01", episode=str(mark)))
    }
    ours = FOUND["... PPO on raw inputs"].ours
    assert f"{ends[5000]:.2f} % at episode 5,000, {ends[15_000]:.2f} % at 15,000" in ours


def test_ratios_of_errors_are_those_of_the_table() -> None:
    answer = FOUND["... against PPO on raw inputs"]
    for shift in ("lags x 0.5", "stiffness x 2", "all, fast"):
        medians = {
            name: np.median(
                [float(r["error_f"]) for r in raw("peg_touch", name, test=shift, episode="5000")]
            )
            for name in ("ppo_raw", "cppo")
        }
        assert f"{shift} {medians['ppo_raw'] / medians['cppo']:,.3g}" in answer.ours


# -- the rules, on tables made up ------------------------------------------------------------------


def arms(**found: tuple[list[float], float, int]) -> pd.DataFrame:
    """A table of peg push: success by seed, return, steps."""
    same = {"test": "nominal", "last": True, "study": "peg_push"}
    return pd.DataFrame(
        [
            same | {"method": name, "step": steps, "seed": k, "success": s, "return": value}
            for name, (success, value, steps) in found.items()
            for k, s in enumerate(success)
        ]
    )


GOOD, BAD = [0.9] * 5, [0.1] * 5


@pytest.mark.parametrize(
    ("table", "control", "ctd3"),
    [
        (arms(ctd3=(GOOD, -50, 300), control=(BAD, -600, 300)), HOLDS, HOLDS),
        (arms(ctd3=(GOOD, -50, 300), control=(GOOD, -60, 300)), FAILS, HOLDS),
        (arms(ctd3=(BAD, -600, 300), control=(BAD, -600, 300)), SHORT, SHORT),
        (arms(ctd3=(BAD, -600, 9_000_000), control=(BAD, -600, 300)), SHORT, FAILS),
        # a return in the band without a touch is not learned, whoever has it
        (arms(ctd3=(GOOD, -50, 300), control=([0.0] * 5, -320, 300)), HOLDS, HOLDS),
        (arms(ctd3=([0.0] * 5, -320, 300), control=(BAD, -600, 300)), SHORT, SHORT),
        # touches with a return below the band are not either
        (arms(ctd3=(GOOD, -600, 300), control=(BAD, -600, 300)), SHORT, SHORT),
        # two seeds in five are enough, one is not
        (arms(ctd3=([1, 1, 0, 0, 0], -50, 300), control=([1, 0, 0, 0, 0], -50, 300)), HOLDS, HOLDS),
        # C-TD3 counts only up to the rival's length
        (arms(ctd3=(GOOD, -50, 900), control=(BAD, -600, 300)), SHORT, HOLDS),
    ],
)  # fmt: skip
def test_one_rule_for_all_arms(monkeypatch, table, control, ctd3) -> None:
    monkeypatch.setattr(rules, "table", lambda study: table)
    assert claims.fails_beside("control").verdict == control
    assert claims.learns("peg_push", "ctd3", 3_000_000).verdict == ctd3


def test_comparisons_are_few_and_corrected() -> None:
    for study in ("peg_maze", "peg_push"):
        found = claims.named(study)
        assert 1 <= len(found) == len(claims.COMPARED[study]) <= 6
        assert (found["p_holm"] >= found["p"]).all()
