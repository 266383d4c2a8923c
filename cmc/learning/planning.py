"""How a task looks to a planner, and to its critics: normalized observations and sub-goals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


class CriticView:
    """What the planner's critics see: also where tip and sub-goal lie from the goal, in mm.

    A planner's observation brings centimeters to order one, so that half a millimeter is a
    twentieth of a unit and a tanh layer hardly tells it from zero. The critics alone (they are not
    needed once the planner is trained) also see tip and asked sub-goal relative to the goal, as
    they are and through tanh at two scales, and their smoothed lengths n(v, c) = sqrt(v.v + c^2).

    Args:
        task: gives sizes, and whether sub-goals are increments.
        planning: normalization; sub-goals are positions (3,), m, or poses (6,), m and rad.
    """

    def __init__(self, task: PandaTask, planning: Planning) -> None:
        names, start = planning.fields or task.high_level, 0
        self._parts: dict[str, slice] = {}
        for name in names:
            size = task.layout[name].stop - task.layout[name].start
            self._parts[name] = slice(start, start + size)
            start += size
        shift = {k: np.broadcast_to(planning.shift[k], 3) for k in ("position", "goal")}
        unit = {k: 1e3 / np.broadcast_to(planning.scale[k], 3) for k in ("position", "goal")}
        middle, half = 0.5 * (planning.low + planning.high), 0.5 * (planning.high - planning.low)
        self._increments = task.config.increments
        self._mm = {k: _tensor(value) for k, value in unit.items()}
        self._apart = _tensor(1e3 * (shift["position"] - shift["goal"]))
        self._middle = _tensor(
            1e3 * middle[:3] - (0.0 if self._increments else 1e3 * shift["goal"])
        )
        self._half, self._turn = _tensor(1e3 * half[:3]), (_tensor(middle[3:]), _tensor(half[3:]))

    def __call__(self, observation: Tensor, action: Tensor) -> Tensor:
        """Observation, action, and the features of both."""
        goal = observation[..., self._parts["goal"]] * self._mm["goal"]
        tip = observation[..., self._parts["position"]] * self._mm["position"] + self._apart - goal
        aim = self._middle + self._half * action[..., :3] + (tip if self._increments else -goal)
        near, far = _norm(tip, 0.1), _norm(aim, 0.1)
        seen = [observation, action, aim / 5, aim.tanh(), (aim / 0.3).tanh()]
        seen += [tip.tanh(), (tip / 0.3).tanh(), far / 5, far.tanh(), near / 5, near.tanh()]
        if action.shape[-1] > 3:
            rotation = observation[..., self._parts["rotation"]]
            asked = rotation + self._turn[0] + self._turn[1] * action[..., 3:]
            seen += [(asked / 0.1).tanh(), 2 * asked, 5 * _norm(asked, 0.01)]
            seen += [5 * _norm(rotation, 0.01)]
        return torch.cat(seen, dim=-1)


def _norm(v: Tensor, c: float) -> Tensor:
    """sqrt(v.v + c^2), (..., 1): a length without a kink at zero."""
    return (v.square().sum(-1, keepdim=True) + c * c).sqrt()


def _tensor(value: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(value), dtype=torch.float32)
