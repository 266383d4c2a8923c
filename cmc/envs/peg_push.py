"""Peg push (paper section VII-B, appendix H): open a lid, enter a slot, push, touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_config import PandaTaskConfig
from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import Array, PandaTask
from cmc.robot.osc import PUSH_GAINS, ControlLaw
from cmc.robot.panda import Peg

BOX_TOP = np.array([0.52, 0.0, 0.02])
"""Centre of the box's top, m; our choice: the arm can tilt by 0.5 rad all around it."""
TARGET = BOX_TOP + [0.0, 0.0, -0.0125]
TOUCH_SIDE, TOUCH_DEPTH = 0.0005, 0.0003
"""Strict touch: tip within half the 1 mm target sideways, and 0.3 mm in depth (our choice), m."""

PUSH = PandaTaskConfig(
    scene="peg_push.xml",
    peg=Peg(length=0.02),
    gains=PUSH_GAINS,
    law=ControlLaw(form="acceleration", drift=False),
    start=tuple(BOX_TOP + [0.0, 0.0115, 0.0045]),
    start_box=(0.004, 0.004, 0.004),
    subgoal_low=(-0.005,) * 3 + (-0.5,) * 3,
    subgoal_high=(0.005,) * 3 + (0.5,) * 3,
    increments=True,
    workspace_low=tuple(BOX_TOP + [-0.018, -0.018, -0.013]),
    workspace_high=tuple(BOX_TOP + [0.018, 0.018, 0.015]),
    ticks=1000,
)
"""Gains and action ranges of `tab:para` and appendix H; workspace and start centre are ours."""


class PegPush(PandaTask):
    """N peg-push tasks; see `PegPushEnv` for what they observe and are rewarded for."""

    sliders, box = 3, (TOUCH_SIDE, TOUCH_SIDE, TOUCH_DEPTH)

    def _draw_goal(self, rng: np.random.Generator) -> Array:
        return TARGET.copy()

    def _reward(self, distance: Array, tilt: Array) -> tuple[Array, dict[str, Array]]:
        near, upright = np.tanh(-50.0 * distance), -0.1 * tilt
        return near + upright, {"translation": near, "rotation": upright}


class PegPushEnv(PandaEnv):
    """Push a sliding lid open, insert the peg into a slot, push an obstacle aside, touch a target.

    A Panda under task-space control carries a 20 mm peg over a 36 mm box (geometry: `tab:geometry`;
    lid and obstacle weigh 0.5 kg each). Every tick (20 ms) a low-level action adds an acceleration
    to the control law, x'' = K_p e + K_d e' + u, and every 20 ticks a high-level action moves the
    sub-goal relative to the current tip pose.

    ## Action space

    | Num  | Action (action_mode "two_level")          | Min    | Max   | Unit    |
    |------|-------------------------------------------|--------|-------|---------|
    | 0-2  | u, translation                            | -1     | 1     | m/s^2   |
    | 3-5  | u, rotation                               | -1     | 1     | rad/s^2 |
    | 6-8  | sub-goal: increment of the tip position   | -0.005 | 0.005 | m       |
    | 9-11 | sub-goal: increment of the rotation vector| -0.5   | 0.5   | rad     |

    `action_mode="low"` takes entries 0-5 and gets sub-goals by `set_subgoal`; "high" takes entries
    6-11 and lasts 20 ticks. Actions outside the bounds are clipped; NaN, infinity and wrong shapes
    raise ValueError. Sub-goals are clamped to 18 mm around the box's centre, 13 mm below to 15 mm
    above its top, and to 0.5 rad from pointing straight down.

    ## Observation space

    | Num   | Field           | Observation                                       | Unit       |
    |-------|-----------------|---------------------------------------------------|------------|
    | 0-2   | position        | tip                                               | m          |
    | 3-5   | rotation        | rotation vector from pointing straight down       | rad        |
    | 6-11  | velocity        | of the tip, linear and angular                    | m/s, rad/s |
    | 12-14 | goal            | position of the target                            | m          |
    | 15-17 | sliders         | lid (y), obstacle (x, y) from their start         | m          |
    | 18-20 | slider_velocity | of the same                                       | m/s        |
    | 21-26 | error           | e = sub-goal - tip                                | m, rad     |
    | 27-32 | latent          | y = K1 e + K2 e'                                  | m/s^2, ... |
    | 33-38 | integral        | of y since the sub-goal was set; 0 for rotation   | m/s, ...   |
    | 39    | time_to_go      | until the next sub-goal is due; < 0 when overdue  | s          |

    `env.task.layout` holds the slices; `HIGH_LEVEL`, `ACTOR` and `CRITIC` name what each level
    reads (`env.task.high_level` adds the sliders).

    ## Rewards

    `info["reward_terms"]`: translation = -tanh(50 |target - tip|), rotation = -0.1 |tilt|.
    `info["tracking_terms"]`, the low level's reward: translation = -|sub-goal - tip| in m and
    rotation in rad.

    `info` also holds `contact_force` at the end of the tick and `contact_force_max` over its
    physics steps (N), `penetration` (m, deepest of the tick) and `success`: strict touch, the tip
    within 0.5 mm of the target in x and y and 0.3 mm in z.

    ## Starting state

    Tip uniform in an 8 mm cube around (0, 11.5, 4.5) mm from the centre of the box's top, at rest,
    pointing down; lid closed, obstacle on the target.

    ## Episode end

    Never terminated; truncated after 1000 ticks (20 s).

    ## Arguments

    | Parameter     | Type     | Default     | Description                                        |
    |---------------|----------|-------------|----------------------------------------------------|
    | `action_mode` | str      | "two_level" | "two_level", "low" or "high"                       |
    | `low_level`   | callable | None        | u(y, integral of y) inside a "high" step           |
    | `changes`     | dict     | {}          | fields of `PandaTaskConfig` to replace, `hold=False` for control at every physics step |

    ## Version history

    * v0: first version.
    """  # noqa: E501

    def __init__(self, *, changes: Any = None, **interface: Any) -> None:
        super().__init__(PegPush(replace(PUSH, **(changes or {}))), **interface)


class PegPushVectorEnv(PandaVectorEnv):
    """`num_envs` peg-push tasks stepped in one call; see `PegPushEnv`.

    Args:
        num_envs: number of worlds.
        changes: as `PegPushEnv`.
        interface: action_mode, low_level and autoreset_mode.
    """

    def __init__(self, num_envs: int = 1, *, changes: Any = None, **interface: Any) -> None:
        super().__init__(PegPush(replace(PUSH, **(changes or {})), num_envs), **interface)
