"""How a task looks to a planner: normalized observations, sub-goals in [-1, 1]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmc.envs.panda_task import PandaTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Planning:
    """How a task's observations and sub-goals are normalized for the planner.

    Attributes:
        shift, scale: observation fields of the planner to (field - shift) * scale, by name; fields
            that are not named stay as they are.
        low, high: ends of the sub-goal's range, which the planner's [-1, 1] is mapped to.
        fields: what the planner sees; the task's own `high_level` if None.
        aim: joint angles around which the random sub-goals of the warm-up lie, (7,), for tasks
            with joint increments; without it they lie around 0.
    """

    shift: Mapping[str, Array]
    scale: Mapping[str, Array]
    low: Array
    high: Array
    fields: tuple[str, ...] | None = None
    aim: Array | None = None

    def observe(self, task: PandaTask, observation: Array) -> Array:
        """The planner's normalized view of observations (..., size)."""
        parts = [
            (observation[..., task.layout[name]] - self.shift.get(name, np.zeros(1)))
            * self.scale.get(name, np.ones(1))
            for name in self.fields or task.high_level
        ]
        return np.concatenate(parts, axis=-1)

    def subgoal(self, action: Array) -> Array:
        """Sub-goal in the task's units from an action in [-1, 1]."""
        return self.low + 0.5 * (action + 1.0) * (self.high - self.low)

    def direction(self, task: PandaTask, observation: Array) -> Array:
        """Middle of the random sub-goals in [-1, 1] that the warm-up draws, (..., size) or ()."""
        if self.aim is None:
            return np.zeros(())
        missing = self.aim - observation[..., task.layout["joints"]]
        return np.clip(2.0 * (missing - self.low) / (self.high - self.low) - 1.0, -1.0, 1.0)
