"""What studies of a planner over a low level share: their configuration, and their methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cmc.envs.panda_task import HIGH_LEVEL, PandaTask, PandaTaskConfig
from cmc.learning.hierarchy import HierarchyConfig, TwoLevel
from cmc.learning.hiro import JointLow, JointUnits, OffPolicyCorrection, PullActor
from cmc.learning.latent import LatentConfig, LatentLow, LatentModel
from cmc.learning.low_level import CriticLow, LowLevel, latent_policy, set_gain, tensor
from cmc.learning.planning import CriticView, OneLevelPPO, Planning, SegmentEnv
from cmc.learning.ppo import PPOConfig
from cmc.learning.td3 import TD3, TD3Config
from cmc.policies import (
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    LinearNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.robot.panda import FINGERTIP, LOWER, UPPER, inverse_kinematics
from cmc.studies.study import Array, Change, Method, both, changed

N = 6  # dimensions of a pose
ACTOR_SIZE, CRITIC_SIZE = 2 * N, 4 * N + 1  # (y, int y), and with error, velocity, time to go
HIRO_HALF = 0.1
"""Half-range of HIRO's joint increments, rad (appendix G)."""


@dataclass(frozen=True)
class TwoLevelConfig:
    """Everything a run depends on; what is not of the paper's tables is our choice."""

    task: PandaTaskConfig
    task_class: type[PandaTask]
    shift: Mapping[str, Any]  # normalization of what the planner sees, by field
    scale: Mapping[str, Any]
    hierarchy: HierarchyConfig
    planner: TD3Config
    low: TD3Config  # of a low level that learns from a critic
    latent: LatentConfig = LatentConfig()  # of one that learns through the latent model
    planner_hidden: tuple[int, ...] = (128, 128)  # the paper's are 400, 300
    low_hidden: tuple[int, ...] = (32, 32)  # for each dimension; the paper's are 200, 200
    start_gain: float = 0.3  # slope du/dy at rest that every low level with a network starts from
    relative: bool = False  # whether the planner's critics see tip and sub-goal from the goal too
    cap: float = 1.2  # what (K_d + g K2) dt is kept below by construction; chatter starts at 2
    mass: tuple[float, float, float] = (1.75, 3.93, 7.17)  # of the tip in x, y, z, kg
    ppo: PPOConfig = PPOConfig(gamma=0.5, epochs=10, learning_rate=1e-3)  # `steps`: an episode's
    fields: tuple[str, ...] | None = None  # what the planner sees; the task's own if None
    joint_task: PandaTaskConfig | None = None  # the task in joint space, for HIRO
    joint_aim: tuple[float, float, float] | None = None  # tip of its warm-up's sub-goals, m
    joint_hidden: tuple[int, ...] = (64, 64)  # of HIRO's low level
    joint_stride: int = 4  # ticks between those whose likelihood counts in relabelling
    joint_noise: float = 0.1  # HIRO's exploration, half-ranges

    def make(self, num: int, seed: int = 0) -> PandaTask:
        """The environment with `num` worlds."""
        return self.task_class(self.task, num=num, seed=seed)

    def planning(self) -> Planning:
        """Normalization of the planner's observations and sub-goals."""
        shift, scale = (
            {name: np.asarray(value, dtype=float) for name, value in part.items()}
            for part in (self.shift, self.scale)
        )
        low, high, aim = np.array(self.task.subgoal_low), np.array(self.task.subgoal_high), None
        if self.task.command == "joint" and self.joint_aim is not None:
            tool = FINGERTIP + self.task.peg.length
            aim = inverse_kinematics(self.joint_aim, tool=tool, q0=start_joints(self.task))
        return Planning(shift, scale, low, high, self.fields, aim)

    def slope_cap(self) -> Array:
        """Largest slope d pi / dy that keeps (K_d + g K2) dt below the cap, (6,)."""
        latent = self.task.gains.latent
        room = self.cap / self.task.tick - latent.K_d
        return room / (latent.K2 * np.array(self.task.u_limit))

    def latent_model(self) -> LatentModel:
        """The model of the tip's latent signals that a low level may learn through."""
        k, limit = self.task.gains.latent, np.array(self.task.u_limit)
        mass, translation = np.array([*self.mass, 0.0, 0.0, 0.0]), np.repeat([1.0, 0.0], 3)
        return LatentModel(k.K_p, k.K_d, k.K1, k.K2, limit, mass, translation, self.task.tick)

    def critic_scale(self) -> Array:
        """Brings (y, int y, error, velocity, time left) of a 5 mm, .1 rad sub-goal to order one."""
        size = np.repeat([0.005, 0.1], 3)
        y = 1.0 / (self.task.gains.latent.K1 * size)
        return np.concatenate([y, y / 0.4, 1.0 / size, 0.2 / size, [2.5]])


def start_joints(task: PandaTaskConfig) -> Array:
    """Joint angles of a task's start, (7,), rad."""
    return inverse_kinematics(task.start, tool=FINGERTIP + task.peg.length)


Seeds = Sequence[int]
Builder = Callable[[TwoLevelConfig, Seeds], LowLevel]
Policy = tuple[nn.Module, LowLevel]
"""What is tested: the planner and a low level that neither explores nor learns."""


