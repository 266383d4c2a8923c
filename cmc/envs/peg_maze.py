"""Peg maze (paper section VII-A, appendix G): reach a goal among fixed obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.robot.osc import MAZE_GAINS, ControlLaw
from cmc.robot.panda import Peg
from cmc.theory.arrays import Array

GOAL_LOW = np.array([0.410, -0.025, 0.005])
GOAL_HIGH = np.array([0.415, -0.020, 0.015])

STIFF = PandaTaskConfig(
    scene="peg_maze.xml",
    peg=Peg(length=0.05),
    gains=MAZE_GAINS,
    law=ControlLaw(form="force", split=True, drift=False),
    start=(0.4290, -0.019, 0.008),
    start_joints=1e-3,
    subgoal_low=(0.40, -0.03, -0.005),
    subgoal_high=(0.43, -0.015, 0.015),
    workspace_low=(0.40, -0.03, -0.005),
    workspace_high=(0.43, -0.015, 0.015),
    ticks=400,
)
"""Rigid peg, unit actions: pressing takes newtons, impacts tens of newtons."""
SOFT = replace(
    STIFF,
    peg=Peg(length=0.05, stiffness=150.0, damping=8.0),
    law=ControlLaw(form="force", split=True, drift=False, error_limit=0.005),
    u_limit=(0.2, 0.2, 0.2, 1.0, 1.0, 1.0),
)
"""Peg on two lateral springs, error limited to 5 mm, translational action to 0.2 m/s^2."""
JOINT = replace(
    STIFF,
    scene="peg_maze_hood.xml",
    command="joint",
    subgoal_low=(-0.1,) * 7,
    subgoal_high=(0.1,) * 7,
    workspace_low=(-0.1,) * 7,
    workspace_high=(0.1,) * 7,
    u_limit=(0.3,) * 7,
)
"""Joint increments and joint torques under a hood, for the joint-space baseline (HIRO)."""
REGIMES = {"stiff": STIFF, "soft": SOFT, "joint": JOINT}


class PegMaze(PandaTask):
    """N peg mazes; see `PegMazeEnv` for what they observe and are rewarded for."""

    near = 0.005  # m, appendix G

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        return rng.uniform(GOAL_LOW, GOAL_HIGH)

    def _reward(self, distance: Array, tilt: Array) -> tuple[Array, dict[str, Array]]:
        reward = -distance
        return reward, {"distance": reward}


class PegMazeVectorEnv(PandaVectorEnv):
    """`num_envs` peg mazes stepped in one call; see `PegMazeEnv` and `PandaVectorEnv`."""

    def __init__(
        self, num_envs: int = 1, regime: str = "stiff", *, changes: Any = None, **interface: Any
    ) -> None:
        if regime not in REGIMES:
            raise ValueError(f"regime must be one of {sorted(REGIMES)}, got {regime!r}")
        config = replace(REGIMES[regime], **(changes or {}))
        super().__init__(PegMaze(config, num_envs), **interface)


class PegMazeEnv(PandaEnv):
    """Move a peg among walls and posts to a goal 18 mm away; the straight path is blocked.

    See `PandaEnv` for what both peg tasks share. The peg is 50 mm long.

    - Action (9,): u, 0-2 in m/s^2 (soft: in 0.2 m/s^2) and 3-5 in rad/s^2, within +-1; absolute
      sub-goal of the tip, straight down, 6-8, m, from (.40, -.03, -.005) to (.43, -.015, .015).
    - Observation (34,): position 0-2, rotation 3-5, velocity 6-11, goal 12-14, error 15-20 (limited
      in the soft regime), latent 21-26, integral 27-32, time_to_go 33.
    - Reward: distance = -|goal - tip|, m. Success: a distance below 5 mm.
    - Start: tip at (.429, -.019, .008) m with up to 1 mrad of error in every joint, at rest; goal
      uniform from (.410, -.025, .005) to (.415, -.020, .015) m. Time: 400 ticks (8 s).

    Keyword `regime`, of `REGIMES`. In "joint", u is 7 joint torques (in 0.3 N m), applied as |u|
    towards the sub-goal, which is 7 joint increments from the current pose (at most 0.1 rad),
    clamped to the joint limits; torque = 1 N m/rad (q_d - q) + u + gravity and Coriolis terms.
    Joints, joint_velocity and joint_error (7 each, rad, rad/s) are observed in place of error,
    latent and integral.
    """

    many = PegMazeVectorEnv
