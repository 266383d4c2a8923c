"""Lesson 11: what the prose claims is what its callbacks, tables and verdicts return."""

import copy

import numpy as np
import pytest
import torch

from cmc import exercises, store
from cmc.envs.peg_maze import GOAL_HIGH, GOAL_LOW
from cmc.lessons import lesson_11, lesson_11_learning, lesson_11_relabel
from cmc.lessons import lesson_11_results as shipped
from cmc.lessons import lesson_11_verdicts as verdicts
from cmc.studies.old import peg_maze


def test_a_target_at_the_goal_ends_at_the_wall():
    walls = lesson_11.obstacles()
    assert len(walls) == 5
    for regime in lesson_11.STUDIES:
        out = lesson_11.straight(regime, worlds=3)
        assert out["tip"].shape == (400, 3, 2)
        assert (out["distance"][-1] > 5.0).all()
        assert (out["force"][-1] > 0.0).all()
        assert (out["goal"] >= 1e3 * GOAL_LOW[:2]).all()
        assert (out["goal"] <= 1e3 * GOAL_HIGH[:2]).all()
        left, right = walls[0][:, 0].min(), walls[0][:, 0].max()
        beside = out["tip"][-1, :, 0]
        assert ((beside > right) | (beside < left)).all()


def test_tracking_gets_cheaper_up_to_the_cap_and_chatter_comes_after_it():
    cost, bound = lesson_11.costs(), lesson_11.cap()
    below = cost["gain"] <= bound["cap"]
    for regime in lesson_11.STUDIES:
        assert (np.diff(cost[regime][below]) < 0).all()
        rest = cost[regime][~below]
        assert cost[regime][below][-1] - rest.min() < 0.1 * cost[regime][below][-1]
    calm, wild = (lesson_11.gain_step(bound["chatter"] * f, "x", "stiff")["u"] for f in (0.8, 1.3))
    assert (np.diff(np.sign(wild[-8:])) != 0).all()
    assert np.abs(calm[-8:]).max() < 0.2 < np.abs(wild[-8:]).min()


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("regime", ["soft", "stiff"])
def test_the_arm_follows_the_model_of_its_gains(axis, regime):
    out = lesson_11.gain_step(6.0, axis, regime)
    assert out["arm"][0] == pytest.approx(5.0)
    assert np.abs(out["arm"] - out["model"]).max() < 0.75
    assert (np.diff(out["press"]) > 0).all()
    assert out["press"][0] == 0.0


def test_tracking_alone_drives_the_slopes_to_the_cap():
    seen = []
    out = lesson_11_learning.learn_low(show=lambda *row: seen.append(row), updates=30)
    assert seen[0] == (0, pytest.approx(0.05, rel=0.02))
    assert (out["share"][-1] > 0.95).all()
    assert (out["share"] <= 1.0 + 1e-6).all()
    before, after = (lesson_11.arm_step(out[k], regime="stiff")["e"] for k in ("seen", "low"))
    assert np.abs(after).mean() < 0.6 * np.abs(before).mean()
    full = lesson_11.arm_step(out["low"], "x", "stiff", split=False)["e"]
    assert 0.0 > full[-1] > 0.5 * after[-1]  # most of the overshoot is the coupling's


def test_a_force_threshold_lowers_the_saturation_and_keeps_the_slope():
    out = lesson_11_learning.learn_low(force_weight=1.0, start=0.99, updates=90)
    first, last = (np.abs(out[key][-1]) for key in ("before", "after"))
    assert (last < 0.6 * first).all()
    assert (out["share"][-1] > 0.95).all()
    model = lesson_11._latent_low("stiff").model
    at_level = model.mass[:3] * (model.K_p[:3] * 0.005 + out["level"])
    np.testing.assert_allclose(at_level, 1.0)
    assert out["level"][0] > out["level"][1] > 0.0 > out["level"][2]
    assert last[0] > out["level"][0]


def test_training_both_levels_reports_both_methods():
    seen = []
    out = lesson_11_learning.train_both(lambda *row: seen.append(row), steps=640)
    assert out["step"].tolist() == [160, 320, 480, 640]
    assert len(seen) == 4
    assert all(np.isfinite(row).all() for row in seen)
    assert (out["ctd3"] > 0).all()
    assert out["share"][-1] > out["share"][0]


