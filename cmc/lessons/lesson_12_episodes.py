"""Lesson 12: test episodes of trained policies, how they fail, and which ones to look at."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc import store
from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
from cmc.fast import budget
from cmc.learning.hierarchy import low_fields
from cmc.learning.low_level import evaluate
from cmc.learning.state import single_thread
from cmc.studies.old import peg_push
from cmc.studies.old.two_level_evaluation import TEST_SEED, slope_at_rest
from cmc.studies.old.two_level_training import marks

Array = NDArray[np.float64]
STUDY = peg_push.STUDY
PEG, LID, OBSTACLE = 0.8, 6.0, 1.0
"""Radius of the peg and half-widths of lid (y) and obstacle, mm (`tab:geometry`)."""
PRESSED = 0.2
"""Penetration from which an episode counts as pressed through, mm (our choice)."""
REACHED = "touches the target at the end"
FAILURES = (
    "pressed through",
    "touched, then left",
    "never came down",
    "stands on the lid",
    "lid not open",
    "beside the slot",
    "obstacle not moved",
    "at the bottom, beside the target",
    "in the slot, not at its bottom",
)


def shipped() -> list[str]:
    """Methods whose policies are shipped, in the study's order."""
    found = []
    for name in STUDY.methods:
        try:
            store.asset("checkpoints", f"{STUDY.name}_{name}.safetensors")
        except FileNotFoundError:
            continue
        found.append(name)
    return found


@lru_cache(maxsize=32)
def episodes(name: str, step: int | None = None, starts: int = 1) -> dict[str, Any]:
    """Deterministic test episodes of all seeds of a method, from the same starts.

    In fast mode they are cut off after 4 s.

    Args:
        name: method.
        step: which kept policy; the last one if None.
        starts: episodes of each seed S; world s * starts + k is start k of seed s.

    Returns:
        `t` (T,); `tip`, `target` (T, S * starts, 3), `qpos`, `force`; `distance` to the target
        (T, ...), m; `success`, `touched`, `penetration` (m), `total` (S * starts,); `model`,
        `title`, `seeds`, `step`.
    """
    planner, low, record = peg_push.load(name, step)
    seeds = len(record["seeds"])
    task = PegPush(PUSH, num=seeds * starts)
    task.seed([TEST_SEED + k for _ in range(seeds) for k in range(starts)])
    planning, fields = STUDY.planning(), low_fields(task)
    shape, rows, obs = (seeds, starts, -1), [], task.reset()
    total, deepest = np.zeros(task.num), np.zeros(task.num)
    touched = np.zeros(task.num, dtype=bool)
    with single_thread():
        for tick in range(budget(PUSH.ticks, 200)):
            if tick % PUSH.horizon == 0:
                aim = planning.subgoal(
                    evaluate(planner, planning.observe(task, obs).reshape(shape))
                )
                obs = task.set_subgoal(aim.reshape(task.num, -1))
            now = (task.worlds.tip, task.target, task.worlds.qpos, task.worlds.force)
            rows.append([part.copy() for part in now])
            u = low.act(task.select(obs, fields).reshape(shape), explore=False)
            obs, reward, _, _, info = task.step(u.reshape(task.num, -1))
            total += reward
            touched |= info["success"]
            deepest = np.maximum(deepest, info["penetration"])
    tip, target, qpos, force = (np.array(part) for part in zip(*rows, strict=True))
    return {
        "t": PUSH.tick * np.arange(len(tip)),
        "tip": tip,
        "target": target,
        "qpos": qpos,
        "force": force,
        "distance": np.linalg.norm(obs[0, task.layout["goal"]] - tip, axis=-1),
        "success": info["success"].copy(),
        "touched": touched,
        "penetration": deepest,
        "total": total,
        "model": task.worlds.model,
        "title": STUDY.method(name).title,
        "seeds": record["seeds"],
        "step": marks(STUDY, name)[-1] if step is None else step,
    }


def classify(
    tip: Array, lid: float, obstacle: Array, *, success: bool, touched: bool, penetration: float
) -> str:
    """What became of an episode, from where things stand at its end.

    Args:
        tip: (3,), mm from the middle of the box's top.
        lid: how far the lid moved along y, mm.
        obstacle: how far the obstacle moved (2,), mm.
        success: strict touch at the end.
        touched: strict touch at any time.
        penetration: deepest of the episode, mm.

    Returns:
        `REACHED` or one of `FAILURES`.
    """
    x, y, z = tip
    if penetration > PRESSED:
        return "pressed through"
    if success:
        return REACHED
    if touched:
        return "touched, then left"
    on_lid = abs(y - lid) < LID + PEG
    if z > -0.5:
        return "stands on the lid" if on_lid and z < 1.0 else "never came down"
    if z > -4.5:  # in the lid's layer
        if lid > PEG - LID - 0.5:  # the lid's edge still covers the target
            return "lid not open"
        return "beside the slot"
    if max(abs(np.array([x, y]) - obstacle)) < OBSTACLE + PEG and z > -11.5:
        return "obstacle not moved" if z < -10.5 else "in the slot, not at its bottom"
    return "at the bottom, beside the target" if z < -11.5 else "in the slot, not at its bottom"


