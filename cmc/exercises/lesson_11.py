"""Exercises of lesson 11: TD3's target, off-policy correction, the designer's gain."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close

Array = NDArray[np.float64]


@check("11-target")
def target(answer: Callable[..., Any]) -> None:
    """Judge `my_target(reward, following, actor, critics, discount, noise)` without noise first."""
    draw = torch.Generator().manual_seed(0)
    reward, following = torch.randn(64, 1, generator=draw), torch.randn(64, 15, generator=draw)

    def actor(s: torch.Tensor) -> torch.Tensor:
        return 0.7 * s[:, :3]

    def first(x: torch.Tensor) -> torch.Tensor:
        return x[:, 15:18].sum(-1, keepdim=True)

    def second(x: torch.Tensor) -> torch.Tensor:
        return 0.5 - x[:, 15:16]

    a = torch.tanh(actor(following))
    values = a.sum(-1, keepdim=True), 0.5 - a[:, :1]
    found = answer(reward, following, actor, (first, second), 0.5, 0.0)
    expect(found is not None, "the target is None; does your function return something?")
    expect(
        tuple(found.shape) == (64, 1), f"wanted a target of shape (64, 1), got {tuple(found.shape)}"
    )
    slips = {
        "the smaller of the two values, not the larger": reward + 0.5 * torch.maximum(*values),
        "the smaller of the two values, not their mean": reward + 0.25 * (values[0] + values[1]),
        "one critic alone is too hopeful: take the smaller value": reward + 0.5 * values[0],
        "the discount is missing": reward + torch.minimum(*values),
        "the reward is missing": 0.5 * torch.minimum(*values),
    }
    wanted = reward + 0.5 * torch.minimum(*values)
    for hint, wrong in slips.items():
        expect(not torch.allclose(found, wrong, atol=1e-5), hint)
    expect_close(found.detach(), wanted, "the target without noise", atol=1e-5)
    noisy = answer(reward, following, actor, (first, second), 0.5, 0.2)
    expect(not torch.allclose(noisy, wanted), "the slow actor's action should get noise")
    loud = answer(reward, following, actor, (first, second), 0.5, 100.0) - reward
    expect(
        bool((loud.abs() <= 0.5 * 3.0 + 1e-5).all()),
        "noise and action should stay in their bounds: clip the noise to 0.5, the action to 1",
    )


@check("11-relabel")
def relabel(answer: Callable[[Array, Array, Array, Any], int]) -> None:
    """Judge `my_choice(states, actions, goals, act)`: the position of the likeliest sub-goal.

    Segments are made by low levels that pursue one of the candidates, with noise. A wrong choice
    is compared with what common slips would choose.
    """
    rng = np.random.default_rng(0)
    for trial in range(40):
        n, ticks, count = (int(rng.integers(*ends)) for ends in ((1, 5), (3, 9), (2, 7)))
        W = rng.normal(size=(n, 2 * n))

        def act(state: Array, left: Array, W: Array = W) -> Array:
            return np.tanh(W @ np.concatenate([state, 2.0 * left]))

        goals = rng.normal(size=(count, n))
        states, actions = [rng.normal(size=n)], list[Array]()
        left = goals[int(rng.integers(count))]
        for _ in range(ticks):
            actions.append(act(states[-1], left) + 0.3 * rng.normal(size=n))
            states.append(states[-1] + 0.4 * rng.normal(size=n))
            left = left + states[-2] - states[-1]
        seen, did = np.array(states[:-1]), np.array(actions)
        shrinking, whole = (_losses(seen, did, goals, act, shrink) for shrink in (True, False))
        best, found = int(np.argmin(shrinking)), answer(seen, did, goals, act)
        expect(found is not None, "the choice is None; does your function return something?")
        expect(
            np.shape(found) == () and 0 <= int(found) < count,
            f"the answer should be a position from 0 to {count - 1}, yours is {found!r}",
        )
        hint = "is yours the largest squared error?" if int(found) == np.argmax(shrinking) else ""
        if int(found) == np.argmin(whole) != best:
            hint = "what is left of a sub-goal shrinks while it is pursued: g' = s + g - s'"
        expect(
            int(found) == best,
            f"segment {trial}: candidate {best} explains the actions best (squared error "
            f"{shrinking[best]:.2f}, yours {shrinking[int(found)]:.2f}). {hint}",
        )


def _losses(states: Array, actions: Array, goals: Array, act: Any, shrink: bool) -> Array:
    """Sum of squared errors for each candidate, with or without a sub-goal that shrinks."""
    errors = []
    for goal in goals:
        left = [goal + shrink * (states[0] - s) for s in states]
        acted = np.array([act(s, g) for s, g in zip(states, left, strict=True)])
        errors.append(float(((actions - acted) ** 2).sum()))
    return np.array(errors)


@check("11-gain")
def gain(answer: Callable[[float, float, float, float], float]) -> None:
    """Judge `my_gain(K_p, K_d, h, level)`: (K_d + g K_2) h = level with the smaller root K_2."""
    for K_p, K_d, h, level in ((40.0, 20.0, 0.02, 1.0), (20.0, 30.0, 0.02, 2.0), (20, 10, 0.01, 1)):
        small, large = (2 * K_p / (K_d + s * np.sqrt(K_d**2 - 4 * K_p)) for s in (1, -1))
        found = answer(K_p, K_d, h, level)
        expect(found is not None, "the gain is None; does your function return something?")
        other = (level / h - K_d) / large
        expect(not np.isclose(found, other), "this is the larger root: K_d *plus* the square root")
        expect_close(found, (level / h - K_d) / small, f"the gain for K_p = {K_p}, K_d = {K_d}")
