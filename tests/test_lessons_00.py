"""Lesson 00: what its text says is what its cells compute."""

import subprocess
import sys

import numpy as np
import pytest
from lesson import NOTEBOOKS, run


@pytest.fixture(scope="module")
def whole():
    return run("00", skip="robot", solved=True)


def test_the_three_kinds_differ_in_the_signs_of_the_weights_alone(whole):
    kinds = whole.space["kinds"]
    W, w = kinds["any sign"]
    np.testing.assert_array_equal(kinds["positive"][0], np.abs(W))
    np.testing.assert_array_equal(kinds["positive"][1], np.abs(w))
    assert not kinds["no control"][1].any()
    for paths in whole.space["paths"].values():
        np.testing.assert_array_equal(paths[0], whole.space["paths"]["any sign"][0])


def test_signs_decide_and_neither_luck_nor_steepness(whole):
    """The shares that the text rests on, for two other draws of the weights and two gains."""
    space = whole.space
    follow, apart = space["follow"], space["apart"]
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        W = rng.normal(size=(8, 1, 2, 16, 2))
        w = rng.normal(size=(8, 1, 2, 16)) / 4.0
        for gain in (1.0, 4.0):
            assert np.mean(apart(follow(W, w, gain)) > 0.1) > 0.6
            assert np.mean(apart(follow(abs(W), abs(w), gain)) > 0.1) == 0.0
        assert apart(follow(W, 0 * w)).max() < 0.1


def test_positive_networks_follow_and_no_control_does_not(whole):
    late, t = whole.space["late"], whole.space["t"]
    goal = whole.space["target"](t[late])[:, None, None]
    paths = whole.space["paths"]
    error = {k: np.median(np.linalg.norm(y[late] - goal, axis=-1)) for k, y in paths.items()}
    assert error["positive"] < 0.5 * error["no control"] < error["any sign"]


def test_apart_is_the_largest_of_all_distances(whole):
    y = whole.space["paths"]["any sign"]
    ends = y[-1, 3]
    wanted = max(np.linalg.norm(a - b) for a in ends for b in ends)
    assert whole.space["apart"](y)[3] == pytest.approx(wanted)


@pytest.mark.parametrize("choice", [(1.0, 1.0), (4.0, 4.0), (-0.2, 1.0), (-1.0, 1.0), (1.0, -0.2)])
def test_the_slider_shows_the_rate_of_the_loop(whole, choice):
    """Against the modules' characteristic polynomials, which the cell does not use."""
    transforms, picture = whole.space["space"], whole.space["forgetting"](*choice)
    roots = [
        np.roots([1.0, -lam + gain * choice[0], gain * choice[1]])
        for lam, gain in zip(transforms.eigenvalues, transforms.gains, strict=True)
    ]
    assert picture["rate"] == pytest.approx(-np.real(roots).max())
    assert ("forget" in picture["text"]) == (picture["rate"] > 0)
    late = picture["apart"][-40:].max() / picture["apart"][100:140].max()
    assert (late < 1.0) == (picture["rate"] > 0)


def test_the_idea_needs_neither_torch_nor_mujoco():
    """Everything but the 3D cells runs with both of them absent, and the first cell says so."""
    code = f"""
import sys
sys.modules["torch"] = sys.modules["mujoco"] = None
sys.path.insert(0, {str(NOTEBOOKS.parent / "tests")!r})
from lesson import run
print(run("00", skip="robot").text)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "missing: ['torch', 'mujoco']" in done.stdout
    assert "make course" in done.stdout


def test_the_robots_are_a_success_and_a_failure_of_the_same_episode():
    from cmc.studies import recorded

    won, lost = recorded.load("peg_push_ctd3"), recorded.load("peg_push_td3_drifts")
    assert won["success"]
    assert not lost["success"]
    assert "--episode 2" in won["record"]["command"]
    assert "--episode 2" in lost["record"]["command"]
    np.testing.assert_allclose(won["qpos"][0], lost["qpos"][0], atol=1e-9)
    shown = won["t"] <= 6.0
    assert won["distance"][shown].min() < 1e-3
    assert lost["distance"][shown][-1] > 0.05
