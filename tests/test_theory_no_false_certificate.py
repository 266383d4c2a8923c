"""A few of the trials of `benchmarks/false_certificates.py`: nothing that is certified is false."""

import numpy as np
import pytest

from benchmarks.false_certificates import KINDS, ask, draw, falsehood


def seeds(kind, count, most=3):
    """The first trials of a kind with at most `most` signals."""
    found = []
    for seed in range(10_000):
        trial = draw(seed)
        if trial.kind == kind and trial.plant.n <= most:
            found.append(seed)
        if len(found) == count:
            return found
    raise AssertionError(f"no {count} trials of {kind}")


@pytest.mark.parametrize("kind", KINDS)
def test_no_certificate_is_contradicted(kind):
    held = 0
    for seed in seeds(kind, 3):
        trial = draw(seed)
        answer = ask(trial)
        held += answer.holds
        if answer.holds:
            assert falsehood(trial, answer, np.random.default_rng([seed, 1])) == "", (seed, answer)
        else:
            assert answer.reason
    if kind == "linear, real modes":
        assert held >= 2


def test_the_check_finds_a_certificate_that_is_false():
    """A rate that is too good, or a sign that is not looked at, must be noticed."""
    seed = seeds("linear, real modes", 1)[0]
    trial = draw(seed)
    answer = ask(trial)
    assert answer.holds
    object.__setattr__(answer, "rate", 30 * answer.rate)
    assert falsehood(trial, answer, np.random.default_rng(0)) != ""
    object.__setattr__(answer, "rate", answer.rate / 30)
    trial.policy.R = -np.ones(trial.plant.n)
    assert falsehood(trial, answer, np.random.default_rng(0)) != ""
