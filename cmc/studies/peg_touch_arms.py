"""What the peg-touch study trains, PPO on it, and what its weights guarantee."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc.envs.peg_touch import PegTouchConfig, PegTouchVectorEnv
from cmc.learning.ppo import PPO, PPOConfig
from cmc.plants import Lags
from cmc.policies import (
    ConvexGradientNetwork,
    DirectPolicy,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.studies.study import Array, Rows
from cmc.theory.certify import certify
from cmc.theory.sampled import largest_slope

HIDDEN = (32, 32)
SAFETY = 0.98
"""Share of the sampled-data limit that a cap leaves to the policy: our choice."""


@dataclass(frozen=True)
class TouchConfig:
    """Everything a run depends on. Defaults are the shipped runs."""

    task: PegTouchConfig = PegTouchConfig()
    """The environment in training. Paper where it says, else our choice."""
    ppo: PPOConfig = PPOConfig()
    """PPO. Our choice."""
    noise: tuple[float, float] | None = None
    """First logarithm of the noise in each dimension, in place of PPO's; where it is set."""
    episodes_per_update: int = 16
    """Trajectories of each seed in an update. Our choice."""
    worst_lag: float = 0.5
    """Caps are designed for lags this factor shorter. Paper's shift of tau, -50 %."""
    worst_stiffness: float = 2.0
    """Caps are designed for surfaces this factor stiffer. Paper's shift of K_sur, +100 %."""

    def slope_limit(self) -> Array:
        """What k1 + (h/2) k2 must stay below for the worst plant of the design, (2,)."""
        task = self.task
        stiffest = task.K_sur[1] if task.stiffness_reference is None else task.stiffness_reference
        tau = self.worst_lag * np.array([task.tau_x, task.tau_z])
        return largest_slope(tau, np.array([1.0, self.worst_stiffness * stiffest]), task.h)


class TouchTraining(PPO):
    """PPO on peg touch with the face of a study's training; it counts episodes."""

    def __init__(self, config: TouchConfig, policy: nn.Module, seeds: Sequence[int]) -> None:
        self.stride = config.episodes_per_update
        env = PegTouchVectorEnv(len(seeds) * self.stride, config.task)
        super().__init__(env, policy, seeds, config.ppo)
        if config.noise is not None:
            with torch.no_grad():
                self.log_std.copy_(torch.tensor(config.noise).expand_as(self.log_std))

    @property
    def steps(self) -> int:
        """Episodes of each seed so far."""
        return self.episodes

    def segment(self) -> Array:
        """One update; mean returns (seeds,)."""
        return np.asarray(self.update()["episode_return"], dtype=float)

    def actors(self) -> dict[str, nn.Module]:
        """The policy, as "policy"."""
        return {"policy": self.policy}

    def acting(self) -> nn.Module:
        """The policy."""
        return self.policy.eval()


# -- policies: R_11 and R_22 are positive everywhere; the environment adds u0, T_y and T_a --------

Network = Callable[[TouchConfig, Sequence[int]], nn.Module]


def modular(network: Callable[..., nn.Module], **options: Any) -> Network:
    """A network that sees each error and its integral."""
    return lambda config, seeds: ModularPolicy(network(2, hidden=HIDDEN, seeds=seeds, **options))


