"""Exercise of lesson 11: the choice of off-policy correction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect

Array = NDArray[np.float64]


@check("11-relabel")
def relabel(answer: Callable[[Array, Array, Array, Any], int]) -> None:
    """Judge `my_choice(states, actions, goals, act)`: the position of the likeliest sub-goal.

    Segments are made by low levels that pursue one of the candidates, with noise; the sum of
    squared errors is compared tick by tick with what is left of each candidate.
    """
    rng = np.random.default_rng(0)
    for trial in range(40):
        n, ticks, count = (int(rng.integers(*ends)) for ends in ((1, 5), (3, 9), (2, 7)))
        W = rng.normal(size=(n, 2 * n))

        def act(state: Array, left: Array, W: Array = W) -> Array:
            return np.tanh(W @ np.concatenate([state, 2.0 * left]))

        goals = rng.normal(size=(count, n))
        truth, states, actions = int(rng.integers(count)), [rng.normal(size=n)], []
        left = goals[truth]
        for _ in range(ticks):
            actions.append(act(states[-1], left) + 0.3 * rng.normal(size=n))
            states.append(states[-1] + 0.4 * rng.normal(size=n))
            left = left + states[-2] - states[-1]
        losses = []
        for goal in goals:
            left, loss = goal, 0.0
            for t in range(ticks):
                loss += float(((actions[t] - act(states[t], left)) ** 2).sum())
                left = left + states[t] - states[t + 1]
            losses.append(loss)
        best = int(np.argmin(losses))
        found = answer(np.array(states[:-1]), np.array(actions), goals, act)
        expect(
            np.shape(found) == () and 0 <= int(found) < count,
            f"the answer should be a position from 0 to {count - 1}, yours is {found!r}",
        )
        expect(
            int(found) == best,
            f"segment {trial}: candidate {best} has the smallest squared error, {losses[best]:.3f};"
            f" yours, {int(found)}, has {losses[int(found)]:.3f}",
        )
