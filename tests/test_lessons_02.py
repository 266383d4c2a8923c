"""Lesson 02: what its text says is what its cells compute."""

import itertools

import numpy as np
import pytest
from lesson import run


@pytest.fixture(scope="module")
def whole():
    return run("02", solved=True)


@pytest.fixture(scope="module")
def space(whole):
    return whole.space


def test_straight_wires_fail_and_swapped_ones_do_not(space):
    """The hook, told fairly: a swap of wires cures this plant."""
    assert (space["straight"] > 0).all()
    assert (space["swapped"] < 0).all()
    assert space["order"] == (1, 0)
    assert (space["auxiliary"] < 0).all()


def test_the_proof_for_every_gain(space):
    f_y, f_u, rng = space["f_y"], space["f_u"], np.random.default_rng(7)
    for _ in range(100):
        K_p, K_i = (np.diag(10 ** rng.uniform(-3, 3, 2)) for _ in range(2))
        J = np.block([[f_y - f_u @ K_p, -f_u @ K_i], [np.eye(2), np.zeros((2, 2))]])
        assert np.linalg.det(J) < 0
        assert np.linalg.eigvals(J).real.max() > 0


def test_one_of_two_pairings_always_has_a_positive_relative_gain():
    G = np.random.default_rng(0).normal(size=(1000, 2, 2))
    relative = (G * np.swapaxes(np.linalg.inv(G), 1, 2))[:, 0]
    np.testing.assert_allclose(relative.sum(-1), 1.0, atol=1e-6)


def test_no_wiring_of_the_three_signals_is_enough_and_the_transforms_are(space):
    assert len(space["hard_shares"]) == 48
    assert max(space["hard_shares"].values()) < 0.75
    f_y, f_u, hard = space["hard_f_y"], space["hard_f_u"], space["hard"]
    assert np.linalg.eigvals(f_y).real.max() < 0
    rng = np.random.default_rng(3)  # other gains than the lesson's
    p, q = 10 ** rng.uniform(-2, 1, (2, 400, 3))
    best = 0.0
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            G = f_u @ (np.eye(3)[:, list(order)] * signs)
            J = [_loop(f_y, G, -a, -b) for a, b in zip(p[:150], q[:150], strict=True)]
            best = max(best, np.mean(np.linalg.eigvals(J).real.max(-1) < 0))
    assert best < 0.75
    sign = -np.sign(np.diag(hard.R))
    J = [_loop(hard.Lambda, hard.R, sign * a, sign * b) for a, b in zip(p, q, strict=True)]
    assert (np.linalg.eigvals(J).real.max(-1) < 0).all()


def _loop(A, B, p, q):
    n = len(A)
    return np.block([[A + B @ np.diag(p), B @ np.diag(q)], [np.eye(n), np.zeros((n, n))]])


def test_the_mode_that_both_signals_show_needs_one_steep_network(space, whole):
    assert np.linalg.eigvals(space["two_f_y"]).real.max() > 0
    vector = space["two"].V[:, 0]
    assert np.abs(vector).min() > 0.3  # seen by both
    assert (space["floors"] > 0).tolist() == [True, False]
    assert "best of 8 wirings: 8" in whole.text or "best of 8 wirings: 9" in whole.text
    # the network that the floor frees may be as flat as it likes
    two, floor = space["two"], space["floors"][0]
    for share, decays in ((1.05, True), (0.95, False)):
        J = _loop(two.Lambda, two.R, np.array([-share * floor, -1e-3]), np.array([-0.1, -0.1]))
        assert (np.linalg.eigvals(J).real.max() < 0) == decays


def test_the_warp_ends_in_the_modes(space):
    """At 1 the map is T_y but for order, sign and length; at 0 it is the identity."""
    start, end = space["warp"](0.0), space["warp"](1.0)
    np.testing.assert_allclose(start["flow"], space["runs"])
    axes = end["axes"]  # (end, mode, 2): along the coordinate axes
    np.testing.assert_allclose(np.abs(axes[1]), 3 * np.eye(2), atol=1e-9)
    moved = end["flow"]  # x_i falls at its own eigenvalue
    t = np.linspace(0.0, 6.0, 121)
    rates = np.log(np.abs(moved[60, 1] / moved[0, 1])) / t[60]
    np.testing.assert_allclose(np.sort(rates), np.sort(np.diag(space["Lambda"])), atol=1e-8)


def test_no_warp_on_the_way_is_singular(space):
    for share in np.linspace(0, 1, 51):
        assert np.isfinite(space["warp"](share)["rows"]).all()


