"""What the peg-touch study trains: its configuration, its policies, and PPO on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.envs.peg_touch_config import PegTouchConfig
from cmc.learning.ppo import PPO, PPOConfig
from cmc.policies import (
    ConvexGradientNetwork,
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.studies.peg_touch_tests import TestConfig
from cmc.studies.study import Array
from cmc.theory.sampled import largest_slope

HIDDEN = (32, 32)
SAFETY = 0.98
"""Share of the sampled-data limit that a cap leaves to the policy: our choice."""
FLOOR = 0.05
"""Share of the limit below which `cppo_bounded` holds no slope (half of it each): our choice."""
BYPASS = np.array([[0.0, 0.0], [0.15, 0.6]])
"""Shares of the limit that `cppo_bypass` puts into a linear bypass, vertically: our choice."""


@dataclass(frozen=True)
class TouchConfig:
    """Everything a run depends on. Defaults are the shipped runs."""

    task: PegTouchConfig = field(default_factory=PegTouchConfig)
    """The environment in training. Paper where it says, else our choice."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """PPO. Our choice."""
    noise: tuple[float, float] | None = None
    """First logarithm of the noise in each dimension, in place of PPO's; where it is set."""
    episodes_per_update: int = 16
    """Trajectories of each seed in an update. Our choice."""
    worst_lag: float = 0.5
    """Caps are designed for lags this factor shorter. Paper's shift of tau, -50 %."""
    worst_stiffness: float = 2.0
    """Caps are designed for surfaces this factor stiffer. Paper's shift of K_sur, +100 %."""
    test: TestConfig = field(default_factory=TestConfig)
    """Tests. Paper: 8000 trajectories for each checkpoint."""

    def slope_limit(self) -> Array:
        """What k1 + (h/2) k2 must stay below for the worst plant of the design, (2,)."""
        task = self.task
        stiffest = task.K_sur[1] if task.stiffness_reference is None else task.stiffness_reference
        tau = self.worst_lag * np.array([task.tau_x, task.tau_z])
        return largest_slope(tau, np.array([1.0, self.worst_stiffness * stiffest]), task.h)


class TouchTraining:
    """PPO on peg touch with the face of a study's training; it counts episodes."""

    def __init__(self, config: TouchConfig, policy: nn.Module, seeds: Sequence[int]) -> None:
        self.config, self.network, self.seeds = config, policy, list(seeds)
        self.stride = config.episodes_per_update

    @cached_property
    def ppo(self) -> PPO:
        """The learner; made when it is first needed, so that loading a policy does without."""
        envs = PegTouchVectorEnv(len(self.seeds) * self.stride, self.config.task)
        made = PPO(envs, self.network, self.seeds, self.config.ppo)
        if self.config.noise is not None:
            with torch.no_grad():
                made.log_std.copy_(torch.tensor(self.config.noise).expand_as(made.log_std))
        return made

    @property
    def steps(self) -> int:
        """Episodes of each seed so far."""
        return self.ppo.episodes

    def segment(self) -> Array:
        """One update; mean returns (seeds,)."""
        return np.asarray(self.ppo.update()["episode_return"], dtype=float)

    def actors(self) -> Mapping[str, nn.Module]:
        """The policy."""
        return {"policy": self.network}

    def acting(self) -> nn.Module:
        """The policy."""
        return self.network.eval()

    def save(self, path: str | Path, record: Mapping[str, Any]) -> None:
        """Write the whole state."""
        self.ppo.save(path, record)

    def load(self, path: str | Path, record: Mapping[str, Any]) -> None:
        """Continue from `save`."""
        self.ppo.load(path, record)


# -- policies: R_11 and R_22 are positive everywhere; the environment adds u0, T_y and T_a --------

Network = Callable[[TouchConfig, Sequence[int]], nn.Module]


def ppo(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Weights of any sign."""
    return ModularPolicy(IndependentNetwork(2, hidden=HIDDEN, seeds=seeds))


def cppo(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Positive weights: the one difference to `ppo`."""
    return ModularPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds))


def capped(config: TouchConfig, seeds: Sequence[int], **more: Any) -> nn.Module:
    """Positive weights with k1 + (h/2) k2 below the sampled-data bound, by construction."""
    cap = ((1.0, config.task.h / 2), SAFETY * config.slope_limit())
    options = {"hidden": HIDDEN, "joint_cap": cap, **more}
    return ModularPolicy(PositiveNetwork(2, seeds=seeds, **options))


def room(config: TouchConfig, shares: Any) -> Array:
    """Slopes (2, 2) that take these shares of the limit, in k1 and in (h/2) k2."""
    limit = config.slope_limit()
    return np.stack([limit, limit / (config.task.h / 2)], axis=-1) * shares


def bounded(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """A cap and a floor."""
    return capped(config, seeds, slope_min=room(config, 0.5 * FLOOR))


def bypass(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """A cap, with most of the vertical room in a linear bypass."""
    return capped(config, seeds, slope_min=room(config, BYPASS))


def no_integral(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Positive weights that do not see the integral."""
    return ModularPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds), integral=False)


def joint(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """One network of any sign that sees both signals."""
    return ModularPolicy(JointNetwork(2, hidden=HIDDEN, seeds=seeds))


def raw(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """One network that sees x, f and the targets: no error, no integral, no sign rule."""
    return DirectPolicy(JointNetwork(2, inputs=4, hidden=HIDDEN, seeds=seeds), part=slice(0, 4))


def convex(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Gradients of convex networks."""
    return ModularPolicy(ConvexGradientNetwork(2, hidden=HIDDEN[0], seeds=seeds))


def fixed(*gains: tuple[float, float]) -> Network:
    """Hand-tuned gains (k1, k2) of each dimension."""
    return lambda config, seeds: ModularPolicy(LinearNetwork(np.array(gains)))
