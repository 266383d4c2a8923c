"""Lesson 05: each sentence that names a figure is tied to what the cells compute."""

import numpy as np
import pytest
from lesson import run
from scipy.integrate import solve_ivp

from cmc.theory.certificates import circle_criterion
from cmc.theory.certify import certify


@pytest.fixture(scope="module")
def whole():
    return run("05")


def test_the_same_weights_lose_with_signs_and_settle_without(whole):
    space = whole.space
    weights, biases = space["draw"](30, 2, seed=4)
    starts = np.tile(space["start"], (30, 1))
    shares = [
        np.mean(space["distance"](W, biases, starts)[-1] > 0.1)
        for W in (weights, [np.abs(W) for W in weights])
    ]
    assert shares[0] > 0.5
    assert shares[1] == 0.0
    assert "their absolute values: 0% of" in whole.text
    assert "absolute: off by more than 0.1 at 15 s:   0% at 0.1,   0% at 1,   0% at 3" in whole.text


def test_outputs_of_tanh_networks_are_bounded(whole):
    weights, biases = whole.space["draw"](50, seed=1)
    far = whole.space["network"](weights, biases, np.full((50, 2), 1e6))
    assert (np.abs(far) <= np.abs(weights[-1]).sum(axis=(-2, -1))).all()


@pytest.mark.parametrize("size", [0.1, 0.8, 5.0])
def test_slopes_stay_in_the_interval_of_the_architecture(whole, size):
    nets = whole.space["BoundedNetworks"]([0.3, 0.1], [1.5, 0.4], size, count=40, seed=2)
    s = np.random.default_rng(0).normal(scale=3.0, size=(300, 40, 2))
    for j, (low, high) in enumerate(((0.3, 1.5), (0.1, 0.4))):
        step = 1e-5 * np.eye(2)[j]
        slope = (nets.pi(s + step) - nets.pi(s - step)) / 2e-5
        assert slope.min() >= low - 1e-8
        assert slope.max() <= high + 1e-8
    assert whole.space["one_network"](0.8, 0.0, 99.0)["slope"].min() < 0.05


def test_identity_transforms_lose_at_every_slope(whole):
    p = np.logspace(-3, 3, 40)
    spaces, growth = whole.space["spaces"], whole.space["growth"]
    assert min(growth(spaces["identity transforms"], x) for x in p) > 0
    assert max(growth(spaces["T_y and T_a"], x) for x in p) < 0
    assert "= -2: negative: without transforms no slope can work" in whole.text


def test_the_floor_is_where_a_growing_mode_turns_stable(whole):
    L, R = 0.7, -1.3
    for share in (0.99, 1.01):
        J = whole.space["module"](L, R, share * L / abs(R), 0.1)
        assert (np.linalg.eigvals(J).real.max() < 0) == (share > 1)


def test_the_breathing_loop_grows_although_every_instant_decays(whole):
    def rhs(t, s):
        return [-0.1 * s[0] - (1 + 0.5 * np.cos(2 * t)) * s[1], s[0]]

    ends = [solve_ivp(rhs, (0, np.pi), e, rtol=1e-10, atol=1e-12).y[:, -1] for e in np.eye(2)]
    multipliers = np.sort(np.linalg.eigvals(np.transpose(ends)))  # over one period of J(t)
    np.testing.assert_allclose(multipliers, [-1.263, -0.579], atol=5e-4)
    found = np.exp(whole.space["log_growth"](0.1, 0.5))
    assert found == pytest.approx(-multipliers[0], rel=1e-5)
    assert "largest real part of J(t) at any instant: -0.050" in whole.text
    assert "multiplies the largest displacement by 1.263" in whole.text


def test_two_oscillations_attract_with_light_damping_and_one_with_heavy(whole):
    starts = np.array([-6.0, -3.0, 0.0, 3.0, 6.0])
    _, light = whole.space["tanh_loop"](0.1, starts)
    amplitudes = np.ptp(light[-241:], axis=0) / 2
    np.testing.assert_allclose(amplitudes, [4.517, 4.517, 0.570, 0.570, 4.517], atol=2e-3)
    assert np.ptp(np.ptp(whole.space["tanh_loop"](1.0, starts)[1][-241:], axis=0)) < 1e-3
    stiffness = 0.2 / np.cosh(0.02 * 4.517) ** 2 + 0.8 / np.cosh(4.517) ** 2
    assert stiffness == pytest.approx(0.2, abs=3e-3)


