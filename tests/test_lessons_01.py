"""Lesson 01: its pictures say what the text says."""

import numpy as np
import pytest

from cmc.lessons import lesson_01 as lesson


def test_a_push_breaks_lyapunovs_function_and_leaves_the_distances_alone():
    calm, pushed = lesson.shifted(0.0), lesson.shifted(0.5)
    assert calm["V"][-1].max() < 1e-2 * calm["V"][0].max()
    assert (np.diff(calm["V"], axis=0) <= 1e-9).all()
    assert np.diff(pushed["V"], axis=0).max() > 0
    assert pushed["V"][-1].min() > 1.0
    assert calm["V"].max() > 1.0
    np.testing.assert_allclose(calm["distance"], pushed["distance"], atol=1e-9)
    np.testing.assert_allclose(pushed["paths"][-1], np.tile(pushed["rest"], (8, 1)), atol=0.05)


def test_shear_changes_the_transient_not_the_eigenvalues():
    for shear in (0.0, 4.0, 10.0):
        data = lesson.sheared(shear)
        assert (data["growth"] <= data["metric"] + 1e-9).all()
        assert (data["growth"] <= data["euclid"] * (1 + 1e-9)).all()
        assert data["rate"] >= 0.8 - 1e-9
        assert data["peak"] <= data["bound"]
    assert lesson.sheared(0.0)["peak"] == pytest.approx(1.0)
    assert data["euclid_rate"] < 0 < data["rate"]


def test_pendulums_forget_their_start_at_least_as_fast_as_proved():
    for damping in (0.5, 1.0, 2.0):
        for torque in (0.0, 0.6):
            data = lesson.pushed_pendulum(damping, torque)
            assert np.isfinite(data["paths"]).all()
            if np.abs(data["angle"]).max() <= 1.2 and np.isfinite(data["proved"]):
                assert data["rate"] >= data["proved"] - 0.02
    assert np.isnan(lesson.pushed_pendulum(0.2, 0.0)["proved"])


def test_the_cycle_attracts_across_and_not_along():
    data = lesson.van_der_pol_cycle(1.0)
    assert data["period"] == pytest.approx(6.6633, abs=2e-3)
    np.testing.assert_allclose(data["cycle"][0], data["cycle"][-1], atol=1e-3)
    along, across = data["multipliers"]
    assert along == pytest.approx(1.0, abs=2e-2)
    assert abs(across) < 0.01
    assert data["distance"][-1].max() > 0.5


def test_control_sees_the_same_plant():
    from cmc import plants

    plant = plants.get("van_der_pol")
    system = lesson.as_control_system(plant)
    y = np.array([0.3, -1.2])
    np.testing.assert_allclose(system.dynamics(0, y, []), plant.f(y, np.zeros(2)))
