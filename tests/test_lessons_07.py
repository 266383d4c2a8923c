import numpy as np
import pytest

from cmc.lessons import (
    lesson_07,
    lesson_07_limits,
    lesson_07_model_error,
    lesson_07_policies,
)
from cmc.theory.contraction import contraction_rate
from cmc.theory.saturation import ANTI_WINDUP


@pytest.fixture(scope="module", autouse=True)
def _fast():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CMC_FAST", "1")
        yield
    lesson_07.containment.cache_clear()
    lesson_07.ladder.cache_clear()
    lesson_07_policies.under_delay.cache_clear()


def test_every_promise_contains_every_trajectory_of_the_nonlinear_loop():
    found = lesson_07.containment()
    assert set(found["inside"].values()) == {found["count"]}
    assert 0.2 < found["used"]["shaped ellipsoid"] < 1.0


def test_ladder_descends_from_the_paper_to_what_happens():
    steps = list(lesson_07.ladder().values())
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > 5 * steps[-2]
    assert steps[-3] < 4 * steps[-2]


def test_worst_disturbances_stay_below_the_bound_and_above_the_random_ones():
    drawn = lesson_07.in_metric()
    for course in drawn["courses"].values():
        assert (course <= drawn["bound"] * (1 + 1e-9) + 1e-12).all()
    last = {name: course[-1] for name, course in drawn["courses"].items()}
    assert last["worst signal, worst fixed slopes"] >= last["worst constant, worst fixed slopes"]
    assert last["worst signal, worst fixed slopes"] > 0.2 * drawn["bound"][-1]
    assert last["largest of the random ones"] < last["worst signal, worst fixed slopes"]


def test_jacobian_of_the_loop_lies_within_the_corners_that_are_certified():
    this = lesson_07.example()
    rng = np.random.default_rng(0)
    s, eps = 3 * rng.normal(size=(50, 4)), 1e-6
    J = np.stack(
        [(this.rhs(0, s + eps * e) - this.rhs(0, s - eps * e)) / (2 * eps) for e in np.eye(4)], -1
    )
    low, high = this.corners.min(axis=0), this.corners.max(axis=0)
    np.testing.assert_allclose(J, np.clip(J, low, high), atol=1e-6)
    assert (contraction_rate(J, this.common.metric) >= this.common.rate - 1e-6).all()


@pytest.mark.parametrize("metric", ["certificate", "one metric", "shaped ellipsoid"])
def test_ball_slider_draws_signals_inside_their_band(metric):
    for size in (0.0, 2.0):
        drawn = lesson_07.ball(size, metric)
        assert drawn["y"].shape == (len(drawn["t"]), 24)
        assert (np.abs(drawn["y"]) <= drawn["high"][:, None] + 1e-9).all()


def test_shifts_of_the_paper_pass_its_own_test_never():
    for shares in lesson_07_model_error.shift_tests(2000).values():
        assert shares["stable"] == 1.0
        assert shares["paper, order"] == 0.0
        assert shares["nominal metric"] > 0.5
    found, policies = lesson_07_model_error.box_metrics()
    assert found == policies


def test_mismatch_map_agrees_with_the_slider():
    drawn = lesson_07_model_error.mismatch_map(5)
    for row, stiffness in enumerate(drawn["factors"]):
        for column, tau in enumerate(drawn["factors"]):
            text = lesson_07_model_error.mismatch(tau, stiffness)["text"]
            assert ("contracts" in text) == (drawn["rate"][row, column] > 0)
            assert ("unstable" not in text) == (drawn["margin"][row, column] > 0)


def test_first_figure_fails_where_it_says():
    drawn = lesson_07_limits.fails()
    assert np.abs(drawn["as designed"][-30:]).max() < 0.02
    assert np.abs(drawn["30 ms late"][-30:]).max() > 0.3
    assert abs(drawn["start 0.45"][-1]) < 0.05
    assert np.isnan(drawn["start 0.55"][-1])


def test_noise_and_delay_are_predicted():
    price = lesson_07_limits.noise_price()
    predicted = np.interp(price["measured at"], price["slopes"], price["noise"])
    np.testing.assert_allclose(price["measured"], predicted, rtol=0.05)
    for delay in (0.0, 30.0, 100.0):
        drawn = lesson_07_limits.late_response(delay, 0.3, False)
        outside = np.abs(drawn["poles"]).max() > 1
        assert outside == ("unstable" in drawn["text"])


def test_no_start_inside_the_ball_is_clipped():
    drawn = lesson_07_limits.unclipped_set(count=2000)
    assert drawn["inside"].sum() > 100
    assert not (drawn["clipped"] & drawn["inside"]).any()
    assert (drawn["clipped"] & ~drawn["inside"]).any()


def test_remedies_recover_what_the_plain_integral_loses():
    drawn = lesson_07_limits.rescue(6)
    for remedy in ANTI_WINDUP:
        assert (drawn["reached"][remedy] <= drawn["predicted"] + 1e-9).all()
    plain, clamp = drawn["reached"]["none"], drawn["reached"]["clamp"]
    assert (clamp >= plain).all()
    assert clamp[0] > 1.2 * plain[0]
    curves = lesson_07_limits.windup_curves(5)
    assert (curves["settling"]["clamp"] <= curves["settling"]["none"] + 1e-9).all()
    assert "overshoot" in lesson_07_limits.windup(0.3, "back")["text"]


def test_full_map_meets_the_predicted_boundary_within_one_cell():
    found = lesson_07_limits.limits_map()
    assert found.measured.shape == (40, 40)
    assert (found.gaps() <= 1).mean() >= 0.95
    assert found.share_within_one_cell() >= 0.95
    # the boundary rises over the first milliseconds, the guarantee does not
    assert found.boundary[1] > 1.5 * found.boundary[0]
    assert (np.diff(found.guaranteed) < 1e-9).all()


def test_trained_policies_oscillate_under_delay_as_predicted():
    for data in lesson_07_policies.under_delay().values():
        assert (data["measured"][:, 0] <= 0.1).all()
        assert (data["measured"][:, -1] >= 0.5).all()
        assert data["agreement"] > 0.9
    capped = lesson_07_policies.under_delay()["cppo_capped"]
    assert (capped["measured"][:, 1] == 0).all()
