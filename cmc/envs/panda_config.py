"""Configuration of a peg task: physics, control, sub-goals, episode."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from cmc.envs.checks import set_numbers, whole
from cmc.robot.osc import ControlLaw, Gains
from cmc.robot.panda import JOINTS, Peg


@dataclass(frozen=True)
class PandaTaskConfig:
    """Physics, control and episode of a peg task.

    Attributes:
        scene: shipped scene or path of an MJCF file.
        peg: the tool.
        gains: K_p, K_d of the task-space controller.
        law: its form and options; the posture is replaced by the starting pose.
        command: sub-goals and actions of the tip ("pose") or of the joints ("joint").
        start: tip at the start, (3,), m.
        start_box: half-widths of the box the starting tip is drawn from, (3,), m.
        start_joints: half-width of the uniform error added to every joint, rad.
        subgoal_low, subgoal_high: bounds of the high-level action, (3,) m, (6,) m and rad,
            or (7,) rad.
        increments: whether sub-goals are increments from the current tip pose, or absolute.
        workspace_low, workspace_high: box that sub-goals are clamped to: positions (3,), m, or
            joint angles relative to the start (7,), rad.
        tilt_limit: largest rotation of the target from pointing straight down, rad.
        u_limit: what a low-level action of 1 means, (6,) m/s^2 and rad/s^2, or (7,) N m.
        joint_stiffness: K_p of the joint controller, N m/rad ("joint" only).
        horizon: ticks between sub-goals.
        ticks: length of an episode.
        tick: control period, s.
        timestep: physics step, s.
        hold: whether the torque is held over a tick (50 Hz) or computed at every physics step.
    """

    scene: str
    peg: Peg
    gains: Gains
    law: ControlLaw
    start: tuple[float, ...]
    subgoal_low: tuple[float, ...]
    subgoal_high: tuple[float, ...]
    workspace_low: tuple[float, ...]
    workspace_high: tuple[float, ...]
    ticks: int
    command: Literal["pose", "joint"] = "pose"
    start_box: tuple[float, ...] = (0.0, 0.0, 0.0)
    start_joints: float = 0.0
    increments: bool = False
    tilt_limit: float = 0.5
    u_limit: tuple[float, ...] = field(default=(1.0,) * 6)
    joint_stiffness: float = 1.0
    horizon: int = 20
    tick: float = 0.02
    timestep: float = 0.002
    hold: bool = True

    def __post_init__(self) -> None:
        for name, kind in (("peg", Peg), ("gains", Gains), ("law", ControlLaw)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name}: wanted a {kind.__name__}, got {getattr(self, name)!r}")
        if self.command not in ("pose", "joint"):
            raise ValueError(f"command must be 'pose' or 'joint', got {self.command!r}")
        sizes = {"start": 3, "start_box": 3, "u_limit": self.low_size}
        names = ("start_joints", "tilt_limit", "joint_stiffness", "tick", "timestep")
        for name in ("subgoal", "workspace"):
            sizes |= dict.fromkeys(
                (f"{name}_low", f"{name}_high"), np.size(getattr(self, f"{name}_low"))
            )
        set_numbers(self, sizes | dict.fromkeys(names, 0))
        for name in ("subgoal", "workspace"):
            low, high = (np.array(getattr(self, f"{name}_{side}")) for side in ("low", "high"))
            if not (low < high).all():
                raise ValueError(f"{name}_low must lie below {name}_high, got {low} and {high}")
        for name in ("ticks", "horizon"):
            object.__setattr__(self, name, whole(name, getattr(self, name)))
        steps = self.tick / self.timestep
        if abs(steps - round(steps)) > 1e-9 or steps < 1:
            raise ValueError(f"tick {self.tick} s is no multiple of timestep {self.timestep} s")

    @property
    def low_size(self) -> int:
        """Length of the low-level action."""
        return 6 if self.command == "pose" else JOINTS

    @property
    def high_size(self) -> int:
        """Length of the high-level action."""
        return len(self.subgoal_low)
