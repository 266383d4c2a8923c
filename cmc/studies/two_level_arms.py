"""The methods of a planner over a low level: what each builds and how it learns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import TwoLevel
from cmc.learning.hiro import JointLow, JointUnits, Normalised, OffPolicyCorrection, PullActor
from cmc.learning.latent import LatentLow
from cmc.learning.low_level import CriticLow, Fixed, LowLevel, latent_policy, set_gain
from cmc.learning.one_level import OneLevelPPO, SegmentEnv
from cmc.learning.planning import CriticView, Planning
from cmc.learning.td3 import TD3, View
from cmc.policies import (
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.robot.panda import LOWER, UPPER
from cmc.studies.study import Method
from cmc.studies.two_level import Adapt, TwoLevelConfig, both, changed, in_joints, start_joints

Array = NDArray[np.float64]
Seeds = Sequence[int]
Policy = tuple[nn.Module, LowLevel]
"""What is tested: the planner and a low level that neither explores nor learns."""
N = 6  # dimensions of a pose
ACTOR_SIZE, CRITIC_SIZE = 2 * N, 4 * N + 1  # (y, int y), and with error, velocity, time to go


# -- low levels -----------------------------------------------------------------------------------


def none(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """No action."""
    return Fixed(None, N)


def gain(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A slope set by hand, for y and its integral alike."""
    start = _start(config)
    return Fixed(latent_policy(LinearNetwork(np.stack([start, start], -1))), N)


