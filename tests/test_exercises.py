"""The exercise framework: registration, messages, and every shipped lesson's checks."""

import numpy as np
import pytest

from cmc import exercises


@pytest.fixture
def judged(monkeypatch):
    """An exercise 00-demo that exists during one test."""

    def demo(answer):
        exercises.expect_close(answer(3.0), 6.0, "twice 3")

    monkeypatch.setitem(exercises.CHECKS, "00-demo", demo)


def stub(x):
    raise NotImplementedError


@pytest.mark.parametrize(
    ("answer", "passed", "line"),
    [
        (lambda x: 2 * x, True, "00-demo: solved."),
        (lambda x: x * x, False, "twice 3 should be 6, yours is 9"),
        (stub, False, "00-demo: not written yet."),
        (lambda x: None, False, "twice 3 is None"),
        (lambda x: 1 / 0, False, "your code stopped with ZeroDivisionError: division by zero"),
    ],
)
def test_every_answer_gets_one_calm_line(judged, answer, passed, line):
    verdict = exercises.check("00-demo", answer)
    assert bool(verdict) is passed
    assert line in repr(verdict)
    assert "\n" not in repr(verdict)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 3)), r"shape \(2, 2\), yours has \(2, 3\)"),
        ("abc", "should be numbers, got str"),
        (None, "is None; does your function return"),
        ([[1.0, 0.0], [np.nan, 1.0]], r"at \(1, 0\) should be 0, yours is nan"),
        ([[1.0, 0.0], [0.0, 1.0 + 2e-6]], r"at \(1, 1\)"),
    ],
)
def test_close_explains(value, message):
    with pytest.raises(AssertionError, match=message):
        exercises.expect_close(value, np.eye(2), "T_y")


def test_unknown_exercises_are_named():
    with pytest.raises(KeyError, match="00-rate"):
        exercises.check("00-nothing", 1)
    with pytest.raises(KeyError, match="lesson '99' has no exercises"):
        exercises.check("99-nothing", 1)
    with pytest.raises(ValueError, match="02-sign-rule"):
        exercises.check("sign", 1)


def test_registering_and_a_name_that_is_taken(judged, monkeypatch):
    def other(answer):
        return None

    other.__module__ = "elsewhere"
    with pytest.raises(ValueError, match="already judged"):
        exercises.check("00-demo")(other)
    monkeypatch.delitem(exercises.CHECKS, "00-demo")
    assert exercises.check("00-demo")(other) is other
    assert exercises.CHECKS.pop("00-demo") is other


def test_lesson_00():
    exercises.judge("00-rate", lambda A: -np.linalg.eigvals(A).real.max())
    assert exercises.names("00") == ["00-rate"]
    for wrong in (
        lambda A: -np.trace(A) / 2,
        lambda A: np.linalg.eigvals(A).real.max(),
        lambda A: -np.linalg.eigvals((A + A.T) / 2).max(),
    ):
        with pytest.raises(AssertionError, match="the rate of"):
            exercises.judge("00-rate", wrong)
