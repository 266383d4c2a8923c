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


def wrong_rate(A):
    return -np.trace(A) / 2


def lower_factor(J, M):
    theta = np.linalg.cholesky(M)
    F = theta @ J @ np.linalg.inv(theta)
    return -np.linalg.eigvalsh((F + F.T) / 2)[-1]


def no_integral(Lambda, R, p, q):
    P = np.diag(p)
    return np.block([[Lambda, R], [P @ Lambda, P @ R]])


def by_columns(Lambda, R, p, q):
    return np.block([[Lambda, R], [p * Lambda + np.diag(q), p * R]])


def explicit(f_y, f_u, exchange=True, transpose=True, last=True):
    T_y = np.linalg.inv(np.linalg.eig(f_y)[1])
    P = np.eye(len(f_y))[::-1]
    W = (T_y @ f_u).T if transpose else P @ T_y @ f_u
    Q = np.linalg.qr(W @ P if exchange and transpose else W)[0]
    return T_y, Q @ P if last else Q


@pytest.mark.parametrize(
    ("name", "answer", "hint"),
    [
        ("00-rate", wrong_rate, "the rate of"),
        ("00-rate", lambda A: np.linalg.eigvals(A).real.max(), "the sign is wrong"),
        ("00-rate", lambda A: -np.linalg.eigvals(A), "one number"),
        ("00-slope", lambda s, W, w: (w * (1 - np.tanh(s @ W.T) ** 2)).sum(-1), "inner derivative"),
        ("00-design", (1.0, -1.0), "does not decay"),
        ("00-design", (3.0, 1.0), "above 2"),
        ("00-design", ..., "not written yet"),
        ("01-rate-in-a-metric", lower_factor, "transpose"),
        ("01-rate-in-a-metric", lambda J, M: -np.linalg.eigvalsh(J + J.T)[-1], "has a half"),
        ("01-metric-design", 4.0, "does not prove"),
        ("01-metric-design", 1e4, "at most 11"),
        ("01-no-contraction", ((0.0, 0.0), (0.1, 0.0)), "angle pi"),
        ("02-relative-gain", lambda G: G * np.linalg.inv(G), "transposed"),
        ("02-angle", lambda W: np.arctan(W[1, 0] / W[1, 1]), "radians"),
        ("02-angle", lambda W: -np.degrees(np.arctan(W[1, 0] / W[1, 1])), "sign"),
        ("02-differential-dynamics", no_integral, "lacks the slopes q"),
        ("02-differential-dynamics", by_columns, "scales columns"),
        ("02-theorem-1", (-1.0, -3.0), "off the diagonal"),
        ("03-harmless-coupling", lambda a, b: a * b, "square"),
        ("03-hierarchy-metric", 1.0, "more weight"),
        ("03-feedback-gain", lambda s, w, p, q: np.eye(2), "skew"),
        ("04-transforms", lambda a, b: explicit(a, b, exchange=False, last=False), "P, ones on"),
        ("04-transforms", lambda a, b: explicit(a, b, last=False), "lacks P"),
        ("04-transforms", lambda a, b: explicit(a, b, transpose=False), "transpose first"),
        ("04-floor", lambda L, R: np.diag(L) / np.abs(np.diag(R)), "cut at 0"),
        ("04-module", (-3.0, -4.5), "trace"),
        ("04-module", (-2.5, -9.0), "determinant"),
    ],
)
def test_likely_slips_get_a_hint_that_fits(name, answer, hint):
    verdict = exercises.check(name, answer)
    assert not verdict
    assert hint in repr(verdict)
    assert "\n" not in repr(verdict)