# -- relabeling ----------------------------------------------------------------------------------


def test_an_unchanged_low_level_keeps_the_sub_goal_it_pursued():
    out = lesson_11_relabel.relabel(0, change=0.0, noise=0.1)
    assert out["picked"] == 0
    assert out["score"][0] == 0.0
    assert (out["score"][1:] < 0).all()
    np.testing.assert_allclose(out["action"], out["mean"], atol=0.5)
    quiet = lesson_11_relabel.relabel(0, change=0.0, noise=0.0)
    np.testing.assert_allclose(quiet["action"], quiet["mean"], atol=1e-5)
    assert quiet["log"][0] == pytest.approx(0.0, abs=1e-6)


def test_a_changed_low_level_makes_another_sub_goal_likelier():
    over = lesson_11_relabel.picks(np.linspace(0, 1, 5))
    assert over["picked"][0] == 0
    assert over["picked"][-1] != 0
    assert (over["gain"] >= 0).all()
    assert over["gain"][-1] > 0


@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_scores_are_those_of_the_trainer(noise):
    batch, correction = lesson_11_relabel.library_choice(noise)
    goals, score = correction.scored(batch)
    out = lesson_11_relabel.relabel(0, change=0.0, noise=noise)
    np.testing.assert_allclose(goals[0, 0, :2], out["goals"][:2], atol=1e-6)  # the rest is drawn
    np.testing.assert_allclose(score[0, 0, :2], out["log"][:2], rtol=1e-4, atol=1e-4)
    picked = correction.relabel(batch).action[0, 0]
    assert any(torch.equal(picked, goal) for goal in goals[0, 0])


def test_the_ticks_of_the_table_add_up_to_the_log_likelihood():
    total = 0.0
    for joint in range(7):
        out = lesson_11_relabel.relabel(3, 0.7, 0.1, joint)
        total += -0.5 * ((out["action"] - out["mean"]) ** 2).sum()
        moved = out["state"] - out["state"][0]
        np.testing.assert_allclose(out["left"], out["left"][0] - moved, atol=1e-6)
    assert total == pytest.approx(out["log"][3], rel=1e-4)
    assert lesson_11_relabel.score_table().count("**picked**") == 1
    assert lesson_11_relabel.tick_table().count("\n") == 6


# -- results -------------------------------------------------------------------------------------


def made_up(success, force=1.0, slope=0.5, mean=5.0, spread=0.1, **more):
    """A method's answer as the studies write it, two seeds, two kept policies."""
    shares = {"zero": 0.5 * force, "below_1_N": force, "below_5_N": 1.0, "largest_N": 3.0}
    final = {
        "step": 200_000,
        "episodes": 100,
        "success": success,
        "success_interval": [0.9 * min(success), 1.0],
        "return": [-1.0, -2.0],
        "final_mm": [1.0, 2.0],
        "force": dict.fromkeys(shipped.RULES, shares),
        "consistency_mm": {"mean": [mean] * 2, "spread": [spread] * 2},
        "gains": {"slope": [[slope] * 6] * 2, "bound": [1.0] * 6, "bounded": True},
    }
    first = copy.deepcopy(final) | {"step": 100_000, "success": [0.0, 0.0]}
    answer = {
        "title": "a method",
        "seeds": [0, 1],
        "training": {"step": [1600 * k for k in range(1, 9)], "reward": [[-0.01, -0.02]] * 8},
        "tests": [first, final],
        "final": final,
        "force_over_tests": final["force"],
    }
    return answer | more


@pytest.fixture
def written(monkeypatch):
    """Replaces the result files by made-up ones."""

    def write(soft, stiff=None):
        files = {"soft": soft, "stiff": stiff or {}}
        for module in (shipped, verdicts):
            monkeypatch.setattr(module, "methods", lambda regime="soft": files[regime])

    return write


