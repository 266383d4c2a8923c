"""Peg touch (section VI, appendix F, fig:1): PPO against C-PPO, 15,000 episodes, five seeds.

The paper gives the plant, the ranges of its parameters, the shifts of the test and the network's
shape. What it leaves open is chosen here, and everything that differs from it is in this list:

1. Position, force targets, start, control period (10 ms), episode (50 steps) and reward are ours
   (`PegTouchConfig`); so are all of PPO's hyperparameters (`PPOConfig`).
2. f_y is linearised exactly at the command that holds x, where the paper replaces g' by g / x and
   often gets the sign wrong. T_y then undoes the slope of the surface, and T_a is the identity.
3. Eigenvectors are scaled to a unit diagonal of T_y, which keeps them continuous along x.
4. Weights are made positive by their absolute value. The command is u0 + T_a a, clipped.
5. The integral is I_k = I_{k-1} + h z_k, the new error included.
6. The critic of the training sees the plant's parameters; the policy never does.
7. Oscillation and drift are not defined in the paper; `cmc.studies.detectors` defines them. Tests
   last 2 s with a deterministic policy, training episodes 0.5 s.
8. Arms that the paper has not: joint and raw inputs, identity transforms, no integral, slopes
   capped by the sampled-data bound (for half the lag and twice the stiffness), the same with most
   of the vertical room in a linear bypass, a cap on the loop gain with the nominal stiffness
   divided out, slopes bounded on both sides, gradients of convex networks (arXiv 2305.17777),
   hand-tuned PI, and a labeled stress setting of PPO.
"""

from __future__ import annotations

from cmc.envs.peg_touch_config import PegShift, PegTouchConfig
from cmc.studies.peg_touch_certificates import certificate_of
from cmc.studies.peg_touch_claims import at, claims, select
from cmc.studies.peg_touch_evaluation import SHIFTS, TestConfig, run_test, shifted
from cmc.studies.peg_touch_methods import METHODS
from cmc.studies.peg_touch_motion import motion, simulate
from cmc.studies.peg_touch_results import evaluate, results
from cmc.studies.peg_touch_training import (
    NAME,
    PegTouchStudy,
    build,
    contents,
    learning_curve,
    load,
    slope_limit,
    task_of,
    train,
)

__all__ = [
    "METHODS",
    "NAME",
    "SHIFTS",
    "PegShift",
    "PegTouchConfig",
    "PegTouchStudy",
    "TestConfig",
    "at",
    "build",
    "certificate_of",
    "claims",
    "contents",
    "evaluate",
    "learning_curve",
    "load",
    "motion",
    "results",
    "run_test",
    "select",
    "shifted",
    "simulate",
    "slope_limit",
    "task_of",
    "train",
]
