"""Proximal policy optimisation of several seeds at once, in one batch of networks.

The algorithm is the usual one (Schulman et al. 2017): clipped surrogate, generalised advantage
estimation, time limits bootstrapped. Everything carries a leading axis of seeds S, and no operation
mixes seeds, so a seed learns the same alone and in a batch. PPO and C-PPO differ in the policy that
is passed in, and in nothing else.

An update starts by resetting the environment with integers derived from (seed, update): the state
of a training is its weights, Adam's moments and the number of updates done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.learning.state import Learners, Resumable, single_thread
from cmc.policies import StackedMLP, as_numpy


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters. The paper gives none: all are our choice."""

    steps: int = 50  # of each trajectory in an update; a multiple of the episode length
    epochs: int = 4  # passes over the data of an update
    minibatches: int = 4  # a pass
    learning_rate: float = 2e-3  # Adam's
    gamma: float = 0.99  # discount
    gae_lambda: float = 0.95  # lambda of the generalised advantage estimate
    clip: float = 0.2  # half-width of the interval that the probability ratio is clipped to
    value_weight: float = 0.5  # of the critic's squared error in the loss
    max_norm: float = 0.5  # of a seed's gradient
    log_std_start: float = -1.0  # logarithm of the noise's deviation, at first
    log_std_floor: float = -4.0  # and its least
    critic_hidden: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("steps", "epochs", "minibatches") and value < 1:
                raise ValueError(f"{name}: wanted at least 1, got {value}")
            if name in ("learning_rate", "clip", "max_norm") and not 0 < value < np.inf:
                raise ValueError(f"{name}: wanted a positive number, got {value}")
            if name in ("gamma", "gae_lambda") and not 0 <= value <= 1:
                raise ValueError(f"{name}: wanted a number in [0, 1], got {value}")


class PPO(Resumable):
    """Train `policy` on `env` with several seeds at once.

    The vector environment has S E trajectories, seed by seed; its `reset` takes one integer a seed
    (a single integer if S = 1). A critic sees `info["privileged"]` where there is one and the
    observation otherwise. The policy maps observations (S, batch, d) to mean commands (S, batch, n)
    and is built with the same seeds.
    """

    kept = ("updates",)

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
            wanted = f"at least one, a number that divides {env.num_envs} trajectories"
            raise ValueError(f"seeds: wanted {wanted}; got {len(self.seeds)}")
        self.each = env.num_envs // len(self.seeds)  # trajectories of a seed
        first, info = env.reset(seed=self._environment_seeds(0))
        inputs = info.get("privileged", first).shape[-1]
        self.critic = StackedMLP(inputs, 1, self.config.critic_hidden, seeds=self.seeds, last=0.1)
        n = env.single_action_space.shape[0]  # type: ignore[index]
        lead = (len(self.seeds), self.each)
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

    @property
    def episodes(self) -> int:
        """Trajectories of `config.steps` steps that each seed has seen."""
        return self.updates * self.each

    @single_thread()
    def update(self) -> dict[str, Any]:
        """Collect one batch of trajectories, learn from it, and report.

        The report holds `update`, `episodes` and `steps` (of each seed, so far), and by seed (S,)
        `episode_return` (sum of rewards over `config.steps` steps, mean over trajectories),
        `value_loss`, `clip_fraction`, and `std` (S, n).
        """
        c = self.config
        if (size := c.steps * self.each) < 2 * c.minibatches:
            raise ValueError(f"wanted 2 steps for each of {c.minibatches} minibatches, got {size}")
        generators = [np.random.default_rng([seed, self.updates]) for seed in self.seeds]
        begin, spread = self._environment_seeds(self.updates), self.log_std.detach()
        rollout = collect(self.env, self.policy, spread, begin, generators, c.steps)
        data = self._learning_data(rollout)
        report: dict[str, Tensor] = {}
        for _ in range(c.epochs):
            shuffled = _shuffle(data, generators)
            for batch in torch.tensor_split(shuffled, c.minibatches, dim=1):
                report = self._minibatch(batch)
        self.updates += 1
        return {
            "update": self.updates,
            "episodes": self.episodes,
            "steps": c.steps * self.episodes,
            "episode_return": rollout.reward.sum(1).mean(1),
            "std": self.log_std.detach().exp()[:, 0].numpy(),
            "value_loss": report["value_error"].square().mean(1).numpy(),
            "clip_fraction": ((report["ratio"] - 1.0).abs() > c.clip).float().mean(1).numpy(),
        }

    def train(
        self, updates: int, callback: Callable[[dict[str, Any]], object] | None = None
    ) -> None:
        """Learn until `updates` updates are done, and report each to `callback`.

        An interrupt (Ctrl-C, a stopped notebook cell) between or within updates returns to the last
        whole update and is raised again; calling `train` goes on from there.
        """
        while self.updates < updates:
            before = self.state()
            try:
                report = self.update()
                if callback is not None:
                    callback({**report, "total_updates": updates})
            except KeyboardInterrupt:
                if self.updates == before[1]["updates"]:
                    self.restore(*before)
                raise

    def learners(self) -> Learners:
        """Policy, critic and noise."""
        return [(self.parameters, self.optimiser)]

    def _environment_seeds(self, update: int) -> Any:
        """One integer for each seed, and a single one where there is a single seed."""
        streams = [np.random.SeedSequence([seed, update, 1]) for seed in self.seeds]
        drawn = [int(stream.generate_state(1)[0]) for stream in streams]
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
        both = (torch.from_numpy(part) for part in (advantage, advantage + value))
        scalars = torch.stack([log_probability, *both], -1)
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
        old, advantage, target = scalars.unbind(-1)
        spread, centre = torch.std_mean(advantage, dim=1, keepdim=True)
        advantage = (advantage - centre) / (spread + 1e-8)
        mean, value = self.policy(observation), self.critic(privileged)
        with torch.no_grad():
            to_mean, to_log_std, ratio = surrogate_gradient(
                mean, self.log_std, action, old, advantage, c.clip
            )
            error = value - target.unsqueeze(-1)
            to_value = (2.0 * c.value_weight / error.shape[1]) * error
        self.optimiser.zero_grad()
        torch.autograd.backward([mean, value, self.log_std], [to_mean, to_value, to_log_std])
        _clip_gradients([p.grad for p in self.parameters.values()], len(self.seeds), c.max_norm)
        self.optimiser.step()
        with torch.no_grad():
            self.log_std.clamp_(min=c.log_std_floor)
        return {"ratio": ratio, "value_error": error[..., 0]}


