"""Lesson 07: promises, tests and edges are what the cells compute, against the library."""

import numpy as np
import pytest
from lesson import run

from cmc import exercises
from cmc.theory.certificates import loop_jacobian
from cmc.theory.delay import LagLoop, class_gain, largest_gain, sample_matrix
from cmc.theory.differential import F1
from cmc.theory.disturbance import peak_gain
from cmc.theory.noise import disturbance_gain, noise_gain
from cmc.theory.reach import reach
from cmc.theory.robustness import ErrorBall
from cmc.theory.saturation import SaturatedLoop


@pytest.fixture(scope="module")
def whole():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CMC_FAST", "1")
        return run("07")


@pytest.fixture(scope="module")
def lag(whole):
    """The library's loop with the numbers of the lesson's dimension."""
    s = whole.space
    return LagLoop(1 / s["speed"], s["gain"] / s["speed"], s["h"], s["T"])


def test_the_first_figure_fails_where_it_says(whole):
    s = whole.space
    soft = lambda z, I: -3 * s["unit"] * np.tanh(z + I / s["T"])  # noqa: E731
    assert np.abs(s["run"](soft)[-20:]).max() < 0.05
    assert np.abs(s["run"](soft, late=3 * s["h"])[-20:]).max() > 0.2
    assert s["circle_p"][0] / s["unit"] > 3  # without delay every such policy contracts
    linear = lambda z, I: -6 * s["unit"] * (z + I / (10 * s["tau"]))  # noqa: E731
    ends = [
        s["run"](linear, steps=60, start=x * s["edge"], grows=True, limit=1.0)[-1] / s["edge"]
        for x in (0.9, 1.1)
    ]
    assert abs(ends[0]) < 0.3
    assert ends[1] > 10


def test_promises_are_those_of_the_library(whole):
    s = whole.space
    ball = ErrorBall.of(s["answer"], s["B"])
    # the certificate's rate is that of its corners or less
    assert s["rate"] >= s["answer"].rate - 1e-9
    same = ErrorBall(s["answer"].metric, s["rate"], s["B"])
    promised = float(same.output_bound(s["row"], np.inf, 0.0, 1.0))
    assert s["promised"] == pytest.approx(promised)
    assert s["promised"] <= float(ball.output_bound(s["row"], np.inf, 0.0, 1.0)) + 1e-9
    paper = np.linalg.norm(s["row"]) * float(same.euclidean_bound(np.inf, 0.0, 1.0))
    assert s["paper"] == pytest.approx(paper)
    found = reach(s["corners"], s["one"], s["B"], samples=400)
    tight = float(found.output_bound(s["row"], np.inf, 0.0, 1.0))
    assert tight <= s["ellipsoid"](s["one"]) <= 1.1 * tight
    worst = max(peak_gain(J, s["B"], s["row"]) for J in s["corners"])
    assert s["exact"] == pytest.approx(worst, rel=0.02)


def test_the_ladder_descends_and_nothing_breaks_a_promise(whole):
    values = list(whole.space["ladder"].values())
    promises = values[:5]
    assert promises[0] > promises[1]
    assert promises[2:] == sorted(promises[2:], reverse=True)
    assert min(promises) > values[5] > values[6]
    assert (np.abs(whole.space["caused"]) < min(promises)).all()
    # the same window on both sides
    assert "from 7.5 s on" in whole.text
    used = whole.space["most"] / whole.space["promised"]
    assert f"at most {used:.1%}" in whole.text


def test_the_policy_stays_in_its_interval(whole):
    s, policy = whole.space, whole.space["Policy"]()
    x = np.random.default_rng(0).normal(scale=2.0, size=(500, 2, 2))
    for j in (0, 1):
        d = 1e-5 * np.eye(2)[j]
        slope = (policy.pi(x + d) - policy.pi(x - d)) / 2e-5
        assert (slope >= s["floor"][:, j] - 1e-8).all()
        assert (slope <= s["ceiling"][:, j] + 1e-8).all()


def test_the_model_error_tests_are_the_library(whole):
    s = whole.space
    slopes = np.stack([s["P"], s["Q"]], axis=-1)[:50]
    space = s["space"]
    np.testing.assert_allclose(s["F_hat"][:50], F1(space, slopes), atol=1e-12)
    J = loop_jacobian(space.Lambda, space.R, s["P"][:50], s["Q"][:50])
    np.testing.assert_allclose(s["J_hat"][:50], J, atol=1e-12)
    assert not s["order"].any()
    assert "order holds in 0.00%" in whole.text
    assert np.mean(s["steady"][1]) > 0.95
    shares = [line for line in whole.text.splitlines() if line.startswith("share")]
    accepted = [float(line.split("accepts ")[1].split("%")[0]) for line in shares]
    assert 20 < max(accepted) < 60
    assert accepted[1] > 2 * accepted[3]  # the share matters


