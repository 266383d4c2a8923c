"""Where does learning a low level pay? On the latent model, against gains found by grid search.

`python -m cmc evaluate low_level` computes the table. Every low level is judged by the mean cost of
segments of the latent model (`cmc.learning.latent`) of peg push, in settings that its designer may
not know: actions that come late, a tool that is heavier or lighter than the gains were made for, a
stronger constant push, a higher price on force beyond 1 N. Compared are

- `start`: the capped network as it starts, slope .3;
- `learned`: the same after `UPDATES` steps through the setting's model, five seeds;
- `nominal gain`: u = tanh(k_1 y + k_2 integral of y), the gains of each axis by grid search where
  everything is as the designer thinks;
- `searched gain`: the same, by grid search in the setting itself.

The grid stays below the network's cap on k_1 + k_2 tick. Searched and learned low levels see the
same model; neither is told the setting otherwise. All are judged on the same fresh segments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from cmc.learning.latent import LatentConfig, LatentLow, LatentModel, Rollouts
from cmc.learning.state import single_thread
from cmc.studies.peg_push import STUDY
from cmc.studies.study import Array, checked_seeds
from cmc.studies.two_level import capped_actor

UPDATES, TUNED, JUDGED = 300, 128, 1024
"""Learning steps; segments that gains are searched on, and that all are judged on."""
P_GRID = (0.3, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 18.0, 24.0, 28.0)
I_GRID = (0.0, 1.0, 3.0, 10.0, 30.0, 60.0, 100.0)
SETTINGS: dict[str, dict[str, Any]] = {
    "as designed": {},
    "2 ticks late": {"delay": 2},
    "twice as heavy": {"force": 0.5},
    "a third lighter": {"force": 1.5},
    "twice the push": {"disturbance": 0.5},
    "force price x 5": {"force_weight": 1.0},
    "force price x 25": {"force_weight": 5.0},
}
"""`force`: acceleration that a command makes, over the designer's; else fields of the model or the
loss."""


class Gains(nn.Module):
    """tanh(k_1 y + k_2 integral of y) for many gains (candidates, n, 2) at once."""

    def __init__(self, gains: Array) -> None:
        super().__init__()
        self.gains = torch.as_tensor(gains, dtype=torch.float32)[:, None]

    def forward(self, seen: Tensor) -> Tensor:
        """Actions (candidates, batch, n) for (y, integral of y)."""
        y, integral = seen.chunk(2, dim=-1)
        return torch.tanh(self.gains[..., 0] * y + self.gains[..., 1] * integral)


def rollouts(force: float = 1.0, delay: int = 0, **loss: float) -> Rollouts:
    """The latent model of peg push in a setting; its coordinates y stay the designer's."""
    config = STUDY.config_of("ctd3")
    model: LatentModel = config.latent_model()
    made = {name: force * getattr(model, name) for name in ("K_p", "K_d", "action")}
    changed: LatentConfig = replace(config.latent, **loss)
    return Rollouts(replace(model, delay=delay, **made), config.task.horizon, changed)


def segments(world: Rollouts, number: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Starts up to 5 mm and 0.1 rad from the sub-goal and in motion, blocked axes, pushes."""
    rng = np.random.default_rng(seed)
    size = np.repeat([0.005, 0.1], 3)
    parts = [rng.uniform(-size, size, (number, 6)), size * rng.standard_normal((number, 6))]
    starts = torch.as_tensor(np.concatenate(parts, -1), dtype=torch.float32)[None]
    return starts, *world.draw([rng], number)


@torch.no_grad()
def cost(world: Rollouts, actor: nn.Module, copies: int, number: int, seed: int) -> Array:
    """Mean cost on the same segments for each of the actor's copies, (copies,)."""
    parts = (part.expand(copies, -1, -1) for part in segments(world, number, seed))
    return world.cost(actor, *parts).double().numpy()


def search(world: Rollouts) -> Array:
    """Gains (6, 2) by grid search below the cap, one axis after the other and twice around."""
    config, gains = STUDY.config_of("ctd3"), np.tile([3.0, 0.0], (6, 1))
    for axis in (*range(6), *range(6)):
        integrals = I_GRID if axis < 3 else (0.0,)  # there is no integral of rotations
        pairs = np.array([(p, i) for p in P_GRID for i in integrals])
        pairs = pairs[pairs @ [1.0, config.task.tick] <= config.slope_cap()[axis]]
        tried = np.tile(gains, (len(pairs), 1, 1))
        tried[:, axis] = pairs
        gains = tried[cost(world, Gains(tried), len(pairs), TUNED, 1).argmin()]
    return gains


def _learn(world: Rollouts, seeds: Sequence[int], updates: int) -> tuple[Array, Array]:
    """Costs of the network at its start and after learning, (seeds,) each."""
    actor = capped_actor(STUDY.config_of("ctd3"), seeds)
    low = LatentLow(actor, seeds, world.model, world.horizon, world.config)
    first = cost(world, actor, len(seeds), JUDGED, 2)
    for update in range(updates):
        drawn = [segments(world, world.config.batch, 1000 + 10**6 * s + update) for s in seeds]
        low.learn(*(torch.cat(part) for part in zip(*drawn, strict=True)))
    return first, cost(world, actor, len(seeds), JUDGED, 2)


def table(
    settings: Sequence[str] = tuple(SETTINGS),
    seeds: Sequence[int] = range(5),
    updates: int = UPDATES,
) -> pd.DataFrame:
    """A row for each setting (`test`), method and seed, with its `cost`."""
    if not settings or not set(settings) <= set(SETTINGS):
        raise ValueError(f"settings: wanted some of {', '.join(SETTINGS)}, got {settings!r}")
    rows, seeds = [], checked_seeds(seeds)
    with single_thread():
        nominal = search(rollouts())
        for setting in settings:
            world = rollouts(**SETTINGS[setting])
            found = dict(zip(("start", "learned"), _learn(world, seeds, updates), strict=True))
            gains = cost(world, Gains(np.stack([nominal, search(world)])), 2, JUDGED, 2)
            found |= {"nominal gain": gains[:1], "searched gain": gains[1:]}
            for method, costs in found.items():
                row = {"method": method, "title": method, "test": setting, "last": True}
                row["step"] = updates if method == "learned" else 0
                each = zip(seeds, costs.tolist(), strict=False)
                rows += [{**row, "seed": seed, "cost": value} for seed, value in each]
    return pd.DataFrame(rows)
