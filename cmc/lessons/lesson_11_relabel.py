"""Lesson 11: one HIRO segment, its ten candidates, and which of them is picked."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cmc.learning.hierarchy import rollout
from cmc.learning.hiro import (
    CANDIDATES,
    JointLow,
    OffPolicyCorrection,
    PullActor,
    candidates,
    log_likelihood,
    subgoal_transition,
)
from cmc.learning.td3 import Batch
from cmc.studies.old import peg_maze
from cmc.studies.old.two_level_parts import build_low

Array = NDArray[np.float64]
STUDY = peg_maze.STUDY.of("hiro")
NAMES = ("as it was set", "the motion", *(f"drawn {k}" for k in range(1, CANDIDATES - 1)))
"""What each candidate is."""


@lru_cache(maxsize=4)
def _segment(noise: float) -> tuple[JointLow, Tensor, Tensor, Tensor]:
    """A low level, what it was seen to do for one sub-goal, the sub-goal, and the drawn noise.

    The sub-goal is one of the first, random ones of a training: around the goal's joint angles.
    """
    torch.manual_seed(0)
    low = build_low(peg_maze.STUDY.of("hiro"), "hiro", [0])
    assert isinstance(low, JointLow)
    low.noise = noise
    task = STUDY.task_class(STUDY.task, num=1, seed=0)
    planning, rng = STUDY.planning(), np.random.default_rng(3)
    obs = task.reset()
    wanted = planning.direction(task, obs) + rng.uniform(-1.0, 1.0, (1, len(low.units.start)))
    goal = np.clip(wanted, -1.0, 1.0)
    segment, *_ = rollout(task, low, task.set_subgoal(planning.subgoal(goal)), (1, 1), True)
    packed = OffPolicyCorrection(low, [0], STUDY.task.horizon).pack(segment)
    drawn = torch.from_numpy(
        rng.standard_normal((1, 1, CANDIDATES - 2, len(low.units.start)))
    ).float()
    return low, torch.from_numpy(packed).float(), torch.from_numpy(goal[None]).float(), drawn


def _changed(actor: PullActor, change: float) -> PullActor:
    """The actor with its weights moved by `change` of the way to those of another training."""
    torch.manual_seed(1)
    other = PullActor(actor.n, STUDY.joint_hidden, [1])
    moved = PullActor(actor.n, STUDY.joint_hidden, [0])
    here, there = actor.state_dict(), other.state_dict()
    moved.load_state_dict({k: w + change * (there[k] - w) for k, w in here.items()})
    return moved


def relabel(
    candidate: int = 1, change: float = 1.0, noise: float = 0.1, joint: int = 0
) -> dict[str, Any]:
    """Score the ten candidates of one segment under a low level that has changed.

    Args:
        candidate: whose actions are shown, 0 to 9.
        change: how far the weights have moved towards another low level, 0 to 1.
        noise: exploration noise of the low level that acted.
        joint: which joint's ticks are shown, 0 to 6.

    Returns:
        `score` (10,): log likelihood less that of the sub-goal as it was set; `goals` (10, 7) in
        half-ranges; `picked`; and by tick t (T,) for the joint: `state`, `left` (what is left of
        the candidate), `mean` (what the low level of today would do), `action` (what was done);
        `bars` (10, 2) and `best` (1, 2) for a figure, `text`.
    """
    low, packed, goal, drawn = _segment(noise)
    n, horizon = len(low.units.start), STUDY.task.horizon
    rows = packed[..., :-n].unflatten(-1, (horizon, 3 * n))
    states, speeds, actions = rows.chunk(3, dim=-1)
    goals = candidates(goal, packed[..., -n:] - states[..., 0, :], drawn)
    acted = low.agent.actor
    assert isinstance(acted, PullActor)
    actor = _changed(acted, change)
    reach = _reach(low)
    score = log_likelihood(actor, states, speeds, actions, goals, reach)[0, 0].numpy()
    start = states[..., :1, :]
    first = (start + goals[:, :, [candidate]]).clamp(*reach) - start
    left = subgoal_transition(first, start, states)
    with torch.no_grad():
        mean = actor(torch.cat([states, speeds, left], dim=-1).flatten(1, -2)).view(left.shape)
    picked = int(score.argmax())
    gain = score - score[0]
    return {
        "t": np.arange(horizon),
        "state": _column(states, joint),
        "left": _column(left, joint),
        "mean": _column(mean, joint),
        "action": _column(actions, joint),
        "goals": goals[0, 0].numpy().astype(float),
        "score": gain.astype(float),
        "log": score.astype(float),
        "picked": picked,
        "bars": np.stack([np.arange(CANDIDATES), gain], axis=-1),
        "best": np.array([[picked, gain[picked]]]),
        "shown": np.array([[candidate, gain[candidate]]]),
        "text": f"picked: {picked}, {NAMES[picked]}",
        "name": f"{candidate}, {NAMES[candidate]}",
    }


def _column(part: Tensor, joint: int) -> Array:
    return part[0, 0, :, joint].numpy().astype(float)


def _reach(low: JointLow) -> tuple[Tensor, Tensor]:
    units = low.units
    low_end, high_end = ((end - units.start) / units.half for end in (units.low, units.high))
    return torch.as_tensor(low_end).float(), torch.as_tensor(high_end).float()


def library_choice(noise: float = 0.1) -> tuple[Batch, OffPolicyCorrection]:
    """The same segment as the trainer's own parts see it, for a low level that has not changed."""
    low, packed, goal, _ = _segment(noise)
    nothing = torch.zeros(1, 1)
    batch = Batch(nothing[..., None], goal, nothing, nothing[..., None], nothing, packed)
    return batch, OffPolicyCorrection(low, [0], STUDY.task.horizon)


