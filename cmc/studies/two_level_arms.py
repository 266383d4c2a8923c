"""The methods of a planner over a low level: what each builds and how it learns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc.envs.panda_task import PandaTask
from cmc.learning.hierarchy import TwoLevel
from cmc.learning.hiro import JointLow, JointUnits, OffPolicyCorrection, PullActor
from cmc.learning.latent import LatentLow
from cmc.learning.low_level import CriticLow, LowLevel, latent_policy, set_gain
from cmc.learning.planning import CriticView, OneLevelPPO, Planning, SegmentEnv
from cmc.learning.td3 import TD3
from cmc.policies import (
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.robot.panda import LOWER, UPPER
from cmc.studies.study import Array, Change, Method, both, changed
from cmc.studies.two_level import TwoLevelConfig, in_joints, start_joints

Seeds = Sequence[int]
Builder = Callable[[TwoLevelConfig, Seeds], LowLevel]
Policy = tuple[nn.Module, LowLevel]
"""What is tested: the planner and a low level that neither explores nor learns."""
N = 6  # dimensions of a pose
ACTOR_SIZE, CRITIC_SIZE = 2 * N, 4 * N + 1  # (y, int y), and with error, velocity, time to go


# -- low levels -----------------------------------------------------------------------------------


def none(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """No action."""
    return LowLevel(None, N)


def gain(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A slope set by hand, for y and its integral alike."""
    start = _start(config)
    return LowLevel(latent_policy(LinearNetwork(np.stack([start, start], -1))), N)


