r"""Does the soft contact make peg push easy? Trained policies under stiffer and softer contact.

`python -m cmc.studies.contact_stiffness` writes `assets/results/peg_push_stiffness.json`.

The paper leaves open how much its ordering owes to the soft contact of the simulator. MuJoCo (its
documentation, chapter Modeling, section "Solver parameters") resolves a contact of depth r by the
reference acceleration a = -b v - k r with

    b = 2 / (d_max T),    k = d(r) / (d_max^2 T^2 zeta^2),

where solref = (T, zeta) are a time constant and a damping ratio, and solimp sets the impedance d.
Appendix H has T = 10 ms and zeta = 1. Here T of every shape that can touch is multiplied by a scale
while zeta, d and all else stay: stiffness k goes with 1 / scale^2, damping b with 1 / scale. Two
physics steps are the shortest T that MuJoCo accepts (it silently raises shorter ones), so that 0.4
is the smallest scale at 2 ms. Nothing is trained here: the policies learned at scale 1.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from cmc import store
from cmc.envs.peg_push import PegPush
from cmc.learning.state import single_thread
from cmc.studies.peg_push import STUDY
from cmc.studies.two_level import TwoLevelStudy
from cmc.studies.two_level_evaluation import Episodes, interval, run_episodes, summary
from cmc.studies.two_level_results import find_checkpoint
from cmc.studies.two_level_training import load, marks

METHODS = ("ctd3", "frozen", "td3")
SCALES = (0.4, 0.7, 1.0, 2.0, 4.0)
EPISODES = 50
RESULT = "peg_push_stiffness.json"
FORMAT = 1
"""Of kept cells; raised when their figures change, so that older ones are not used."""
TIME_CONSTANT = 0.01
"""Of contact in the scene, s."""


def scaled(scale: float) -> type[PegPush]:
    """Peg push with the time constant of all contact multiplied by `scale`.

    Raises:
        ValueError: if the time constant falls below two physics steps.
    """
    shortest = 2 * STUDY.task.timestep
    if not (np.isfinite(scale) and scale * TIME_CONSTANT >= shortest * (1 - 1e-9)):
        raise ValueError(
            f"scale: {scale} makes the time constant {1e3 * scale * TIME_CONSTANT:g} ms, wanted at "
            f"least two physics steps, {1e3 * shortest:g} ms"
        )

    class ScaledPush(PegPush):
        def _scene(self, history: int) -> mujoco.MjModel:
            model = super()._scene(history)
            touches = (model.geom_contype | model.geom_conaffinity) != 0
            model.geom_solref[touches, 0] *= scale
            return model

    return ScaledPush


def sweep(
    names: Sequence[str] | None = None,
    *,
    scales: Iterable[float] = SCALES,
    episodes: int = EPISODES,
    checkpoints: str | Path | None = None,
    folder: str | Path | None = None,
    study: TwoLevelStudy = STUDY,
    progress: Callable[[str, dict[str, Any]], object] | None = None,
) -> dict[str, Any]:
    """Test the last policies of some methods at every scale; finished cells are not repeated.

    Args:
        names: methods; those of `METHODS` that have a checkpoint if None.
        scales: of the time constant.
        episodes: of each seed and scale.
        checkpoints: folder of checkpoint files; the shipped ones if None.
        folder: where cells are kept, by default `runs/peg_push/stiffness`.
        study: peg push, perhaps in a smaller configuration.
        progress: called with the method and each cell as it is ready.

    Returns:
        `methods` (name to `title`, `seeds`, `step` of the policies and `cells`, what `measure`
        answers at each scale), `episodes`, `scales`, provenance.

    Raises:
        ValueError: for an unknown method, a scale that is too small or less than one episode.
        CheckpointError: if a checkpoint is damaged, or missing although it was asked for.
    """
    if episodes < 1:
        raise ValueError(f"episodes: wanted at least 1, got {episodes}")
    tasks = {float(scale): scaled(scale) for scale in scales}
    wanted = METHODS if names is None else names
    paths = {name: find_checkpoint(study, name, checkpoints) for name in wanted}
    if names is None:
        paths = {name: path for name, path in paths.items() if path.is_file()}
    if not paths:
        raise store.CheckpointError(f"no checkpoint of any of {', '.join(wanted)}")
    kept = Path("runs") / study.name / "stiffness" if folder is None else Path(folder)
    methods: dict[str, Any] = {}
    for name, path in paths.items():
        planner, low, record = load(study, name, path=path)
        weights, file = path.read_bytes(), kept / f"{name}.json"
        ready, cells = store.read_json(file) if file.is_file() else {}, []
        for scale, task in tasks.items():
            what = f"{FORMAT} {study} {scale} {episodes}".encode()
            key = hashlib.sha256(weights + what).hexdigest()
            if key not in ready:
                here, seeds = replace(study, task_class=task), len(record["seeds"])
                with single_thread():
                    found = run_episodes(here, planner, low, seeds, episodes)
                ready[key] = {"scale": scale, **measure(found, scale)}
                store.write_json(file, ready)
            cells.append(ready[key])
            if progress is not None:
                progress(name, ready[key])
        methods[name] = {
            "title": study.method(name).title,
            "seeds": record["seeds"],
            "step": marks(study, name, path)[-1],
            "cells": cells,
        }
    command = f"python -m cmc.studies.contact_stiffness --method {' '.join(methods)}"
    command += f" --scale {' '.join(f'{scale:g}' for scale in tasks)} --episodes {episodes}"
    made = store.provenance(command, max((m["seeds"] for m in methods.values()), key=len))
    numbers = {"episodes": episodes, "scales": list(tasks)}
    return {"study": study.name, **made, **numbers, "methods": methods}


def measure(found: Episodes, scale: float) -> dict[str, Any]:
    """Figures of one cell: those of `summary`, the contact's constants, and more by seed.

    Returns:
        Also `time_constant_ms`, `stiffness` relative to the nominal one, `success_by_seed` and
        `touched_by_seed`, exact 95 % intervals of each seed, `penetration_median_mm` of an
        episode's deepest, and `force_by_seed`, shares of ticks by the largest force of a tick.
    """
    count, largest = found.success.shape[1], found.force_max
    shares = {"zero": largest == 0, "below_1_N": largest < 1, "below_5_N": largest < 5}
    by_seed = {key: part.mean((0, 2)).tolist() for key, part in shares.items()}
    return {
        "time_constant_ms": round(1e3 * TIME_CONSTANT * scale, 6),
        "stiffness": round(scale**-2, 6),
        **summary(found),
        "success_by_seed": [interval(int(hits), count) for hits in found.success.sum(1)],
        "touched_by_seed": [interval(int(hits), count) for hits in found.touched.sum(1)],
        "penetration_median_mm": (1e3 * np.median(found.penetration, axis=1)).tolist(),
        "force_by_seed": {**by_seed, "largest_N": largest.max((0, 2)).astype(float).tolist()},
    }


def main(words: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Peg push under stiffer and softer contact.")
    parser.add_argument("--method", nargs="+", choices=list(STUDY.methods), metavar="NAME")
    parser.add_argument("--scale", nargs="+", type=float, default=list(SCALES))
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of each seed and scale")
    parser.add_argument("--checkpoints", type=Path, help="folder; the shipped ones if left out")
    parser.add_argument("--out", type=Path, help="folder that keeps finished cells")
    parser.add_argument("--write", type=Path, default=Path("assets/results") / RESULT)
    chosen = parser.parse_args(words)

    def show(name: str, cell: dict[str, Any]) -> None:
        success, touched = (100 * np.mean(cell[key]) for key in ("success", "touched"))
        print(
            f"{name:14} scale {cell['scale']:3g}  success {success:5.1f} %  touched {touched:5.1f} "
            f"%  return {np.mean(cell['return']):7.1f}  deepest {max(cell['penetration_mm']):.3f} "
            f"mm  below 1 N {100 * cell['force']['largest']['below_1_N']:.2f} %",
            flush=True,
        )

    answer = sweep(
        chosen.method,
        scales=chosen.scale,
        episodes=chosen.episodes,
        checkpoints=chosen.checkpoints,
        folder=chosen.out,
        progress=show,
    )
    print(store.write_json(chosen.write, answer))


if __name__ == "__main__":
    main()