def positive(
    capped: bool = False, floor: Any = None, ceiling: Any = None, **options: Any
) -> Network:
    """Positive weights, with bounds on the slopes by construction.

    Args:
        capped: whether k1 + (h/2) k2 stays below the sampled-data bound.
        floor: shares of that bound that each of k1 and (h/2) k2 has in a linear bypass, (2, 2).
        ceiling: shares that each of them stays below.
        options: of the network.
    """

    def build(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
        half, limit = config.task.h / 2, config.slope_limit()
        room, more = np.stack([limit, limit / half], axis=-1), {"hidden": HIDDEN, **options}
        if capped:
            more["joint_cap"] = ((1.0, half), SAFETY * limit)
        if floor is not None:
            more["slope_min"] = room * floor
        if ceiling is not None:
            more["slope_max"] = SAFETY * (room * ceiling)
        return ModularPolicy(PositiveNetwork(2, seeds=seeds, **more))

    return build


def no_integral(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Positive weights that do not see the integral."""
    return ModularPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds), integral=False)


def raw(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """One network that sees x, f and the targets: no error, no integral, no sign rule."""
    return DirectPolicy(JointNetwork(2, inputs=4, hidden=HIDDEN, seeds=seeds), part=slice(0, 4))


def convex(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    """Gradients of convex networks."""
    return ModularPolicy(ConvexGradientNetwork(2, hidden=HIDDEN[0], seeds=seeds))


def fixed(*gains: tuple[float, float]) -> Network:
    """Hand-tuned gains (k1, k2) of each dimension."""
    return lambda config, seeds: ModularPolicy(LinearNetwork(np.array(gains)))


# -- what the weights guarantee -------------------------------------------------------------------


def signed(policy: nn.Module) -> bool:
    """Whether the weights guarantee the sign of every slope, each dimension on its own."""
    network = getattr(policy, "network", None)
    return hasattr(network, "slope_bounds") and not isinstance(network, ConvexGradientNetwork)


def certificates(policy: nn.Module, task: PegTouchConfig, limit: Array) -> Rows:
    """What holds for each seed of a policy, from its weights alone.

    In contact and in the coordinates (x, z) the peg is two separate lags with gains 1 and K,
    exactly; the surface only couples the first into the second. Each loop can be judged alone.

    Args:
        policy: with `slope_bounds`.
        task: at the nominal lags.
        limit: what k1 + (h/2) k2 must stay below for the worst plant of the design, (2,).

    Returns:
        Rows with `seed` (position) and, for all states: `signs`: every slope has the right sign, so
        each linearization is a stable continuous loop (the paper's condition). `slope_x`,
        `slope_z`: k1 + (h/2) k2, bounded by the product of the weights. `stiffest`: stiffness up to
        which the sampled loop of every linearization is stable at the nominal lags, N/m;
        `stiffness_factor`: the same over the stiffest of the training set; `x_margin`: the same for
        the horizontal loop, as a factor on its gain. `design`: whether `limit` is met.
        `contracting`, `rate`: whether one quadratic metric proves contraction for all slopes that
        the weights allow, sampled, on the softest and the stiffest surface of the training set;
        `reason`: why not.
    """
    lower, upper = (b.reshape(-1, 2, 2) for b in policy.slope_bounds())  # type: ignore[operator]
    steepest = upper[..., 0] + 0.5 * task.h * upper[..., 1]
    tau, reference = np.array([task.tau_x, task.tau_z]), task.stiffness_reference
    margin = 1.0 / np.tanh(task.h / (2.0 * tau)) / steepest
    # a cap on the loop gain allows any nominal stiffness: what counts is the factor on it
    gains = task.K_sur if reference is None else [reference]
    rows = []
    for k, bounds in enumerate(zip(lower, upper, strict=True)):
        own = SimpleNamespace(slope_bounds=lambda bounds=bounds: bounds)
        plants = [Lags(tau=tuple(tau), gain=(1.0, gain)) for gain in gains]
        found = [certify(own, plant, h=task.h) for plant in plants]
        rows.append(
            {
                "seed": k,
                "signs": bool((bounds[0] >= 0.0).all()),
                "slope_x": steepest[k, 0],
                "slope_z": steepest[k, 1],
                "stiffest": margin[k, 1] if reference is None else None,
                "stiffness_factor": margin[k, 1] / gains[-1],
                "x_margin": margin[k, 0],
                "design": bool((steepest[k] < limit).all()),
                "contracting": all(part.holds for part in found),
                "rate": min((part.rate for part in found if part.holds), default=None),
                "reason": next((part.reason for part in found if not part.holds), ""),
            }
        )
    return rows