def frozen(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A capped network that stays as it started."""
    return Fixed(capped_actor(config, seeds), N)


def latent(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A capped network that learns through the latent model."""
    actor, horizon = capped_actor(config, seeds), config.task.horizon
    return LatentLow(actor, seeds, config.latent_model(), horizon, config.latent)


def paper(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """Positive weights and biases; the critic sees (y, int y) and learns one-step targets."""
    return _plain(config, seeds, PositiveNetwork(N, hidden=config.low_hidden, seeds=seeds))


def positive(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """Positive weights and biases; the critic sees the full state and learns returns."""
    return _corrected(config, seeds, PositiveNetwork(N, hidden=config.low_hidden, seeds=seeds))


def free(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """Weights of any sign; else as `paper`."""
    return _plain(config, seeds, IndependentNetwork(N, hidden=config.low_hidden, seeds=seeds))


def corrected(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """Weights of any sign; else as `positive`."""
    return _corrected(config, seeds, IndependentNetwork(N, hidden=config.low_hidden, seeds=seeds))


def _start(config: TwoLevelConfig) -> Array:
    return np.minimum(config.start_gain, 0.99 * config.slope_cap())


def capped_actor(config: TwoLevelConfig, seeds: Seeds) -> ModularPolicy:
    """Positive weights, no biases, slopes below the sampled-data cap by construction."""
    cap = (np.array([1.0, config.task.tick]), config.slope_cap())
    net = PositiveNetwork(N, hidden=config.low_hidden, seeds=seeds, bias=False, joint_cap=cap)
    set_gain(net, _start(config))
    return latent_policy(net)


def _plain(config: TwoLevelConfig, seeds: Seeds, net: Any) -> LowLevel:
    set_gain(net, _start(config))
    agent = TD3(latent_policy(net), seeds, ACTOR_SIZE, N, config.low, stream=2)
    weights = {"translation": 1.0, "rotation": 1.0}
    return CriticLow(agent, seeds, ACTOR_SIZE, noise=0.1, whole_return=False, weights=weights)


def _corrected(config: TwoLevelConfig, seeds: Seeds, net: Any) -> LowLevel:
    set_gain(net, _start(config))
    view = scaled(config.critic_scale())
    agent = TD3(latent_policy(net), seeds, CRITIC_SIZE, N, config.low, stream=2, view=view)
    weights = {"translation": 100.0, "rotation": 1.0}
    return CriticLow(agent, seeds, CRITIC_SIZE, noise=0.5, whole_return=True, weights=weights)


def scaled(scale: Array) -> View:
    """What critics see: (observation * scale, action)."""
    factor = torch.as_tensor(scale, dtype=torch.float32)
    return lambda observation, action: torch.cat([observation * factor, action], dim=-1)


def joints(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """HIRO's low level: one network that moves all joints."""
    task, start = config.task, start_joints(config.task)
    half, n = np.array(task.subgoal_high), task.low_size
    low = np.maximum(start + np.array(task.workspace_low), LOWER)
    high = np.minimum(start + np.array(task.workspace_high), UPPER)
    actor = PullActor(n, config.joint_hidden, seeds)
    agent = TD3(actor, seeds, 3 * n, n, config.low, stream=2)
    return JointLow(agent, seeds, JointUnits(start, half, low, high), config.joint_noise)


# -- trainings ------------------------------------------------------------------------------------


class TwoLevelTraining(TwoLevel):
    """`TwoLevel` for a study's runner."""

    def acting(self) -> Policy:
        """Planner and low level as they are now, without exploration and learning."""
        return self.planner.actor.eval(), still(self.low)


class OneLevelTraining(OneLevelPPO):
    """`OneLevelPPO` for a study's runner."""

    def acting(self) -> Policy:
        """The planner, and no action below it."""
        return self.policy.eval(), self.low


def two_level(
    low_level: Callable[[TwoLevelConfig, Seeds], LowLevel], relabel: bool = False
) -> Callable[[TwoLevelConfig, Seeds], TwoLevelTraining]:
    """A planner that learns by TD3 over a low level; relabelled sub-goals are HIRO's."""

    def build(config: TwoLevelConfig, seeds: Seeds) -> TwoLevelTraining:
        task = config.make(len(seeds) * config.hierarchy.worlds)
        planning = config.planning()
        actor, inputs = _planner(config, task, planning, seeds)
        view = CriticView(task, planning) if config.relative else None
        agent = TD3(actor, seeds, inputs, len(planning.low), config.planner, stream=1, view=view)
        low: Any = low_level(config, seeds)
        correction = None
        if relabel:
            stride = min(config.joint_stride, config.task.horizon)
            correction = OffPolicyCorrection(low, seeds, config.task.horizon, stride)
        return TwoLevelTraining(task, seeds, agent, low, planning, config.hierarchy, correction)

    return build


def one_level(config: TwoLevelConfig, seeds: Seeds) -> OneLevelTraining:
    """A planner that learns by PPO, without a low level."""
    task = config.make(len(seeds) * config.hierarchy.worlds)
    planning = config.planning()
    actor, _ = _planner(config, task, planning, seeds)
    env = SegmentEnv(task, planning, config.hierarchy.reward_scale)
    whole = replace(config.ppo, steps=config.task.ticks // config.task.horizon)
    return OneLevelTraining(env, actor, seeds, whole)


def _planner(
    config: TwoLevelConfig, task: PandaTask, planning: Planning, seeds: Seeds
) -> tuple[DirectPolicy, int]:
    """The planner's network, and the size of what it sees."""
    size = planning.observe(task, task.reset()).shape[-1]
    return planner(size, len(planning.low), config.planner_hidden, seeds), size


def planner(inputs: int, outputs: int, hidden: Sequence[int], seeds: Seeds) -> DirectPolicy:
    """Sub-goals in [-1, 1] from normalized observations."""
    network = JointNetwork(outputs, inputs=inputs, hidden=hidden, seeds=seeds, last=1.0)
    return DirectPolicy(network, squash=True)


def still(low: LowLevel) -> Fixed:
    """A low level as it is now, without exploration and learning."""
    if isinstance(low, JointLow):
        return Fixed(Normalised(low.agent.actor, low.units), len(low.units.start))
    return Fixed(low.agent.actor if isinstance(low, CriticLow) else getattr(low, "actor", None))


# -- methods --------------------------------------------------------------------------------------

RESTING = changed(hierarchy={"low_updates": 0})
"""The low level does not learn."""
TUNED = changed(start_gain=20.0)
"""A gain found by hand, close to the cap: what learning should find by itself."""


def through_the_model(config: TwoLevelConfig) -> TwoLevelConfig:
    """Learning through the latent model has updates and a cap of its own."""
    updates = changed(hierarchy={"low_updates": 16, "low_updates_late": 1, "low_late": 20_000})
    return replace(updates(config), cap=config.latent.cap)


def hiro(high_noise: float, low_noise: float) -> Adapt:
    """HIRO with this noise of the planner and of the low level, in half-ranges."""
    noise = {"high_noise": high_noise, "high_noise_end": None}
    return both(in_joints, changed(hierarchy=noise, joint_noise=low_noise))


METHODS: dict[str, Method] = {
    "ctd3": Method("TD3/C-TD3", two_level(latent), through_the_model),
    "ctd3_tuned": Method(
        "TD3/C-TD3, tuned start", two_level(latent), both(through_the_model, TUNED)
    ),
    "ctd3_short": Method(
        "TD3/C-TD3, discount .5",
        two_level(latent),
        both(through_the_model, changed(planner={"discount": 0.5})),
    ),
    "ctd3_plain_view": Method(
        "TD3/C-TD3, plain view", two_level(latent), both(through_the_model, changed(relative=False))
    ),
    "ctd3_no_bursts": Method(
        "TD3/C-TD3, Gaussian noise alone",
        two_level(latent),
        both(through_the_model, changed(hierarchy={"redraw": (0.0, 0.0), "burst": (0.0, 0.0)})),
    ),
    "ctd3_no_pull": Method(
        "TD3/C-TD3, no pull",
        two_level(latent),
        both(through_the_model, changed(planner={"pull": 0.0})),
    ),
    "ctd3_paper": Method("TD3/C-TD3, the paper's scheme", two_level(paper)),
    "ctd3_positive": Method("TD3/C-TD3, corrected critic", two_level(positive)),
    "frozen": Method("TD3/frozen random C", two_level(frozen), RESTING),
    "frozen_tuned": Method(
        "TD3/frozen random C, tuned start", two_level(frozen), both(RESTING, TUNED)
    ),
    "gain": Method("TD3/hand-tuned gain", two_level(gain), both(RESTING, TUNED)),
    "td3": Method("TD3/TD3, plain critic", two_level(free)),
    "td3_corrected": Method("TD3/TD3, corrected critic", two_level(corrected)),
    "control": Method("TD3/Control", two_level(none), RESTING),
    "ppo_control": Method("PPO/Control", one_level),
}
HIRO: dict[str, Method] = {
    "hiro": Method("HIRO", two_level(joints, relabel=True), hiro(1.0, 1.0)),
    "hiro_matched": Method("HIRO, matched noise", two_level(joints, relabel=True), hiro(0.3, 0.1)),
}
"""Where the study has a task in joint space."""
