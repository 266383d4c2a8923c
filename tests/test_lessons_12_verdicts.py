"""Lesson 12: intervals, and verdicts on made-up results, against what they were made to say."""

import copy

import numpy as np
import pytest
from scipy import stats

from cmc.lessons import lesson_12_picked
from cmc.lessons import lesson_12_results as shipped
from cmc.lessons import lesson_12_verdicts as verdicts

# -- verdicts on made-up results -----------------------------------------------------------------


def test_intervals_are_students_and_welchs():
    rng = np.random.default_rng(0)
    a, b = rng.normal(1.0, 2.0, 5), rng.normal(0.0, 1.0, 4)
    mean, low, high = shipped.mean_interval(a)
    wanted = stats.t.interval(0.95, 4, a.mean(), stats.sem(a))
    np.testing.assert_allclose((mean, low, high), (a.mean(), *wanted))
    welch = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
    np.testing.assert_allclose(shipped.difference(a, b)[1:], (welch.low, welch.high))
    assert shipped.difference([1.0] * 5, [0.0] * 5) == (1.0, 1.0, 1.0)
    assert not np.isfinite(shipped.mean_interval([1.0])[1])
    assert not np.isfinite(shipped.difference([1.0], b)[1])


def made_up(returns, touch, *, title, step=300_000, far=0.5, seeds=5):
    """One method's answer; `returns` and `touch` are the middle of five seeds."""
    spread = np.linspace(-1, 1, seeds)
    total = (returns + 10 * spread).tolist()
    share = np.clip(touch + 0.05 * spread, 0, 1).tolist()
    force = {"zero": 0.5, "below_1_N": 0.9, "below_5_N": 0.99, "largest_N": 20.0}
    last = {
        "step": step,
        "episodes": 10,
        "success": share,
        "success_interval": [0.1, 0.9],
        "touched": share,
        "touched_interval": [0.1, 0.9],
        "return": total,
        "nearest_mm": [0.3] * seeds,
        "final_mm": [far] * seeds,
        "nearest_mm_all": [[0.3] * 10] * seeds,
        "final_mm_all": [[far + 0.01 * s] * 10 for s in range(seeds)],
        "passed_by": [0.0] * seeds,
        "penetration_mm": [0.05] * seeds,
        "force": {"at_50_hz": force, "largest": force},
        "consistency_mm": {"mean": [5.0] * seeds, "spread": [0.1] * seeds},
        "gains": {"slope": [[20.0] * 6] * seeds, "bound": [40.0] * 6, "bounded": True},
    }
    first = {**copy.deepcopy(last), "step": 100_000, "return": [-700.0] * seeds}
    curve = {"step": [100, 200], "reward": [[-0.7] * seeds, [-0.3] * seeds]}
    tests = [first, last]
    return {
        "title": title,
        "seeds": list(range(seeds)),
        "training": curve,
        "tests": tests,
        "final": last,
    }


@pytest.fixture
def results(monkeypatch):
    """Put made-up methods in place of the file."""

    def put(**found):
        for module in (shipped, verdicts, lesson_12_picked):
            monkeypatch.setattr(module, "methods", lambda: found)
        return found

    return put


def paper_like(**changes):
    """All methods as the paper reports them, with some replaced."""
    found = {
        name: made_up(-300.0 if "ctd3" in name else -700.0, 0.9 if "ctd3" in name else 0.0, title=t)
        for name, t in (
            ("ctd3", "ours"),
            ("ctd3_paper", "as-paper"),
            ("td3", "plain"),
            ("control", "none"),
            ("ppo_control", "ppo"),
        )
    }
    found["td3"] = made_up(-700.0, 0.0, title="plain", far=8.0)
    return {**found, **changes}


def test_every_claim_holds_on_results_like_the_papers(results):
    results(**paper_like())
    assert verdicts.claim_learns()[1].startswith("holds (the paper-like scheme)")
    assert verdicts.claim_others()[1] == "holds so far"
    assert verdicts.claim_only("ctd3_paper")[1] == "holds"
    assert verdicts.claim_early("ctd3_paper")[1] == "sooner than reported"
    assert verdicts.claim_passing()[1] == "holds"
    assert verdicts.claim_left_out()[1] == "not tested"


def test_every_claim_fails_on_results_unlike_the_papers(results):
    found = paper_like(
        td3=made_up(-100.0, 0.95, title="plain"), ctd3_paper=made_up(-720.0, 0.0, title="as-paper")
    )
    found["frozen"] = made_up(-90.0, 0.99, title="frozen")
    results(**found)
    assert verdicts.claim_learns()[1].startswith("does not hold so far (the paper-like scheme)")
    assert verdicts.claim_others()[1] == "does not hold: plain learned it too"
    assert verdicts.claim_only("ctd3_paper")[1] == "does not hold: another method is better"
    assert verdicts.claim_early("ctd3_paper")[1].startswith("not seen: only 300k steps")
    assert verdicts.claim_passing()[1] == "does not hold: it never does"
    assert verdicts.claim_left_out()[1] == "learned: frozen"


