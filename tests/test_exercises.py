"""Exercises: registration, one calm line for every answer, a hint that fits for likely slips."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

import exercises
from cmc.theory.composite import composite


@pytest.fixture
def judged(monkeypatch):
    """An exercise 00-demo that exists during one test."""

    exercises.names("00")  # they are registered before and stay
    monkeypatch.setattr(exercises, "CHECKS", dict(exercises.CHECKS))

    @exercises.compare("00-demo", "twice {0:g}")
    def demo():
        yield (3.0,), 6.0, {"this is 3 squared": 9.0}


def stub(x):
    raise NotImplementedError


@pytest.mark.parametrize(
    ("answer", "passed", "line"),
    [
        (lambda x: 2 * x, True, "00-demo: solved."),
        (lambda x: x * x, False, "this is 3 squared"),
        (lambda x: x + 1, False, "twice 3 should be 6, yours is 4"),
        (stub, False, "00-demo: not written yet."),
        (..., False, "00-demo: not written yet."),
        (lambda x: None, False, "twice 3 is None"),
        (lambda x: 1 / 0, False, "your code stopped with ZeroDivisionError: division by zero"),
        (lambda x: exec("a b"), False, "your code stopped with SyntaxError"),
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
        ([[1.0, 0.0], [np.nan, 1.0]], r"at \(1, 0\) should be finite"),
        ([[1.0, 0.0], [0.0, 1.0 + 2e-6]], r"at \(1, 1\)"),
    ],
)
def test_close_explains(value, message):
    with pytest.raises(AssertionError, match=message):
        exercises.expect_close(value, np.eye(2), "T_y")


def test_unknown_and_taken_names_are_refused(judged):
    for name, message in (("00-no", "00-rate"), ("99-no", "lesson '99' has no exercises")):
        with pytest.raises(KeyError, match=message):
            exercises.check(name, 1)
    with pytest.raises(ValueError, match="02-sign-rule"):
        exercises.check("sign", 1)
    stub.__module__ = "elsewhere"
    with pytest.raises(ValueError, match="already judged"):
        exercises.check("00-demo")(stub)
    assert exercises.check("00-new")(stub) is exercises.CHECKS["00-new"] is stub


def wrong_rate(A):
    return -np.trace(A) / 2


def lower_factor(J, M):
    theta = np.linalg.cholesky(M)
    F = theta @ J @ np.linalg.inv(theta)
    return -np.linalg.eigvalsh((F + F.T) / 2)[-1]


def no_integral(L, R, p, q):
    return np.block([[L, R], [np.diag(p) @ L, np.diag(p) @ R]])


def by_columns(L, R, p, q):
    return np.block([[L, R], [p * L + np.diag(q), p * R]])


def explicit(f_y, f_u, exchange=True, transpose=True, last=True):
    T_y = np.linalg.inv(np.linalg.eig(f_y)[1])
    P = np.eye(len(f_y))[::-1]
    W = (T_y @ f_u).T if transpose else P @ T_y @ f_u
    Q = np.linalg.qr(W @ P if exchange and transpose else W)[0]
    return T_y, Q @ P if last else Q


def disturbance(time, sign):
    def answer(t, J, B, row, end):
        w = row @ expm(J * time(t, end)) @ B
        return sign * w / np.linalg.norm(w)

    return answer


def targets(s, a, critics):
    seen = torch.cat([s, torch.tanh(a(s))], -1)
    return [critic(seen) for critic in critics]


def unshrinking(states, actions, goals, act):
    return int(np.argmin([((actions - [act(s, g) for s in states]) ** 2).sum() for g in goals]))


STILL = ([[-1.0, 0.5], [0.2, -3.0]], [[1.0, 0.3], [0.4, 2.0]], [[0.5, 0.3]] * 2, [[2.0, 1.0]] * 2)
APART = (np.diag([-1.0, -2.0]), np.eye(2), np.ones((2, 2)), np.ones((2, 2)), 0.1)
SLOW_PLAN = [(9.5, 4), (9.5, -3), (-5.1, -3), (3, -3), (3, -12.5), (0, -12.5)]
SLIPS = [
    ("00-rate", wrong_rate, "the slowest of the rates"),
    ("00-rate", lambda A: np.linalg.eigvals(A).real.max(), "the sign is wrong"),
    ("00-rate", lambda A: -np.linalg.eigvals(A), "one number"),
    ("00-slope", lambda s, W, w: (w * (1 - np.tanh(s @ W.T) ** 2)).sum(-1), "inner derivative"),
    ("00-design", (1.0, -1.0), "does not decay"),
    ("00-design", (3.0, 1.0), "above 2"),
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
    ("05-slopes", lambda W, b, s: np.linalg.multi_dot(W[::-1])[0], "W_l ... W_1 alone"),
    ("05-slopes", lambda W, b, s: 1.0, "should have shape (2,)"),
    ("05-pump", lambda z, w: 1.0, "decays"),
    ("05-pump", lambda z, w: 0.5 if z * w < 0 else 1.5, "decays"),
    ("05-pump", lambda z, w: 2.0, "should stay in"),
    ("05-quadrature", lambda p, q, L, R, h: np.eye(2), "the step in"),
    ("05-own-plant", lambda: APART, "f_y is diagonal"),
    ("05-own-plant", lambda: (*STILL, 0.05), "at 1.1 h"),
    ("06-design", lambda s, f, g: (s + f, s * f, 0.01), "not the reverse"),
    ("06-design", lambda s, f, g: (s * f, s + f, 1e-4), "can be longer"),
    ("06-design", lambda s, f, g: (s * f, s + f, 2.0 / (s + f)), "too long"),
    ("06-verdict", lambda K_p, K_d, g, dt: "settles", "yours 'settles'"),
    (
        "06-verdict",
        lambda p, d, g, dt: "alternates" if (d + g * composite(p, d).K2) * dt > 1 else "settles",
        "the level alone does not tell",
    ),
    ("06-commands", lambda n: np.full((n, 2), 3.0), "look alike"),
    ("06-commands", lambda n: np.full((n, 2), 4.0), "beyond 3"),
    ("06-commands", lambda n: np.random.default_rng(0).uniform(-3, 3, (n, 2)), "of the random"),
    ("07-worst-disturbance", lambda t, J, B, row, end: np.array([1.0, 0.0]), "a constant"),
    ("07-worst-disturbance", lambda t, J, B, row, end: row @ B + 1.0, "divide by its length"),
    ("07-worst-disturbance", disturbance(lambda t, end: t, 1), "time runs the wrong way"),
    ("07-worst-disturbance", disturbance(lambda t, end: end - t, -1), "sign is wrong"),
    ("07-edge", lambda radius, top: 2.0, "yours is 2"),
    ("07-anti-windup", lambda ahead, *rest: ahead, "stop the integral"),
    ("07-anti-windup", lambda ahead, integral, *rest: integral, "within its limits"),
    ("08-gains", lambda: (0.02, 8.0), "on 62 N/m you use 172%"),
    ("08-gains", lambda: (0.001, 1.0), "too slow"),
    ("08-gains", lambda: (-0.02, 4.0), "wrong sign"),
    ("08-gains", lambda: 0.02, "two numbers"),
    ("08-turned-tool", lambda K, s, a: ([[1, 0], [-K * s, 1]], np.eye(2)), "this is V"),
    ("08-turned-tool", lambda K, s, a: ([[1, 0], [K * s, 1]], np.eye(2)), "R_21 should be 0"),
    ("08-best-average", lambda r, f, w: np.argmax(r @ w), "place of the best"),
    ("08-best-average", lambda r, f, w: (r @ w).max(), "best average; return the factor"),
    ("09-surrogate", lambda r, A, c: np.mean(np.clip(r, 1 - c, 1 + c) * A), "undone"),
    ("09-surrogate", lambda r, A, c: np.mean(r * A), "it is cut"),
    ("09-surrogate", lambda r, A, c: np.minimum(r * A, np.clip(r, 0.8, 1.2) * A), "one number"),
    ("09-slope-cap", lambda k1, k2, tau, K, h: 1.0, "of its bound"),
    ("09-slope-cap", lambda k1, k2, tau, K, h: 1e-3, "the used share"),
    ("09-period", lambda k1, k2, tau, K: 0.001, "it is still calm"),
    ("09-period", lambda k1, k2, tau, K: 0.15, "it rattles already"),
    ("10-torque", lambda M, J, h, d, p: J.T @ p + h, "the torque at"),
    ("10-torque", lambda M, J, h, d, p: M @ np.linalg.pinv(J) @ p + h, "counts twice"),
    ("10-torque", lambda M, J, h, d, p: M @ np.linalg.pinv(J) @ (p - d), "h is missing"),
    (
        "10-torque",
        lambda M, J, h, d, p: J.T @ np.linalg.solve(J @ np.linalg.inv(M) @ J.T, p - d) + h,
        "acceleration form",
    ),
    ("10-posture", lambda M, J, q: M @ q, "does to the tip"),
    ("10-posture", lambda M, J, q: (np.eye(7) - np.linalg.pinv(J) @ J) @ q, "does to the tip"),
    ("10-posture", lambda M, J, q: np.zeros(7), "elbow"),
    ("10-limit", lambda m, k, c: 1.0 / m - k * c, "7.0 kg"),
    ("11-target", lambda r, s, a, c, d, n: r + d * torch.maximum(*targets(s, a, c)), "the larger"),
    ("11-target", lambda r, s, a, c, d, n: r + d * targets(s, a, c)[0], "too hopeful"),
    ("11-target", lambda r, s, a, c, d, n: r + torch.minimum(*targets(s, a, c)), "discount is"),
    ("11-target", lambda r, s, a, c, d, n: r + d * torch.minimum(*targets(s, a, c)), "get noise"),
    ("11-relabel", lambda s, a, g, act: 0, "explains the actions best"),
    ("11-relabel", unshrinking, "shrinks"),
    (
        "11-gain",
        lambda p, d, h, level: (level / h - d) / (2 * p / (d - (d * d - 4 * p) ** 0.5)),
        "larger root",
    ),
    ("12-segment-return", lambda r, h: np.cumsum(r[::-1])[::-1], "ends with the segment"),
    ("12-discount", lambda push, stand: 0.99, "smallest discount"),
    ("12-plan", lambda: [(9.5, 4), (0, -12.5)], "no strict touch"),
    ("12-plan", lambda: SLOW_PLAN, "wanted above -90"),
    ("12-plan", lambda: None, "None"),
    ("13-order", lambda f_y: list(range(len(f_y))), "after it"),
    ("13-order", lambda f_y: None, "an order exists"),
    ("13-hold", lambda proved, low, high: low, "falls short"),
    ("13-hold", lambda proved, low, high: high, "not proved"),
    ("13-hold", lambda p, a, b: max(h for h in np.arange(a, b, 0.001) if p(h)), "questions"),
    ("13-angle", lambda limit: limit / 5, "can hold"),
    ("13-angle", lambda limit: np.arcsin(limit / 5) if limit < 5 else np.pi, "90 degrees"),
    ("13-own", lambda: 3, "five things"),
    ("13-own", lambda: (lambda y, u: u - y, ([-1, -1], [1, 1]), (-1, 1), 1, 2), "linear"),
]


@pytest.mark.parametrize(("name", "answer", "hint"), SLIPS)
def test_likely_slips_get_a_hint_that_fits(name, answer, hint):
    verdict = exercises.check(name, answer)
    assert not verdict
    assert hint in repr(verdict)
    assert "\n" not in repr(verdict)
