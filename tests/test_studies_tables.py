"""Tables without a training: the maze's regimes do what their names say; gains and low levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cmc import results
from cmc.__main__ import main
from cmc.envs.peg_maze import SOFT, STIFF
from cmc.studies import low_level, softness
from cmc.studies.low_level import JUDGED, Gains, cost, rollouts, search, segments, table
from cmc.studies.peg_push import STUDY

CONFIG = STUDY.config_of("ctd3")

# -- softness --------------------------------------------------------------------------------------


def test_a_short_run_of_both_regimes() -> None:
    soft, stiff = (softness.measure(config, 8, 200) for config in (SOFT, STIFF))
    assert max(soft["left_worst"], stiff["left_worst"]) < 0.25
    assert soft["below_1_N_50hz"] >= soft["below_1_N"] > 0.99
    assert soft["press_x_N"] < 1.0
    assert stiff["impact_x_N"] > 5.0
    assert stiff["below_1_N"] < 0.8


@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_two_formulas_explain_the_figures(axis: str) -> None:
    """Pressing is m_eff (K_p e_max + u_max); a spring makes impacts v sqrt(k m_eff) at most."""
    soft = softness.press(SOFT, axis)
    press, impact, mass = (
        soft[f"{k}_{axis}_{u}"] for k, u in (("press", "N"), ("impact", "N"), ("mass", "kg"))
    )
    limit = mass * (40 * 0.005 + 0.2)
    assert press == pytest.approx(limit, rel=0.3)
    assert impact < soft[f"speed_{axis}"] * np.sqrt(SOFT.peg.stiffness * mass) + limit
    rigid = softness.press(replace(SOFT, peg=STIFF.peg), axis)
    assert rigid[f"impact_{axis}_N"] > 3 * impact
    assert rigid[f"press_{axis}_N"] == pytest.approx(limit, rel=0.3)  # the spring changes nothing
    shipped = results.tidy("softness").set_index("method").loc["soft"]
    for key, value in soft.items():
        assert value == pytest.approx(shipped[key], rel=1e-3)


def test_the_fixed_low_level_is_odd_increasing_and_bounded() -> None:
    y = np.linspace(-0.03, 0.03, 41)[:, None] * np.ones(6)
    u = softness.low_level(SOFT, y, np.zeros_like(y))
    np.testing.assert_allclose(u, -u[::-1], atol=1e-15)
    assert (np.diff(u, axis=0) > 0).all()
    assert (np.abs(u) <= 1.0).all()


def test_shipped_regimes_are_soft_and_stiff() -> None:
    data = results.tidy("softness").set_index("method")
    assert list(data.index) == list(softness.CONFIGS)
    assert (data.loc["soft", ["below_1_N", "below_1_N_50hz"]] >= 0.999).all()
    assert data.loc["soft", "left_worst"] <= 0.25
    assert data.loc["stiff", "impact_x_N"] > 10


# -- low levels on the latent model: what the grid search finds, what learning is compared with ----


def test_no_single_gain_beats_the_searched_ones(monkeypatch):
    monkeypatch.setattr(low_level, "P_GRID", (1.0, 8.0, 28.0))
    monkeypatch.setattr(low_level, "I_GRID", (0.0, 30.0))
    world = rollouts(force=1.5, force_weight=1.0)
    limit, tick = CONFIG.slope_cap(), CONFIG.task.tick
    gains = search(world)
    assert (gains @ [1.0, tick] <= limit).all()
    assert (gains[3:, 1] == 0).all()
    known = segments(world, low_level.TUNED, 1)
    others = np.tile(gains, (18, 1, 1))
    for k in range(6):
        others[3 * k : 3 * k + 3, k, 0] = (1.0, 8.0, 28.0)
    others[others @ np.array([1.0, tick]) > limit] = [1.0, 0.0]
    rivals = world.cost(Gains(others), *(part.expand(18, -1, -1) for part in known))
    own = world.cost(Gains(gains[None]), *known)
    assert float(own) <= float(rivals.min()) + 1e-6


def test_a_heavier_tool_moves_less_and_a_price_costs_more():
    gains = Gains(np.tile([5.0, 0.0], (1, 6, 1)))
    plain, heavy, dear = (
        cost(rollouts(**setting), gains, 1, JUDGED, 2)[0]
        for setting in ({}, {"force": 0.5}, {"force_weight": 5.0})
    )
    assert plain < dear
    free = segments(rollouts(), 64, 5)
    free = (free[0], torch.zeros_like(free[1]), torch.zeros_like(free[2]))
    costs = [float(rollouts(**s).cost(gains, *free)) for s in ({}, {"force": 0.5})]
    assert costs[0] < costs[1]
    assert np.isfinite(heavy)


def test_a_short_table_has_every_method_and_seed():
    found = table(("as designed",), seeds=[3, 4], updates=40)
    assert found.groupby("method").size().to_dict() == {
        "start": 2,
        "learned": 2,
        "nominal gain": 1,
        "searched gain": 1,
    }
    mean = found.groupby("method").cost.mean()
    assert mean["learned"] < mean["start"] - 0.1
    assert mean["nominal gain"] == mean["searched gain"]


@pytest.mark.parametrize(
    ("settings", "seeds", "message"),
    [
        ((), [0], "settings: wanted some of as designed"),
        (("heavy",), [0], "settings: wanted some of .* got \\('heavy',\\)"),
        (("as designed",), [], "seeds: wanted at least one"),
    ],
)
def test_a_table_of_nothing_is_refused(settings, seeds, message):
    with pytest.raises(ValueError, match=message):
        table(settings, seeds)


def test_a_table_is_computed_by_one_command(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(softness, "CONFIGS", {"soft": SOFT})
    monkeypatch.setattr(softness, "_wander", lambda *_: {})
    assert main(["evaluate", "softness", "--out", str(tmp_path)]) == 0
    assert str(tmp_path / "softness.csv") in capsys.readouterr().out
    found = results.read(tmp_path / "softness.csv")
    assert found.attrs["command"] == "python -m cmc evaluate softness"
    assert found["press_y_N"].item() == pytest.approx(1.18436, rel=1e-3)
