"""Peg maze (paper section VII-A, appendix G): reach a goal among fixed obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import Array, PandaTask
from cmc.robot.osc import MAZE_GAINS, ControlLaw
from cmc.robot.panda import Peg

GOAL_LOW = np.array([0.410, -0.025, 0.005])
GOAL_HIGH = np.array([0.415, -0.020, 0.015])
SUCCESS_DISTANCE = 0.005
"""Appendix G: success is an L2 distance below 5 mm."""

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

    near = SUCCESS_DISTANCE

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        return rng.uniform(GOAL_LOW, GOAL_HIGH)

    def _reward(self, distance: Array, tilt: Array) -> tuple[Array, dict[str, Array]]:
        return -distance, {"distance": -distance}


class PegMazeEnv(PandaEnv):
    """Move a peg among walls and posts to a goal 18 mm away; the straight path is blocked.

    A Panda under task-space control carries a 50 mm peg. Every tick (20 ms) a low-level action
    adds an acceleration to the control law,

        x'' = K_p e + K_d e' + u,    e = sub-goal - tip,

    and every 20 ticks a high-level action sets the sub-goal.

    ## Action space

    | Num | Action (action_mode "two_level")    | Min               | Max              | Unit    |
    |-----|-------------------------------------|-------------------|------------------|---------|
    | 0-2 | u, translation                      | -1                | 1                | 1 m/s^2 (soft: 0.2) |
    | 3-5 | u, rotation                         | -1                | 1                | rad/s^2 |
    | 6-8 | sub-goal: absolute tip position     | .40, -.03, -.005  | .43, -.015, .015 | m       |

    `action_mode="low"` takes entries 0-5 and gets sub-goals by `set_subgoal`; "high" takes entries
    6-8 and lasts 20 ticks. Actions outside the bounds are clipped; NaN, infinity and wrong shapes
    raise ValueError. The sub-goal's orientation is straight down.

    Regime "joint": u is 7 joint torques (in units of 0.3 N m), applied as |u| towards the sub-goal, and
    the sub-goal is 7 joint increments from the current pose (at most 0.1 rad), clamped to the
    joint limits; torque = 1 N m/rad (q_d - q) + u + gravity and Coriolis terms.

    ## Observation space

    | Num   | Field       | Observation                                                 | Unit       |
    |-------|-------------|-------------------------------------------------------------|------------|
    | 0-2   | position    | tip (the true one, also on a compliant mount)               | m          |
    | 3-5   | rotation    | rotation vector from pointing straight down                 | rad        |
    | 6-11  | velocity    | of the tip, linear and angular                              | m/s, rad/s |
    | 12-14 | goal        | position                                                    | m          |
    | 15-20 | error       | e, of the hand's nominal tip, limited in the soft regime    | m, rad     |
    | 21-26 | latent      | y = K1 e + K2 e'                                            | m/s^2, ... |
    | 27-32 | integral    | of y since the sub-goal was set; 0 for rotation             | m/s, ...   |
    | 33    | time_to_go  | until the next sub-goal is due; negative when overdue       | s          |

    `env.task.layout` holds the slices, `HIGH_LEVEL`, `ACTOR` and `CRITIC` name what each level
    reads. Regime "joint" has joints (7, rad), joint_velocity (7, rad/s) and joint_error (7, rad)
    in place of error, latent and integral.

    ## Rewards

    `info["reward_terms"]`: distance = -|goal - tip|, m. `info["tracking_terms"]`, the low level's
    reward: translation = -|sub-goal - tip| in m and rotation in rad.

    `info` also holds `contact_force` at the end of the tick and `contact_force_max` over its
    physics steps (N), `penetration` (m, deepest of the tick) and `success` (distance < 5 mm).

    ## Starting state

    Tip at (.429, -.019, .008) m with up to 1 mrad of error in every joint, at rest; goal uniform in
    (.410-.415, -.025 - -.020, .005-.015) m.

    ## Episode end

    Never terminated; truncated after 400 ticks (8 s).

    ## Arguments

    | Parameter     | Type     | Default     | Description                                        |
    |---------------|----------|-------------|----------------------------------------------------|
    | `regime`      | str      | "stiff"     | "stiff", "soft" or "joint" (see `REGIMES`)         |
    | `action_mode` | str      | "two_level" | "two_level", "low" or "high"                       |
    | `low_level`   | callable | None        | u(y, integral of y) inside a "high" step           |
    | `changes`     | dict     | {}          | fields of `PandaTaskConfig` to replace, `hold=False` for control at every physics step |

    ## Version history

    * v0: first version.
    """  # noqa: E501

    def __init__(self, regime: str = "stiff", *, changes: Any = None, **interface: Any) -> None:
        super().__init__(PegMaze(regime_config(regime, changes)), **interface)


class PegMazeVectorEnv(PandaVectorEnv):
    """`num_envs` peg mazes stepped in one call; see `PegMazeEnv`.

    Args:
        num_envs: number of worlds.
        regime: as `PegMazeEnv`.
        changes: as `PegMazeEnv`.
        interface: action_mode, low_level and autoreset_mode.
    """

    def __init__(
        self, num_envs: int = 1, regime: str = "stiff", *, changes: Any = None, **interface: Any
    ) -> None:
        super().__init__(PegMaze(regime_config(regime, changes), num_envs), **interface)


def regime_config(regime: str, changes: dict[str, Any] | None = None) -> PandaTaskConfig:
    """Configuration of a named regime, with some fields replaced.

    Raises:
        ValueError: if there is no such regime.
    """
    if regime not in REGIMES:
        raise ValueError(f"regime must be one of {sorted(REGIMES)}, got {regime!r}")
    return replace(REGIMES[regime], **(changes or {}))