def test_the_turn_makes_R_triangular(space):
    R = space["turn"](space["right"])["R"]
    assert abs(R[1, 0]) < 1e-3
    np.testing.assert_allclose(np.abs(np.diag(R)), np.diag(space["R"]), atol=2e-3)
    assert abs(space["turn"](space["right"] + 30)["R"][1, 0]) > 0.3


def test_the_numbers_by_hand(space):
    """Those of the Markdown cell."""
    T_y, T_a, R = (space[k] for k in ("T_y", "T_a", "R"))
    np.testing.assert_allclose(T_y, [[0.358, 0.977], [0.840, -0.615]], atol=6e-4)
    np.testing.assert_allclose(T_y @ space["f_u"], [[1.824, 1.693], [-0.082, 1.065]], atol=6e-4)
    np.testing.assert_allclose(T_a, [[0.997, -0.077], [0.077, 0.997]], atol=6e-4)
    np.testing.assert_allclose(R, [[1.949, 1.547], [0, 1.068]], atol=6e-4)


def test_F_is_the_derivative_of_the_loop(space):
    Lambda, R, p, q = (space[k] for k in ("Lambda", "R", "p", "q"))
    d = np.random.default_rng(0).normal(size=4)
    z_dot = Lambda @ d[:2] + R @ d[2:]
    np.testing.assert_allclose(space["F"] @ d, [*z_dot, *(p * z_dot + q * d[:2])])
    grouped = space["grouped"]
    np.testing.assert_allclose(grouped[2:, :2], 0.0, atol=1e-12)


@pytest.mark.parametrize("way", ["straight wires", "T_y and T_a"])
@pytest.mark.parametrize("crossing", [0.0, 0.55, 0.6, 1.5])
def test_crossing(space, way, crossing):
    out = space["coordinates"](crossing, 1.0, 0.5, way)
    decays = way == "T_y and T_a" or crossing < 0.577
    assert ("decays" in out["text"]) == decays
    assert (np.abs(out["y"][-1]).max() < np.abs(out["y"][0]).max()) or not decays


def test_a_singular_crossing_is_refused(space):
    out = space["coordinates"](float(space["limit"]), 1.0, 1.0, "T_y and T_a")
    assert out["text"].startswith("Refused")


def test_the_rate_has_the_half(space):
    distance, t, beta = space["distance"], space["t_short"], space["beta"]
    assert (space["lines"]["worst distance"] <= np.exp(-1.9 * t) + 1e-12).all()  # exercise 4
    F = space["one_F"]
    rate = -np.linalg.eigvalsh((F + F.T) / 2)[-1]
    assert (distance <= np.exp(-rate * t) + 1e-12).all()
    assert (distance[5:] > np.exp(-2 * rate * t[5:])).all()
    assert beta.shape == (40, 40)
    assert 0.0 < space["met"].mean() < 0.1
    assert space["decays"].all()


def test_the_transient_stays_below_its_bound(space):
    for h in (-8.0, 0.0, 5.0):
        out = space["leaning"](h)
        assert (out["y"] <= out["bound"] + 1e-9).all()
        assert (np.diff(out["z"]) < 0).all()
    assert out["y"].max() > 1.5


def test_turning_against_a_simulation(space):
    speed, h, S = 2.0, 1e-3, space["slant"]

    def f_y(t):
        c, s = np.cos(speed * t), np.sin(speed * t)
        V = np.array([[c, -s], [s, c]]) @ S
        return V @ space["rates"] @ np.linalg.inv(V)

    y = S.copy()
    for k in range(4000):
        y = y + h * f_y((k + 0.5) * h) @ (y + 0.5 * h * f_y(k * h) @ y)
    c, s = np.cos(4 * speed), np.sin(4 * speed)
    measured = np.linalg.norm(np.linalg.inv(np.array([[c, -s], [s, c]]) @ S) @ y, 2)
    out = space["turning"](speed)
    assert out["moving"][100] == pytest.approx(measured, rel=2e-3)  # at 4 s
    exponents = [space["growth"](space["rates"] - _spin(S, v)) for v in (0.1, 2.0, 20.0)]
    assert (np.array(exponents) > 0).tolist() == [False, True, False]


def _spin(S, speed):
    return np.linalg.inv(S) @ np.array([[0.0, -speed], [speed, 0.0]]) @ S


def test_a_frame_comes_to_rest_only_with_its_plant(space):
    assert space["falls"][-1] < 1e-6
    assert space["driven"][750:].max() > 0.05