def frozen(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A capped network that stays as it started."""
    return LowLevel(capped_actor(config, seeds), N)


def latent(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """A capped network that learns through the latent model."""
    actor, horizon = capped_actor(config, seeds), config.task.horizon
    return LatentLow(actor, seeds, config.latent_model(), horizon, config.latent)


def _start(config: TwoLevelConfig) -> Array:
    return np.minimum(config.start_gain, 0.99 * config.slope_cap())


def capped_actor(config: TwoLevelConfig, seeds: Seeds) -> ModularPolicy:
    """Positive weights, no biases, slopes below the sampled-data cap by construction."""
    cap = (np.array([1.0, config.task.tick]), config.slope_cap())
    net = PositiveNetwork(N, hidden=config.low_hidden, seeds=seeds, bias=False, joint_cap=cap)
    set_gain(net, _start(config))
    return latent_policy(net)


def critic(network: Callable[..., Any], corrected: bool = False) -> Builder:
    """A network with biases that learns from a critic.

    The paper's critic, as we read it, sees (y, integral of y) and learns one-step targets from
    meters and radians. A corrected one sees the full state and learns returns, in centimeters.
    """
    noise, size = (0.5, CRITIC_SIZE) if corrected else (0.1, ACTOR_SIZE)
    weights = {"translation": 100.0 if corrected else 1.0, "rotation": 1.0}

    def build(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
        net = network(N, hidden=config.low_hidden, seeds=seeds)
        set_gain(net, _start(config))
        factor = torch.as_tensor(config.critic_scale(), dtype=torch.float32)

        def view(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return torch.cat([observation * factor, action], dim=-1)

        seen = view if corrected else None
        agent = TD3(latent_policy(net), seeds, size, N, config.low, stream=2, view=seen)
        options: Any = {"noise": noise, "whole_return": corrected, "weights": weights}
        return CriticLow(agent, seeds, size, **options)

    return build


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


def two_level(
    low_level: Builder, relabel: bool = False
) -> Callable[[TwoLevelConfig, Seeds], TwoLevel]:
    """A planner that learns by TD3 over a low level; relabelled sub-goals are HIRO's."""

    def build(config: TwoLevelConfig, seeds: Seeds) -> TwoLevel:
        task, planning, actor, inputs = _planner(config, seeds)
        view = CriticView(task, planning) if config.relative else None
        agent = TD3(actor, seeds, inputs, len(planning.low), config.planner, stream=1, view=view)
        low: Any = low_level(config, seeds)
        horizon, correction = config.task.horizon, None
        if relabel:
            correction = OffPolicyCorrection(low, seeds, horizon, min(config.joint_stride, horizon))
        return TwoLevel(task, seeds, agent, low, planning, config.hierarchy, correction)

    return build


def one_level(config: TwoLevelConfig, seeds: Seeds) -> OneLevelPPO:
    """A planner that learns by PPO, without a low level."""
    task, planning, actor, _ = _planner(config, seeds)
    env = SegmentEnv(task, planning, config.hierarchy.reward_scale)
    whole = replace(config.ppo, steps=config.task.ticks // config.task.horizon)
    return OneLevelPPO(env, actor, seeds, whole)


def _planner(config: TwoLevelConfig, seeds: Seeds) -> tuple[PandaTask, Planning, DirectPolicy, int]:
    """Task, normalization, the planner's network (to [-1, 1]), and the size of what it sees."""
    task, planning = config.make(len(seeds) * config.hierarchy.worlds), config.planning()
    inputs, hidden = planning.observe(task, task.reset()).shape[-1], config.planner_hidden
    network = JointNetwork(len(planning.low), inputs=inputs, hidden=hidden, seeds=seeds, last=1.0)
    return task, planning, DirectPolicy(network, squash=True), inputs


# -- methods --------------------------------------------------------------------------------------


def arm(title: str, low_level: Builder, *steps: Change, relabel: bool = False) -> Method:
    """A method whose planner learns by TD3, and what it changes of the configuration."""
    return Method(title, two_level(low_level, relabel), both(*steps))


RESTING = changed(hierarchy={"low_updates": 0})
"""The low level does not learn."""
TUNED = changed(start_gain=20.0)
"""A gain found by hand, close to the cap: what learning should find by itself."""
GAUSSIAN = changed(hierarchy={"redraw": (0.0, 0.0), "burst": (0.0, 0.0)})


def model(config: TwoLevelConfig) -> TwoLevelConfig:
    """Learning through the latent model has updates and a cap of its own."""
    updates = changed(hierarchy={"low_updates": 16, "low_updates_late": 1, "low_late": 20_000})
    return replace(updates(config), cap=config.latent.cap)


def noise(high: float, low: float) -> Change:
    """HIRO's noise of the planner and of the low level, in half-ranges."""
    return changed(hierarchy={"high_noise": high, "high_noise_end": None}, joint_noise=low)


METHODS: dict[str, Method] = {
    "ctd3": arm("TD3/C-TD3", latent, model),
    "ctd3_tuned": arm("TD3/C-TD3, tuned start", latent, model, TUNED),
    "ctd3_short": arm("TD3/C-TD3, discount .5", latent, model, changed(planner={"discount": 0.5})),
    "ctd3_plain_view": arm("TD3/C-TD3, plain view", latent, model, changed(relative=False)),
    "ctd3_no_bursts": arm("TD3/C-TD3, Gaussian noise alone", latent, model, GAUSSIAN),
    "ctd3_no_pull": arm("TD3/C-TD3, no pull", latent, model, changed(planner={"pull": 0.0})),
    "ctd3_paper": arm("TD3/C-TD3, the paper's scheme", critic(PositiveNetwork)),
    "ctd3_positive": arm("TD3/C-TD3, corrected critic", critic(PositiveNetwork, corrected=True)),
    "frozen": arm("TD3/frozen random C", frozen, RESTING),
    "frozen_tuned": arm("TD3/frozen random C, tuned start", frozen, RESTING, TUNED),
    "gain": arm("TD3/hand-tuned gain", gain, RESTING, TUNED),
    "td3": arm("TD3/TD3, plain critic", critic(IndependentNetwork)),
    "td3_corrected": arm("TD3/TD3, corrected critic", critic(IndependentNetwork, corrected=True)),
    "control": arm("TD3/Control", none, RESTING),
    "ppo_control": Method("PPO/Control", one_level),
}
HIRO: dict[str, Method] = {
    "hiro": arm("HIRO", joints, in_joints, noise(1.0, 1.0), relabel=True),
    "hiro_matched": arm("HIRO, matched noise", joints, in_joints, noise(0.3, 0.1), relabel=True),
}
"""Where the study has a task in joint space."""
