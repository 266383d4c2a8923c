"""Replay memory for several seeds at once, one packed array: a row holds a whole transition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """Transitions of all seeds: observation, action, reward, next observation, continues.

    Shapes are (seeds, batch, size), and (seeds, batch) for reward and continues. `continues` is 1
    where the next state's value counts and 0 where it does not; `extra` is what else was stored.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    next_observation: Tensor
    continues: Tensor
    extra: Tensor


class Replay:
    """The last `capacity` transitions of each seed.

    All seeds are written at the same pace, so one counter serves them all. Each seed draws its
    samples from its own generator: what one seed learns does not depend on the others.

    Args:
        seeds: one integer for each seed.
        observation: size of an observation.
        action: size of an action.
        capacity: transitions kept for each seed.
        stream: separates generators that share their seeds (two levels, say).
        extra: size of what else is stored with a transition.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        observation: int,
        action: int,
        capacity: int,
        stream: int = 0,
        extra: int = 0,
    ) -> None:
        if capacity < 1 or observation < 1 or action < 1 or extra < 0 or not seeds:
            raise ValueError(
                "wanted seeds and positive sizes; got "
                f"{len(seeds)} seeds, observation {observation}, action {action}, {capacity} rows"
            )
        self.sizes = (observation, action, 1, observation, 1, extra)
        self.capacity = capacity
        self.rows: Array32 = np.zeros((len(seeds), capacity, sum(self.sizes)), dtype=np.float32)
        self.written = 0
        self._generators = [np.random.default_rng([seed, stream, 11]) for seed in seeds]

    def __len__(self) -> int:
        return min(self.written, self.capacity)

    def add(
        self,
        observation: ArrayLike,
        action: ArrayLike,
        reward: ArrayLike,
        next_observation: ArrayLike,
        continues: ArrayLike,
        extra: ArrayLike | None = None,
    ) -> None:
        """Add transitions (seeds, count, size); reward and continues are (seeds, count)."""
        given = (observation, action, reward, next_observation, continues)
        parts = [np.asarray(part, dtype=np.float32) for part in given]
        parts[2], parts[4] = parts[2][..., None], parts[4][..., None]
        if extra is not None:
            parts.append(np.asarray(extra, dtype=np.float32))
        new = np.concatenate(parts, axis=-1)
        if new.shape[0] != len(self.rows) or new.shape[2] != self.rows.shape[2]:
            raise ValueError(
                f"wanted rows of {self.sizes} for {len(self.rows)} seeds; got {new.shape}"
            )
        where = (self.written + np.arange(new.shape[1])) % self.capacity
        self.rows[:, where] = new
        self.written += new.shape[1]

    def sample(self, size: int) -> Batch:
        """Draw `size` transitions of each seed, with replacement."""
        if not len(self):
            raise ValueError("the replay memory is empty: add transitions before sampling")
        drawn = np.stack(
            [generator.integers(len(self), size=size) for generator in self._generators]
        )
        rows = torch.from_numpy(self.rows[np.arange(len(self.rows))[:, None], drawn])
        observation, action, reward, following, continues, extra = rows.split(self.sizes, dim=-1)
        return Batch(observation, action, reward[..., 0], following, continues[..., 0], extra)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All that is needed to continue: the rows in use, the counter, the generators."""
        generators = [generator.bit_generator.state for generator in self._generators]
        return {"rows": self.rows[:, : len(self)]}, {
            "written": self.written,
            "generators": generators,
        }

    def restore(self, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> None:
        """Continue from `state`."""
        rows = arrays["rows"]
        self.rows[:, : rows.shape[1]] = rows
        self.written = int(record["written"])
        for generator, state in zip(self._generators, record["generators"], strict=True):
            generator.bit_generator.state = state
