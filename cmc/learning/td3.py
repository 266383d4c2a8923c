"""TD3 for several seeds at once: twin critics, a delayed actor, clipped dQ/da, and its memory.

Source: Fujimoto, van Hoof, Meger, "Addressing function approximation error in actor-critic
methods", ICML 2018, with the options that the paper's tables name (`tab:my_label`, `tab:para`).
The networks of all seeds are one stack, the learners stay independent: Adam works elementwise, and
gradients are clipped seed by seed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.learning.state import Arrays, Kept, Learners, State
from cmc.policies import StackedMLP, tanh

Array32 = NDArray[np.float32]
View = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class TD3Config:
    """Settings of one learner; defaults are the paper's `tab:para` unless marked.

    `pull` weighs the mean square of the actor's values before its last tanh, which keeps them where
    tanh still has a slope. With `average` what acts after training is a running mean of the actor's
    weights: w <- w + average (actor - w) at every actor update (Polyak and Juditsky, "Acceleration
    of stochastic approximation by averaging", 1992).
    """

    actor_rate: float = 1e-4  # of Adam; the table calls it the target learning rate
    critic_rate: float = 1e-3
    discount: float = 0.99  # per transition of this learner
    target_rate: float = 0.005  # part of the way that targets move at each target update
    target_period: int = 50  # critic updates between target updates
    actor_period: int = 2  # and between actor updates, TD3's default
    action_gradient_clip: float | None = None  # bound on each entry of dQ/da
    gradient_clip: float | None = None  # on the norm of each parameter's gradient, seed by seed
    target_noise: float = 0.2  # deviation of the noise on target actions, TD3's default
    target_noise_clip: float = 0.5  # and its bound
    critic_hidden: tuple[int, ...] = (128, 128)  # our choice; the paper's are 400, 300
    batch: int = 128  # transitions of each seed in one update
    critic_head_start: int = 0  # critic updates before the actor first moves (our choice)
    pull: float = 0.0  # our choice
    average: float = 0.0  # our choice

    def __post_init__(self) -> None:
        positive = (self.actor_rate, self.critic_rate, self.target_period, self.actor_period)
        if min(*positive, self.batch) <= 0:
            raise ValueError(f"rates, periods and the batch must be positive: {self}")
        if not (0 <= self.discount <= 1 and 0 < self.target_rate <= 1 and 0 <= self.average <= 1):
            raise ValueError(f"wanted discount, target_rate > 0, average from 0 to 1: {self}")


class TD3(Kept):
    """One actor and twin critics for each seed.

    The actor maps observations (seeds, batch, size) to actions in [-1, 1] (seeds, batch, action);
    with `pull` they are tanh(actor.unsquashed(observation)). `view` is what the critics see of
    observations and actions; `stream` separates learners that share their seeds.
    """

    kept = ("updates", "streams")

    def __init__(
        self,
        actor: nn.Module,
        seeds: Sequence[int],
        observation: int,
        action: int,
        config: TD3Config,
        stream: int = 0,
        view: View | None = None,
    ) -> None:
        self.config, self.seeds = config, tuple(seeds)
        self.actor = actor
        self._view = view or (lambda *parts: torch.cat(parts, dim=-1))
        inputs = self._view(torch.zeros(1, 1, observation), torch.zeros(1, 1, action)).shape[-1]
        own = [seed * 1009 + stream for seed in seeds]
        sizes = (inputs, 1, config.critic_hidden)
        self.critics = StackedMLP(*sizes, copies=2, seeds=own, start="signed")
        self.target_actor = copy.deepcopy(actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.acting = copy.deepcopy(self.target_actor) if config.average else actor
        adam = torch.optim.Adam
        self.actor_adam = adam(actor.parameters(), config.actor_rate, fused=True)
        self.critic_adam = adam(self.critics.parameters(), config.critic_rate, fused=True)
        self.updates = 0
        self.streams = [np.random.default_rng([seed, stream, 13]) for seed in seeds]

    def values(self, critics: StackedMLP, observation: Tensor, action: Tensor) -> Tensor:
        """Both critics' values, (seeds, 2, batch)."""
        x = self._view(observation, action).repeat_interleave(2, dim=0)
        return critics(x)[..., 0].reshape(len(self.seeds), 2, -1)

    def update(self, batch: Batch) -> np.ndarray:
        """One critic update, and now and then one of the actor and the targets.

        Returns the critics' mean squared error, (seeds,).
        """
        error = self._update_critics(batch)
        self.updates += 1
        config = self.config
        ready = self.updates > config.critic_head_start
        if ready and self.updates % config.actor_period == 0:
            self._update_actor(batch)
        if self.updates % config.target_period == 0:
            _move(self.target_actor, self.actor, config.target_rate)
            _move(self.target_critics, self.critics, config.target_rate)
        return error

    def _update_critics(self, batch: Batch) -> np.ndarray:
        target = batch.reward
        if bool(batch.continues.any()):  # returns that end here need no next value
            with torch.no_grad():
                following = self.target_actor(batch.next_observation)
                following = (following + self._smoothing(following)).clamp(-1.0, 1.0)
                value = self.values(self.target_critics, batch.next_observation, following)
                target = target + self.config.discount * batch.continues * value.amin(1)
        value = self.values(self.critics, batch.observation, batch.action)
        error = (value - target[:, None]).square().mean(-1).sum(-1)
        self.critic_adam.zero_grad()
        error.sum().backward()
        self._clip(self.critics)
        self.critic_adam.step()
        return error.detach().numpy()

    def _update_actor(self, batch: Batch) -> None:
        config = self.config
        seen, actor = batch.observation, self.actor
        before = actor.unsquashed(seen) if config.pull else None  # type: ignore[operator]
        action = actor(seen) if before is None else tanh(before)
        slope = self._action_gradient(seen, action)
        if config.action_gradient_clip is not None:
            slope = slope.clamp(-config.action_gradient_clip, config.action_gradient_clip)
        loss = -(slope * action).sum() / action.shape[1]
        if before is not None:
            loss = loss + config.pull * before.square().mean((1, 2)).sum()
        self.actor_adam.zero_grad()
        loss.backward()
        self._clip(self.actor)
        self.actor_adam.step()
        if config.average:
            _move(self.acting, self.actor, config.average)

    def _action_gradient(self, observation: Tensor, action: Tensor) -> Tensor:
        """dQ/da of the first critic alone, (seeds, batch, action)."""
        action = action.detach().requires_grad_()
        parts = (self.critics.weights, self.critics.biases)
        weights, biases = ([p.detach()[::2] for p in part] for part in parts)
        value = self.critics.run(self._view(observation, action), weights, biases)
        (slope,) = torch.autograd.grad(value.sum(), action)
        return slope

    def set_rates(self, factor: float) -> None:
        """Let both optimizers step by `factor` times the configured rates."""
        self.actor_adam.param_groups[0]["lr"] = factor * self.config.actor_rate
        self.critic_adam.param_groups[0]["lr"] = factor * self.config.critic_rate

    def _smoothing(self, like: Tensor) -> Tensor:
        noise = [generator.standard_normal(like.shape[1:]) for generator in self.streams]
        scaled = self.config.target_noise * torch.from_numpy(np.stack(noise)).to(like.dtype)
        return scaled.clamp(-self.config.target_noise_clip, self.config.target_noise_clip)

    def _clip(self, module: nn.Module) -> None:
        """Shorten each parameter's gradient to the bound, seed by seed."""
        bound = self.config.gradient_clip
        for gradient in (p.grad for p in module.parameters() if bound is not None):
            if gradient is not None:
                by_seed = gradient.view(len(self.seeds), -1)
                norm = by_seed.norm(dim=1, keepdim=True)
                by_seed.mul_((bound / norm.clamp(min=1e-12)).clamp(max=1.0))

    def learners(self) -> Learners:
        """Actor and critics, their targets, and the mean of the actors if one is kept."""
        adam = {"actor": self.actor_adam, "critics": self.critic_adam}
        names = ["actor", "critics", "target_actor", "target_critics"]
        names += ["acting"] if self.config.average else []
        return [(dict(getattr(self, k).named_parameters(k)), adam.get(k)) for k in names]


@torch.no_grad()
def _move(target: nn.Module, source: nn.Module, rate: float) -> None:
    """Move the target: target <- (1 - rate) target + rate source."""
    pairs = list(zip(target.parameters(), source.parameters(), strict=True))
    torch._foreach_lerp_([t for t, _ in pairs], [s.detach() for _, s in pairs], rate)


@dataclass(frozen=True)
class Batch:
    """Transitions of all seeds, (seeds, batch, size), and (seeds, batch) for reward and continues.

    `continues` is 1 where the next state's value counts and 0 where it does not; `extra` is what
    else was stored.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    next_observation: Tensor
    continues: Tensor
    extra: Tensor


class Replay(Kept):
    """The last `capacity` transitions of each seed.

    Each seed draws its samples from its own generator: what it learns depends on no other.
    `observation`, `action` and `extra` (what else is stored) are sizes; `stream` separates
    generators that share their seeds (two levels, say).
    """

    kept = ("written", "streams")

    def __init__(
        self,
        seeds: Sequence[int],
        observation: int,
        action: int,
        capacity: int,
        stream: int = 0,
        extra: int = 0,
    ) -> None:
        if min(capacity, observation, action, extra + 1, len(seeds)) < 1:
            got = f"{len(seeds)} seeds, observation {observation}, action {action}, {capacity} rows"
            raise ValueError(f"wanted seeds and positive sizes; got {got}")
        self.sizes = (observation, action, 1, observation, 1, extra)
        self.capacity = capacity
        self.rows: Array32 = np.zeros((len(seeds), capacity, sum(self.sizes)), dtype=np.float32)
        self.written = 0
        self.streams = [np.random.default_rng([seed, stream, 11]) for seed in seeds]

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
        if new.shape[::2] != self.rows.shape[::2]:
            seeds = len(self.rows)
            raise ValueError(f"wanted rows of {self.sizes} for {seeds} seeds; got {new.shape}")
        where = (self.written + np.arange(new.shape[1])) % self.capacity
        self.rows[:, where] = new
        self.written += new.shape[1]

    def sample(self, size: int) -> Batch:
        """Draw `size` transitions of each seed, with replacement."""
        if not len(self):
            raise ValueError("the replay memory is empty: add transitions before sampling")
        drawn = np.stack([generator.integers(len(self), size=size) for generator in self.streams])
        rows = torch.from_numpy(self.rows[np.arange(len(self.rows))[:, None], drawn])
        observation, action, reward, following, continues, extra = rows.split(self.sizes, dim=-1)
        return Batch(observation, action, reward[..., 0], following, continues[..., 0], extra)

    def state(self) -> State:
        """The rows in use, the counter, the random streams."""
        arrays, record = super().state()
        return {"rows": self.rows[:, : len(self)], **arrays}, record

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""
        super().restore(arrays, record)
        self.rows[:, : len(self)] = arrays["rows"]
