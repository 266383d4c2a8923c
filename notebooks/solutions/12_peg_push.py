"""Solution of the exercise of lesson 12."""

import numpy as np


def my_segment_return(rewards, horizon):
    """Sum of the rewards from each tick to the end of its segment."""
    by_segment = rewards.reshape(-1, horizon)
    return np.cumsum(by_segment[:, ::-1], axis=1)[:, ::-1].ravel()
