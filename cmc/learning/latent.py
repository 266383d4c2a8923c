"""A low level that learns by differentiating through the latent model that the gains make.

In free space the controlled arm obeys e'' + K_d e' + K_p e + c u = 0 along each axis (`2nd_sys`),
whose coefficients are the controller's own gains: the effect of an action need not be guessed by a
critic. Segments of that model are unrolled under the actor and the loss is differentiated through
all ticks. Where the peg is blocked the error stands still and the same reference presses with
m_eff (K_p e + c u): some axes of some rollouts are blocked, and force beyond a threshold costs.
Friction and whatever else the model lacks is stood for by a constant push d on each axis, c (u + d)
in place of c u: without it there is nothing for the integral to do, and it is unlearned.
The slope cap of the actor holds by construction, so learning cannot leave the stable set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import expm
from torch import Tensor, nn

from cmc.learning.low_level import Segment, evaluate
from cmc.learning.state import Arrays, State, learned, relearn, set_streams, streams

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LatentConfig:
    """Loss and optimizer of the latent rollout (all our choice).

    Attributes:
        rate: Adam step.
        batch: segments of each seed in one update.
        blocked: share of the translation axes that are blocked in a rollout.
        force_limit: pressing force that costs nothing, N.
        force_weight: cost of each newton beyond it, in units of the tracking loss.
        effort_weight: cost of u^2 in free motion.
        disturbance: largest constant push of a rollout on each axis, in units of an action.
        cap: what (K_d + g K2) dt is kept below by construction: below 1 an error does not change
            sides from tick to tick, which in contact is felt well before chatter starts at 2.
        memory: segment starts kept for each seed.
        rotation_scale: radians that count as much as one meter of translation error.
    """

    rate: float = 2e-3
    batch: int = 64
    blocked: float = 0.2
    force_limit: float = 1.0
    force_weight: float = 0.2
    effort_weight: float = 0.0
    disturbance: float = 0.25
    cap: float = 1.0
    memory: int = 4096
    rotation_scale: float = 100.0


@dataclass(frozen=True)
class LatentModel:
    """The known model of one axis each; every array is (n,) unless said otherwise.

    Attributes:
        K_p, K_d: controller gains.
        K1, K2: composite gains.
        action: what an action of 1 commands (m/s^2 or rad/s^2).
        mass: effective mass that presses where an axis is blocked, kg; 0 where it never is.
        integrates: 1 where the integral acts, 0 elsewhere.
        tick: control period, s.
        delay: ticks by which actions come late.
    """

    K_p: Array
    K_d: Array
    K1: Array
    K2: Array
    action: Array
    mass: Array
    integrates: Array
    tick: float
    delay: int = 0

    def transition(self) -> tuple[Array, Array]:
        """Exact step of (e, e') under a held action in [-1, 1]: (n, 2, 2) and (n, 2)."""
        n = len(self.K_p)
        motion, push = np.zeros((n, 2, 2)), np.zeros((n, 2))
        for k in range(n):
            full = np.zeros((3, 3))
            full[0, 1] = 1.0
            full[1] = -self.K_p[k], -self.K_d[k], -self.action[k]  # 2nd_sys
            step = expm(full * self.tick)
            motion[k], push[k] = step[:2, :2], step[:2, 2]
        return motion, push


class Rollouts:
    """Segments of the latent model under an actor, and what they cost.

    Args:
        model: the latent model of n axes.
        horizon: ticks of a segment.
        config: the loss.
    """

    def __init__(self, model: LatentModel, horizon: int, config: LatentConfig) -> None:
        self.model, self.horizon, self.config = model, horizon, config
        self._motion, self._push = (_tensor(part) for part in model.transition())
        names = ("K_p", "K1", "K2", "action", "mass", "integrates")
        self._constants = {name: _tensor(getattr(model, name)) for name in names}

    def draw(self, generators: Sequence[np.random.Generator], batch: int) -> tuple[Tensor, Tensor]:
        """Axes that are blocked, and constant pushes, (seeds, batch, n) each."""
        shape, limit = (batch, len(self.model.K_p)), self.config.disturbance
        blocked = np.stack([g.random(shape) for g in generators]) < self.config.blocked
        blocked &= self.model.mass > 0
        pushes = np.stack([g.uniform(-limit, limit, shape) for g in generators])
        return torch.from_numpy(blocked), torch.from_numpy(pushes.astype(np.float32))

    def cost(self, actor: nn.Module, starts: Tensor, blocked: Tensor, pushes: Tensor) -> Tensor:
        """Mean cost of rollouts, (seeds,).

        Args:
            actor: maps (y, integral of y), (seeds, batch, 2n), to actions in [-1, 1].
            starts: (e, e') of each segment, (seeds, batch, 2n).
            blocked: axes that cannot move, (seeds, batch, n).
            pushes: constant disturbance of each axis in units of an action, (seeds, batch, n).
        """
        c, config = self._constants, self.config
        e, v = starts.chunk(2, dim=-1)
        v = torch.where(blocked, 0.0, v)
        free = (~blocked).to(e.dtype)
        unit = torch.ones_like(c["K_p"])
        unit[3:] = 1.0 / config.rotation_scale
        size = (e * unit).norm(dim=-1, keepdim=True).clamp(min=1e-3)
        integral, late = torch.zeros_like(e), [torch.zeros_like(e)] * self.model.delay
        cost = torch.zeros(e.shape[:-1])
        for _ in range(self.horizon):
            y = c["K1"] * e + c["K2"] * v  # mapping_pos
            integral = integral + self.model.tick * c["integrates"] * y
            late.append(actor(torch.cat([y, integral], dim=-1)))
            u = late.pop(0)
            press = c["mass"] * (c["K_p"] * e + c["action"] * u).abs() * blocked
            step = torch.einsum("...nj,nij->...ni", torch.stack([e, v], -1), self._motion)
            step = step + self._push * (u + pushes)[..., None]
            e = torch.where(blocked, e, step[..., 0])
            v = torch.where(blocked, v, step[..., 1])
            cost = cost + ((e * unit).abs() * free / size).sum(-1)
            cost = cost + config.force_weight * (press - config.force_limit).clamp(min=0).sum(-1)
            cost = cost + config.effort_weight * (u * u * free).sum(-1)
        return cost.mean(-1) / self.horizon


class LatentLow:
    """Learns an actor through the latent model, from the segment starts it has seen.

    Args:
        actor: maps (y, integral of y) to actions in [-1, 1].
        seeds: one integer for each seed.
        model: the latent model.
        horizon: ticks of a segment.
        config: loss and optimizer.
    """

    def __init__(
        self,
        actor: nn.Module,
        seeds: Sequence[int],
        model: LatentModel,
        horizon: int,
        config: LatentConfig,
    ) -> None:
        self.actor, self.model, self.horizon, self.config = actor, model, horizon, config
        self.rollouts = Rollouts(model, horizon, config)
        self.adam = torch.optim.Adam(actor.parameters(), config.rate, foreach=True)
        self._n = len(model.K_p)
        self._starts = np.zeros((len(seeds), config.memory, 2 * self._n), dtype=np.float32)
        self._written = 0
        self._generators = [np.random.default_rng([seed, 3, 17]) for seed in seeds]

    def act(self, observation: Array, explore: bool) -> Array:
        """See `LowLevel.act`; nothing is explored, since the model is known."""
        return evaluate(self.actor, observation)

    def record(self, segment: Segment) -> None:
        """Keep the error and velocity with which each segment starts."""
        n = self._n
        starts = segment.observation[0][..., 2 * n : 4 * n].copy()  # error, velocity of the tip
        starts[..., n:] *= -1.0  # the sub-goal is at rest: e' = -velocity
        where = (self._written + np.arange(starts.shape[1])) % self.config.memory
        self._starts[:, where] = starts
        self._written += starts.shape[1]

    def update(self) -> None:
        """One Adam step on the cost of a batch of rollouts."""
        known, batch = min(self._written, self.config.memory), self.config.batch
        if not known:
            return
        drawn = np.stack([g.integers(known, size=batch) for g in self._generators])
        starts = torch.from_numpy(self._starts[np.arange(len(drawn))[:, None], drawn])
        self.learn(starts, *self.rollouts.draw(self._generators, batch))

    def learn(self, starts: Tensor, blocked: Tensor, pushes: Tensor) -> Tensor:
        """One Adam step on the cost of given rollouts, which it returns, (seeds,)."""
        cost = self.rollouts.cost(self.actor, starts, blocked, pushes)
        self.adam.zero_grad()
        cost.sum().backward()
        self.adam.step()
        return cost.detach()

    def state(self) -> State:
        """Actor, Adam, starts, random streams."""
        arrays = learned(dict(self.actor.named_parameters()), self.adam)
        arrays["starts"] = self._starts.copy()
        return arrays, {"written": self._written, "noise": streams(self._generators)}

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""
        relearn(arrays, dict(self.actor.named_parameters()), self.adam)
        self._starts[:] = arrays["starts"]
        self._written = int(record["written"])
        set_streams(self._generators, record["noise"])


def _tensor(value: Array) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float32)