def test_success_is_met_or_not_by_the_file(written):
    written({"ctd3": made_up([1.0, 0.96])})
    text = verdicts.success_verdict()
    assert "short of" not in text
    assert "are those of step 200,000" in text
    written({"ctd3": made_up([0.9, 0.9])})
    text = verdicts.success_verdict()
    assert "short of the 95%" in text
    assert "no kept policy reaches 95%" in text
    assert verdicts.success_verdict("td3") == ""


@pytest.mark.parametrize(("share", "word"), [(0.9995, "Met"), (0.99, "**Not met**")])
def test_force_is_met_or_not_by_the_file(written, share, word):
    written({"ctd3": made_up([1.0, 1.0], share)})
    assert verdicts.force_verdict().startswith(word)


def test_force_separates_methods_or_says_that_it_does_not(written):
    soft = {"ctd3": made_up([1.0, 1.0]), "td3": made_up([0.0, 0.0], 0.9995, title="other")}
    stiff = {"ctd3": made_up([1.0, 1.0], 0.95), "td3": made_up([0.0, 0.0], 0.7, title="other")}
    written(soft, stiff)
    first, second = verdicts.softness_verdict().split("\n\n")
    assert "force says nothing" in first
    assert "25.0 percentage points" in second
    assert "70.0% (other)" in second
    written({"ctd3": made_up([1.0, 1.0])})
    assert verdicts.softness_verdict() == ""


def test_a_learned_low_level_wins_only_in_every_seed(written):
    better = {"ctd3": made_up([1.0, 1.0]), "frozen": made_up([1.0, 0.9], spread=0.2)}
    written(better)
    assert "at least as good in every seed" in verdicts.learned_verdict("ctd3", "frozen")
    assert "not better throughout" in verdicts.learned_verdict("frozen", "ctd3")
    written({"ctd3": made_up([1.0, 1.0], 0.9), "frozen": made_up([1.0, 0.9])})
    assert "not better throughout" in verdicts.learned_verdict("ctd3", "frozen")
    assert verdicts.learned_verdict("ctd3", "hiro") == ""


def test_gains_are_judged_by_sign_and_bound(written):
    written({"ctd3": made_up([1.0, 1.0], slope=0.99)})
    assert "all 12 slopes at rest are positive, the largest is 0.99" in verdicts.gain_verdict()
    written({"ctd3": made_up([1.0, 1.0], slope=1.5)})
    assert "12 exceed their bound" in verdicts.gain_verdict()
    written({"ctd3": made_up([1.0, 1.0], slope=-0.002)})
    text = verdicts.gain_verdict()
    assert "12 of 12 slopes at rest have the wrong sign" in text
    assert "12 of 12 are below one percent" in text


def test_hiro_is_reported_with_its_steps(written):
    assert written({"ctd3": made_up([1.0, 1.0])}) is None
    assert verdicts.hiro_verdict() == "No HIRO policies are shipped."
    hiro = made_up([0.5, 0.7], 0.8)
    hiro["final"]["step"] = 230_000
    del hiro["final"]["gains"]
    written({"hiro": hiro}, {"ctd3": made_up([1.0, 1.0], 0.9)})
    text = verdicts.hiro_verdict()
    assert "230,000 steps (10% of the paper's)" in text
    assert "80.0% of the ticks below 1 N" in text
    assert "With the same rigid peg, a method: 90.0%" in text
    assert "rigid" in shipped.force_table()
    assert shipped.gain_table().count("\n| ") == 1


def test_consistency_uses_what_was_measured(written):
    still = made_up([0.0, 0.0], mean=0.2, spread=0.01, title="still")
    written({"ctd3": made_up([1.0, 1.0]), "control": still})
    text = verdicts.consistency_verdict()
    assert "over starts: still (0.01 mm); least: a method (0.10 mm)" in text
    assert "miss the step by more than half: still" in text
    assert "push" not in text
    moved = made_up([1.0, 1.0], consistency_over_training_mm=[0.3, 0.5])
    moved["final"]["consistency_mm"] |= {
        "pushed": [0.1, 0.3],
        "mean_vector": [[-5.0, 0.3, 0.4]] * 2,
    }
    written({"ctd3": moved, "control": made_up([0.0, 0.0])})
    np.testing.assert_allclose(shipped.miss("ctd3"), np.hypot(0.5, 0.1))
    row = shipped.consistency_table().splitlines()[2]
    assert "0.20 [0.10, 0.30]" in row
    assert "0.40 [0.30, 0.50]" in row


