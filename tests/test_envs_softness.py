"""The regimes of the maze do what their names say: by the shipped figures and by a short run."""

from dataclasses import replace

import numpy as np
import pytest

from cmc.envs.peg_maze import SOFT, STIFF
from cmc.envs.softness import low_level, measure
from cmc.store import asset, read_json


def test_a_short_run_of_both_regimes():
    soft, stiff = (measure(config, 8, 200, 1) for config in (SOFT, STIFF))
    for figures in (soft, stiff):
        assert figures["tracking_residual"]["worst"] < 0.25
    assert soft["random"]["share_below_1N_substeps"] > 0.99
    assert soft["random"]["share_below_1N_50Hz"] >= soft["random"]["share_below_1N_substeps"]
    assert soft["contact"]["x"]["steady_press_N"] < 1.0
    assert stiff["contact"]["x"]["impact_peak_N"] > 5.0
    assert stiff["random"]["share_below_1N_substeps"] < 0.8


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_two_formulas_explain_the_figures(axis):
    """Pressing is m_eff (K_p e_max + u_max); a spring makes impacts v sqrt(k m_eff) at most."""
    soft = measure(SOFT, 1, 20, 0)["contact"][axis]
    mass, speed = soft["effective_mass_kg"], soft["approach_speed_m_s"]
    limit = mass * (40 * 0.005 + 0.2)
    assert soft["steady_press_N"] == pytest.approx(limit, rel=0.3)
    assert soft["impact_peak_N"] < speed * np.sqrt(SOFT.peg.stiffness * mass) + limit
    rigid = measure(replace(SOFT, peg=STIFF.peg), 1, 20, 0)["contact"][axis]
    assert rigid["impact_peak_N"] > 3 * soft["impact_peak_N"]
    assert rigid["steady_press_N"] == pytest.approx(limit, rel=0.3)  # the spring changes nothing


def test_the_fixed_low_level_is_odd_increasing_and_bounded():
    policy = low_level(SOFT)
    y = np.linspace(-0.03, 0.03, 41)[:, None] * np.ones(6)
    u = np.asarray(policy(y, np.zeros_like(y)))
    np.testing.assert_allclose(u, -u[::-1], atol=1e-15)
    assert (np.diff(u, axis=0) > 0).all()
    assert (np.abs(u) <= 1.0).all()


def test_shipped_figures_are_those_of_the_shipped_regimes():
    figures = read_json(asset("results", "softness.json"))
    soft, stiff = (figures["regimes"][name] for name in ("soft", "stiff"))
    for rule in ("50Hz", "substeps"):
        assert soft["random"][f"share_below_1N_{rule}"] >= 0.999
    assert soft["tracking_residual"]["worst"] <= 0.25
    assert stiff["contact"]["x"]["impact_peak_N"] > 10
    again = measure(SOFT, 1, 20, 0)
    for axis in ("x", "y"):
        assert again["contact"][axis] == pytest.approx(soft["contact"][axis], rel=1e-3)
