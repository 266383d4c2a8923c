"""Solutions of the exercises of lesson 12."""

import numpy as np


def my_segment_return(rewards, horizon):
    """Sum of the rewards from each tick to the end of its own segment."""
    parts = np.reshape(rewards, (-1, horizon))
    return parts[:, ::-1].cumsum(axis=1)[:, ::-1].ravel()


def my_discount(push, stand):
    """Smallest discount on a grid at which the first plan is worth more."""
    for gamma in np.arange(100) / 100:
        if ((np.asarray(push) - stand) * gamma ** np.arange(len(push))).sum() > 0:
            return gamma
    return 1.0


def my_plan():
    """Straight down beside the lid, push it open no farther than needed, and go in."""
    return [(9.5, 0), (9.5, -2.5), (-4.6, -2.5), (3, -3), (3, -12.5), (0, -12.5)]
