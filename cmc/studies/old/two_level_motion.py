"""One recorded test episode as arrays, for 3D pages and for `python -m cmc play`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cmc.learning.hierarchy import low_fields
from cmc.learning.low_level import evaluate
from cmc.learning.state import single_thread
from cmc.studies.old.two_level import TwoLevelStudy
from cmc.studies.old.two_level_evaluation import TEST_SEED
from cmc.studies.old.two_level_training import load


def motion(
    study: TwoLevelStudy,
    name: str,
    seed: int = 0,
    *,
    episode: int = 0,
    step: int | None = None,
    path: str | Path | None = None,
) -> dict[str, Any]:
    """Run one test episode and record it.

    Args:
        study: configuration.
        name: method.
        seed: position of the trained seed.
        episode: number of the test start, from 0.
        step: which of the kept policies; the last one if None.
        path: checkpoint file; the shipped one if None.

    Returns:
        `model` (MuJoCo), `t` (T,), `qpos` (T, nq), `tip` (T, 3), `force` (T, 3), N, on the peg,
        `distance` (T,) to the goal, m, `markers` (name to (3,) or (T, 3)), `success` at the end
        and `touched` at any tick, `seeds` (the trained one's) and `text`.

    Raises:
        ValueError: for an unknown method, step or seed.
        CheckpointError: if the file is damaged or foreign.
    """
    planner, low, record = load(study, name, step, path)
    seeds = len(record["seeds"])
    if not 0 <= seed < seeds:
        raise ValueError(f"seed: wanted 0 to {seeds - 1}, got {seed}")
    title, study = study.method(name).title, study.of(name)
    task = study.task_class(study.task, num=seeds)
    task.seed([TEST_SEED + episode] * seeds)
    planning, fields = study.planning(), low_fields(task)
    with single_thread():
        obs, rows = task.reset(), []
        success, touched = False, False
        for tick in range(study.task.ticks):
            if tick % study.task.horizon == 0:
                seen = planning.observe(task, obs).reshape(seeds, 1, -1)
                aim = planning.subgoal(evaluate(planner, seen)).reshape(seeds, -1)
                obs = task.set_subgoal(aim)
            now = (task.worlds.qpos, task.worlds.tip, task.target, task.worlds.force)
            rows.append([part[seed].copy() for part in now])
            u = low.act(task.select(obs, fields).reshape(seeds, 1, -1), explore=False)
            obs, *_, info = task.step(u.reshape(seeds, -1))
            success = bool(info["success"][seed])
            touched |= success
    qpos, tip, target, force = (np.array(part) for part in zip(*rows, strict=True))
    goal = obs[seed, task.layout["goal"]]
    markers = {"goal": goal}
    if study.task.command == "pose":
        markers["sub-goal"] = target
    distance = np.linalg.norm(goal - tip, axis=-1)
    end = f"ends {1e3 * distance[-1]:.1f} mm from the goal"
    return {
        "model": task.worlds.model,
        "t": study.task.tick * np.arange(len(tip)),
        "qpos": qpos,
        "tip": tip,
        "force": force,
        "distance": distance,
        "markers": markers,
        "success": success,
        "touched": touched,
        "seeds": [int(record["seeds"][seed])],
        "text": f"{study.name}, {title}, seed {record['seeds'][seed]}: the tip {end}",
    }
