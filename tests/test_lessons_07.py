"""Lesson 07: promises, tests and edges are what the cells compute, against the library."""

import numpy as np
import pytest
from lesson import run
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_discrete_lyapunov

from cmc.theory.contraction import F, contraction_rate
from cmc.theory.robustness import ErrorBall
from cmc.theory.sampled import LagLoop


@pytest.fixture(scope="module")
def whole():
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
    # sup ||B d|| / beta sqrt(m_high / m_low), the paper's Euclidean radius
    low, high = np.linalg.eigvalsh(same.metric)[[0, -1]]
    paper = np.linalg.norm(s["B"], 2) / s["rate"] * np.sqrt(high / low)
    assert s["paper"] == pytest.approx(np.linalg.norm(s["row"]) * paper)
    # in one metric the ellipsoid never promises less than what can happen, nor more than the ball
    ball = ErrorBall(s["one"], float(contraction_rate(s["corners"], s["one"]).min()), s["B"])
    assert s["exact"] <= s["ellipsoid"](s["one"])
    assert s["ellipsoid"](s["one"], 400) <= float(ball.output_bound(s["row"], np.inf, 0.0, 1.0))
    pushed = [
        quad_vec(lambda t, J=J: np.linalg.norm(s["row"] @ expm(J * t) @ s["B"]), 0.0, 40.0)[0]
        for J in s["corners"]
    ]
    assert s["exact"] == pytest.approx(max(pushed), rel=0.02)


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
    np.testing.assert_allclose(s["F_hat"][:50], F(space, slopes), atol=1e-12)
    np.testing.assert_allclose(s["J_hat"][:50], space.loop(slopes), atol=1e-12)
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
    np.testing.assert_allclose(step, lag.sample_matrix(late * s["h"], p), atol=1e-12)
    z = s["run"](lambda z, I: -p * (z + I / s["T"]), late * s["h"], 30)
    state, path = np.eye(len(step))[0], []
    for _ in range(30):
        path.append(state[0])
        state = step @ state
    np.testing.assert_allclose(z, path, atol=1e-9)


def test_the_edges_are_the_library_and_are_met(whole, lag):
    s = whole.space
    np.testing.assert_allclose(s["exact_p"], lag.largest_gain(s["lates"]), rtol=2e-3)
    np.testing.assert_allclose(s["circle_p"], lag.class_gain(s["lates"]), rtol=2e-3)
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
    late, phi = 2 * s["h"], np.exp(-s["speed"] * s["h"])
    for p in s["ps"][::6]:
        step = lag.sample_matrix(late, p)
        entry = np.eye(len(step))[0]
        seen = step @ entry - phi * entry  # noise moves what the policy sees, not the lag
        spread = solve_discrete_lyapunov(step, np.outer(seen, seen))[0, 0]
        assert s["noise_gain"](p, late) == pytest.approx(np.sqrt(spread))
        pushed, state = [], (1 - phi) * s["gain"] / s["speed"] * entry
        for _ in range(4000):
            pushed.append(abs(state[0]))
            state = step @ state
        found = s["disturbance_gain"](p, late, 4000) * s["gain"] / s["speed"]
        assert found == pytest.approx(sum(pushed), rel=1e-3)
    assert np.abs(s["seen"] / s["noise"][::4] - 1).max() < 0.06
    assert (np.diff(s["noise"]) > 0).all()
    assert 0 < np.argmin(s["push"]) < len(s["push"]) - 1


def test_no_start_inside_the_ball_is_clipped(whole):
    s = whole.space
    assert s["inside"].sum() > 100
    assert not (s["clipped"] & s["inside"]).any()
    assert (~s["clipped"] & ~s["inside"]).any()
    edge = np.linalg.solve(s["M"], s["row_u"])  # where the ball comes nearest to the limit
    edge *= s["level"] / np.sqrt(edge @ s["M"] @ edge)
    assert s["row_u"] @ edge == pytest.approx(1.0)


def test_clamping_saves_what_the_plain_integral_loses(whole):
    lines = [line for line in whole.text.splitlines() if "comes back from up to" in line]
    plain, clamped = (float(line.split("up to ")[1].split()[0]) for line in lines)
    assert plain < clamped <= 1.0
    overs = [
        float(whole.space["step_response"](0.3, clamp)["text"].split()[1].rstrip("%"))
        for clamp in (False, True)
    ]
    assert overs[1] < overs[0] / 2