def verdicts(run: dict[str, Any]) -> list[str]:
    """`classify` for every world of `episodes`."""
    tips = 1e3 * (run["tip"][-1] - BOX_TOP)
    sliders = 1e3 * run["qpos"][-1, :, -3:]
    return [
        classify(
            tips[k],
            float(sliders[k, 0]),
            sliders[k, 1:],
            success=bool(run["success"][k]),
            touched=bool(run["touched"][k]),
            penetration=1e3 * float(run["penetration"][k]),
        )
        for k in range(len(tips))
    ]


def failure_table(names: list[str] | None = None, starts: int | None = None) -> str:
    """Markdown: how the test episodes of the last policies end, by method.

    Args:
        names: methods; all shipped ones if None.
        starts: episodes of each seed; 4, or 1 in fast mode.
    """
    names = shipped() if names is None else names
    starts = budget(4, 1) if starts is None else starts
    ends = {name: verdicts(episodes(name, None, starts)) for name in names}
    used = [end for end in (REACHED, *FAILURES) if any(end in found for found in ends.values())]
    seconds = budget(PUSH.ticks, 200) * PUSH.tick
    head = (
        f"| method, after {seconds:g} s | episodes | "
        + " | ".join(used)
        + " |\n|"
        + "---|" * (len(used) + 2)
        + "\n"
    )
    rows = [
        f"| {STUDY.method(name).title} | {len(found)} | "
        + " | ".join(str(found.count(end)) for end in used)
        + " |"
        for name, found in ends.items()
    ]
    return head + "\n".join(rows)


def gallery(
    names: list[str] | None = None, failures: int = 3, starts: int | None = None
) -> list[dict[str, Any]]:
    """Episodes to look at: one success if there is any, and failures of different kinds.

    Failures come from as many kinds as there are, then from as many methods, in the study's order.

    Args:
        names: methods; all shipped ones if None.
        failures: how many of them.
        starts: as for `failure_table`, whose episodes are used again.

    Returns:
        For each: `t`, `qpos`, `tip`, `target`, `force` (T, 3), `distance` (T,), m, `model`, `kind`,
        `title`.
    """
    names = shipped() if names is None else names
    starts = budget(4, 1) if starts is None else starts
    found = [
        (kind, name, world)
        for name in names
        for world, kind in enumerate(verdicts(episodes(name, None, starts)))
    ]
    chosen = [case for case in found if case[0] == REACHED][:1]
    left = [case for case in found if case[0] != REACHED]
    for _ in range(min(failures, len(left))):
        kinds, methods = ([case[k] for case in chosen] for k in (0, 1))
        left.sort(key=lambda case: (kinds.count(case[0]), methods.count(case[1])))
        chosen.append(left.pop(0))
    return [_case(kind, name, world, starts) for kind, name, world in chosen]


def _case(kind: str, name: str, world: int, starts: int) -> dict[str, Any]:
    run = episodes(name, None, starts)
    keys = ("tip", "target", "qpos", "force", "distance")
    seed = run["seeds"][world // starts]
    return {
        "t": run["t"],
        "model": run["model"],
        "kind": kind,
        "title": f"{run['title']}, seed {seed}: {kind}",
        **{key: run[key][:, world] for key in keys},
    }


def distances(method: str = "ctd3", checkpoint: int = 10) -> dict[str, Any]:
    """Distance to the target over one test episode of each seed; the slider's picture.

    Args:
        method: one whose policies are shipped.
        checkpoint: number of the kept policy, from 1; the last one if there are fewer.

    Returns:
        `t` s, `distance` (T, seeds) mm, and `text`.
    """
    kept = marks(STUDY, method)
    step = kept[min(checkpoint, len(kept)) - 1]
    run = episodes(method, step)
    end = 1e3 * np.median(run["distance"][-1])
    return {
        "t": run["t"][::5],
        "distance": 1e3 * run["distance"][::5],
        "text": f"{run['title']}, step {step:,} (of {len(kept)} kept): "
        f"ends at {end:.1f} mm; {run['success'].sum()} of {len(run['seeds'])} touch",
    }


def at_rest() -> dict[str, dict[str, Array]]:
    """Low levels as shipped: largest |u| at y = 0 and slopes at rest, by title, (seeds,) each."""
    found = {}
    for name in shipped():
        _, low, record = peg_push.load(name)
        if low.actor is None:  # type: ignore[attr-defined]
            continue
        seeds = len(record["seeds"])
        rest = low.act(np.zeros((seeds, 1, 25)), explore=False)[:, 0]
        slope = slope_at_rest(STUDY, low, seeds)[:, :3]
        found[STUDY.method(name).title] = {
            "offset": np.abs(rest).max(-1),
            "lowest": slope.min(-1),
            "highest": slope.max(-1),
        }
    return found


def rest_table() -> str:
    """Markdown: `at_rest`, lowest to highest seed."""
    head = (
        "| low level, last policies | largest action at $y = 0$ | slopes at rest |\n|---|---|---|\n"
    )
    rows = []
    for title, found in at_rest().items():
        offset = " to ".join(f"{f(found['offset']):.2f}" for f in (np.min, np.max))
        slopes = f"{found['lowest'].min():.1f} to {found['highest'].max():.1f}"
        rows.append(f"| {title} | {offset} | {slopes} |")
    return head + "\n".join(rows)
