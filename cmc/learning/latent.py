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

import numpy as np
import torch
from scipy.linalg import expm
from torch import Tensor, nn

from cmc.learning.low_level import LowLevel, Segment, tensor
from cmc.learning.state import Learners
from cmc.theory.arrays import Array


@dataclass(frozen=True)
class LatentConfig:
    """Loss and optimizer of the latent rollout (all our choice).

    (K_d + g K2) dt is kept below `cap` by construction: below 1 an error does not change sides from
    tick to tick, which in contact is felt well before chatter starts at 2.
    """

    rate: float = 2e-3  # Adam's
    batch: int = 64  # segments of each seed in one update
    blocked: float = 0.2  # share of the translation axes that are blocked in a rollout
    force_limit: float = 1.0  # pressing force that costs nothing, N
    force_weight: float = 0.2  # cost of each newton beyond it, in units of the tracking loss
    effort_weight: float = 0.0  # cost of u^2 in free motion
    disturbance: float = 0.25  # largest constant push on each axis, in units of an action
    cap: float = 1.0
    memory: int = 4096  # segment starts kept for each seed
    rotation_scale: float = 100.0  # radians that count as much as one meter of error


@dataclass(frozen=True)
class LatentModel:
    """The known model of one axis each; every array is (n,)."""

    K_p: Array  # controller gains
    K_d: Array
    K1: Array  # composite gains
    K2: Array
    action: Array  # what an action of 1 commands, m/s^2 or rad/s^2
    mass: Array  # effective mass that presses where an axis is blocked, kg; 0 where it never is
    integrates: Array  # 1 where the integral acts, 0 elsewhere
    tick: float  # control period, s
    delay: int = 0  # ticks by which actions come late

    def transition(self) -> tuple[Array, Array]:
        """Exact step of (e, e') under a held action in [-1, 1]: (n, 2, 2) and (n, 2)."""
        full = np.zeros((len(self.K_p), 3, 3))
        full[:, 0, 1] = 1.0
        full[:, 1] = -np.stack([self.K_p, self.K_d, self.action], axis=-1)  # 2nd_sys
        step = np.array([expm(matrix * self.tick) for matrix in full])
        return step[:, :2, :2], step[:, :2, 2]


class Rollouts:
    """Segments of the latent model of n axes under an actor, `horizon` ticks, and their cost."""

    def __init__(self, model: LatentModel, horizon: int, config: LatentConfig) -> None:
        self.model, self.horizon, self.config = model, horizon, config
        self._motion, self._push = (tensor(part) for part in model.transition())
        names = ("K_p", "K1", "K2", "action", "mass", "integrates")
        self._constants = {name: tensor(getattr(model, name)) for name in names}

    def draw(self, generators: Sequence[np.random.Generator], batch: int) -> tuple[Tensor, Tensor]:
        """Axes that are blocked, and constant pushes, (seeds, batch, n) each."""
        shape, limit = (batch, len(self.model.K_p)), self.config.disturbance
        blocked = np.stack([g.random(shape) for g in generators]) < self.config.blocked
        blocked &= self.model.mass > 0
        pushes = np.stack([g.uniform(-limit, limit, shape) for g in generators])
        return torch.from_numpy(blocked), torch.from_numpy(pushes.astype(np.float32))

    def cost(self, actor: nn.Module, starts: Tensor, blocked: Tensor, pushes: Tensor) -> Tensor:
        """Mean cost of rollouts, (seeds,).

        The actor maps (y, integral of y) to actions in [-1, 1]; segments start at (e, e'), both
        (seeds, batch, 2n). By axis, (seeds, batch, n), `blocked` says which cannot move, and
        `pushes` are constant disturbances in units of an action.
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


class LatentLow(LowLevel):
    """Learns an actor through the latent model, from the segment starts it has seen.

    The actor maps (y, integral of y) to actions in [-1, 1]; the model is known: none is explored.
    """

    kept = ("starts", "written", "streams")

    def __init__(
        self,
        actor: nn.Module,
        seeds: Sequence[int],
        model: LatentModel,
        horizon: int,
        config: LatentConfig,
    ) -> None:
        super().__init__(actor, len(model.K_p))
        self.model, self.config = model, config
        self.rollouts = Rollouts(model, horizon, config)
        self.adam = torch.optim.Adam(actor.parameters(), config.rate, foreach=True)
        self.starts = np.zeros((len(seeds), config.memory, 2 * self.n), dtype=np.float32)
        self.written = 0
        self.streams = [np.random.default_rng([seed, 3, 17]) for seed in seeds]

    def record(self, segment: Segment) -> None:
        """Keep the error and velocity with which each segment starts."""
        n = self.n
        starts = segment.observation[0][..., 2 * n : 4 * n].copy()  # error, velocity of the tip
        starts[..., n:] *= -1.0  # the sub-goal is at rest: e' = -velocity
        where = (self.written + np.arange(starts.shape[1])) % self.config.memory
        self.starts[:, where] = starts
        self.written += starts.shape[1]

    def update(self) -> None:
        """One Adam step on the cost of a batch of rollouts."""
        known, batch = min(self.written, self.config.memory), self.config.batch
        if not known:
            return
        drawn = np.stack([g.integers(known, size=batch) for g in self.streams])
        starts = torch.from_numpy(self.starts[np.arange(len(drawn))[:, None], drawn])
        self.learn(starts, *self.rollouts.draw(self.streams, batch))

    def learn(self, starts: Tensor, blocked: Tensor, pushes: Tensor) -> Tensor:
        """One Adam step on the cost of given rollouts, which it returns, (seeds,)."""
        cost = self.rollouts.cost(self.actor, starts, blocked, pushes)
        self.adam.zero_grad()
        cost.sum().backward()
        self.adam.step()
        return cost.detach()

    def learners(self) -> Learners:
        """The actor and its Adam."""
        return [(dict(self.actor.named_parameters()), self.adam)]
