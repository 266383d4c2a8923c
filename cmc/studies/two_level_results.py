"""Every figure of a peg study, computed from checkpoints, by method and by kept policy."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from cmc import store
from cmc.learning.low_level import Fixed
from cmc.learning.state import single_thread
from cmc.studies.two_level import TwoLevelStudy
from cmc.studies.two_level_evaluation import consistency, run_episodes, slope_at_rest, summary
from cmc.studies.two_level_training import checkpoint_path, load, marks

Progress = Callable[[int, int, str], object]
Folder = str | Path | None
EARLIER = 5
"""Policies kept on the way are tested by this many times fewer episodes than the last one."""
FORMAT = 2
"""Of kept tests; raised when their figures change, so that older ones are not used."""
CURVE = 100
"""Points of a learning curve."""


def evaluate(
    study: TwoLevelStudy,
    names: Iterable[str] | None = None,
    *,
    trajectories: int | None = None,
    folder: Folder = None,
    checkpoints: Folder = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Test trained policies and collect every figure; finished tests are not repeated.

    Args:
        study: configuration.
        names: methods; all that have a checkpoint if None.
        trajectories: test episodes of each seed with the last policy; the study's if None.
        folder: where tests are kept, so that an interrupted evaluation goes on; by default
            `runs/STUDY/results`.
        checkpoints: folder of checkpoint files; the shipped ones if None.
        progress: called with (tests done, tests in all, what is next).

    Returns:
        `methods` (name to `evaluate_method`'s answer), `claims` (a line for each), provenance.

    Raises:
        ValueError: for an unknown method, or less than one episode.
        FileNotFoundError: if a method that was asked for has no checkpoint.
        CheckpointError: if a checkpoint is damaged or of another study.
    """
    count = study.episodes if trajectories is None else trajectories
    if count < 1:
        raise ValueError(f"trajectories: wanted at least 1, got {count}")
    found = [name for name in study.methods if find_checkpoint(study, name, checkpoints).is_file()]
    wanted = found if names is None else [*names]
    paths = {name: find_checkpoint(study, name, checkpoints) for name in wanted}
    kept = Path(folder) if folder is not None else Path("runs") / study.name / "results"
    total, done = sum(len(marks(study, name, path)) for name, path in paths.items()), 0
    methods: dict[str, Any] = {}
    for name, path in paths.items():

        def step(number: int, what: str, before: int = done) -> None:
            if progress is not None:
                progress(before + number, total, what)

        methods[name] = evaluate_method(study, name, path, count, kept / f"{name}.json", step)
        done += len(methods[name]["tests"])
    if progress is not None:
        progress(done, total, "done")
    seeds: list[int] = max((m["seeds"] for m in methods.values()), key=len, default=[])
    lines = {name: {"verdict": verdict(method)} for name, method in methods.items()}
    answer = {"study": study.name, "test": {"trajectories": count}, "methods": methods}
    made = store.provenance(f"python -m cmc evaluate {study.name} --json", seeds)
    return answer | {"claims": lines} | made


