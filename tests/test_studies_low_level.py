"""Low levels on the latent model: what the grid search finds, what learning is compared with."""

from __future__ import annotations

import numpy as np
import torch

from cmc.studies import low_level
from cmc.studies.low_level import Gains, judge, rollouts, search, segments, table
from cmc.studies.peg_push import STUDY

CONFIG = STUDY.config_of("ctd3")


def test_no_single_gain_beats_the_searched_ones(monkeypatch):
    monkeypatch.setattr(low_level, "P_GRID", (1.0, 8.0, 28.0))
    monkeypatch.setattr(low_level, "I_GRID", (0.0, 30.0))
    world = rollouts(force=1.5, force_weight=1.0)
    limit, tick = CONFIG.slope_cap(), CONFIG.task.tick
    gains = search(world, limit, tick)
    assert (gains @ [1.0, tick] <= limit).all()
    assert (gains[3:, 1] == 0).all()
    known = segments(world, low_level.TUNED, 1)
    others = np.tile(gains, (18, 1, 1))
    for k in range(6):
        others[3 * k : 3 * k + 3, k, 0] = (1.0, 8.0, 28.0)
    others[others @ np.array([1.0, tick]) > limit] = [1.0, 0.0]
    cost = world.cost(Gains(others), *(part.expand(18, -1, -1) for part in known))
    own = world.cost(Gains(gains[None]), *known)
    assert float(own) <= float(cost.min()) + 1e-6


def test_a_heavier_tool_moves_less_and_a_price_costs_more():
    gains = Gains(np.tile([5.0, 0.0], (1, 6, 1)))
    plain, heavy, dear = (
        judge(rollouts(**setting), gains, 1)[0]
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
    cost = found.groupby("method").cost.mean()
    assert cost["learned"] < cost["start"] - 0.1
    assert cost["nominal gain"] == cost["searched gain"]
