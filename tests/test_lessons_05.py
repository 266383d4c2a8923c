"""Lesson 05: its pictures say what the text says."""

import numpy as np
import pytest

from cmc import plants
from cmc.lessons import lesson_05 as lesson
from cmc.theory.certify import certify
from cmc.theory.contraction import floquet_multipliers, rate_from_cloud
from cmc.theory.exact import Region


def test_untrained_positive_networks_settle_and_free_ones_do_not():
    data = lesson.untrained_loops(40)
    assert np.mean(data["free"][-1] > 0.1) > 0.5
    assert (data["positive"][-1] < 0.1).all()
    assert (data["positive"][0] == data["free"][0]).all()


def test_slopes_stay_in_their_interval():
    for weight in (0.1, 1.0, 5.0):
        for bypass in (0.0, 0.3):
            for cap in (0.0, 0.5):
                data = lesson.slopes(weight, bypass, cap)
                assert data["low"] == bypass
                assert (data["slope"] >= data["low"]).all()
                assert (data["slope"] <= data["high"] + 1e-12).all()
                found = np.gradient(data["pi"], data["s"])[1:-1]
                np.testing.assert_allclose(data["slope"][1:-1], found, atol=0.02)
                if cap:
                    assert data["high"] <= bypass + cap + 1e-12
    assert lesson.slopes(5.0, 0.0, 0.0)["slope"].min() < 1e-3


def test_identity_transforms_lose_at_every_gain():
    growth = lesson.loop_growth(np.logspace(-2, 2, 40), 0.5)
    assert (growth["identity transforms"] > 0).all()
    assert (growth["T_y and T_a"] < 0).all()


def test_root_locus_is_the_module():
    import control

    plant = plants.get("coupled_lags")
    space = lesson.auxiliary_space(plant)
    for i in (0, 1):
        p, ratio = 0.7, 0.5
        closed = control.feedback(p * lesson.module_transfer(plant, i, ratio), 1)
        R, Lambda = space.gains[i], space.eigenvalues[i]
        module = np.array([[Lambda - R * p, -R * ratio * p], [1.0, 0.0]])
        np.testing.assert_allclose(
            np.sort_complex(closed.poles()),
            np.sort_complex(np.linalg.eigvals(module).astype(complex)),
        )


def test_breathing_loop_and_its_map():
    data = lesson.breathing(0.1, 0.5)
    assert data["frozen"].max() == pytest.approx(-0.05)
    assert data["multiplier"] == pytest.approx(1.263, abs=5e-4)
    assert not data["certified"]
    truth = lesson.verdicts(15)
    certified = truth["damping"][None] > truth["limit"][:, None]
    assert (truth["growth"][certified] < 0).all()
    assert (truth["growth"] > 0).any()
    loop = plants.FloquetLoop(
        lag=-truth["damping"][3] / 2, p=-truth["damping"][3] / 2, depth=truth["depth"][9]
    )
    largest = np.abs(floquet_multipliers(lambda t: loop.jacobian(t, np.zeros(2)), np.pi)[0])
    assert truth["growth"][9, 3] == pytest.approx(np.log(largest), abs=1e-4)


def test_more_damping_removes_the_second_attractor():
    data = lesson.two_attractors()
    assert np.abs(data["light"][:, 0] - data["light"][:, 1]).max() > 3
    np.testing.assert_allclose(data["heavy"][:, 0], data["heavy"][:, 1], atol=1e-3)


def test_bounded_policy_is_reproducible_and_its_certificate_is_obeyed():
    policy = lesson.bounded_policy(0.5, 2.0)
    low, high = policy.slope_bounds()
    np.testing.assert_allclose(low, np.tile([0.5, 0.25], (2, 1)))
    assert (high <= np.tile([2.0, 1.0], (2, 1)) + 1e-9).all()
    lesson.bounded_policy.cache_clear()
    again = lesson.bounded_policy(0.5, 2.0)
    np.testing.assert_array_equal(again.slope_bounds()[1], high)
    answer = certify(policy, plants.get("coupled_lags"))
    assert answer
    measured = rate_from_cloud(*lesson.loop_paths(policy), answer.metric)
    assert measured.ratio.max() <= 1 + 1e-9
    assert measured.rate >= answer.rate


def test_turning_interface():
    region = Region([-0.35, -0.5], [0.35, 0.5])
    policy, lags = lesson.TurningInterface(), plants.Lags(tau=(1.0, 1.0), gain=(1.0, 1.0))
    verdict = {
        kind: certify(policy, lags, region=region, kind=kind, transforms=policy.spaces).holds
        for kind in ("frozen", "exact")
    }
    assert verdict == {"frozen": True, "exact": False}
    data = lesson.turning()
    inside = np.isfinite(data["distance"])
    assert (data["distance"][inside] / data["distance"][0].min()).max() > 10


def test_the_sampled_prediction_is_what_is_measured():
    found = lesson.predicted_and_measured(np.logspace(-0.3, 1.5, 12))
    np.testing.assert_allclose(found["measured"], found["predicted"], rtol=3e-3)
    for period, slope in ((2.0, 0.3), (10.0, 0.06), (10.0, 0.08)):
        data = lesson.sampled_lag(period, slope, 2.0)
        assert (np.abs(data["eig"]).max() < 1) == (data["margin"] > 0) == (slope < data["limit"])
