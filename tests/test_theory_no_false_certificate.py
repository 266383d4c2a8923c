"""A few of the trials of `benchmarks/false_certificates.py`: nothing that is certified is false."""

import numpy as np
import pytest

from benchmarks.false_certificates import Truth, falsehood, held_still
from benchmarks.questions import KINDS, draw


def question(kind, seed):
    """A small question of a kind, and its answer."""
    if "SB3" in kind:
        pytest.importorskip("stable_baselines3")
    trial = draw(seed, kind)
    return trial, trial.ask()


@pytest.mark.parametrize("kind", KINDS)
def test_no_certificate_is_contradicted(kind):
    held = 0
    for seed in (0, 3, 6, 11):
        trial, answer = question(kind, seed)
        held += answer.holds
        if answer.holds:
            assert falsehood(trial, answer, np.random.default_rng([seed, 1])) == "", (seed, answer)
        else:
            assert answer.reason
    assert bool(held) == (kind not in ("coupled policy", "slip in a Jacobian"))


def test_the_check_finds_a_certificate_that_is_false():
    """A rate that is too good, or a sign that is not looked at, must be noticed."""
    for seed in range(9):
        trial, answer = question("linear, real modes", seed)
        if answer.holds:
            break
    object.__setattr__(answer, "rate", 30 * answer.rate)
    assert falsehood(trial, answer, np.random.default_rng(0)) != ""
    object.__setattr__(answer, "rate", answer.rate / 30)
    trial.policy.R = -np.ones(trial.plant.n)
    assert falsehood(trial, answer, np.random.default_rng(0)) != ""


@pytest.mark.parametrize("seed", [20749, 30164])
def test_a_metric_that_fails_between_the_points_is_no_certificate(seed):
    """A loop of which 3000 points fit a metric, at 1e-7 1/s, and one in 3000 others does not."""
    answer = draw(seed).ask()
    assert not answer
    assert "outward" in answer.reason


def test_the_check_takes_R_where_the_command_holds_the_plant():
    """B (u + g u^3): at u = 0 the sign of R is another one, and the loop that has it diverges."""
    trial = draw(32392)
    answer = trial.ask()
    assert answer.holds
    assert falsehood(trial, answer, np.random.default_rng(1)) == ""
    y = Truth(trial).states(np.random.default_rng(2), 50)[:, : trial.plant.n]
    assert np.abs(trial.plant.f(y, held_still(trial.plant, y))).max() < 1e-9


def test_rounding_of_the_check_is_not_taken_for_growth():
    """Slopes so small that the loop contracts by 5e-12 a sample (in 50 digits): that holds."""
    trial = draw(60623)
    answer = trial.ask()
    assert answer.holds
    assert falsehood(trial, answer, np.random.default_rng(0)) == ""
