"""What the planner's critics see: also where tip and sub-goal lie from the goal, at several scales.

A planner's observation brings centimeters to order one, so that half a millimeter is a twentieth of
a unit and a tanh layer hardly tells it from zero. The critics alone (they are not needed once the
planner is trained) also see the tip and the asked sub-goal relative to the goal in millimeters, as
they are and through tanh, and their smoothed distances n(v, c) = sqrt(v.v + c^2).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cmc.envs.panda_task import PandaTask
from cmc.learning.planning import Planning


class CriticView:
    """Input of the planner's critics from observations and actions, (..., size).

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
