"""Proximal policy optimisation of several seeds at once, in one batch of networks.

The algorithm is the usual one (Schulman et al. 2017): clipped surrogate, generalised advantage
estimation, time limits bootstrapped. Everything carries a leading axis of seeds S, and no operation
mixes seeds: advantages are normalised, gradients are clipped and minibatches are drawn a seed at a
time, so a seed learns the same alone and in a batch.

PPO and C-PPO differ in the policy that is passed in, and in nothing else.

An update starts by resetting the environment with integers derived from (seed, update). The whole
state of a training is therefore its weights, Adam's moments and the number of updates done: a
training that is killed and resumed ends with the weights of one that was not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from cmc.learning.rollout import Rollout, collect
from cmc.learning.state import Arrays, Resumable, State, learned, relearn, single_thread
from cmc.policies import StackedMLP

Callback = Callable[[dict[str, Any]], object]


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters. The paper gives none: all are our choice.

    Attributes:
        steps: environment steps of each trajectory in an update; a multiple of the episode length.
        epochs: passes over the data of an update.
        minibatches: minibatches a pass.
        learning_rate: Adam's step size.
        gamma: discount factor.
        gae_lambda: lambda of the generalised advantage estimate.
        clip: half-width of the interval to which the probability ratio is clipped.
        value_weight: weight of the critic's squared error in the loss.
        max_norm: largest norm of a seed's gradient.
        log_std_start, log_std_floor: first and smallest logarithm of the noise's deviation.
        critic_hidden: hidden layers of the critic.
    """

    steps: int = 50
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 2e-3
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    value_weight: float = 0.5
    max_norm: float = 0.5
    log_std_start: float = -1.0
    log_std_floor: float = -4.0
    critic_hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        for name in ("steps", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: wanted at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "clip", "max_norm"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: wanted a positive number, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: wanted a number in [0, 1], got {getattr(self, name)}")


class PPO(Resumable):
    """Train `policy` on `env` with several seeds at once.

    Args:
        env: a vector environment of S E trajectories, seed by seed; `reset` takes one integer a
            seed (a single integer if S = 1). A critic sees `info["privileged"]` where there is one
            and the observation otherwise.
        policy: module from observations (S, batch, d) to mean commands (S, batch, n), built with
            the same seeds.
        seeds: one non-negative integer for each seed.
        config: hyperparameters.

    Raises:
        ValueError: if there is no seed, the trajectories cannot be shared out equally, or the
            policy has other seeds or sizes.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        policy: nn.Module,
        seeds: Sequence[int],
        config: PPOConfig | None = None,
    ) -> None:
        self.env, self.policy, self.config = env, policy, config or PPOConfig()
        self.seeds = tuple(int(seed) for seed in seeds)
        if not self.seeds or env.num_envs % len(self.seeds):
            raise ValueError(
                f"wanted at least one seed, a number that divides {env.num_envs} trajectories; "
                f"got {len(self.seeds)}"
            )
        first, info = env.reset(seed=self._environment_seeds(0))
        inputs = info.get("privileged", first).shape[-1]
        self.critic = StackedMLP(inputs, 1, self.config.critic_hidden, seeds=self.seeds, last=0.1)
        n = env.single_action_space.shape[0]  # type: ignore[index]
        lead = (len(self.seeds), env.num_envs // len(self.seeds))
        with torch.no_grad():
            found = policy(torch.as_tensor(first).reshape(*lead, -1)).shape
        if tuple(found) != (*lead, n):
            raise ValueError(f"wanted a policy with outputs {(*lead, n)}; got {tuple(found)}")
        self.log_std = nn.Parameter(torch.full((len(self.seeds), 1, n), self.config.log_std_start))
        named = [*policy.named_parameters("policy"), *self.critic.named_parameters("critic")]
        self.parameters = {**dict(named), "log_std": self.log_std}
        self.optimiser = torch.optim.Adam(
            self.parameters.values(), lr=self.config.learning_rate, eps=1e-5, fused=True
        )
        self.updates = 0
        """Updates done."""

    @property
    def episodes(self) -> int:
        """Trajectories of `config.steps` steps that each seed has seen."""
        return self.updates * (self.env.num_envs // len(self.seeds))

    @single_thread()
    def update(self) -> dict[str, Any]:
        """Collect one batch of trajectories, learn from it, and report.

        Returns:
            `update`, `episodes` and `steps` (of each seed, so far), and by seed (S,) arrays:
            `episode_return` (sum of rewards over `config.steps` steps, mean over trajectories),
            `value_loss`, `clip_fraction`, `std` (S, n).
        """
        c = self.config
        generators = [np.random.default_rng([seed, self.updates]) for seed in self.seeds]
        rollout = collect(
            self.env,
            self.policy,
            self.log_std.detach(),
            self._environment_seeds(self.updates),
            generators,
            c.steps,
        )
        data = self._learning_data(rollout)
        report: dict[str, Tensor] = {}
        for _ in range(c.epochs):
            shuffled = shuffle(data, generators)
            for batch in torch.tensor_split(shuffled, c.minibatches, dim=1):
                report = self._minibatch(batch)
        self.updates += 1
        steps = c.steps * self.episodes
        return {
            "update": self.updates,
            "episodes": self.episodes,
            "steps": steps,
            "episode_return": rollout.reward.sum(1).mean(1),
            "std": self.log_std.detach().exp()[:, 0].numpy(),
            "value_loss": report["value_error"].square().mean(1).numpy(),
            "clip_fraction": ((report["ratio"] - 1.0).abs() > c.clip).float().mean(1).numpy(),
        }

    def train(
        self,
        updates: int,
        callback: Callback | None = None,
        *,
        checkpoint: str | Path | None = None,
        every: int = 25,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Learn until `updates` updates are done; a given checkpoint is resumed and kept current.

        An interrupt (Ctrl-C, a stopped notebook cell) between or within updates returns to the last
        whole update, writes the checkpoint and is raised again; calling `train` goes on from there.

        Args:
            updates: updates in all, those already done included.
            callback: called with the report of each update.
            checkpoint: file of the training's state; resumed from if it exists.
            every: updates between two checkpoints.
            record: JSON record for the checkpoint: at least `study` and `method`.
        """
        if checkpoint is not None and Path(checkpoint).is_file():
            self.load(checkpoint, record)
        while self.updates < updates:
            before = self.state()
            try:
                report = self.update()
                if callback is not None:
                    callback({**report, "total_updates": updates})
            except KeyboardInterrupt:
                if self.updates == before[1]["updates"]:
                    self.restore(*before)
                if checkpoint is not None:
                    self.save(checkpoint, record)
                raise
            if checkpoint is not None and (self.updates % every == 0 or self.updates == updates):
                self.save(checkpoint, record)

    def state(self) -> State:
        """Weights, Adam, updates done."""
        return learned(self.parameters, self.optimiser), {"updates": self.updates}

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""
        relearn(arrays, self.parameters, self.optimiser)
        self.updates = int(record["updates"])

    def _environment_seeds(self, update: int) -> Any:
        """One integer for each seed, and a single one where there is a single seed."""
        drawn = [
            int(np.random.SeedSequence([seed, update, 1]).generate_state(1)[0])
            for seed in self.seeds
        ]
        return drawn if len(drawn) > 1 else drawn[0]

    @torch.no_grad()
    def _learning_data(self, rollout: Rollout) -> Tensor:
        """What an update learns from, one row a step: (S, T E, columns), see `_columns`."""
        c = self.config
        shape = rollout.reward.shape
        value = self.critic(rollout.privileged.flatten(1, 2)).reshape(shape).numpy()
        following = self.critic(rollout.following.flatten(1, 2)).reshape(shape).numpy()
        advantage = generalised_advantage(rollout, value, following, c.gamma, c.gae_lambda)
        noise = rollout.noise
        log_probability = -(0.5 * noise * noise + self.log_std.unsqueeze(1)).sum(-1)
        scalars = torch.stack(
            [log_probability, torch.from_numpy(advantage), torch.from_numpy(advantage + value)], -1
        )
        parts = (rollout.observation, rollout.privileged, rollout.action, scalars)
        self._columns = [part.shape[-1] for part in parts]
        return torch.cat(parts, -1).flatten(1, 2)

    def _minibatch(self, batch: Tensor) -> dict[str, Tensor]:
        """One step of Adam on a minibatch (S, m, columns); seeds do not mix.

        The loss of a seed is the clipped surrogate plus `value_weight` times the squared error of
        the critic. Its derivatives by the networks' outputs are short, so they are written down
        (`surrogate_gradient`); autograd goes on from there, through the networks.
        """
        c = self.config
        observation, privileged, action, scalars = batch.split(self._columns, -1)
        old_log_probability, advantage, target = scalars.unbind(-1)
        spread, centre = torch.std_mean(advantage, dim=1, keepdim=True)
        advantage = (advantage - centre) / (spread + 1e-8)
        mean, value = self.policy(observation), self.critic(privileged)
        with torch.no_grad():
            to_mean, to_log_std, ratio = surrogate_gradient(
                mean, self.log_std, action, old_log_probability, advantage, c.clip
            )
            error = value - target.unsqueeze(-1)
            to_value = (2.0 * c.value_weight / error.shape[1]) * error
        self.optimiser.zero_grad()
        torch.autograd.backward([mean, value, self.log_std], [to_mean, to_value, to_log_std])
        clip_gradients([p.grad for p in self.parameters.values()], len(self.seeds), c.max_norm)
        self.optimiser.step()
        with torch.no_grad():
            self.log_std.clamp_(min=c.log_std_floor)
        return {"ratio": ratio, "value_error": error[..., 0]}


def generalised_advantage(
    rollout: Rollout, value: np.ndarray, following: np.ndarray, gamma: float, lam: float
) -> np.ndarray:
    """Generalised advantage estimate A_t = delta_t + gamma lambda A_t+1 (Schulman et al. 2016).

    delta_t = r_t + gamma V(next) - V(now), where V(next) is the critic at the state that was
    reached, also where a time limit cut the episode, and 0 only where the task ended.

    Args:
        rollout: reward, terminated and done, (S, T, E) each.
        value: critic at the states, (S, T, E).
        following: critic at the states reached, before any restart, (S, T, E).
        gamma: discount factor.
        lam: lambda.
    """
    delta = rollout.reward + gamma * following * ~rollout.terminated - value
    carry = gamma * lam * ~rollout.done
    advantage = delta.copy()
    for t in range(delta.shape[1] - 2, -1, -1):
        advantage[:, t] += carry[:, t] * advantage[:, t + 1]
    return advantage


def surrogate_gradient(
    mean: Tensor,
    log_std: Tensor,
    action: Tensor,
    old_log_probability: Tensor,
    advantage: Tensor,
    clip: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the clipped surrogate for a Gaussian policy, by mean and log_std.

    With r = p(action)/p_old(action) the loss L = -mean_m min(r A, clip(r, 1 - c, 1 + c) A) has

        dL/dlog p = -r A / m   where r A is the smaller of the two, and 0 where it is clipped,
        dlog p/dmean = x / std,   dlog p/dlog_std = x^2 - 1   with x = (action - mean) / std.

    Args:
        mean: (S, m, n).
        log_std: (S, 1, n).
        action: (S, m, n).
        old_log_probability: (S, m), without the constant -n/2 log 2 pi.
        advantage: A, (S, m).
        clip: c.

    Returns:
        dL/dmean (S, m, n), dL/dlog_std (S, 1, n) and the ratio r (S, m).
    """
    precision = torch.exp(-log_std)
    x = (action - mean) * precision
    square = x * x
    log_probability = -(0.5 * square + log_std).sum(-1)
    ratio = torch.exp(log_probability - old_log_probability)
    gain = ratio * advantage
    active = gain <= ratio.clamp(1.0 - clip, 1.0 + clip) * advantage
    slope = (gain * active).mul_(-1.0 / advantage.shape[1]).unsqueeze(-1)
    return slope * (x * precision), (slope * (square - 1.0)).sum(1, keepdim=True), ratio


def shuffle(data: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
    """Put the rows of data (S, N, columns) in random order, each seed by its own generator."""
    S, N, columns = data.shape
    order = np.stack([g.permutation(N) + N * s for s, g in enumerate(generators)])
    index = torch.from_numpy(order.reshape(-1))
    return data.reshape(S * N, columns).index_select(0, index).reshape(S, N, columns)


def clip_gradients(gradients: Sequence[Tensor | None], seeds: int, max_norm: float) -> None:
    """Scale each seed's gradient, over all parameters, to a norm of at most `max_norm`."""
    rows = [gradient.view(seeds, -1) for gradient in gradients if gradient is not None]
    squares = torch.stack([torch.linalg.vector_norm(row, dim=1) for row in rows])
    scale = (max_norm / (torch.linalg.vector_norm(squares, dim=0) + 1e-6)).clamp(max=1.0)
    for row in rows:
        row.mul_(scale.unsqueeze(1))