class Rollout(NamedTuple):
    """S seeds, T steps, E trajectories a seed; all arrays start with (S, T, E)."""

    observation: Tensor  # what the policy saw
    privileged: Tensor  # what the critic saw at the same time
    following: Tensor  # what the critic sees at the state that was reached, before any restart
    action: Tensor  # commands, noise included
    noise: Tensor  # standard normal noise of the commands
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]  # where the task ended: no value beyond
    done: NDArray[np.bool_]  # where the trajectory ended, by the task or by a time limit


def collect(
    env: VectorEnv[Any, Any, Any],
    policy: nn.Module,
    log_std: Tensor,
    env_seeds: Any,
    generators: Sequence[np.random.Generator],
    steps: int,
) -> Rollout:
    """Reset `env` and run the policy with Gaussian noise for `steps` steps.

    `env` has S E trajectories, seed by seed, and `reset` takes `env_seeds`; the policy maps
    (S, E, d) to (S, E, n), log_std is (S, 1, n), and each seed's noise has its generator.
    """
    S, n = len(generators), log_std.shape[-1]
    E = env.num_envs // S
    noise = np.stack([g.standard_normal((steps, E, n), dtype=np.float32) for g in generators])
    kick = noise * log_std.exp().unsqueeze(1).numpy()
    observation, info = env.reset(seed=env_seeds)
    privileged = info.get("privileged", observation)
    sizes = (observation.shape[-1], privileged.shape[-1], privileged.shape[-1], n)
    floats = [np.empty((S, steps, E, size), dtype=np.float32) for size in sizes]
    scalars = [np.empty((S, steps, E), dtype=kind) for kind in (np.float32, bool, bool)]
    act = as_numpy(policy)
    for t in range(steps):
        seen = observation.reshape(S, E, -1)
        action = act(seen) + kick[:, t]
        floats[0][:, t], floats[1][:, t] = seen, privileged.reshape(S, E, -1)
        observation, gain, end, limit, info = env.step(action.reshape(S * E, n))
        privileged = info.get("privileged", observation)
        reached = _before_restart(privileged, end | limit, info)
        floats[2][:, t], floats[3][:, t] = reached.reshape(S, E, -1), action
        for array, part in zip(scalars, (gain, end, end | limit), strict=True):
            array[:, t] = part.reshape(S, E)
    saw, knew, arrived, acted, kicked = map(torch.from_numpy, (*floats, noise))
    return Rollout(saw, knew, arrived, acted, kicked, *scalars)


