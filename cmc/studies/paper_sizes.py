"""Peg maze once with the network sizes of the paper's table: what they cost, and one curve.

`python -m cmc.studies.paper_sizes` trains one seed of TD3/C-TD3, tests every kept policy and writes
`assets/results/peg_maze_paper_sizes.json`; stopped, it goes on where it was. The comparison of the
methods has smaller networks (`cmc.studies.peg_maze`, 5); a short run of one seed at those sizes
gives their cost by the same measure. This low level needs no critic.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from cmc import store
from cmc.studies import peg_maze
from cmc.studies.two_level import TwoLevelStudy
from cmc.studies.two_level_results import evaluate_method
from cmc.studies.two_level_training import train

METHOD, SEEDS = "ctd3", [0]
STUDY = replace(
    peg_maze.STUDY,
    name="peg_maze_paper_sizes",
    planner=replace(peg_maze.STUDY.planner, critic_hidden=(400, 300)),
    planner_hidden=(400, 300),
    low_hidden=(200, 200),
)
SHORT = 20_000
"""Learning steps that the cost at our sizes is measured over."""


class Meter:
    """CPU time of a training's learning steps, measured in each session and kept in a file.

    A session is one process. Steps that are done again after a stop count twice, with their time.
    """

    def __init__(self, path: Path, study: TwoLevelStudy) -> None:
        self.path, self.start = path, study.hierarchy.warm_up
        self.every = study.snapshot_every // 20
        self.sessions = store.read_json(path)["sessions"] if path.is_file() else []
        self._last: tuple[int, float] | None = None

    def __call__(self, row: dict[str, Any]) -> None:
        """Count one segment; a session's first one has the start-up in it and is left out."""
        now = (int(row["steps"]), time.process_time())
        if self._last is None:
            self.sessions.append({"steps": 0, "cpu_seconds": 0.0})
        elif self._last[0] >= self.start:
            self.sessions[-1]["steps"] += now[0] - self._last[0]
            self.sessions[-1]["cpu_seconds"] += now[1] - self._last[1]
        last = now[0] >= row["total_steps"]
        if last or (self._last and now[0] // self.every > self._last[0] // self.every):
            store.write_json(self.path, {"sessions": self.sessions})
        self._last = now

    def record(self) -> dict[str, Any]:
        """Sessions, and milliseconds of CPU time for one learning step of the only seed."""
        steps, seconds = (sum(s[k] for s in self.sessions) for k in ("steps", "cpu_seconds"))
        return {"cpu_ms_per_step": 1e3 * seconds / max(steps, 1), "sessions": self.sessions}


def sizes(study: TwoLevelStudy) -> dict[str, list[int]]:
    """Hidden sizes of planner, critics and low level."""
    critics, low = list(study.planner.critic_hidden), list(study.low_hidden)
    return {"planner": list(study.planner_hidden), "critics": critics, "low": low}


def run(
    study: TwoLevelStudy = STUDY,
    ours: TwoLevelStudy = peg_maze.STUDY,
    *,
    out: Path,
    steps: int = STUDY.steps,
    episodes: int = STUDY.episodes,
) -> dict[str, Any]:
    """Train, test and measure; finished parts are not repeated.

    Args:
        study: with the paper's sizes.
        ours: with ours.
        out: folder of the run.
        steps: of the training.
        episodes: of the last test.

    Returns:
        What `evaluate_method` answers, `sizes`, `cpu_ms_per_step` and the `sessions` that it was
        measured in; under `ours` the sizes and the cost of one seed at our sizes.
    """
    file, meter = out / "ours.json", Meter(out / "cost.json", study)
    if not file.is_file():
        store.write_json(file, _cost(ours, min(ours.hierarchy.warm_up + SHORT, steps)))
    path = train(study, METHOD, SEEDS, steps=steps, out=out, callback=meter)
    tests = evaluate_method(study, METHOD, path, episodes, out / "tests.json")
    named = {"study": study.name, "method": METHOD, "sizes": sizes(study)}
    return named | tests | meter.record() | {"ours": store.read_json(file)}


def _cost(study: TwoLevelStudy, steps: int) -> dict[str, Any]:
    """The sizes of a study, and what a learning step of a short training costs."""
    with tempfile.TemporaryDirectory() as scratch:
        meter = Meter(Path(scratch) / "cost.json", study)
        train(study, METHOD, SEEDS, steps=steps, out=scratch, callback=meter)
    return {"sizes": sizes(study)} | meter.record()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Peg maze with the paper's network sizes.")
    parser.add_argument("--steps", type=int, default=STUDY.steps)
    parser.add_argument("--out", type=Path, default=Path("runs") / STUDY.name)
    parser.add_argument("--write", type=Path, default=Path(f"assets/results/{STUDY.name}.json"))
    chosen = parser.parse_args()
    made = store.provenance(f"python -m cmc.studies.paper_sizes --steps {chosen.steps}", SEEDS)
    answer = run(steps=chosen.steps, out=chosen.out)
    store.write_json(chosen.write, answer | made)
    print("{cpu_ms_per_step:.3f} ms of CPU a step".format(**answer))


if __name__ == "__main__":
    main()
