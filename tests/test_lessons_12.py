"""Lesson 12: the model and the episodes, against independent references."""

import numpy as np
import pytest

from cmc import store
from cmc.envs.peg_push import BOX_TOP, PUSH, TARGET
from cmc.lessons import lesson_12, lesson_12_critic, lesson_12_episodes
from cmc.studies.old import peg_push, two_level_training

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