def test_wide_intervals_are_left_open(results):
    wide = made_up(-400.0, 0.5, title="as-paper")
    wide["final"]["return"] = [-700.0, -100.0, -650.0, -150.0, -400.0]
    wide["tests"][-1] = wide["final"]
    results(**paper_like(ctd3_paper=wide, control=wide))
    assert verdicts.claim_learns()[1].startswith("open (the paper-like scheme)")
    assert verdicts.claim_others()[1] == "open: as-paper"
    assert verdicts.claim_only("ctd3_paper")[1] == "open"


def test_a_better_return_than_the_papers_is_said(results):
    results(ctd3=made_up(-90.0, 0.9, title="ours"))
    assert verdicts.claim_learns()[1] == "holds, and better than the band (ours)"
    assert verdicts.claim_others() == ("not in the file", "not tested")
    assert verdicts.claim_only("ctd3_paper")[1] == "not tested"


@pytest.mark.parametrize(("touch", "word"), [(0.9, "helps"), (0.5, "not shown"), (0.1, "hurts")])
def test_parts_are_judged_by_their_interval(results, touch, word):
    results(ctd3=made_up(-300.0, touch, title="ours"), frozen=made_up(-300.0, 0.5, title="frozen"))
    table = verdicts.parts_table()
    assert table.count("\n| ") == 1
    cells = table.splitlines()[-1].split("|")
    assert cells[4].strip().endswith(f": **{word}**")
    assert cells[5].strip().endswith(f": **{word}**")
    assert cells[6].strip().endswith(": **not shown**")
    at_end, any_time, returns = verdicts.parts_verdict().splitlines()
    head = {"helps": "these help", "hurts": "these hurt", "not shown": ": 1 of 1"}[word]
    assert head in at_end
    assert head in any_time
    assert "these" not in returns
    assert ": 1 of 1" in returns


def test_arms_are_compared_where_both_were_tested(results):
    long = made_up(-100.0, 0.9, title="ours", step=1_000_000)
    short = made_up(-300.0, 0.5, title="plain")
    long["tests"].insert(1, {**copy.deepcopy(short["final"]), "success": [0.5] * 5})
    results(ctd3=long, td3=short)
    a, b = verdicts.common(long, short)
    assert a["step"] == b["step"] == 300_000
    assert "| 300k |" in verdicts.parts_table()
    assert "**300,000**" in shipped.method_table()  # fewer steps than another, so bold
    long["tests"] = long["tests"][-1:]
    assert verdicts.common(long, short) is None
    assert "no common step" in verdicts.parts_table()


@pytest.mark.parametrize(("touch", "deep", "words"), [(1.0, 0.1, 0), (0.5, 0.3, 3)])
def test_our_own_aim(results, touch, deep, words):
    ours = made_up(-100.0, touch, title="ours")
    ours["final"]["penetration_mm"] = [deep] * 5
    ours["final"]["success"] = ours["final"]["touched"] = [touch] * 5
    results(ctd3=ours)
    assert lesson_12_picked.aim_verdict().count("not met") == words


def test_tables_have_a_row_for_every_method_and_none_for_a_missing_file(results):
    results(**paper_like())
    for table in (shipped.method_table(), shipped.contact_table(), shipped.consistency_table()):
        assert table.count("\n| ") == 5
        assert "nan" not in table
    assert shipped.groups() == [["ctd3", "ctd3_paper"], ["td3", "control", "ppo_control"]]
    steps, returns = shipped.training(["td3"])["plain"]
    assert returns.shape == (5, steps.size)
    np.testing.assert_allclose(returns[0], [-700.0, -300.0])
    steps, share = shipped.by_checkpoint("success", ["ctd3"])["ours"]
    assert share.shape == (5, steps.size)
    assert all(near.shape == far.shape for near, far in shipped.distances(["td3"]).values())
    assert list(shipped.by_seed("return"))[0] == "ours, 300k"
    results()
    assert shipped.groups() == []
    assert shipped.method_table().count("\n| ") == 0
    assert verdicts.claims_table().count("not tested") == 8
    assert "No result" in lesson_12_picked.aim_verdict()


def test_passing_by_needs_to_come_near_and_to_leave():
    test = {
        "nearest_mm_all": [[0.5, 0.5, 1.5, 1.5]],
        "final_mm_all": [[0.5, 2.5, 1.5, 2.5]],
        "passed_by": [0.9],
    }
    assert shipped.passing(test).tolist() == [0.25]
    assert shipped.passing({"passed_by": [0.9]}).tolist() == [0.9]
    assert shipped.passing({}) is None


@pytest.mark.parametrize(
    ("touched", "depth", "met"), [(0.95, 0.1, 1), (0.85, 0.1, 0), (0.95, 0.3, 0)]
)
def test_picked_policies_are_judged_on_their_fresh_episodes(monkeypatch, touched, depth, met):
    seeds = [touched] * 4 + [0.0]
    found = {"title": "ours", "picked": [1000] * 5, "touched": seeds, "success": seeds}
    found |= {"touched_interval": [0.5, 0.9], "success_interval": [0.5, 0.9]}
    found["penetration_mm"] = [depth] * 5
    monkeypatch.setattr(lesson_12_picked, "picked", lambda: {"ctd3": found})
    assert lesson_12_picked.picked_verdict().count("**met**") == met
    assert f"{100 * touched:.0f} · " in lesson_12_picked.picked_table()
    monkeypatch.setattr(lesson_12_picked, "picked", dict)
    assert lesson_12_picked.picked_table() == lesson_12_picked.picked_verdict()
