"""Lesson 12: the model, the episodes and the verdicts, against independent references."""

import copy

import numpy as np
import pytest
from scipy import stats

from cmc import store
from cmc.envs.peg_push import BOX_TOP, PUSH, TARGET
from cmc.lessons import lesson_12, lesson_12_critic, lesson_12_episodes, lesson_12_picked
from cmc.lessons import lesson_12_results as shipped
from cmc.lessons import lesson_12_verdicts as verdicts
from cmc.studies import peg_push, two_level_training

# -- one sub-goal, one plan ----------------------------------------------------------------------


def test_the_gains_alone_cover_a_fifth_of_a_step_and_a_gain_all_of_it():
    """Reference: the closed solution of e'' + K_d e' + K_p e = 0 from rest."""
    step = lesson_12.one_step((0.0, 20.0, 150.0))
    p, q = np.roots([1.0, 30.0, 20.0]).real
    t = step["t"]
    exact = 1.0 - (p * np.exp(q * t) - q * np.exp(p * t)) / (p - q)
    np.testing.assert_allclose(step["share"][:, 0], exact, atol=0.02)
    assert step["share"][-1, 1] > 0.95
    swing = np.abs(np.diff(step["u"][-6:], axis=0)).max(0)
    assert swing[1] < 0.1 < 1.0 < swing[2]  # beyond the bound the command chatters


@pytest.mark.parametrize("gain", [0.0, 2.0, 20.0])
def test_slider_agrees_with_the_arm(gain):
    arm, model = lesson_12.one_step((gain,)), lesson_12.segment(gain)
    np.testing.assert_allclose(model["share"][:21], 100 * arm["share"][:, 0], atol=2.5)


def test_slider_says_when_a_command_chatters():
    K2 = peg_push.STUDY.task.gains.latent.K2[0]
    for level, words in ((1.0, ("calm", "swings")), (2.0, ("swings", "chatters"))):
        edge = (level / PUSH.tick - 30.0) / K2
        for part, word in zip((0.98, 1.02), words, strict=True):
            assert word in lesson_12.segment(part * edge)["text"]
    tail = [np.diff(np.sign(lesson_12.segment(g, integral=False)["u"])) for g in (20.0, 150.0)]
    assert not tail[0].any()
    assert np.abs(tail[1][20:]).sum() > 20  # every other tick another sign
    assert lesson_12.level(lesson_12.CAP) == pytest.approx(peg_push.STUDY.latent.cap)
    assert lesson_12.segment(2.0, ticks=50)["due"] == pytest.approx(1000.0)
    more, less = (lesson_12.segment(2.0, integral=i)["share"][20] for i in (True, False))
    assert more > less


def test_the_plan_succeeds_with_a_low_level_and_not_without():
    run = lesson_12.plan((0.0, 20.0))
    assert run["success"].tolist() == [False, True]
    assert run["total"][1] > -400 > run["total"][0]
    np.testing.assert_allclose(run["distance"], np.linalg.norm(TARGET - run["tip"], axis=-1))


def test_live_training_reports_both_arms():
    seen = []
    run = lesson_12.live_training(lambda *row: seen.append(row), steps=320, warm_up=160)
    assert run["step"].tolist() == [160, 320]
    assert len(seen) == 2
    assert seen[-1][0] == 320
    for name in ("ctd3", "control"):
        assert run[name].shape == (2,)
        assert ((run[name] < 0) & (run[name] > -1200)).all()
    assert "far too short" in lesson_12.live_sentence(run)


# -- what a critic can know ----------------------------------------------------------------------


def test_twins_look_alike_and_want_opposite_actions():
    twin = lesson_12_critic.twins()
    assert np.abs(twin["y"]).max() < 1e-12
    np.testing.assert_allclose(twin["e"][0], [1.0, -1.0])
    np.testing.assert_allclose(twin["value"][0], twin["value"][1])
    assert twin["slope"][0] == pytest.approx(-twin["slope"][1])
    assert twin["slope"][0] > 0.5


