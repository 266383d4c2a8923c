"""What studies of a planner over a low level share: their configuration, and changes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cmc.envs.panda_task import HIGH_LEVEL, PandaTask, PandaTaskConfig
from cmc.learning.hierarchy import HierarchyConfig
from cmc.learning.latent import LatentConfig, LatentModel
from cmc.learning.planning import Planning
from cmc.learning.ppo import PPOConfig
from cmc.learning.td3 import TD3Config
from cmc.robot.panda import FINGERTIP, inverse_kinematics
from cmc.studies.study import Array

HIRO_HALF = 0.1
"""Half-range of HIRO's joint increments, rad (appendix G)."""


@dataclass(frozen=True)
class TwoLevelConfig:
    """Everything a run depends on; what is not of the paper's tables is our choice.

    Attributes:
        task, task_class: the environment.
        shift, scale: normalization of what the planner sees, by field.
        hierarchy: rates and sizes.
        planner, low: TD3 of the planner, and of a low level that learns from a critic.
        latent: learning through the latent model.
        planner_hidden: hidden sizes (the paper's are 400, 300).
        low_hidden: hidden sizes for each dimension (the paper's are 200, 200).
        start_gain: slope du/dy at rest that every low level with a network starts from.
        relative: whether the planner's critics also see tip and sub-goal relative to the goal.
        cap: what (K_d + g K2) dt is kept below by construction; chatter starts at 2. Learning
            through the latent model has a lower one of its own.
        mass: effective mass of the tip in x, y, z at the start, kg.
        ppo: PPO in place of the planner's TD3; `steps` is replaced by an episode's segments.
        fields: what the planner sees; the task's own if None.
        joint_task: the task in joint space, for HIRO.
        joint_aim: tip position that HIRO's random sub-goals of the warm-up lie around, m.
        joint_hidden, joint_noise: hidden sizes of HIRO's low level, its exploration, half-ranges.
        joint_stride: ticks between those whose likelihood counts in relabelling.
    """

    task: PandaTaskConfig
    task_class: type[PandaTask]
    shift: Mapping[str, Any]
    scale: Mapping[str, Any]
    hierarchy: HierarchyConfig
    planner: TD3Config
    low: TD3Config
    latent: LatentConfig = field(default_factory=LatentConfig)
    planner_hidden: tuple[int, ...] = (128, 128)
    low_hidden: tuple[int, ...] = (32, 32)
    start_gain: float = 0.3
    relative: bool = False
    cap: float = 1.2
    mass: tuple[float, float, float] = (1.75, 3.93, 7.17)
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(gamma=0.5, epochs=10, learning_rate=1e-3)
    )
    fields: tuple[str, ...] | None = None
    joint_task: PandaTaskConfig | None = None
    joint_aim: tuple[float, float, float] | None = None
    joint_hidden: tuple[int, ...] = (64, 64)
    joint_stride: int = 4
    joint_noise: float = 0.1

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


# -- what a method changes of the configuration ---------------------------------------------------


def in_joints(config: TwoLevelConfig) -> TwoLevelConfig:
    """HIRO has a task of its own, and a planner that sees the joints."""
    task = config.joint_task
    if task is None:
        raise ValueError("HIRO: this study has no task in joint space")
    most = 25_000  # whole segments are large; 25,000 of them are 500,000 ticks
    hierarchy = replace(config.hierarchy, capacity=min(config.hierarchy.capacity, most))
    return replace(
        config,
        task=task,
        hierarchy=hierarchy,
        relative=False,
        fields=(*HIGH_LEVEL, "joints"),
        shift={**config.shift, "joints": tuple(start_joints(task))},
        scale={**config.scale, "joints": 1.0 / HIRO_HALF},
    )


def light(config: TwoLevelConfig) -> TwoLevelConfig:
    """With one world of each seed: acts the same and is made faster."""
    return replace(config, hierarchy=replace(config.hierarchy, worlds=1, capacity=1))