def score_table(change: float = 1.0, noise: float = 0.1) -> str:
    """Markdown: every candidate, its first three joints, its log likelihood, and the choice."""
    found = relabel(0, change, noise)
    head = (
        "| candidate | increments of joints 1, 2, 3 (rad) | log likelihood | |\n|---|---|---|---|\n"
    )
    rows = []
    for k, (name, goal, value) in enumerate(zip(NAMES, found["goals"], found["log"], strict=True)):
        joints = ", ".join(f"{0.1 * g:+.3f}" for g in goal[:3])
        mark = "**picked**" if k == found["picked"] else ""
        rows.append(f"| {k}, {name} | {joints} | {value:.2f} | {mark} |")
    return head + "\n".join(rows)


def tick_table(candidate: int = 0, joint: int = 0, change: float = 1.0, noise: float = 0.1) -> str:
    """Markdown: one joint of one candidate, every fourth tick, as one does by hand."""
    found = relabel(candidate, change, noise, joint)
    head = (
        "| tick | joint angle $s_t$ (rad) | left of the sub-goal $s_0 + g - s_t$ (rad) "
        r"| action today $\mu_t$ | action then $a_t$ | $-\frac12 (a_t - \mu_t)^2$ |"
        "\n|---|---|---|---|---|---|\n"
    )
    rows = []
    for t in range(0, len(found["t"]), 4):
        s, g, m, a = (float(found[key][t]) for key in ("state", "left", "mean", "action"))
        loss = -0.5 * (a - m) ** 2
        rows.append(f"| {t} | {0.1 * s:+.4f} | {0.1 * g:+.4f} | {m:+.2f} | {a:+.2f} | {loss:.3f} |")
    return head + "\n".join(rows)


def picks(changes: Array, noise: float = 0.1) -> dict[str, Array]:
    """Over the change: how much likelier the picked candidate is, and which one it is."""
    runs = [relabel(0, float(c), noise) for c in changes]
    return {
        "change": np.asarray(changes, dtype=float),
        "picked": np.array([run["picked"] for run in runs], dtype=float),
        "gain": np.array([run["score"].max() for run in runs]),
    }
