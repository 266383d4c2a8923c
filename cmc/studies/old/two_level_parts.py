"""How the methods of the two peg studies are built: planner, low level, trainer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cmc.learning.hierarchy import HierarchyConfig, TwoLevel
from cmc.learning.hiro import JointLow, JointUnits, Normalised, OffPolicyCorrection, PullActor
from cmc.learning.latent import LatentLow, LatentModel
from cmc.learning.low_level import CriticLow, Fixed, LowLevel, latent_policy, set_gain
from cmc.learning.one_level import OneLevelPPO, SegmentEnv
from cmc.learning.planning import CriticView
from cmc.learning.td3 import TD3, View
from cmc.policies import (
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    PositiveNetwork,
)
from cmc.robot.panda import LOWER, UPPER
from cmc.studies.old.two_level import Arm, TwoLevelStudy, start_joints

Array = NDArray[np.float64]
N = 6  # dimensions of a pose
ACTOR_SIZE, CRITIC_SIZE = 2 * N, 4 * N + 1  # (y, int y), and with error, velocity, time to go


Trainer = TwoLevel | OneLevelPPO


def Planner(inputs: int, outputs: int, hidden: Sequence[int], seeds: Sequence[int]) -> DirectPolicy:
    """Sub-goals in [-1, 1] from normalized observations."""
    network = JointNetwork(outputs, inputs=inputs, hidden=hidden, seeds=seeds, last=1.0)
    return DirectPolicy(network, squash=True)


def build_low(study: TwoLevelStudy, name: str, seeds: Sequence[int]) -> LowLevel:
    """The low level of a method, untrained."""
    arm, study = study.method(name), study.of(name)
    if arm.low == "none":
        return Fixed(None, N)
    if arm.low == "hiro":
        return _joint_low(study, arm, seeds)
    cap = study.slope_cap(name)
    start = np.minimum(study.start_gain, 0.99 * cap)
    if arm.low == "gain":
        gain = LinearNetwork(np.stack([start, start], -1))
        return Fixed(latent_policy(gain), N)
    net: nn.Module
    if arm.positive:
        limit = (np.array([1.0, study.task.tick]), cap) if arm.capped else None
        net = PositiveNetwork(
            N, hidden=study.low_hidden, seeds=seeds, bias=not arm.capped, joint_cap=limit
        )
    else:
        net = IndependentNetwork(N, hidden=study.low_hidden, seeds=seeds)
    set_gain(net, start)
    actor = latent_policy(net)
    if arm.low == "frozen":
        return Fixed(actor, N)
    if arm.low == "latent":
        return LatentLow(actor, seeds, _latent_model(study), study.task.horizon, study.latent)
    size = CRITIC_SIZE if arm.corrected else ACTOR_SIZE
    view = scaled(_critic_scale(study)) if arm.corrected else None
    agent = TD3(actor, seeds, size, N, study.low, stream=2, view=view)
    weights = {"translation": 100.0 if arm.corrected else 1.0, "rotation": 1.0}
    return CriticLow(
        agent,
        seeds,
        size,
        noise=0.5 if arm.corrected else 0.1,
        whole_return=arm.corrected,
        weights=weights,
    )


def _latent_model(study: TwoLevelStudy) -> LatentModel:
    latent = study.task.gains.latent
    return LatentModel(
        latent.K_p,
        latent.K_d,
        latent.K1,
        latent.K2,
        np.array(study.task.u_limit),
        np.array([*study.mass, 0.0, 0.0, 0.0]),
        np.repeat([1.0, 0.0], 3),
        study.task.tick,
    )


def scaled(scale: Array) -> View:
    """What critics see: (observation * scale, action)."""
    factor = torch.as_tensor(scale, dtype=torch.float32)
    return lambda observation, action: torch.cat([observation * factor, action], dim=-1)


def _critic_scale(study: TwoLevelStudy) -> Array:
    """Brings (y, int y, error, velocity, time to go) of a 5 mm, 0.1 rad sub-goal to order one."""
    latent = study.task.gains.latent
    size = np.repeat([0.005, 0.1], 3)
    y = 1.0 / (latent.K1 * size)
    return np.concatenate([y, y / 0.4, 1.0 / size, 0.2 / size, [2.5]])


def _joint_low(study: TwoLevelStudy, arm: Arm, seeds: Sequence[int]) -> JointLow:
    task, start = study.task, start_joints(study.task)
    half, n = np.array(task.subgoal_high), task.low_size
    low = np.maximum(start + np.array(task.workspace_low), LOWER)
    high = np.minimum(start + np.array(task.workspace_high), UPPER)
    actor = PullActor(n, study.joint_hidden, seeds)
    agent = TD3(actor, seeds, 3 * n, n, study.low, stream=2)
    noise = arm.noise[1] if arm.noise else 0.1
    return JointLow(agent, seeds, JointUnits(start, half, low, high), noise)


def build(study: TwoLevelStudy, name: str, seeds: Sequence[int]) -> Trainer:
    """The trainer of a method.

    Raises:
        ValueError: for an unknown method, or no seed.
    """
    if len(seeds) == 0:
        raise ValueError("seeds: wanted at least one, got none")
    arm, study = study.method(name), study.of(name)
    config = _rates(study.hierarchy, arm)
    task = study.task_class(study.task, num=len(seeds) * config.worlds)
    planning = study.planning()
    inputs, outputs = planning.observe(task, task.reset()).shape[-1], len(planning.low)
    actor = Planner(inputs, outputs, study.planner_hidden, seeds)
    if arm.planner == "ppo":
        env = SegmentEnv(task, planning, config.reward_scale)
        whole = replace(study.ppo, steps=study.task.ticks // study.task.horizon)
        return OneLevelPPO(env, actor, seeds, whole)
    view = CriticView(task, planning) if study.relative else None
    planner = TD3(actor, seeds, inputs, outputs, study.planner, stream=1, view=view)
    low = build_low(study, name, seeds)
    correction = None
    if isinstance(low, JointLow):
        stride = min(study.joint_stride, study.task.horizon)
        correction = OffPolicyCorrection(low, seeds, study.task.horizon, stride)
    return TwoLevel(task, seeds, planner, low, planning, config, correction)


def _rates(config: HierarchyConfig, arm: Arm) -> HierarchyConfig:
    """Updates, noise and memory of a method."""
    if arm.low in ("frozen", "gain", "none"):
        config = replace(config, low_updates=0)
    elif arm.low == "latent":
        config = replace(config, low_updates=16, low_updates_late=1, low_late=20_000)
    elif arm.low == "hiro":  # whole segments are large; 25,000 of them are 500,000 ticks
        config = replace(config, capacity=min(config.capacity, 25_000))
    if arm.noise:
        config = replace(config, high_noise=arm.noise[0], high_noise_end=None)
    return config


def frozen(low: LowLevel) -> Fixed:
    """A low level as it is now, without exploration and learning."""
    if isinstance(low, JointLow):
        return Fixed(Normalised(low.agent.actor, low.units), len(low.units.start))
    return Fixed(low.agent.actor if isinstance(low, CriticLow) else getattr(low, "actor", None))
