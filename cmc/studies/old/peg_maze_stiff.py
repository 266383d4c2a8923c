"""Peg maze with a rigid peg and actions of 1 m/s^2; else `cmc.studies.peg_maze`."""

from __future__ import annotations

from functools import partial

from cmc.studies.old import two_level_motion, two_level_training
from cmc.studies.old.peg_maze import STIFF_STUDY as STUDY

NAME = STUDY.name
METHODS = STUDY.methods
train = partial(two_level_training.train, STUDY)
load = partial(two_level_training.load, STUDY)
motion = partial(two_level_motion.motion, STUDY)
