"""Lesson 06: what its pictures show is true, and its exercise tells right from wrong."""

import numpy as np
import pytest

from cmc import exercises
from cmc.lessons import latent_arm, lesson_06
from cmc.theory.composite import composite


def test_error_motion_is_the_exact_solution():
    t = np.linspace(0, 1, 101)
    path = lesson_06.error_motion(40.0, 20.0, 1.0, np.array([1.0, 0.0]), t)
    p, q = np.sort(np.roots([1, 20, 40]).real)
    exact = (p * np.exp(q * t) - q * np.exp(p * t)) / (p - q)
    np.testing.assert_allclose(path[:, 0], exact, atol=1e-10)


@pytest.mark.parametrize("root", ["small", "large"])
def test_point_mass_shows_y_on_its_envelope(root):
    shown = lesson_06.point_mass(40.0, 20.0, 1.0, root)
    np.testing.assert_allclose(shown["y"], shown["latent"], atol=1e-9)


def test_point_mass_in_the_infeasible_zone_says_so_and_rings():
    shown = lesson_06.point_mass(40.0, 5.0)
    assert "refused" in shown["text"]
    assert "12.65" in shown["text"]
    assert np.isnan(shown["y"]).all()
    assert shown["e"].min() < -0.05
    assert (np.abs(shown["edge"][:, 1] ** 2 - 4 * shown["edge"][:, 0]) < 1e-9).all()


def test_wrong_composition_converges_in_y_and_diverges_in_e():
    run = lesson_06.wrong_composition()
    assert abs(run["y"][-1]) < 0.06 * run["y"][0]
    assert run["e"][-1] > 5 * run["e"][0]


def test_hierarchy_decays_at_the_rates_of_the_model():
    run = lesson_06.hierarchy("small")
    np.testing.assert_allclose(
        run["y"] / run["y"][0], run["latent"][:, None] * np.ones(39), rtol=1e-6
    )
    late = run["e"][-1] / run["e"][150]
    np.testing.assert_allclose(late, run["latent"][-1] / run["latent"][150], rtol=0.02)


def test_velocity_only_leaves_positions_apart():
    run = lesson_06.velocity_only()
    assert np.abs(run["y"][-1]).max() < 1e-3
    assert np.ptp(run["e"][-1]) > 0.5


@pytest.mark.parametrize(("slope", "one"), [(5.0, True), (-0.5, True), (-3.0, False)])
def test_policy_slopes_decide_between_one_group_and_two(slope, one):
    assert (lesson_06.policy_loop(slope)["spread"] < 1.0) == one


@pytest.mark.parametrize("dt_ms", [5.0, 20.0, 40.0])
def test_chatter_starts_at_the_level_two(dt_ms):
    cap = float(composite(40.0, 20.0).slope_cap(dt_ms * 1e-3))
    for share, stable in ((0.98, True), (1.02, False)):
        run = lesson_06.chatter(share * cap, dt_ms)
        assert (run["level"] < 2) == (run["radius"] < 1) == stable
        assert np.isfinite(run["v"]).all()


def test_arm_follows_its_latent_model_and_any_positive_network_contracts():
    starts = latent_arm.ring_of_starts(4)
    for policy in (latent_arm.no_policy, latent_arm.positive_policy(3)):
        run = latent_arm.tracking(policy, starts)
        assert np.abs(run["y"] - run["y_model"]).max() < 0.03 * np.abs(run["y"]).max()
        spread = np.linalg.norm(run["tip"] - run["tip"].mean(axis=1, keepdims=True), axis=-1)
        assert spread[-1].max() < 0.02 * spread[0].max()


def test_the_wrong_sign_does_not_track():
    run = latent_arm.tracking(
        latent_arm.positive_policy(0, sign=-1.0), latent_arm.ring_of_starts(3)
    )
    assert np.linalg.norm(run["e"][-1], axis=-1).min() > 0.06


def test_policies_are_positive_and_odd():
    policy = latent_arm.positive_policy(0)
    s = np.random.default_rng(0).normal(size=(200, 2, 2))
    np.testing.assert_allclose(policy(-s), -policy(s), atol=1e-12)
    for j, cap in enumerate(latent_arm.SLOPES):
        step = np.zeros(2)
        step[j] = 1e-4
        slope = (policy(s + step) - policy(s)) / 1e-4
        assert slope.min() > 0
        assert slope.max() < 1.001 * cap


def test_learning_recovers_the_gains_where_they_are_right_and_beats_them_where_not():
    right, wrong = latent_arm.model_errors(0.0), latent_arm.model_errors(0.3)
    np.testing.assert_allclose(right["fit"].f_u, np.diag(right["model"].f_u), atol=0.05)
    np.testing.assert_allclose(right["fit"].f_y, np.diag(right["model"].f_y), atol=0.05)
    assert right["gains"] < 0.02
    assert wrong["learned"] < 0.5 * wrong["gains and a constant"] < wrong["gains"]


def test_more_data_learn_better():
    error = lesson_06.data_needed(seeds=6)["error"].mean(axis=0)
    assert error[-1] < 0.25 * error[0]


def test_exercise_refuses_the_small_root_the_wrong_scale_and_silence():
    def small(K_p, K_d, lambda_d):
        m = composite(K_p, K_d, lambda_d)
        return m.K1, m.K2, m.A_lat, m.B_lat

    def large(K_p, K_d, lambda_d):
        m = composite(K_p, K_d, lambda_d, root="large")
        return m.K1, m.K2, m.A_lat, m.B_lat

    def scaled(K_p, K_d, lambda_d):
        K1, K2, A, B = large(K_p, K_d, lambda_d)
        return 2 * K1, 2 * K2, A / 2, B / 2

    def silent(K_p, K_d, lambda_d):
        return large(K_p, max(K_d, 2.1 * np.sqrt(K_p * lambda_d)), lambda_d)

    exercises.check("06-composite", large)
    for wrong, reason in ((small, "small root"), (scaled, "paper's scale"), (silent, "ValueError")):
        with pytest.raises(AssertionError, match=reason):
            exercises.check("06-composite", wrong)