def test_the_model_is_the_differential_equation():
    """One tick, against a fine integration of e'' = -K_d e' - K_p e - u."""
    rng = np.random.default_rng(0)
    e, v, u = rng.normal(size=(3, 4, 6))
    latent, small = peg_push.STUDY.task.gains.latent, PUSH.tick / 20_000
    x, w = e.copy(), v.copy()
    for _ in range(20_000):
        x, w = x + small * w, w - small * (latent.K_d * w + latent.K_p * x + u)
    found = lesson_12_critic.advance(e, v, u)
    np.testing.assert_allclose(found, (x, w), atol=2e-4)


def test_action_slope_is_the_change_of_the_return():
    """Far from zero error the return is -sum of e: its slope is the impulse response, summed."""
    e, v = np.zeros((1, 6)), np.zeros((1, 6))
    e[0, 0] = 1.0  # so large that e stays positive; u = 0
    slope = lesson_12_critic.action_slope(lambda seen: np.zeros(seen[..., :6].shape), e, v)
    path, rate, total = 0.0, 0.0, 0.0
    small, steps = PUSH.tick / 1000, 1000
    for k in range(PUSH.horizon):
        for _ in range(steps):
            path, rate = (
                path + small * rate,
                rate - small * (30.0 * rate + 20.0 * path + float(k == 0)),
            )
        total += path
    assert slope[0, 0] == pytest.approx(-total, rel=0.01)
    np.testing.assert_allclose(slope[0, 1:], 0.0, atol=1e-9)


def test_plane_is_odd_in_the_effect_and_even_in_the_return():
    plane = lesson_12_critic.plane(21)
    np.testing.assert_allclose(plane["value"], plane["value"][::-1, ::-1])
    np.testing.assert_allclose(plane["gain"], -plane["gain"][::-1, ::-1], atol=1e-9)
    line = np.abs(plane["v"][:, None] - plane["y_zero"][None]) < 8.0
    assert np.ptp(plane["value"][line]) > 0.05 * np.ptp(plane["value"])


def test_three_ways_train_and_only_the_model_needs_no_critic():
    found = lesson_12_critic.three_ways(segments=4, seeds=(0,))
    for name in lesson_12_critic.WAYS:
        way = found[name]
        assert way["covered"].shape == way["offset"].shape == (found["ticks"].size, 1)
        assert ("agreement" in way) == (name != "ctd3")
        if name != "ctd3":
            assert 0.0 <= way["agreement"][0] <= 1.0
    assert (found["ctd3"]["slope"] <= lesson_12.CAP).all()
    assert (found["ctd3"]["covered"] > 0.8).all()
    assert (found["ctd3"]["offset"] < 1e-6).all()  # odd by construction
    assert lesson_12_critic.ways_table(found).count("\n| ") == len(lesson_12_critic.WAYS) + 1


def test_agreement_counts_signs(monkeypatch):
    """A critic that is the truth agrees everywhere, its opposite nowhere."""
    low = lesson_12_critic.build_low(peg_push.STUDY, "td3_corrected", [0])
    e = np.random.default_rng(0).uniform(-0.005, 0.005, (1, 4, 6))
    segment, _ = lesson_12_critic._segment(low, e, np.zeros_like(e))

    def along(sign):
        def values(critics, seen, u):  # u should push along y where the tip hardly moves
            return (sign * u[..., :3] * seen[..., 12:15]).sum(-1)[:, None]

        return values

    shares = []
    for sign in (1.0, -1.0):
        monkeypatch.setattr(low.agent, "values", along(sign))
        shares.append(lesson_12_critic.agreement(low, segment)[0])
    assert shares[0] + shares[1] == pytest.approx(1.0)
    assert shares[0] > 0.8


