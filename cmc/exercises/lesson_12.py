"""Exercises of lesson 12: the return of a segment, the discount that decides, a plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
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
        found = answer(rewards.copy(), horizon)
        expect(found is not None, "the return is None; does your function return something?")
        found = np.asarray(found, dtype=float)
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


@check("12-discount")
def discount(answer: Callable[[Array, Array], float]) -> None:
    """Judge `my_discount(push, stand)`: the first of 0, .01, ... .99 at which push is worth more.

    The plans differ as in the lesson: one pays a cost first and gains later.
    """
    rng = np.random.default_rng(0)
    for _ in range(5):
        push = np.r_[-rng.uniform(0.1, 0.3, 4), np.zeros(16)]
        stand = np.full(20, -rng.uniform(0.04, 0.09))
        steps = np.arange(100) / 100
        better = [((push - stand) * gamma ** np.arange(20)).sum() > 0 for gamma in steps]
        expect_close(
            answer(push, stand),
            steps[int(np.argmax(better))],
            "the smallest discount at which pushing is worth more",
        )


@check("12-plan")
def plan(answer: Callable[[], Sequence[tuple[float, float]]]) -> None:
    """Judge `my_plan()`: waypoints (y, z), mm, that end in a strict touch with a return above -90.

    The low level is u = tanh(20 (y + integral of y)); the start is that of the lesson.
    """
    points = answer()
    expect(points is not None, "the plan is None; does your function return something?")
    way = np.asarray(points, dtype=float)
    expect(way.ndim == 2 and way.shape[1] == 2, f"wanted a list of (y, z), got shape {way.shape}")
    task, total, stage = PegPush(PUSH, num=1, seed=0), 0.0, 0
    obs, layout = task.reset(), task.layout
    for k in range(PUSH.ticks):
        if k % PUSH.horizon == 0:
            tip = 1e3 * (obs[0, layout["position"]] - BOX_TOP)
            stage += bool(np.abs(tip[1:] - way[stage]).max() < 0.7 and stage < len(way) - 1)
            step = 1e-3 * np.r_[-tip[0], way[stage] - tip[1:]]
            obs = task.set_subgoal(np.r_[step, -obs[0, layout["rotation"]]][None])
        u = np.tanh(20.0 * (obs[:, layout["latent"]] + obs[:, layout["integral"]]))
        obs, reward, *_, info = task.step(u)
        total += float(reward[0])
    away = 1e3 * float(np.linalg.norm(obs[0, layout["goal"]] - obs[0, layout["position"]]))
    expect(
        info["success"][0],
        f"the tip ends {away:.2f} mm from the target, at waypoint {stage + 1} of {len(way)}: "
        "no strict touch",
    )
    expect(total > -90.0, f"a strict touch, with a return of {total:.0f}; wanted above -90")
