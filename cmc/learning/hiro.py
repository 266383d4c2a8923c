"""HIRO in joint space: two TD3 learners, and sub-goals of the past that are relabelled.

The planner asks for joint increments g; towards the end of a segment what is left of them is

    g' = s + g - s',

with s the joint angles. The low level sees (s, s', g) and is rewarded with -|g|. It changes while
the planner's memory fills, so an old transition shows what another low level made of its sub-goal.
Off-policy correction replaces that sub-goal by the one, of ten candidates, under which the low
level of today would most likely have acted as it was seen to act.

Source: Nachum, Gu, Lee, Levine, "Data-efficient hierarchical reinforcement learning", NeurIPS 2018.
Angles, increments and errors are in units of the planner's half-range (0.1 rad), from the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from cmc.learning.low_level import CriticLow, Segment, tensor
from cmc.learning.state import Kept
from cmc.learning.td3 import TD3, Batch
from cmc.policies import StackedMLP, tanh
from cmc.theory.arrays import Array

CANDIDATES = 10  # the sub-goal as it was, the motion that followed, and eight drawn around it


@dataclass(frozen=True)
class JointUnits:
    """What brings (joints, joint velocity, joint error) to order one; arrays are (n,), rad."""

    start: Array  # joint angles at the start
    half: Array  # half-range of the planner's increments
    low: Array  # ends that sub-goals are clamped to
    high: Array
    speed: float = 0.2  # joint velocity that counts as 1, rad/s (our choice)

    def normalise(self, observation: Array) -> Array:
        """(..., 3n) in rad and rad/s to the units of this module."""
        q, v, e = np.split(observation, 3, axis=-1)
        parts = [(q - self.start) / self.half, v / self.speed, e / self.half]
        return np.concatenate(parts, axis=-1)


def candidates(goal: Tensor, moved: Tensor, noise: Tensor) -> Tensor:
    """Sub-goals that may replace `goal`: itself, the motion, and draws around the motion.

    `goal` (..., n) was set, `moved` is s_T - s_0 (..., n), and `noise` (..., k, n) is standard
    normal, taken times half of the half-range. Of the (..., k + 2, n) that are returned all but the
    first are clipped to the planner's range [-1, 1].
    """
    drawn = torch.cat([moved[..., None, :], moved[..., None, :] + 0.5 * noise], dim=-2)
    return torch.cat([goal[..., None, :], drawn.clamp(-1.0, 1.0)], dim=-2)


@torch.no_grad()
def log_likelihood(
    actor: nn.Module,
    states: Tensor,
    speeds: Tensor,
    actions: Tensor,
    goals: Tensor,
    reach: tuple[Tensor, Tensor],
) -> Tensor:
    """How likely the actor acts as recorded, for each sub-goal: -1/2 sum_t |a_t - mu(s_t, g_t)|^2.

    The standard deviation is 1 and the constant is left out: neither changes which is largest.
    The actor maps (s, velocity, g), (seeds, batch, 3n), to actions (seeds, batch, n). States,
    speeds and actions are (seeds, batch, T, n), the first state where the sub-goal was set; goals
    at t = 0 are (seeds, batch, k, n). Targets s_0 + g are clamped to `reach`, (n,) each. Returns
    (seeds, batch, k).
    """
    start = states[..., None, :1, :]  # (seeds, batch, 1, 1, n)
    first = (start + goals[..., None, :]).clamp(*reach) - start
    left = start + first - states[..., None, :, :]  # (seeds, batch, k, T, n)
    seen = [part[..., None, :, :].expand_as(left) for part in (states, speeds)]
    inputs = torch.cat([*seen, left], dim=-1).flatten(1, -2)
    predicted = actor(inputs).view(left.shape)
    error = predicted - actions[..., None, :, :]
    return -0.5 * error.square().sum((-1, -2))


class PullActor(nn.Module):
    """Joint torques in [-1, 1] that pull towards the sub-goal: |tanh(net)| sign(g) (appendix G)."""

    def __init__(self, n: int, hidden: Sequence[int], seeds: Sequence[int]) -> None:
        super().__init__()
        self.n = n
        self.net = StackedMLP(3 * n, n, hidden, seeds=seeds)

    def forward(self, seen: Tensor) -> Tensor:
        """Actions (seeds, batch, n) from normalised observations (seeds, batch, 3n)."""
        return tanh(self.net(seen)).abs() * seen[..., -self.n :].sign()


class JointLow(CriticLow):
    """TD3 on (joint state, sub-goal), both normalised; see `CriticLow`.

    Actions are stored as they act, with the sign that the task forces on them, so that likelihoods
    compare torques. `noise` is in units of the largest torque.
    """

    def __init__(self, agent: TD3, seeds: Sequence[int], units: JointUnits, noise: float) -> None:
        n = len(units.start)
        weights = {"joints": float(1.0 / units.half.max())}
        super().__init__(agent, seeds, 3 * n, noise=noise, whole_return=False, weights=weights, n=n)
        self.units = units

    def act(self, observation: Array, explore: bool) -> Array:
        """See `LowLevel.act`; observations are in rad, in single precision where it is tested."""
        if not explore:
            observation = observation.astype(np.float32).astype(np.float64)
        action = super().act(self.units.normalise(observation), explore)
        return np.abs(action) * np.sign(observation[..., -action.shape[-1] :])

    def record(self, segment: Segment) -> None:
        """Store every tick of the segment, normalised."""
        seen = self.units.normalise(segment.observation)
        super().record(replace(segment, observation=seen))


class OffPolicyCorrection(Kept):
    """Stores whole segments with the planner's transitions and relabels what is drawn.

    The present policy of `low` decides. A segment has `horizon` ticks T, and every `stride`-th of
    them counts (1: all, as in the source).
    """

    kept = ("streams",)

    def __init__(self, low: JointLow, seeds: Sequence[int], horizon: int, stride: int = 1) -> None:
        if not 1 <= stride <= horizon:
            raise ValueError(f"stride: wanted 1 to {horizon} ticks, got {stride}")
        self.low, self.horizon, self.stride = low, horizon, stride
        units = low.units
        self.n = len(units.start)
        self.size = (3 * horizon + 1) * self.n
        least, most = ((end - units.start) / units.half for end in (units.low, units.high))
        self._reach = (tensor(least), tensor(most))
        self.streams = [np.random.default_rng([seed, 4, 17]) for seed in seeds]

    def pack(self, segment: Segment) -> Array:
        """States, velocities and actions of the segment and its last state, (seeds, N, size)."""
        seen = self.low.units.normalise(segment.observation)
        ticks = np.concatenate([seen[:-1, ..., : 2 * self.n], segment.action], axis=-1)
        rows = np.moveaxis(ticks, 0, 2)  # (seeds, N, T, 3n)
        last = seen[-1, ..., : self.n]
        return np.concatenate([rows.reshape(*rows.shape[:2], -1), last], axis=-1)

    def relabel(self, batch: Batch) -> Batch:
        """The sample with each sub-goal replaced by its likeliest candidate."""
        rows = batch.extra[..., : -self.n].unflatten(-1, (self.horizon, 3 * self.n))
        moved = batch.extra[..., -self.n :] - rows[..., 0, : self.n]
        shape = (moved.shape[1], CANDIDATES - 2, self.n)
        noise = np.stack([g.standard_normal(shape, dtype=np.float32) for g in self.streams])
        goals = candidates(batch.action, moved, torch.from_numpy(noise))
        states, speeds, actions = rows[..., :: self.stride, :].chunk(3, dim=-1)
        actor = self.low.agent.actor
        score = log_likelihood(actor, states, speeds, actions, goals, self._reach)
        best = score.argmax(-1)[..., None, None].expand(-1, -1, 1, self.n)
        return replace(batch, action=goals.gather(2, best)[:, :, 0])
