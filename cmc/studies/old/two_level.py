"""What the two peg studies share: their methods and their configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.panda_task import HIGH_LEVEL, PandaTask
from cmc.learning.hierarchy import HierarchyConfig
from cmc.learning.latent import LatentConfig
from cmc.learning.planning import Planning
from cmc.learning.ppo import PPOConfig
from cmc.learning.td3 import TD3Config
from cmc.robot.panda import FINGERTIP, inverse_kinematics

Array = NDArray[np.float64]
Callback = Callable[[dict[str, Any]], object]
HIRO_HALF = 0.1
"""Half-range of HIRO's joint increments, rad (appendix G)."""


@dataclass(frozen=True)
class Arm:
    """A low level and how it learns.

    Attributes:
        title: in figures.
        low: "latent" learns through the latent model, "critic" from a critic, "frozen" keeps its
            random start, "gain" is a fixed slope, "none" does not act, "hiro" moves joints and
            relabels the planner's sub-goals.
        positive: positive weights, else free ones.
        capped: no biases, and slopes kept below the sampled-data cap.
        corrected: the low level's critic sees the full state and learns the segment's return.
        planner: the planner's algorithm.
        noise: exploration of planner and low level, in half-ranges; the defaults if None.
        changes: fields of the study that the method has otherwise; of a configuration among them
            only the fields that differ.
        trained: whether it can be trained.
    """

    title: str
    low: Literal["latent", "critic", "frozen", "gain", "none", "hiro"]
    positive: bool = True
    capped: bool = True
    corrected: bool = False
    planner: Literal["td3", "ppo"] = "td3"
    noise: tuple[float, float] | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    trained: bool = True


TUNED = {"start_gain": 20.0}
"""A gain found by hand, close to the cap: what learning should find by itself."""
METHODS: dict[str, Arm] = {
    "ctd3": Arm("TD3/C-TD3", "latent"),
    "ctd3_tuned": Arm("TD3/C-TD3, tuned start", "latent", changes=TUNED),
    "ctd3_paper": Arm("TD3/C-TD3, the paper's scheme", "critic", capped=False),
    "ctd3_positive": Arm("TD3/C-TD3, corrected critic", "critic", capped=False, corrected=True),
    "frozen": Arm("TD3/frozen random C", "frozen"),
    "frozen_tuned": Arm("TD3/frozen random C, tuned start", "frozen", changes=TUNED),
    "gain": Arm("TD3/hand-tuned gain", "gain", changes=TUNED),
    "td3": Arm("TD3/TD3, plain critic", "critic", positive=False, capped=False),
    "td3_corrected": Arm(
        "TD3/TD3, corrected critic", "critic", positive=False, capped=False, corrected=True
    ),
    "ctd3_short": Arm(
        "TD3/C-TD3, discount .5",
        "latent",
        changes={"planner": {"discount": 0.5}, "ppo": {"gamma": 0.5}},
    ),
    "ctd3_plain_view": Arm("TD3/C-TD3, plain view", "latent", changes={"relative": False}),
    "ctd3_no_bursts": Arm(
        "TD3/C-TD3, Gaussian noise alone",
        "latent",
        changes={"hierarchy": {"redraw": (0.0, 0.0), "burst": (0.0, 0.0)}},
    ),
    "ctd3_no_pull": Arm("TD3/C-TD3, no pull", "latent", changes={"planner": {"pull": 0.0}}),
    "control": Arm("TD3/Control", "none"),
    "ppo_control": Arm("PPO/Control", "none", planner="ppo"),
    "hiro": Arm("HIRO", "hiro", noise=(1.0, 1.0)),
    "hiro_matched": Arm("HIRO, matched noise", "hiro", noise=(0.3, 0.1)),
}