def _none(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """No action."""
    return LowLevel(None, N)


def _gain(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
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


def _critic(network: Callable[..., Any], corrected: bool = False) -> Builder:
    """A network with biases that learns from a critic.

    The paper's critic, as we read it, sees (y, integral of y) and learns one-step targets from
    meters and radians. A corrected one sees the full state and learns returns, in centimeters.
    """
    noise, size = (0.5, CRITIC_SIZE) if corrected else (0.1, ACTOR_SIZE)
    weights = {"translation": 100.0 if corrected else 1.0, "rotation": 1.0}

    def build(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
        net = network(N, hidden=config.low_hidden, seeds=seeds)
        set_gain(net, _start(config))
        factor = tensor(config.critic_scale())

        def view(observation: Tensor, action: Tensor) -> Tensor:
            return torch.cat([observation * factor, action], dim=-1)

        seen = view if corrected else None
        agent = TD3(latent_policy(net), seeds, size, N, config.low, stream=2, view=seen)
        options: Any = {"noise": noise, "whole_return": corrected, "weights": weights}
        return CriticLow(agent, seeds, size, **options)

    return build


def _joints(config: TwoLevelConfig, seeds: Seeds) -> LowLevel:
    """HIRO's low level: one network that moves all joints."""
    task, start = config.task, start_joints(config.task)
    half, n = np.array(task.subgoal_high), task.low_size
    low = np.maximum(start + np.array(task.workspace_low), LOWER)
    high = np.minimum(start + np.array(task.workspace_high), UPPER)
    actor = PullActor(n, config.joint_hidden, seeds)
    agent = TD3(actor, seeds, 3 * n, n, config.low, stream=2)
    return JointLow(agent, seeds, JointUnits(start, half, low, high), config.joint_noise)


def two_level(low_level: Builder, relabel: bool = False) -> Callable[..., TwoLevel]:
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


def _one_level(config: TwoLevelConfig, seeds: Seeds) -> OneLevelPPO:
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


def _arm(title: str, low_level: Builder, *steps: Change, relabel: bool = False) -> Method:
    """A method whose planner learns by TD3, and what it changes of the configuration."""
    return Method(title, two_level(low_level, relabel), both(*steps))


def _in_joints(config: TwoLevelConfig) -> TwoLevelConfig:
    """HIRO has a task of its own, and a planner that sees the joints."""
    task = config.joint_task
    if task is None:
        raise ValueError("HIRO: this study has no task in joint space")
    most = 25_000  # whole segments are large; 25,000 of them are 500,000 ticks
    hierarchy = replace(config.hierarchy, capacity=min(config.hierarchy.capacity, most))
    seen: dict[str, Any] = {"relative": False, "fields": (*HIGH_LEVEL, "joints")}
    seen["shift"] = {**config.shift, "joints": tuple(start_joints(task))}
    seen["scale"] = {**config.scale, "joints": 1.0 / HIRO_HALF}
    return replace(config, task=task, hierarchy=hierarchy, **seen)


def light(config: TwoLevelConfig) -> TwoLevelConfig:
    """With one world of each seed: acts the same and is made faster."""
    return replace(config, hierarchy=replace(config.hierarchy, worlds=1, capacity=1))


RESTING = changed(hierarchy={"low_updates": 0})
"""The low level does not learn."""
TUNED = changed(start_gain=20.0)
"""A gain found by hand, close to the cap: what learning should find by itself."""
AVERAGED = changed(planner={"average": 5e-4})  # over some 2,000 updates, 40,000 steps
GAUSSIAN = changed(hierarchy={"redraw": (0.0, 0.0), "burst": (0.0, 0.0)})


def _model(config: TwoLevelConfig) -> TwoLevelConfig:
    """Learning through the latent model has updates and a cap of its own."""
    updates = changed(hierarchy={"low_updates": 16, "low_updates_late": 1, "low_late": 20_000})
    return replace(updates(config), cap=config.latent.cap)


def _noise(high: float, low: float) -> Change:
    """HIRO's noise of the planner and of the low level, in half-ranges."""
    return changed(hierarchy={"high_noise": high, "high_noise_end": None}, joint_noise=low)


METHODS: dict[str, Method] = {
    "ctd3": _arm("TD3/C-TD3", latent, _model),
    "ctd3_tuned": _arm("TD3/C-TD3, tuned start", latent, _model, TUNED),
    "ctd3_short": _arm(
        "TD3/C-TD3, discount .5", latent, _model, changed(planner={"discount": 0.5})
    ),
    "ctd3_plain_view": _arm("TD3/C-TD3, plain view", latent, _model, changed(relative=False)),
    "ctd3_no_bursts": _arm("TD3/C-TD3, Gaussian noise alone", latent, _model, GAUSSIAN),
    "ctd3_no_pull": _arm("TD3/C-TD3, no pull", latent, _model, changed(planner={"pull": 0.0})),
    "ctd3_averaged": _arm("TD3/C-TD3, averaged planner", latent, _model, AVERAGED),
    "ctd3_paper": _arm("TD3/C-TD3, the paper's scheme", _critic(PositiveNetwork)),
    "ctd3_positive": _arm("TD3/C-TD3, corrected critic", _critic(PositiveNetwork, corrected=True)),
    "frozen": _arm("TD3/frozen random C", frozen, RESTING),
    "frozen_tuned": _arm("TD3/frozen random C, tuned start", frozen, RESTING, TUNED),
    "gain": _arm("TD3/hand-tuned gain", _gain, RESTING, TUNED),
    "td3": _arm("TD3/TD3, plain critic", _critic(IndependentNetwork)),
    "td3_corrected": _arm("TD3/TD3, corrected critic", _critic(IndependentNetwork, corrected=True)),
    "control": _arm("TD3/Control", _none, RESTING),
    "ppo_control": Method("PPO/Control", _one_level),
}
HIRO: dict[str, Method] = {
    "hiro": _arm("HIRO", _joints, _in_joints, _noise(1.0, 1.0), relabel=True),
    "hiro_matched": _arm(
        "HIRO, matched noise", _joints, _in_joints, _noise(0.3, 0.1), relabel=True
    ),
}
"""Where the study has a task in joint space."""
