"""What the two peg studies share: methods, how they are built, trained, evaluated and loaded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.learning.hierarchy import HierarchyConfig, TwoLevel
from cmc.learning.latent_rollout import LatentConfig, LatentLow, LatentModel
from cmc.learning.low_level import (
    CriticLow,
    Fixed,
    LowLevel,
    ModularActor,
    set_gain,
)
from cmc.learning.planning import Planning
from cmc.learning.td3 import TD3, TD3Config
from cmc.policies import IndependentNetwork, PositiveNetwork, StackedMLP, tanh

Array = NDArray[np.float64]
Callback = Callable[[dict[str, Any]], object]
N = 6  # dimensions of a pose
ACTOR_SIZE, CRITIC_SIZE = 2 * N, 4 * N + 1  # (y, int y), and with error, velocity, time to go


@dataclass(frozen=True)
class Arm:
    """A low level and how it learns.

    Attributes:
        title: in figures.
        low: "latent" learns through the latent model, "critic" from a critic, "frozen" keeps its
            random start, "gain" is a fixed slope, "none" does not act.
        positive: positive weights, else free ones.
        capped: no biases, and slopes kept below the sampled-data cap.
        corrected: the critic sees the full state and learns the segment's return.
    """

    title: str
    low: Literal["latent", "critic", "frozen", "gain", "none"]
    positive: bool = True
    capped: bool = True
    corrected: bool = False
    trained: bool = True


METHODS: dict[str, Arm] = {
    "ctd3": Arm("TD3/C-TD3", "latent"),
    "ctd3_paper": Arm("TD3/C-TD3, the paper's scheme", "critic", capped=False),
    "frozen": Arm("TD3/frozen random C", "frozen"),
    "gain": Arm("TD3/hand-tuned gain", "gain"),
    "td3": Arm("TD3/TD3, plain critic", "critic", positive=False, capped=False),
    "td3_corrected": Arm(
        "TD3/TD3, corrected critic", "critic", positive=False, capped=False, corrected=True
    ),
    "control": Arm("TD3/Control", "none"),
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
        start_gain: slope in y that constrained low levels start from, below the cap.
        cap: what (K_d + g K2) dt is kept below by construction; chatter starts at 2.
        mass: effective mass of the tip in x, y, z at the start, kg.
        steps: environment steps of each seed.
        snapshot_every: steps between two kept policies.
        episodes: test episodes of each seed.
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
    start_gain: float = 20.0
    cap: float = 1.2
    mass: tuple[float, float, float] = (1.75, 3.93, 7.17)
    episodes: int = 100

    def planning(self) -> Planning:
        """Normalization of the planner's observations and sub-goals."""
        return Planning(
            {name: np.asarray(value, dtype=float) for name, value in self.shift.items()},
            {name: np.asarray(value, dtype=float) for name, value in self.scale.items()},
            np.array(self.task.subgoal_low),
            np.array(self.task.subgoal_high),
        )

    def slope_cap(self) -> Array:
        """Largest slope d pi / dy that keeps (K_d + g K2) dt below the cap, (6,)."""
        latent = self.task.gains.latent
        room = self.cap / self.task.tick - latent.K_d
        return room / (latent.K2 * np.array(self.task.u_limit))


class Planner(nn.Module):
    """Sub-goals in [-1, 1] from normalized observations."""

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int], seeds: Sequence[int]):
        super().__init__()
        self.net = StackedMLP(inputs, outputs, hidden, seeds=seeds)

    def forward(self, observation: Tensor) -> Tensor:
        """Actions (seeds, batch, outputs)."""
        return tanh(self.net(observation))


class Gain(nn.Module):
    """u_i = tanh(g_i (y_i + integral of y_i)): a hand-tuned low level."""

    def __init__(self, gain: Array) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.as_tensor(gain, dtype=torch.float32), requires_grad=False)

    def forward(self, s: Tensor) -> Tensor:
        """Values (seeds, batch, n) for s (seeds, batch, n, 2)."""
        return self.gain * s.sum(-1)


def method(name: str) -> Arm:
    """The arm of this name.

    Raises:
        ValueError: if there is none.
    """
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(METHODS)}")
    return METHODS[name]


def build_low(study: TwoLevelStudy, name: str, seeds: Sequence[int]) -> LowLevel:
    """The low level of a method, untrained."""
    arm, cap = method(name), study.slope_cap()
    start = np.minimum(study.start_gain, 0.99 * cap)
    if arm.low == "none":
        return Fixed(None, N)
    if arm.low == "gain":
        return Fixed(ModularActor(Gain(start), N), N)
    net: nn.Module
    if arm.positive:
        limit = (np.array([1.0, study.task.tick]), cap) if arm.capped else None
        net = PositiveNetwork(
            N, hidden=study.low_hidden, seeds=seeds, bias=not arm.capped, joint_cap=limit
        )
        if arm.capped:
            set_gain(net, start)
    else:
        net = IndependentNetwork(N, hidden=study.low_hidden, seeds=seeds)
    actor = ModularActor(net, N)
    if arm.low == "frozen":
        return Fixed(actor, N)
    if arm.low == "latent":
        return LatentLow(actor, seeds, _latent_model(study), study.task.horizon, study.latent)
    size = CRITIC_SIZE if arm.corrected else ACTOR_SIZE
    scale = _critic_scale(study)[:size] if arm.corrected else 1.0
    agent = TD3(actor, seeds, size, N, study.low, stream=2, scale=scale)
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


def _critic_scale(study: TwoLevelStudy) -> Array:
    """Brings (y, int y, error, velocity, time to go) of a 5 mm, 0.1 rad sub-goal to order one."""
    latent = study.task.gains.latent
    size = np.repeat([0.005, 0.1], 3)
    y = 1.0 / (latent.K1 * size)
    return np.concatenate([y, y / 0.4, 1.0 / size, 0.2 / size, [2.5]])


def build(study: TwoLevelStudy, name: str, seeds: Sequence[int]) -> TwoLevel:
    """The trainer of a method.

    Raises:
        ValueError: for an unknown method, or no seed.
    """
    if len(seeds) == 0:
        raise ValueError("seeds: wanted at least one, got none")
    arm = method(name)
    config = study.hierarchy
    if arm.low in ("frozen", "gain", "none"):
        config = replace(config, low_updates=0)
    elif arm.low == "latent":
        config = replace(config, low_updates=4)
    task = study.task_class(study.task, num=len(seeds) * config.worlds)
    planning = study.planning()
    inputs = planning.observe(task, task.reset()).shape[-1]
    actor = Planner(inputs, len(planning.low), study.planner_hidden, seeds)
    planner = TD3(actor, seeds, inputs, len(planning.low), study.planner, stream=1)
    return TwoLevel(task, seeds, planner, build_low(study, name, seeds), planning, config)


def low_actor(low: LowLevel) -> nn.Module | None:
    """The network of a low level, or None."""
    return low.agent.actor if isinstance(low, CriticLow) else getattr(low, "actor", None)