@pytest.mark.parametrize("late", [0.0, 0.6, 2.0, 3.3])
def test_the_delayed_step_is_the_library(whole, lag, late):
    s = whole.space
    p = 0.7 * s["unit"]
    step = s["late_step"](p, p / s["T"], late * s["h"])
    np.testing.assert_allclose(step, sample_matrix(lag, late * s["h"], p), atol=1e-12)
    z = s["run"](lambda z, I: -p * (z + I / s["T"]), late * s["h"], 30)
    state, path = np.eye(len(step))[0], []
    for _ in range(30):
        path.append(state[0])
        state = step @ state
    np.testing.assert_allclose(z, path, atol=1e-9)


def test_the_edges_are_the_library_and_are_met(whole, lag):
    s = whole.space
    np.testing.assert_allclose(s["exact_p"], largest_gain(lag, s["lates"]), rtol=2e-3)
    np.testing.assert_allclose(s["circle_p"], class_gain(lag, s["lates"]), rtol=2e-3)
    assert s["gap"] < 0.03
    assert s["rise"] > 1.3  # a short delay raises the exact edge, not the guarantee
    assert (np.diff(s["circle_p"]) < 0).all()


def test_two_slopes_that_switch_grow_below_the_line(whole):
    s = whole.space
    assert max(s["constant_pairs"]) < 1
    assert s["factor"] > 1.01
    assert "switching pairs: grows by" in whole.text
    for late, p in zip(s["few"], s["safe"], strict=True):
        assert s["switching"](late, 0.98 * p, length=4) < 1
        assert p < s["predictions"](late)[1]


def test_noise_and_disturbances_are_the_library(whole, lag):
    s = whole.space
    late = 2 * s["h"]
    for p in s["ps"][::6]:
        assert s["noise_gain"](p, late) == pytest.approx(noise_gain(lag, late, p))
        found = s["disturbance_gain"](p, late, 4000) * s["gain"] / s["speed"]
        assert found == pytest.approx(disturbance_gain(lag, late, p), rel=1e-3)
    assert np.abs(s["seen"] / s["noise"][::4] - 1).max() < 0.06
    assert (np.diff(s["noise"]) > 0).all()
    assert 0 < np.argmin(s["push"]) < len(s["push"]) - 1


def test_no_start_inside_the_ball_is_clipped(whole):
    s = whole.space
    assert s["inside"].sum() > 100
    assert not (s["clipped"] & s["inside"]).any()
    assert (~s["clipped"] & ~s["inside"]).any()
    loop = SaturatedLoop(-s["speed"], s["gain"], s["p"], s["q"], -1.0, 1.0, s["h"])
    assert s["level"] == pytest.approx(loop.unclipped_level(s["M"]))


def test_clamping_saves_what_the_plain_integral_loses(whole):
    lines = [line for line in whole.text.splitlines() if "comes back from up to" in line]
    plain, clamped = (float(line.split("up to ")[1].split()[0]) for line in lines)
    assert plain < clamped <= 1.0
    overs = [
        float(whole.space["step_response"](0.3, clamp)["text"].split()[1].rstrip("%"))
        for clamp in (False, True)
    ]
    assert overs[1] < overs[0] / 2


@pytest.mark.parametrize(
    ("name", "answer", "reason"),
    [
        ("07-worst-disturbance", lambda t, J, B, row, end: np.array([1.0, 0.0]), "a constant"),
        ("07-worst-disturbance", lambda t, J, B, row, end: row @ B + 1.0, "divide by its length"),
        ("07-edge", lambda radius, top: 2.0, "yours is 2"),
        ("07-anti-windup", lambda ahead, *rest: ahead, "stop the integral"),
        ("07-anti-windup", lambda ahead, integral, *rest: integral, "within its limits"),
    ],
)
def test_wrong_answers_get_a_fitting_hint(name, answer, reason):
    assert reason in repr(exercises.check(name, answer))


def test_the_usual_slips_with_the_worst_disturbance_are_named():
    from scipy.linalg import expm

    def wrong_time(t, J, B, row, end):
        w = row @ expm(J * t) @ B
        return w / np.linalg.norm(w)

    def wrong_sign(t, J, B, row, end):
        w = row @ expm(J * (end - t)) @ B
        return -w / np.linalg.norm(w)

    for answer, reason in ((wrong_time, "time runs the wrong way"), (wrong_sign, "sign is wrong")):
        assert reason in repr(exercises.check("07-worst-disturbance", answer))
