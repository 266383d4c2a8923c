"""Peg push (section VII-B, appendix H): a planner over C-TD3, and the ablation.

What the paper gives is in `cmc.envs.peg_push` and in the table `tab:para`. Deviations:

1. The sliders weigh 0.5 kg, so that pressing through the obstacle does not work; the paper gives no
   masses. Success is a strict touch of the target, not a return.
2. Eight worlds of each seed; updates are spread over the segments (100 for 1024 steps).
3. The planner's discount is .9, the paper's .5: at .5 a planner sees two segments ahead, and
   standing on the obstacle is worth more than pushing it aside ("discount .5" is a method).
4. Its rates are 1e-3 and fall to a tenth between 180,000 and 420,000 steps; its targets move by .01
   at every update. Its noise falls from 0.3 to 0.05 half-ranges in 180,000 steps (the table's is
   below a micrometer), that of its target actions is 0.05: 0.3 and 0.2 are 1.5 mm and 1 mm, coarser
   than the touch. With a probability of .1 that falls to .02 an entry of a sub-goal is drawn anew,
   and with .05 that falls to .01 three whole sub-goals in a row: only a lift with a step sideways
   frees the target, which small noise does not find. 10,000 steps of random sub-goals come first;
   rewards are means over a segment.
5. Its critics also see tip and sub-goal relative to the target in millimeters, at several scales
   (`cmc.learning.critic_view`), and a small weight on the actor's values before its last tanh keeps
   them where it has a slope. Critics have 128, 128 units.
6. Low level: as in the maze (`cmc.studies.peg_maze`, 6); PPO/Control as there (8), discount .9.
7. 3 to 5 were chosen in trainings with seeds 0 to 4.
"""

from __future__ import annotations

from functools import partial

from cmc.envs.peg_push import PUSH, TARGET, PegPush
from cmc.learning.hierarchy import HierarchyConfig
from cmc.learning.ppo import PPOConfig
from cmc.learning.td3 import TD3Config
from cmc.studies.old import two_level_motion, two_level_training
from cmc.studies.old.two_level import TwoLevelStudy

STUDY = TwoLevelStudy(
    name="peg_push_half",
    task=PUSH,
    task_class=PegPush,
    shift={"position": tuple(TARGET), "goal": tuple(TARGET)},
    scale={
        "position": 100.0,
        "goal": 100.0,
        "velocity": (20.0, 20.0, 20.0, 1.0, 1.0, 1.0),
        "sliders": 100.0,
        "slider_velocity": 10.0,
    },
    hierarchy=HierarchyConfig(
        high_noise_end=0.05,
        redraw=(0.1, 0.02),
        burst=(0.05, 0.01),
        noise_steps=180_000,
        rate_steps=(180_000, 420_000),
    ),
    planner=TD3Config(
        discount=0.9,
        actor_rate=1e-3,
        target_rate=0.01,
        target_period=1,
        target_noise=0.05,
        target_noise_clip=0.125,
        pull=0.003,
    ),
    ppo=PPOConfig(gamma=0.9, epochs=10, learning_rate=1e-3),
    relative=True,
    low=TD3Config(discount=1.0, action_gradient_clip=0.1, critic_head_start=500),
    steps=480_000,
    snapshot_every=60_000,
)

NAME = STUDY.name
METHODS = STUDY.methods
train = partial(two_level_training.train, STUDY)
load = partial(two_level_training.load, STUDY)
motion = partial(two_level_motion.motion, STUDY)
