"""Peg push (paper section VII-B, appendix H): open a lid, enter a slot, push, touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from cmc.envs.panda_gym import PandaEnv, PandaVectorEnv
from cmc.envs.panda_task import PandaTask, PandaTaskConfig
from cmc.robot.osc import PUSH_GAINS, ControlLaw
from cmc.robot.panda import Peg
from cmc.theory.arrays import Array

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

    See `PandaEnv` for what both peg tasks share. The peg is 20 mm long, over a 36 mm box (geometry:
    `tab:geometry`; lid and obstacle weigh 0.5 kg each). Sub-goals move with the current tip pose
    and are clamped to 18 mm around the box's centre, 13 mm below to 15 mm above its top, and to
    0.5 rad from pointing straight down.

    - Action (12,): u, 0-2 in m/s^2 and 3-5 in rad/s^2, within +-1; increment of the tip's position
      6-8, within +-0.005 m, and of its rotation vector 9-11, within +-0.5 rad.
    - Observation (40,): position 0-2, rotation 3-5, velocity 6-11, goal, the target, 12-14,
      sliders, lid (y) and obstacle (x, y) from their start, 15-17, m, slider_velocity 18-20, m/s,
      error 21-26, latent 27-32, integral 33-38, time_to_go 39.
    - Reward: translation = -tanh(50 |target - tip|), rotation = -0.1 |tilt|. Success, a strict
      touch: the tip within 0.5 mm of the target in x and y and 0.3 mm in z.
    - Start: tip uniform in an 8 mm cube around (0, 11.5, 4.5) mm from the centre of the box's top,
      at rest, pointing down; lid closed, obstacle on the target. Time: 1000 ticks (20 s).
    """

    many = PegPushVectorEnv
