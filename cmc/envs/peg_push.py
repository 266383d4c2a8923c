"""Peg push (paper section VII-B, appendix H): open a lid, enter a slot, push, touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.envs.vector import Array
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


class PegPushVectorEnv(PandaVectorEnv):
    """`num_envs` peg-push tasks stepped in one call; see `PegPushEnv` and `PandaVectorEnv`."""

    def __init__(self, num_envs: int = 1, *, changes: Any = None, **interface: Any) -> None:
        super().__init__(PegPush(replace(PUSH, **(changes or {})), num_envs), **interface)


class PegPushEnv(PandaEnv):
    """Push a sliding lid open, insert the peg into a slot, push an obstacle aside, touch a target.

    A Panda under task-space control carries a 20 mm peg over a 36 mm box (geometry: `tab:geometry`;
    lid and obstacle weigh 0.5 kg each). Every tick (20 ms) a low-level action u adds an
    acceleration to the control law, x'' = K_p e + K_d e' + u with e = sub-goal - tip; every 20
    ticks a high-level action moves the sub-goal relative to the current tip pose. Actions are
    clipped to their bounds; NaN, infinity and wrong shapes raise ValueError. Sub-goals are clamped
    to 18 mm around the box's centre, 13 mm below to 15 mm above its top, and to 0.5 rad from
    pointing straight down.

    - Action (12,): u, 0-2 in m/s^2 and 3-5 in rad/s^2, within +-1; increment of the tip's position
      6-8, within +-0.005 m, and of its rotation vector 9-11, within +-0.5 rad.
    - Observation (40,), slices in `env.task.layout`: position of the tip 0-2, m; rotation 3-5, a
      rotation vector from pointing straight down, rad; velocity 6-11, m/s and rad/s; goal, the
      target, 12-14, m; sliders, lid (y) and obstacle (x, y) from their start, 15-17, m, and
      slider_velocity 18-20, m/s; error e 21-26, m and rad; latent y = K1 e + K2 e' 27-32, m/s^2 and
      rad/s^2; integral of y since the sub-goal was set 33-38 (0 for rotation); time_to_go until the
      next sub-goal is due 39, s, < 0 when overdue.
    - Reward: the sum of `info["reward_terms"]`, translation = -tanh(50 |target - tip|) and
      rotation = -0.1 |tilt|. The low level's own, `info["tracking_terms"]`: translation =
      -|sub-goal - tip|, m, and rotation, rad.
    - Info: `contact_force` at the end of the tick, `contact_force_max` over its physics steps, N;
      `penetration`, the deepest of the tick, m; `success`: strict touch, the tip within 0.5 mm of
      the target in x and y and 0.3 mm in z.
    - Start: tip uniform in an 8 mm cube around (0, 11.5, 4.5) mm from the centre of the box's top,
      at rest, pointing down; lid closed, obstacle on the target.
    - End: never terminated; truncated after 1000 ticks (20 s).

    Keywords: `changes` of fields of `PandaTaskConfig`, such as `{"hold": False}` for control at
    every physics step, `render_mode` (None or "rgb_array"), and `action_mode` and `low_level` (see
    `PandaVectorEnv`).
    """

    many = PegPushVectorEnv
