"""Peg maze (section VII-A, appendix G): a planner over C-TD3 and over its rivals.

What the paper gives is in `cmc.envs.peg_maze` and in the table `tab:my_label`. Deviations:

1. Obstacles, peg length and start are ours: the paper does not give them.
2. Two regimes: *soft* (compliant peg, clipped error, scaled action) and *stiff*.
3. Eight worlds of each seed; updates are spread over the segments (100 for 1024 steps, both levels;
   the table's low level has 200).
4. The planner's rates are 1e-3 and its targets move by .01 at every update; its noise falls from
   0.3 to 0.1 half-ranges in 60,000 steps; 10,000 steps of random sub-goals come first, from which
   the low level alone learns; rewards are means over a segment, in cm. Its critics also see tip and
   sub-goal relative to the goal (`cmc.learning.planning.CriticView`), and a small weight on the
   actor's values before its last tanh keeps them where it has a slope. The discount is the paper's.
5. Critics have 128, 128 units.
6. Low level: a segment ends its return, in every method, and every network starts with a slope of
   0.3 at rest ("tuned start": 20). The paper's scheme has biases, no cap, a critic that sees
   (y, integral of y), reward in meters and radians, and noise 0.1; what its critic sees is our
   reading, the paper gives sizes only. Ours has no biases, slopes capped by construction, and
   learns through the latent model under constant pushes, with a price on force beyond 1 N (higher
   in the stiff regime): 16 updates for 1024 steps up to 20,000 steps, then one. Corrected critics
   see the full state and the return as it came, in centimeters and radians, with noise 0.5.
7. HIRO plans joint increments for a rigid peg under a hood, its planner sees the joints too, and
   its low level has two hidden layers of 64 units for all joints. Noise is 1.0 in half-ranges (the
   table's "HL: 1.0, LL: 1.0"), or 0.3 and 0.1 as in the other methods ("matched"). The first 10,000
   steps are the initial exploration towards the maze: random sub-goals around the goal's joint
   angles. The likelihood of relabelling counts every fourth tick. Else as the other methods. Its
   rigid contacts make episodes that change with the last bit of rounding: tested anew, shares of
   success move by several points.
8. PPO plans without a low level; its hyperparameters are ours, an update has one episode of each
   of the eight worlds.
"""

from __future__ import annotations

from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze
from cmc.learning.hierarchy import HierarchyConfig
from cmc.learning.latent import LatentConfig
from cmc.learning.td3 import TD3Config
from cmc.studies.study import Study, Test, before_last, last
from cmc.studies.two_level import HIRO, METHODS, TwoLevelConfig, light
from cmc.studies.two_level_tests import judge, motion

_CENTER = (0.415, -0.0225, 0.005)
_INVERSE_HALF = (1 / 0.015, 1 / 0.0075, 1 / 0.01)

TESTS = (Test("nominal", 20, when=before_last), Test("nominal", 100, when=last))

STUDY = Study(
    name="peg_maze",
    about="a compliant peg finds its way between walls: a planner over C-TD3 and over its rivals",
    config=TwoLevelConfig(
        task=SOFT,
        task_class=PegMaze,
        shift={"position": _CENTER, "goal": _CENTER},
        scale={
            "position": _INVERSE_HALF,
            "goal": _INVERSE_HALF,
            "velocity": (20.0, 20.0, 20.0, 1.0, 1.0, 1.0),
        },
        hierarchy=HierarchyConfig(reward_scale=100.0, high_noise_end=0.1, noise_steps=60_000),
        planner=TD3Config(
            discount=0.5, actor_rate=1e-3, target_rate=0.01, target_period=1, pull=0.003
        ),
        relative=True,
        low=TD3Config(
            discount=1.0,
            action_gradient_clip=0.1,
            gradient_clip=0.1,
            target_period=100,
            critic_head_start=500,
        ),
        joint_task=JOINT,
        joint_aim=(0.4125, -0.0225, 0.010),
    ),
    methods={**METHODS, **HIRO},
    tests=TESTS,
    length=140_000,
    every=20_000,
    judge=judge,
    motion=motion,
    light=light,
)
_STIFF = STUDY.variant(
    "peg_maze_stiff",
    "the maze with a rigid peg and actions of 1 m/s^2",
    task=STIFF,
    latent=LatentConfig(force_weight=0.5),  # pressing forces exceed the limit here
)
_PAPER_SIZES = STUDY.variant(
    "peg_maze_paper_sizes",
    "the maze with the network sizes of the paper's table",
    planner={"critic_hidden": (400, 300)},
    planner_hidden=(400, 300),
    low_hidden=(200, 200),
)
VARIANTS = {study.name: study for study in (_STIFF, _PAPER_SIZES)}