def evaluate_method(
    study: TwoLevelStudy,
    name: str,
    path: Path,
    count: int,
    file: Path,
    step: Callable[[int, str], object] | None = None,
) -> dict[str, Any]:
    """All tests of one method.

    Args:
        study: configuration.
        name: the method.
        path: its checkpoints.
        count: test episodes of each seed with the last policy.
        file: where tests are kept one by one; those that are there are not repeated.
        step: called before each test with its number and what it is.

    Returns:
        `title`, `seeds`, `training` (the learning curve), `tests` (one for each kept policy: `step`
        and what `summary` holds, `consistency`, `gains`), `final` (the last of them),
        `force_over_tests`, the shares averaged over all kept policies, and two figures by seed of
        how much the low level changed while it learned: `consistency_over_training_mm`, the root
        of the summed variances over the kept policies of the mean displacement (`consistency`), and
        `consistency_late_mm`, the same over those of the second half of training. Both are None
        with less than two policies.
    """
    here, arm = study.of(name), study.method(name)
    print_of = hashlib.sha256(path.read_bytes() + f"{FORMAT} {here}".encode()).hexdigest()
    earlier = store.read_json(file) if file.is_file() else {}
    ready = earlier.get("tests", []) if earlier.get("fingerprint") == print_of else []
    found, tests = marks(study, name, path), []
    for number, mark in enumerate(found):
        episodes = count if mark == found[-1] else max(1, count // EARLIER)
        if step is not None:
            step(number, f"{name}, step {mark}")
        known = [t for t in ready if t["step"] == mark and t["episodes"] == episodes]
        with single_thread():
            made = (
                known[0]
                if known
                else _test(here, study, name, path, mark, episodes, mark == found[-1])
            )
        tests.append(made)
        later = [t for t in ready if all(t is not kept for kept in tests)]
        store.write_json(file, {"fingerprint": print_of, "tests": tests + later})
    tensors, record = store.load_checkpoint(path, study=study.name, method=name)
    return {
        "title": arm.title,
        "seeds": record["seeds"],
        "training": _curve(tensors["rewards"], found[-1]),
        "tests": tests,
        "final": tests[-1],
        "force_over_tests": _mean_shares(tests),
        "consistency_over_training_mm": _over_training(tests),
        "consistency_late_mm": _over_training([t for t in tests if 2 * t["step"] >= found[-1]]),
    }


def _test(
    here: TwoLevelStudy,
    study: TwoLevelStudy,
    name: str,
    path: Path,
    mark: int,
    episodes: int,
    last: bool,
) -> dict[str, Any]:
    """One kept policy; `here` is the study as the method runs it."""
    planner, low, record = load(study, name, mark, path)
    seeds = len(record["seeds"])
    figures = summary(run_episodes(here, planner, low, seeds, episodes), every=last)
    moved = consistency(here, low, seeds)
    figures["consistency_mm"] = {key: (1e3 * value).tolist() for key, value in moved.items()}
    silent = isinstance(low, Fixed) and low.actor is None
    if here.task.command == "pose" and not silent:
        figures["gains"] = {
            "slope": slope_at_rest(here, low, seeds).tolist(),
            "bound": here.slope_cap(name).tolist(),
            "bounded": study.method(name).capped and study.method(name).positive,
        }
    return {"step": mark, **figures}


def _curve(rewards: np.ndarray, last: int) -> dict[str, Any]:
    """Mean reward a tick, averaged into at most `CURVE` points."""
    parts = np.array_split(rewards, min(CURVE, len(rewards)))
    ends = np.cumsum([len(part) for part in parts]) * last / len(rewards)
    means = np.array([part.mean(0) for part in parts], dtype=float)
    return {"step": np.round(ends).astype(int).tolist(), "reward": np.round(means, 6).tolist()}


def _mean_shares(tests: list[dict[str, Any]]) -> dict[str, Any]:
    rules = tests[0]["force"]
    return {
        rule: {
            key: (max if key == "largest_N" else np.mean)([t["force"][rule][key] for t in tests])
            for key in rules[rule]
        }
        for rule in rules
    }


def _over_training(tests: list[dict[str, Any]]) -> list[float] | None:
    """Spread over policies of the mean displacement, by seed, mm."""
    if len(tests) < 2:
        return None
    means = np.array([test["consistency_mm"]["mean_vector"] for test in tests])
    spread: list[float] = np.sqrt(means.var(0).sum(-1)).tolist()
    return spread


def verdict(method: dict[str, Any]) -> str:
    """One line about a method's last policies."""
    final = method["final"]

    def share(name: str) -> str:
        low, high = final[f"{name}_interval"]
        return f"{100 * np.mean(final[name]):.1f} % ({100 * low:.1f}-{100 * high:.1f})"

    light = final["force"]["largest"]["below_1_N"]
    return (
        f"{method['title']}: success {share('success')}, at any time {share('touched')}, return "
        f"{np.mean(final['return']):.2f}, {100 * light:.2f} % of the ticks below 1 N"
    )


def find_checkpoint(study: TwoLevelStudy, name: str, checkpoints: Folder = None) -> Path:
    """Checkpoint file of a method: in the folder, else the shipped one, else that of `runs`.

    Raises:
        ValueError: for an unknown method.
    """
    study.method(name)
    file = f"{study.name}_{name}.safetensors"
    if checkpoints is not None:
        return Path(checkpoints) / file
    try:
        return checkpoint_path(study, name)
    except FileNotFoundError:
        return Path("runs") / study.name / file
