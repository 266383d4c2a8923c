"""Lesson 06: what its cells show is true, for its gains and for others."""

import numpy as np
import pytest
from lesson import lesson, run

from cmc.theory.composite import composite

GAINS = """
K_p, K_d = np.array({K_p}), np.array({K_d})
lambda_d = {lam}
arm = TwoLinkArm(lengths=(0.5, 0.4), masses=(2.0, 1.0))
"""


@pytest.fixture(scope="module")
def whole():
    return run("06")


@pytest.fixture(scope="module")
def demo():
    return lesson("06")


@pytest.mark.parametrize("sign", [1, -1])
def test_the_formula_of_the_cell_is_the_library_and_fits_the_error_equation(demo, sign):
    for K_p, K_d, lam in ((40.0, 20.0, 1.0), (3.0, 8.0, 2.0), (20.0, 30.0, 0.5)):
        K1, K2, A, B = demo["mixture"](K_p, K_d, lam, sign)
        np.testing.assert_allclose([A * K2, A * K1 + B * K2, B * K1], [lam, K_d, K_p])
        m = composite(K_p, K_d, lam, "small" if sign == 1 else "large")
        np.testing.assert_allclose([K1, K2, A, B], [m.K1, m.K2, m.A_lat, m.B_lat])
    with pytest.raises(ValueError, match=r"at least 12\.6"):
        demo["mixture"](40.0, 12.0)


def test_the_wrong_mixture_converges_in_y_and_runs_away_in_e(whole):
    A = np.array([[3.0, -3.0], [0.0, -2.0]])  # the cell's matrix: e' = 3 (e - y), y' = -2 y
    e, y = whole.space["linear_flow"](A, np.array([0.0, 1.5]), [0.7, 1.0])[-1]
    assert y < 0.06
    assert e > 5.0
    # on the path y = e - e'/3
    assert np.allclose(A[0] @ [e, y], 3 * (e - y))


def test_differences_decay_at_the_latent_rate(whole):
    K_p, K_d = 40.0, 20.0
    poles = np.sort(np.roots([1.0, K_d, K_p]))
    rate = whole.space["B"] / whole.space["A"]
    assert -rate == pytest.approx(poles[1])
    np.testing.assert_allclose(whole.space["change"], rate, rtol=1e-6)


@pytest.mark.parametrize(("factor", "one"), [(5.0, True), (-0.5, True), (-3.0, False)])
def test_slopes_decide_between_one_group_and_two(whole, factor, one):
    y = whole.space["tanh_policy"](factor * whole.space["B"])[1]
    assert (np.ptp(y[-1]) < 1.0) == one


def test_alternation_begins_after_one_and_rules_before_two(whole):
    text = whole.text
    assert "a negative eigenvalue from 1.14 on; it is the larger one from 1.76 on;" in text
    assert "at 2.00 it reaches -1" in text
    # a level between 1 and 1.14: the velocity does not alternate
    g = (1.05 / 0.02 - 20) / composite(40.0, 20.0).K2
    step, s, signs = whole.space["held_step"](g, 0.02), np.array([1.0, 0.0]), []
    for _ in range(40):
        s = step @ s
        signs.append(np.sign(s[1]))
    assert np.sum(np.diff(signs) != 0) == 0


@pytest.mark.parametrize("dt_ms", [5.0, 20.0, 40.0])
def test_the_verdict_turns_at_the_level_two(whole, dt_ms):
    cap = float(composite(40.0, 20.0).slope_cap(dt_ms * 1e-3))
    for share, word in ((0.98, "settles"), (1.02, "diverges")):
        assert word in whole.space["held"](share * cap, dt_ms, 40.0, 20.0)["text"]


def test_the_arm_follows_the_model_of_gains(whole):
    assert whole.space["off"] < 0.05
    e, y, u = whole.space["follow"](lambda s: 5.0 * s[..., 0])
    assert np.abs(y - whole.space["by_gains"](y[0], u)).max() < 0.05 * np.abs(y).max()


def test_untrained_policies_in_their_true_order(whole):
    left = {name: line[-1] for name, line in whole.space["worst"].items()}
    assert left["linear, at the caps"] < 0.05 * left["network by hand"]
    assert left["no policy"] < 0.3 * min(left["network as drawn"], left["same, no biases"])
    assert left["wrong sign"] > 50


def test_the_order_is_that_of_another_seed_too(whole):
    seed = 2

    def left(policy):
        return np.linalg.norm(whole.space["follow"](policy)[0][-1], axis=-1).max()

    networks = whole.space["networks"]
    assert left(networks(seed, 0.5, lambda k: 2 / k)) > left(whole.space["policies"]["no policy"])
    assert left(networks(seed, 0.0, lambda k: 0.8)) > left(
        whole.space["policies"]["linear, at the caps"]
    )


def test_networks_are_positive_and_capped(whole):
    policy = whole.space["networks"](5, 0.3, lambda k: 0.8)
    s = np.random.default_rng(0).normal(size=(100, 2, 2))
    for j, cap in enumerate(whole.space["caps"]):
        step = 1e-4 * np.eye(2)[j]
        slope = (policy(s + step) - policy(s - step)) / 2e-4
        assert slope.min() > 0
        assert slope.max() < 1.001 * cap


def test_learning_finds_the_gains_where_they_are_right_and_beats_them_where_not(whole):
    f_y, f_u, f_0 = whole.space["fit"](*whole.space["excite"](0.0, 300))
    np.testing.assert_allclose(np.diag(f_u), whole.space["latent"].f_u, rtol=0.05)
    np.testing.assert_allclose(np.diag(f_y), whole.space["latent"].f_y, rtol=0.05)
    wrong = whole.space["unexplained"](0.3)
    assert wrong["learned"] < 0.5 * wrong["gains and a constant"] < 0.5 * wrong["gains"]
    f_y, f_u, _ = whole.space["fit"](*whole.space["excite"](0.3, 300))
    for M in (f_y, f_u):
        assert np.abs(M - np.diag(np.diag(M))).max() < 0.12 * np.abs(np.diag(M)).min()


def test_the_error_falls_as_one_over_the_root(whole):
    assert -0.75 < whole.space["power"] < -0.35


def test_other_gains_give_their_own_figures():
    other = run("06", plant=GAINS.format(K_p=[12.0, 30.0, 5.0], K_d=[8.0, 25.0, 9.0], lam=1.2))
    assert "it uses the first ones" in other.text
    poles = np.sort(np.roots([1.2, 8.0, 12.0]).real)
    assert other.space["B"] / other.space["A"] == pytest.approx(-poles[1])
    np.testing.assert_allclose(other.space["change"], -poles[1], rtol=1e-5)
    assert other.space["off"] < 0.05
    assert "at 2.00 it reaches -1" in other.text


@pytest.mark.parametrize(
    ("K_d", "reason"),
    [([12.0, 20.0], "no real composite variable"), ([-3.0, 5.0], "K_d needs positive values")],
)
def test_gains_without_a_composite_variable_are_refused_and_replaced(K_d, reason):
    found = lesson("06", plant=GAINS.format(K_p=[40.0, 40.0], K_d=K_d, lam=1.0))
    assert (found["K_d"] ** 2 >= 4 * found["K_p"] * found["lambda_d"]).all()
    with pytest.raises(ValueError, match=reason):
        composite([40.0, 40.0], K_d, 1.0)