@dataclass(frozen=True)
class TwoLevelStudy:
    """Everything a run depends on.

    Attributes:
        name: of the study.
        task: the environment.
        task_class: its class.
        shift, scale: normalization of the planner's observation, by field (our choice).
        hierarchy: rates and sizes.
        planner: TD3 of the planner.
        low: TD3 of a low level that learns from a critic.
        latent: learning through the latent model.
        planner_hidden: hidden sizes (our choice; the paper's are 400, 300).
        low_hidden: hidden sizes for each dimension (our choice; the paper's are 200, 200).
        start_gain: slope du/dy at rest that every low level with a network starts from.
        relative: whether the planner's critics also see tip and sub-goal relative to the goal.
        cap: what (K_d + g K2) dt is kept below by construction; chatter starts at 2. Learning
            through the latent model has a lower one of its own.
        mass: effective mass of the tip in x, y, z at the start, kg.
        steps: environment steps of each seed.
        snapshot_every: steps between two kept policies.
        episodes: test episodes of each seed.
        ppo: PPO in place of the planner's TD3; `steps` is replaced by an episode's segments.
        fields: what the planner sees; the task's own if None.
        joint_task: the task in joint space, for HIRO; without one there is no HIRO.
        joint_aim: tip position that HIRO's random sub-goals of the warm-up lie around, m.
        joint_hidden: hidden sizes of HIRO's low level (our choice).
        joint_stride: ticks between those whose likelihood counts in relabelling (our choice).
    """

    name: str
    task: PandaTaskConfig
    task_class: type[PandaTask]
    shift: Mapping[str, Any]
    scale: Mapping[str, Any]
    hierarchy: HierarchyConfig
    planner: TD3Config
    low: TD3Config
    steps: int
    snapshot_every: int
    latent: LatentConfig = field(default_factory=LatentConfig)
    planner_hidden: tuple[int, ...] = (128, 128)
    low_hidden: tuple[int, ...] = (32, 32)
    start_gain: float = 0.3
    relative: bool = False
    cap: float = 1.2
    mass: tuple[float, float, float] = (1.75, 3.93, 7.17)
    episodes: int = 100
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(gamma=0.5, epochs=10, learning_rate=1e-3)
    )
    fields: tuple[str, ...] | None = None
    joint_task: PandaTaskConfig | None = None
    joint_aim: tuple[float, float, float] | None = None
    joint_hidden: tuple[int, ...] = (64, 64)
    joint_stride: int = 4

    @property
    def methods(self) -> dict[str, Arm]:
        """The methods of this study, by name."""
        return {k: arm for k, arm in METHODS.items() if arm.low != "hiro" or self.joint_task}

    def method(self, name: str) -> Arm:
        """The arm of this name.

        Raises:
            ValueError: if there is none.
        """
        if name not in self.methods:
            raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(self.methods)}")
        return self.methods[name]

    def of(self, name: str) -> TwoLevelStudy:
        """The study as a method runs it: with its changes; HIRO has a task and a view of its own.

        Raises:
            ValueError: if there is no such method.
        """
        arm, changes = self.method(name), dict[str, Any]()
        for key, value in arm.changes.items():
            old: Any = getattr(self, key)
            changes[key] = replace(old, **value) if isinstance(value, Mapping) else value
        study = replace(self, **changes)
        if arm.low != "hiro" or self.joint_task is None:
            return study
        start = tuple(start_joints(self.joint_task))
        return replace(
            study,
            relative=False,
            task=self.joint_task,
            fields=(*HIGH_LEVEL, "joints"),
            shift={**self.shift, "joints": start},
            scale={**self.scale, "joints": 1.0 / HIRO_HALF},
        )

    def planning(self) -> Planning:
        """Normalization of the planner's observations and sub-goals."""
        return Planning(
            {name: np.asarray(value, dtype=float) for name, value in self.shift.items()},
            {name: np.asarray(value, dtype=float) for name, value in self.scale.items()},
            np.array(self.task.subgoal_low),
            np.array(self.task.subgoal_high),
            self.fields,
            self._joint_aim(),
        )

    def _joint_aim(self) -> Array | None:
        if self.task.command != "joint" or self.joint_aim is None:
            return None
        tool = FINGERTIP + self.task.peg.length
        return inverse_kinematics(self.joint_aim, tool=tool, q0=start_joints(self.task))

    def slope_cap(self, method: str = "frozen") -> Array:
        """Largest slope d pi / dy that keeps (K_d + g K2) dt below a method's cap, (6,)."""
        latent = self.task.gains.latent
        cap = self.latent.cap if self.method(method).low == "latent" else self.cap
        room = cap / self.task.tick - latent.K_d
        return room / (latent.K2 * np.array(self.task.u_limit))


def start_joints(task: PandaTaskConfig) -> Array:
    """Joint angles of a task's start, (7,), rad."""
    return inverse_kinematics(task.start, tool=FINGERTIP + task.peg.length)
