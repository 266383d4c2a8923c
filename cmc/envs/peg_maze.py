"""Peg maze (paper section VII-A, appendix G): reach a goal among fixed obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.envs.vector import Array
from cmc.robot.osc import MAZE_GAINS, ControlLaw
from cmc.robot.panda import Peg

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

    A Panda under task-space control carries a 50 mm peg. Every tick (20 ms) a low-level action u
    adds an acceleration to the control law, x'' = K_p e + K_d e' + u with e = sub-goal - tip; every
    20 ticks a high-level action sets the sub-goal, straight down. Actions are clipped to their
    bounds; NaN, infinity and wrong shapes raise ValueError.

    - Action (9,): u, 0-2 in m/s^2 (soft: in 0.2 m/s^2) and 3-5 in rad/s^2, within +-1; absolute
      sub-goal of the tip 6-8, m, from (.40, -.03, -.005) to (.43, -.015, .015).
    - Observation (34,), slices in `env.task.layout`: position of the (true) tip 0-2, m; rotation
      3-5, a rotation vector from pointing straight down, rad; velocity 6-11, m/s and rad/s; goal
      12-14, m; error e of the hand's nominal tip 15-20, m and rad, limited in the soft regime;
      latent y = K1 e + K2 e' 21-26, m/s^2 and rad/s^2; integral of y since the sub-goal was set
      27-32 (0 for rotation); time_to_go until the next sub-goal is due 33, s, < 0 when overdue.
    - Reward: `info["reward_terms"]`, distance = -|goal - tip|, m. The low level's own,
      `info["tracking_terms"]`: translation = -|sub-goal - tip|, m, and rotation, rad.
    - Info: `contact_force` at the end of the tick, `contact_force_max` over its physics steps, N;
      `penetration`, the deepest of the tick, m; `success`: a distance below 5 mm.
    - Start: tip at (.429, -.019, .008) m with up to 1 mrad of error in every joint, at rest; goal
      uniform from (.410, -.025, .005) to (.415, -.020, .015) m.
    - End: never terminated; truncated after 400 ticks (8 s).

    Regime "joint": u is 7 joint torques (in 0.3 N m), applied as |u| towards the sub-goal, which is
    7 joint increments from the current pose (at most 0.1 rad), clamped to the joint limits; torque
    = 1 N m/rad (q_d - q) + u + gravity and Coriolis terms. Joints, joint_velocity and joint_error
    (7 each, rad, rad/s) are observed in place of error, latent and integral.

    Keywords: `regime` (of `REGIMES`), `changes` of fields of `PandaTaskConfig`, such as
    `{"hold": False}` for control at every physics step, `render_mode` (None or "rgb_array"), and
    `action_mode` and `low_level` (see `PandaVectorEnv`).
    """

    many = PegMazeVectorEnv