# -- how episodes end ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tip", "lid", "obstacle", "kind"),
    [
        ((0, 0, -12.5), -12, (0, -3), lesson_12_episodes.REACHED),
        ((0, 11, 4), 0, (0, 0), "never came down"),
        ((0, 1, 0.05), 0, (0, 0), "stands on the lid"),
        ((0, 10, -3.9), 0, (0, 0), "lid not open"),
        ((5, 0, -3.9), -12, (0, 0), "beside the slot"),
        ((0, 0, -11.0), -12, (0, 0), "obstacle not moved"),
        ((0, 3, -12.6), -12, (0, 0), "at the bottom, beside the target"),
        ((0, 4, -8.0), -12, (0, 0), "in the slot, not at its bottom"),
    ],
)
def test_ends_are_named_by_where_things_are(tip, lid, obstacle, kind):
    found = lesson_12_episodes.classify(
        np.array(tip, float),
        lid,
        np.array(obstacle, float),
        success=kind == lesson_12_episodes.REACHED,
        touched=False,
        penetration=0.05,
    )
    assert found == kind


def test_history_comes_before_place():
    place = (np.array([0.0, 0.0, -12.5]), -12.0, np.array([0.0, -3.0]))
    past = {"success": False, "touched": True, "penetration": 0.1}
    assert lesson_12_episodes.classify(*place, **past) == "touched, then left"
    past |= {"success": True, "penetration": 0.3}
    assert lesson_12_episodes.classify(*place, **past) == "pressed through"


@pytest.fixture
def policies(tmp_path, monkeypatch):
    """Barely trained policies of two methods in place of the shipped ones."""
    for name in ("frozen", "control"):
        two_level_training.train(peg_push.STUDY, name, [0, 1], steps=160, out=tmp_path)
    asset = store.asset

    def find(*parts):
        if parts[0] != "checkpoints":
            return asset(*parts)
        if not (tmp_path / parts[1]).is_file():
            raise FileNotFoundError(parts[1])
        return tmp_path / parts[1]

    monkeypatch.setattr(store, "asset", find)
    monkeypatch.setenv("CMC_FAST", "1")
    lesson_12_episodes.episodes.cache_clear()
    yield tmp_path
    lesson_12_episodes.episodes.cache_clear()


def test_episodes_are_those_of_the_study(policies):
    assert lesson_12_episodes.shipped() == ["frozen", "control"]
    run = lesson_12_episodes.episodes("frozen", None, 2)
    motion = peg_push.motion("frozen", 1, episode=1)
    np.testing.assert_allclose(run["qpos"][:, 3], motion["qpos"][: len(run["t"])], atol=1e-9)
    np.testing.assert_allclose(run["distance"][:, 3], motion["distance"][: len(run["t"])])
    out = lesson_12_episodes.distances("control", 10)
    assert out["distance"].shape == (len(out["t"]), 2)
    assert "step 160 " in out["text"]


def test_tables_and_gallery_of_failures(policies):
    table = lesson_12_episodes.failure_table(starts=2)
    rows = [row.split("|")[1:-1] for row in table.splitlines()[2:]]
    assert [row[0].strip() for row in rows] == ["TD3/frozen random C", "TD3/Control"]
    for row in rows:
        assert sum(int(cell) for cell in row[2:]) == int(row[1]) == 4
    cases = lesson_12_episodes.gallery(failures=3, starts=2)
    assert len(cases) == 3
    kinds = set(
        lesson_12_episodes.verdicts(lesson_12_episodes.episodes("frozen", None, 2))
        + lesson_12_episodes.verdicts(lesson_12_episodes.episodes("control", None, 2))
    )
    assert len({case["kind"] for case in cases}) == min(len(kinds), 3)
    for case in cases:
        assert case["qpos"].shape[0] == case["t"].size == case["tip"].shape[0]
        np.testing.assert_allclose(case["tip"][0], BOX_TOP, atol=0.02)
    assert lesson_12_episodes.rest_table().count("\n| ") == 1  # control has no low level


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