def test_the_metric_of_the_proof_exists_where_the_criterion_holds(whole):
    rng = np.random.default_rng(0)
    for c, k_lo, k_hi in rng.uniform(0.05, 3.0, (200, 3)):
        k_lo, k_hi = sorted((k_lo, k_hi))
        M, worst = whole.space["one_metric"](c, k_lo, k_hi)
        assert (worst < 0) == bool(circle_criterion(c, k_lo, k_hi))
        assert np.linalg.eigvalsh(M).min() > 0


def test_the_map_is_the_truth_and_the_criterion(whole):
    space = whole.space
    true, damping, depths = space["true"], space["damping"], space["depths"]
    certified = depths[:, None] < space["certified_to"]
    assert (true[certified] < 0).all()
    assert (np.diff(true, axis=0) > -1e-9).all()  # growth rises with the depth
    inside = space["grows_from"] < 0.97
    at_edge = space["log_growth"](damping, space["grows_from"])
    assert np.abs(at_edge[inside]).max() < 0.01
    for c, depth in ((0.1, 0.5), (0.8, 0.5)):
        assert ("certificate holds" in space["on_the_map"](c, depth)["text"]) == bool(
            circle_criterion(c, 1 - depth, 1 + depth)
        )


def test_the_certificate_is_of_the_whole_interval_and_no_weights_break_it(whole):
    space = whole.space
    nets = space["BoundedNetworks"]([0.5, 0.25], [2.0, 1.0])
    answer = certify(nets, space["linear"])
    assert answer.rate == pytest.approx(0.0528, abs=5e-4)
    assert answer.overshoot == pytest.approx(2.12, abs=0.02)
    for size, seed in ((0.1, 5), (1.0, 6), (30.0, 7)):
        other = space["BoundedNetworks"]([0.5, 0.25], [2.0, 1.0], size, seed=seed)
        left = space["cloud"](other, answer.metric)
        assert (left <= np.exp(-answer.rate * np.linspace(0, 12, 121)) + 1e-6).all()
    assert not certify(space["BoundedNetworks"]([0.0, 0.0], [2.0, 1.0]), space["linear"])


def test_the_turning_plant_follows_the_recipe_and_leaves_its_goal(whole):
    space = whole.space
    turning = space["turning"]
    y = np.array([[0.1, -4.5], [-0.2, -4.0], [0.0, 1.0]])
    recipe = turning.space(y, turning.hold(y))
    cos, sin = np.cos(3 * y[:, 0]), np.sin(3 * y[:, 0])
    rot = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    np.testing.assert_allclose(recipe.T_a, rot, atol=1e-6)
    u, step = np.array([0.3, -1.0]), 1e-6
    numeric = [(turning.f(y + d, u) - turning.f(y - d, u)) / (2 * step) for d in step * np.eye(2)]
    np.testing.assert_allclose(turning.f_y(y, u), np.stack(numeric, -1), atol=1e-7)
    assert np.linalg.eigvals(space["J_frozen"]).real.max() < 0  # at the goal
    assert "exact  linearization at the goal: largest real part +13.34" in whole.text
    assert not space["promise"]  # a frozen answer proves nothing here
    assert space["promise"].rate > 0
    assert space["apart"][-1].min() > 50 * space["apart"][0].min()


def test_the_sampled_formula_is_what_is_measured(whole):
    assert whole.space["error"] < 0.01
    for log_h, p in ((-0.5, 2.0), (0.3, 0.5), (-1.0, 9.0)):
        shown = whole.space["held"](log_h, p, 0.25)
        h = whole.space["tau"] * 10**log_h
        L, R, q = whole.space["Lambda"], whole.space["R"], 0.25 * p / whole.space["tau"]
        stable = p + h / 2 * q < L / R / np.tanh(L * h / 2)
        assert ("unstable" not in shown["text"]) == stable
