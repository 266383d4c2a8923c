"""Low levels of a hierarchy: what turns (y, integral of y) into an action, and how it is learned.

Every low level acts on observations (seeds, worlds, size) whose first 2n entries are the latent
signals y and their integrals, and answers actions in [-1, 1]. `record` receives whole segments (the
ticks between two sub-goals), `update` learns from them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from cmc.envs.panda_task import CRITIC, PandaTask
from cmc.learning.state import Kept, Learners
from cmc.learning.td3 import TD3, Replay
from cmc.policies import IndependentNetwork, ModularPolicy, PositiveNetwork, as_numpy
from cmc.theory.arrays import Array

CAPACITY = 65536  # ticks that a critic's memory keeps for each seed


@dataclass(frozen=True)
class Segment:
    """The ticks of every world between two sub-goals; T ticks, N worlds of each seed."""

    observation: Array  # before each tick, and after the last, (T + 1, seeds, N, size)
    action: Array  # (T, seeds, N, n), in [-1, 1]
    tracking: dict[str, Array]  # minus the distances to the sub-goal, by name, (T, seeds, N)


class LowLevel(Kept):
    """A low level that does not learn: any actor, or None for n actions of zero."""

    def __init__(self, actor: nn.Module | None, n: int = 6) -> None:
        self.actor: Any = actor
        self.n = n

    def act(self, observation: Array, explore: bool) -> Array:
        """Actions in [-1, 1], (seeds, N, n)."""
        if self.actor is None:
            return np.zeros((*observation.shape[:-1], self.n))
        return evaluate(self.actor, observation)

    def record(self, segment: Segment) -> None:
        """Receive a finished segment."""

    def update(self) -> None:
        """One learning step."""

    def learners(self) -> Learners:
        """The actor's weights."""
        return [] if self.actor is None else [(dict(self.actor.named_parameters()), None)]


class CriticLow(LowLevel):
    """A low level that learns from a critic, as the paper's does.

    Critics see the first `size` entries of an observation, and learn one-step targets, or, with
    `whole_return`, the rest of the segment's return as it came; the segment's end is terminal in
    both. `weights` are what each tracking term counts, `noise` is the deviation of the exploration.
    """

    kept = ("agent", "replay", "streams")

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
    ) -> None:
        super().__init__(agent.actor, n)
        self.agent, self.size, self.noise = agent, size, noise
        self.whole_return, self.weights = whole_return, weights
        self.replay = Replay(seeds, size, n, CAPACITY, stream=2)
        self.streams = [np.random.default_rng([seed, 2, 17]) for seed in seeds]

    def act(self, observation: Array, explore: bool) -> Array:
        """Exploration adds Gaussian noise."""
        action = super().act(observation, explore)
        if explore:
            noise = np.stack([g.standard_normal(action.shape[1:]) for g in self.streams])
            action = np.clip(action + self.noise * noise, -1.0, 1.0)
        return action

    def record(self, segment: Segment) -> None:
        """Store every tick of the segment, with its reward or with its return to go."""
        reward = np.zeros(segment.action.shape[:-1])
        for name, weight in self.weights.items():
            reward += weight * segment.tracking[name]
        continues = np.ones_like(reward)
        continues[-1] = 0.0
        if self.whole_return:
            reward = np.cumsum(reward[::-1], axis=0)[::-1]
            continues[:] = 0.0
        seen = segment.observation[..., : self.size]
        parts = (seen[:-1], segment.action, reward, seen[1:], continues)
        moved = (np.moveaxis(part, 1, 0) for part in parts)
        self.replay.add(*(part.reshape(len(part), -1, *part.shape[3:]) for part in moved))

    def update(self) -> None:
        """One step of the critics, and every other time of the actor."""
        self.agent.update(self.replay.sample(self.agent.config.batch))

    def learners(self) -> Learners:
        """Nothing but what the agent keeps."""
        return []


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
    weights, last = net.used_weights(), net.mlp.weights[-1]  # (seeds n, hidden, 1)
    wanted = torch.as_tensor(np.asarray(gain), dtype=last.dtype).expand(net.seeds or 1, net.n)
    wanted = wanted.reshape(-1, 1, 1)
    rest = torch.zeros(net.mlp.stack, 1, 2, dtype=last.dtype)
    slope = net.mlp.slopes(rest, weights)[..., :1]
    if isinstance(net, PositiveNetwork):
        last.mul_(wanted / slope)
        return
    h = rest + rest.new_tensor([1.0, 0.0])
    for weight in weights[:-1]:
        h = h @ weight
    last.add_((wanted - slope) * h.mT / h.square().sum(-1, keepdim=True))


def low_fields(task: PandaTask) -> tuple[str, ...]:
    """Observation fields that the low level of a task sees."""
    joints = ("joints", "joint_velocity", "joint_error")
    return joints if task.config.command == "joint" else CRITIC


def rollout(
    task: PandaTask,
    low: LowLevel,
    obs: Array,
    shape: tuple[int, int],
    explore: bool,
    watch: Callable[[dict[str, Any]], object] | None = None,
) -> tuple[Segment, Array, Array, bool]:
    """Run the low level until the next sub-goal is due, from `obs` (worlds, size) seen after one.

    `shape` is (seeds, worlds of each); `watch` is called after each tick with `info`, the
    observation and the reward. Returns the segment, mean rewards (seeds, worlds), the last
    observations, whether time is up.
    """
    fields, over = low_fields(task), False
    views = [task.select(obs, fields).reshape(*shape, -1)]
    actions: list[Array] = []
    terms: dict[str, list[Array]] = {}
    total = np.zeros(task.num)
    for _ in range(task.config.horizon):
        actions.append(low.act(views[-1], explore))
        obs, reward, _, truncated, info = task.step(actions[-1].reshape(task.num, -1))
        total += reward
        views.append(task.select(obs, fields).reshape(*shape, -1))
        for name, value in info["tracking_terms"].items():
            terms.setdefault(name, []).append(value.reshape(shape))
        over = bool(truncated[0])
        if watch is not None:
            watch({**info, "observation": obs, "reward": reward})
    tracking = {name: np.stack(values) for name, values in terms.items()}
    segment = Segment(np.stack(views), np.stack(actions), tracking)
    return segment, (total / task.config.horizon).reshape(shape), obs, over


def evaluate(actor: nn.Module, observation: Array) -> Array:
    """The actor's output as an array of floats."""
    return as_numpy(actor)(observation).astype(np.float64)


def tensor(value: ArrayLike) -> Tensor:
    """In single precision."""
    return torch.as_tensor(np.asarray(value), dtype=torch.float32)
