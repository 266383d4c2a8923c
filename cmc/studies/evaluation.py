"""Test the kept policies of a study: every row of its tables, from checkpoints."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cmc import results, store
from cmc.learning.state import single_thread
from cmc.studies.runner import Folder, Progress, find, load, marks_of
from cmc.studies.study import Rows, Study, Test

CURVE = 100
"""Points of a learning curve."""
FORMAT = 3
"""Of kept tests; raised when their figures change, so that older ones are not used."""
Tables = dict[str, Rows]


def evaluate(
    study: Study,
    names: Iterable[str] | None = None,
    *,
    trajectories: int | None = None,
    folder: Folder = None,
    checkpoints: Folder = None,
    progress: Progress | None = None,
) -> Tables:
    """Test trained policies; finished tests are kept and not repeated.

    Args:
        study: whose policies.
        names: methods; all that have a checkpoint or need none if None.
        trajectories: of each seed in the largest tests, others in proportion; the study's if None.
        folder: where tests are kept; by default `runs/STUDY/results`.
        checkpoints: folder of checkpoint files; the shipped ones if None.
        progress: called with (tests done, tests in all, what is next).

    Returns:
        Rows by table, as `cmc.results` describes them.

    Raises:
        ValueError: for an unknown method, or less than one trajectory.
        CheckpointError: if a checkpoint is missing, damaged or of another study.
    """
    if trajectories is not None and trajectories < 1:
        raise ValueError(f"trajectories: wanted at least 1, got {trajectories}")
    there = [n for n, m in study.methods.items() if not m.trained or _file(study, n, checkpoints)]
    wanted = there if names is None else [*names]
    kept = Path(folder) if folder is not None else Path("runs") / study.name / "results"
    plans = {name: _plan(study, name, checkpoints, trajectories) for name in wanted}
    total, done = sum(len(plan) for plan in plans.values()), 0
    tables: Tables = defaultdict(list)
    for name, plan in plans.items():
        path = find(study, name, checkpoints) if study.method(name).trained else None
        file, weights = kept / f"{name}.json", path.read_bytes() if path else b""
        ready = store.read_json(file) if file.is_file() else {}
        for test, mark in plan:
            if progress is not None:
                progress(done, total, f"{name}, {study.unit} {mark}, {test.name}")
            config = test.change(study.config_of(name))
            what = f"{FORMAT} {config} {test.name} {test.number} {mark}".encode()
            key = hashlib.sha256(weights + what).hexdigest()
            if key not in ready:
                with single_thread():
                    ready[key] = _test(study, name, test, mark, path)
                store.write_json(file, ready)
            for table, rows in ready[key].items():
                tables[table] += rows
            done += 1
        if path is not None:
            tables["curves"] += _curve(study, name, path)
    if progress is not None:
        progress(done, total, "done")
    return dict(tables)


def _file(study: Study, name: str, checkpoints: Folder) -> bool:
    return find(study, name, checkpoints).is_file()


def _plan(
    study: Study, name: str, checkpoints: Folder, trajectories: int | None
) -> list[tuple[Test, int]]:
    """The tests of a method and the kept policies that they look at."""
    marks = [0]
    if study.method(name).trained:
        marks = marks_of(store.load_checkpoint(find(study, name, checkpoints))[0])
    largest = max(test.number for test in study.tests)
    share = 1.0 if trajectories is None else trajectories / largest
    return [
        (replace(test, number=max(1, round(share * test.number))), mark)
        for test in study.tests
        if test.methods is None or name in test.methods
        for mark in test.when(marks)
    ]


def _test(study: Study, name: str, test: Test, mark: int, path: Path | None) -> Tables:
    """Rows of one test of one kept policy, with what they are about in front."""
    found = load(study, name, mark if path else None, path=path)
    marks = marks_of(store.load_checkpoint(path)[0]) if path else [0]
    about: dict[str, Any] = {"method": name, "title": study.method(name).title}
    about |= {"test": test.name, study.unit: mark, "last": mark == marks[-1]}
    config = test.change(study.config_of(name))
    tables = study.judge(config, found.policy, len(found.seeds), test)
    shown = {"tests", "certificates"} if mark not in study.shown(marks) else set(tables)
    return {
        table: [
            about | row | ({"seed": found.seeds[row["seed"]]} if "seed" in row else {})
            for row in plain_rows(rows)
        ]
        for table, rows in tables.items()
        if table in shown
    }


def plain_rows(rows: Rows) -> Rows:
    """Rows of plain numbers, without those that are missing."""
    return [
        {
            key: value.item() if isinstance(value, np.generic) else value
            for key, value in row.items()
            if value is not None
        }
        for row in rows
    ]


def _curve(study: Study, name: str, path: Path) -> Rows:
    """The learning curve, averaged into at most `CURVE` points."""
    tensors, record = store.load_checkpoint(path, study=study.name, method=name)
    values = tensors[f"{study.gain}s"]
    parts = np.array_split(values, min(CURVE, len(values)))
    last = marks_of(tensors)[-1]
    ends = np.round(np.cumsum([len(part) for part in parts]) * last / len(values)).astype(int)
    about = {"method": name, "title": study.method(name).title}
    return [
        {**about, study.unit: int(end), "seed": seed, study.gain: float(part[:, k].mean())}
        for end, part in zip(ends, parts, strict=True)
        for k, seed in enumerate(record["seeds"])
    ]


def summary(study: Study, tables: Tables) -> list[str]:
    """A line for each method about its last policies in the nominal test: means over seeds."""
    data = results.at(pd.DataFrame(tables["tests"]))
    shares = [key for key in ("success", "touched", "oscillation", "drift") if key in data]
    figures = [key for key in ("error_f", "return", "largest_N") if key in data]
    found = {key: results.share(data, key, "title") for key in shares}
    found |= {key: results.spread(data, key, "title") for key in figures}
    lines = []
    for title in data["title"].unique():
        parts = []
        for key, rows in found.items():
            mean, low, high = rows.loc[title, ["mean", "low", "high"]]
            unit = " %" if key in shares else ""
            parts.append(f"{key} {mean:.4g}{unit} [{low:.3g}, {high:.3g}]")
        lines.append(f"{title}: {', '.join(parts)}")
    return lines
