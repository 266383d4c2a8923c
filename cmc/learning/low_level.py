"""Low levels of a hierarchy: what turns (y, integral of y) into an action, and how it is learned.

Every low level acts on observations (seeds, worlds, size) whose first 2n entries are the latent
signals y and their integrals, and answers actions in [-1, 1]. `record` receives whole segments (the
ticks between two sub-goals), `update` learns from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from cmc.learning.state import Arrays, State, learned, relearn, set_streams, streams, under, within
from cmc.learning.td3 import TD3, Replay
from cmc.policies import IndependentNetwork, ModularPolicy, PositiveNetwork, as_numpy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """The ticks of every world between two sub-goals; T ticks, N worlds of each seed.

    Attributes:
        observation: before each tick, and after the last, (T + 1, seeds, N, size).
        action: (T, seeds, N, n), in [-1, 1].
        tracking: minus the distances to the sub-goal, by name, (T, seeds, N).
        force: largest contact force of each tick, (T, seeds, N), N.
    """

    observation: Array
    action: Array
    tracking: dict[str, Array]
    force: Array


class LowLevel(Protocol):
    """What a hierarchy asks of its low level."""

    def act(self, observation: Array, explore: bool) -> Array:
        """Actions in [-1, 1], (seeds, N, n)."""

    def record(self, segment: Segment) -> None:
        """Receive a finished segment."""

    def update(self) -> None:
        """One learning step."""

    def state(self) -> State:
        """All that is needed to continue."""

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""


def latent_policy(network: nn.Module) -> ModularPolicy:
    """u_i = tanh(pi_i(y_i, integral of y_i)) on (y, integral of y, ...), whose slope is positive.

    An action pulls towards the sub-goal, e'' + ... + u = 0 (`2nd_sys`): R is negative.
    """
    n = int(network.n)  # type: ignore[arg-type]
    layout = {"z": slice(0, n), "integral": slice(n, 2 * n)}
    return ModularPolicy(network, layout=layout, R=-1.0, squash=True)


@torch.no_grad()
def set_gain(net: PositiveNetwork | IndependentNetwork, gain: ArrayLike) -> None:
    """Give every network of a stack the slope `gain`, broadcast to (n,), in y at rest.

    Of positive networks the last layer W is scaled (`gain` must lie below their caps). Free ones
    start without biases and with slopes of either sign: with h the slope of the last hidden layer,
    W is changed as little as makes h W = gain.
    """
    last = net.mlp.weights[-1]  # (seeds n, hidden, 1)
    wanted = torch.as_tensor(np.asarray(gain), dtype=last.dtype).expand(net.seeds or 1, net.n)
    rest = torch.zeros(net.mlp.stack, 1, 2, dtype=last.dtype)
    if isinstance(net, PositiveNetwork):
        slope = net.mlp.slopes(rest, net.positive_weights())[..., :1]
        last.mul_(wanted.reshape(-1, 1, 1) / slope)
        return
    weights = list(net.mlp.weights)
    slope = net.mlp.slopes(rest, weights)[..., :1]
    h = rest + rest.new_tensor([1.0, 0.0])
    for weight in weights[:-1]:
        h = h @ weight
    last.add_((wanted.reshape(-1, 1, 1) - slope) * h.mT / h.square().sum(-1, keepdim=True))


class Fixed:
    """A low level that does not learn: any actor, or None for no action at all."""

    def __init__(self, actor: nn.Module | None, n: int = 6) -> None:
        self.actor, self.n = actor, n

    def act(self, observation: Array, explore: bool) -> Array:
        """See `LowLevel.act`; nothing is explored."""
        if self.actor is None:
            return np.zeros((*observation.shape[:-1], self.n))
        return evaluate(self.actor, observation)

    def record(self, segment: Segment) -> None:
        """Nothing is kept."""

    def update(self) -> None:
        """Nothing is learned."""

    def state(self) -> State:
        """The actor's weights."""
        return learned(dict(self.actor.named_parameters()) if self.actor else {}, None), {}

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Put the actor's weights back."""
        relearn(arrays, dict(self.actor.named_parameters()) if self.actor else {}, None)


class CriticLow:
    """A low level that learns from a critic, as the paper's does.

    Args:
        agent: actor and critics; the critics see the first `agent` observation entries.
        seeds: one integer for each seed.
        size: how many leading entries of an observation the critics see.
        noise: standard deviation of the exploration noise.
        whole_return: whether the critics learn the rest of the segment's return as it came (the
            segment ends there) instead of one-step targets; the segment's end is terminal in both.
        weights: what each tracking term counts.
        capacity: ticks kept for each seed.
    """

    def __init__(
        self,
        agent: TD3,
        seeds: Sequence[int],
        size: int,
        *,
        noise: float,
        whole_return: bool,
        weights: dict[str, float],
        n: int = 6,
        capacity: int = 65536,
    ) -> None:
        self.agent, self.size, self.noise = agent, size, noise
        self.whole_return, self.weights = whole_return, weights
        self.replay = Replay(seeds, size, n, capacity, stream=2)
        self._generators = [np.random.default_rng([seed, 2, 17]) for seed in seeds]

    def act(self, observation: Array, explore: bool) -> Array:
        """See `LowLevel.act`; exploration adds Gaussian noise."""
        action = evaluate(self.agent.actor, observation)
        if explore:
            shape = action.shape[1:]
            noise = np.stack([g.standard_normal(shape) for g in self._generators])
            action = np.clip(action + self.noise * noise, -1.0, 1.0)
        return action

    def record(self, segment: Segment) -> None:
        """Store every tick of the segment, with its reward or with its return to go."""
        reward = np.zeros(segment.force.shape)
        for name, weight in self.weights.items():
            reward += weight * segment.tracking[name]
        continues = np.ones_like(reward)
        continues[-1] = 0.0
        if self.whole_return:
            reward = np.cumsum(reward[::-1], axis=0)[::-1]
            continues[:] = 0.0
        seen = segment.observation[..., : self.size]
        parts = (seen[:-1], segment.action, reward, seen[1:], continues)
        self.replay.add(*(_flat(part) for part in parts))

    def update(self) -> None:
        """One step of the critics, and every other time of the actor."""
        self.agent.update(self.replay.sample(self.agent.config.batch))

    def state(self) -> State:
        """Agent, memory and noise."""
        (agent, first), (replay, second) = self.agent.state(), self.replay.state()
        record = {"agent": first, "replay": second, "noise": streams(self._generators)}
        return within("agent/", agent) | within("replay/", replay), record

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.agent.restore(under(arrays, "agent/"), record["agent"])
        self.replay.restore(under(arrays, "replay/"), record["replay"])
        set_streams(self._generators, record["noise"])


def evaluate(actor: nn.Module, observation: Array) -> Array:
    """The actor's output as an array of floats."""
    return as_numpy(actor)(observation).astype(np.float64)


def _flat(part: Array) -> Array:
    """(T, seeds, N, ...) to (seeds, T N, ...)."""
    moved = np.moveaxis(part, 1, 0)
    return moved.reshape(moved.shape[0], -1, *moved.shape[3:])
