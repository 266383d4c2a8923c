"""Exercise of lesson 12: the return of a segment, as a corrected critic learns it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close

Array = NDArray[np.float64]


@check("12-segment-return")
def segment_return(answer: Callable[[Array, int], Array]) -> None:
    """Judge `my_segment_return(rewards, horizon)`: rewards (T,) of an episode, T = segments x h.

    Entry t must be the sum of the rewards from tick t to the end of *its* segment.
    """
    rng = np.random.default_rng(0)
    for segments, horizon in ((1, 4), (3, 5), (50, 20)):
        rewards = rng.normal(size=segments * horizon)
        found = np.asarray(answer(rewards.copy(), horizon), dtype=float)
        expect(
            found.shape == rewards.shape,
            f"wanted one number for each tick, shape {rewards.shape}, yours {found.shape}",
        )
        last = found[horizon - 1 :: horizon]
        expect_close(last, rewards[horizon - 1 :: horizon], "the last tick of every segment")
        wanted = [
            rewards[t : (t // horizon + 1) * horizon].sum() for t in range(segments * horizon)
        ]
        expect_close(found, np.array(wanted), "the rest of the segment's return at every tick")