def _before_restart(privileged: np.ndarray, done: np.ndarray, info: dict[str, Any]) -> np.ndarray:
    """Critic's input at the states reached, where the environment has already restarted some."""
    if not done.any() or "final_obs" not in info:
        return privileged
    final = info.get("final_info", {}).get("privileged", info["final_obs"])
    if final.dtype == object:  # Gymnasium's general vector environments hold one array or None
        final = np.stack([row if row is not None else privileged[0] for row in final])
    return np.where(done[:, None], final, privileged)


def generalised_advantage(
    rollout: Rollout, value: np.ndarray, following: np.ndarray, gamma: float, lam: float
) -> np.ndarray:
    """Generalised advantage estimate A_t = delta_t + gamma lambda A_t+1 (Schulman et al. 2016).

    delta_t = r_t + gamma V(next) - V(now), where V(next) is the critic at the state that was
    reached (`following`), also where a time limit cut the episode, and 0 only where the task ended.
    All arrays are (S, T, E).
    """
    delta = rollout.reward + gamma * following * ~rollout.terminated - value
    carry = gamma * lam * ~rollout.done
    advantage = delta.copy()
    for t in range(delta.shape[1] - 2, -1, -1):
        advantage[:, t] += carry[:, t] * advantage[:, t + 1]
    return advantage


def surrogate_gradient(
    mean: Tensor, log_std: Tensor, action: Tensor, old: Tensor, advantage: Tensor, clip: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the clipped surrogate for a Gaussian policy, by mean and log_std.

    With r = p(action)/p_old(action) the loss L = -mean_m min(r A, clip(r, 1 - c, 1 + c) A) has

        dL/dlog p = -r A / m   where r A is the smaller of the two, and 0 where it is clipped,
        dlog p/dmean = x / std,   dlog p/dlog_std = x^2 - 1   with x = (action - mean) / std.

    Shapes: mean and action (S, m, n), log_std (S, 1, n), the rest (S, m); `old` is log p_old
    without its constant -n/2 log 2 pi. Returns dL/dmean, dL/dlog_std and the ratio r (S, m).
    """
    precision = torch.exp(-log_std)
    x = (action - mean) * precision
    square = x * x
    log_probability = -(0.5 * square + log_std).sum(-1)
    ratio = torch.exp(log_probability - old)
    gain = ratio * advantage
    active = gain <= ratio.clamp(1.0 - clip, 1.0 + clip) * advantage
    slope = (gain * active).mul_(-1.0 / advantage.shape[1]).unsqueeze(-1)
    return slope * (x * precision), (slope * (square - 1.0)).sum(1, keepdim=True), ratio


def _shuffle(data: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
    """Put the rows of data (S, N, columns) in random order, each seed by its own generator."""
    S, N, columns = data.shape
    order = np.stack([g.permutation(N) + N * s for s, g in enumerate(generators)])
    index = torch.from_numpy(order.reshape(-1))
    return data.reshape(S * N, columns).index_select(0, index).reshape(S, N, columns)


def _clip_gradients(gradients: Sequence[Tensor | None], seeds: int, max_norm: float) -> None:
    """Scale each seed's gradient, over all parameters, to a norm of at most `max_norm`."""
    rows = [gradient.view(seeds, -1) for gradient in gradients if gradient is not None]
    squares = torch.stack([torch.linalg.vector_norm(row, dim=1) for row in rows])
    scale = (max_norm / (torch.linalg.vector_norm(squares, dim=0) + 1e-6)).clamp(max=1.0)
    for row in rows:
        row.mul_(scale.unsqueeze(1))