def test_shares_are_told_from_none_and_all():
    assert shipped.percent(1.0) == "100%"
    assert shipped.percent(0.0) == "0%"
    assert shipped.percent(0.99999) == "> 99.99%"
    assert shipped.percent(1e-6) == "< 0.01%"
    assert shipped.percent(0.9993) == "99.93%"
    assert shipped.percent(0.6424) == "64.2%"


def test_learning_curves_average_over_whole_episodes(written):
    answer = made_up([1.0, 1.0])
    teeth = [[-0.01 * (k % 2)] * 2 for k in range(8)]  # 1600 steps: half an episode of all worlds
    answer["training"]["reward"] = teeth
    written({"ctd3": answer})
    ((step, distance),) = shipped.training(["ctd3"]).values()
    assert distance.shape == (2, len(step)) == (2, 7)
    np.testing.assert_allclose(distance, 5.0)
    assert step[0] == pytest.approx(2400.0)


def test_the_paper_sizes_are_shown_where_they_are_shipped(monkeypatch, tmp_path):
    assert isinstance(verdicts.paper_sizes(), dict)
    path = tmp_path / "peg_maze_paper_sizes.json"
    found = made_up([0.97])
    found |= {"sizes": {"planner": [400, 300]}, "cpu_ms_per_step": 3.0}
    found["ours"] = {"sizes": {"planner": [128, 128]}, "cpu_ms_per_step": 1.2}
    store.write_json(path, found)
    monkeypatch.setattr(store, "asset", lambda *parts: path)
    out = verdicts.paper_sizes()
    assert "costs 2.5 times as much" in out["text"]
    assert "planner 400, 300): 3.00 ms" in out["text"]
    assert "97.0%" in out["text"]
    np.testing.assert_allclose(out["distance"], [[10.0] * 7, [20.0] * 7])


def test_shipped_results_fill_every_figure_and_table():
    there = shipped.methods()
    assert "ctd3" in there
    shown = [name for group in shipped.groups() for name in group]
    assert sorted(shown) == sorted(there)
    for table in (shipped.method_table(), shipped.consistency_table(), shipped.force_table()):
        for found in there.values():
            assert f"| {found['title']} |" in table
        assert "nan" not in table
    for names in shipped.groups():
        for step, distance in shipped.training(names).values():
            assert distance.shape[1] == len(step)
        for _, mean, low, high in shipped.success(names).values():
            assert ((low <= mean + 1e-9) & (mean <= high + 1e-9)).all()
    for name in there:
        _, bands = shipped.force_bands(name)
        np.testing.assert_allclose(sum(bands.values()), 1.0)
        assert (np.array(list(bands.values())) > -1e-12).all()
    for regime in shipped.FILES:
        assert "nan" not in verdicts.consistency_verdict(regime)
    assert verdicts.force_verdict()
    assert verdicts.success_verdict()
    assert verdicts.gain_verdict()


def test_an_episode_of_a_shipped_policy():
    marks = lesson_11.kept()
    out = lesson_11.episode(step=marks[-1])
    assert out["path"].shape == out["aim"].shape == (400, 2)
    assert out["distance"].shape == (400,)
    box = peg_maze.STUDY.task
    assert (out["aim"] >= 1e3 * np.array(box.subgoal_low[:2]) - 1e-6).all()
    assert (out["aim"] <= 1e3 * np.array(box.subgoal_high[:2]) + 1e-6).all()


# -- exercise ------------------------------------------------------------------------------------


def test_a_choice_that_forgets_the_transition_is_refused():
    def forgets(states, actions, goals, act):
        losses = [
            sum(((a - act(s, goal)) ** 2).sum() for s, a in zip(states, actions, strict=True))
            for goal in goals
        ]
        return int(np.argmin(losses))

    with pytest.raises(AssertionError, match="smallest squared error"):
        exercises.check("11-relabel", forgets)
    with pytest.raises(AssertionError, match="position"):
        exercises.check("11-relabel", lambda *parts: 99)
