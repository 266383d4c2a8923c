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
    """Push the lid from its edge, no farther than needed, and go in on a diagonal."""
    return [(9.5, -3), (-5.1, -3), (3, -5), (3, -12.5), (0, -12.5)]
