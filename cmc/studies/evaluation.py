"""Test the kept policies of a study, and ship what a run has: policies, and rows of tables."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cmc import results, store
from cmc.learning.state import single_thread
from cmc.studies.runner import Folder, Progress, find, load, marks_of
from cmc.studies.study import Rows, Study, Test, checked_methods, checked_study
from cmc.theory.arrays import count

CURVE = 100  # points of a learning curve
FORMAT = 3  # of kept tests; raised when their figures change, so that older ones are not used
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
    """Test trained policies; rows by table, as `cmc.results` describes them.

    Without `names` all methods are tested that have a checkpoint, in the folder `checkpoints` or
    shipped, or need none. `trajectories` are those of each seed in the largest tests, others in
    proportion. Finished tests are kept in `folder` (`runs/STUDY/results`) and not repeated.
    `progress` is called with (tests done, tests in all, what is next).
    A CheckpointError if a file is missing, damaged or of another study, or there is none at all.
    """
    files = _files(study, names, checkpoints)
    kept = store.as_path("folder", folder or Path("runs") / study.name / "results")
    plans = {name: _plan(study, name, file, trajectories) for name, file in files.items()}
    total, done = sum(len(plan) for plan in plans.values()), 0
    tables: Tables = defaultdict(list)
    for name, plan in plans.items():
        file, cache = files[name], kept / f"{name}.json"
        weights = file.read_bytes() if file else b""
        ready = store.read_json(cache) if cache.is_file() else {}
        for test, mark in plan:
            if progress is not None:
                progress(done, total, f"{name}, {study.unit} {mark}, {test.name}")
            config = test.change(study.config_of(name))
            what = f"{FORMAT} {config} {test.name} {test.number} {mark}".encode()
            key = hashlib.sha256(weights + what).hexdigest()
            if key not in ready:
                with single_thread():
                    ready[key] = _test(study, name, test, mark, file)
                store.write_json(cache, ready)
            for table, rows in ready[key].items():
                tables[table] += rows
            done += 1
        if file is not None:
            tables["curves"] += _curve(study, name, file)
    if progress is not None:
        progress(done, total, "done")
    return dict(tables)


def _files(
    study: Study, names: Iterable[str] | None, checkpoints: Folder
) -> dict[str, Path | None]:
    """Checkpoint files of methods, None for fixed gains; without names, of all that have one."""
    methods = checked_study(study).methods
    checkpoints = None if checkpoints is None else store.as_path("checkpoints", checkpoints)
    files = {
        name: find(study, name, checkpoints) if methods[name].trained else None
        for name in checked_methods("names", study, methods if names is None else names, least=1)
    }
    if names is None:
        files = {name: file for name, file in files.items() if file is None or file.is_file()}
        if not any(files.values()) and any(method.trained for method in methods.values()):
            where = f"is shipped: `python -m cmc train {study.name}` makes them"
            if checkpoints is not None:
                others = sorted(path.stem for path in checkpoints.glob("*.safetensors"))
                where = f"in {checkpoints}, wanted its folder; it holds {', '.join(others[:3])}"
                where = where if others else f"in {checkpoints}"
            raise store.CheckpointError(f"no checkpoint of {study.name} {where}")
    return files


def _plan(
    study: Study, name: str, file: Path | None, trajectories: int | None
) -> list[tuple[Test, int]]:
    """The tests of a method and the kept policies that they look at; 0 for fixed gains."""
    largest, marks = max(test.number for test in study.tests), [0]
    if file is not None:
        marks = marks_of(store.load_checkpoint(file, study=study.name, method=name)[0])
    share = 1.0 if trajectories is None else count("trajectories", trajectories) / largest
    return [
        (replace(test, number=max(1, round(share * test.number))), mark)
        for test in study.tests
        if test.methods is None or name in test.methods
        for mark in test.when(marks)
    ]


def _test(study: Study, name: str, test: Test, mark: int, file: Path | None) -> Tables:
    """Rows of one test of one kept policy, with what they are about in front."""
    found = load(study, name, mark if file else None, path=file)
    about: dict[str, Any] = {"method": name, "title": study.method(name).title}
    about |= {"test": test.name, study.unit: mark, "last": mark == found.marks[-1]}
    config = test.change(study.config_of(name))
    tables = study.judge(config, found.policy, len(found.seeds), test)
    shown = set(tables) if mark in study.shown(found.marks) else {"tests", "certificates"}

    def plain(row: dict[str, Any]) -> dict[str, Any]:
        """Plain numbers, without those that are missing; the seed in place of its position."""
        row = {k: v.item() if isinstance(v, np.generic) else v for k, v in row.items()}
        seed = {"seed": found.seeds[row["seed"]]} if "seed" in row else {}
        return about | {k: v for k, v in row.items() if v is not None} | seed

    return {name: [plain(row) for row in rows] for name, rows in tables.items() if name in shown}


def _curve(study: Study, name: str, file: Path) -> Rows:
    """The learning curve, averaged into at most `CURVE` points."""
    tensors, record = store.load_checkpoint(file, study=study.name, method=name)
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


def summary(tables: Tables) -> list[str]:
    """A line for each method about its last policies in the nominal test: means over seeds."""
    if not (isinstance(tables, dict) and tables.get("tests")):
        raise ValueError("tables: wanted rows of `tests`, as `evaluate` answers")
    data = results.at(pd.DataFrame(tables["tests"]))
    shares, lines = ("success", "touched", "oscillation", "drift"), defaultdict(list)
    for key in (*shares, "error_f", "return", "largest_N"):
        made, unit = (results.share, " %") if key in shares else (results.spread, "")
        for title, row in made(data, key, "title").iterrows() if key in data else ():
            ends = f"[{row['low']:.3g}, {row['high']:.3g}]"
            lines[title].append(f"{key} {row['mean']:.4g}{unit} {ends}")
    return [f"{title}: {', '.join(parts)}" for title, parts in lines.items()]


def ship(
    study: Study,
    folder: str | Path,
    assets: str | Path = "assets",
    *,
    complete: Collection[str] = (),
    progress: Progress | None = None,
) -> list[Path]:
    """Test every method of a run and put its policies and tables among the assets.

    The last policy of each method goes to `assets/checkpoints`, bit by bit, with the run's record
    beside it as JSON; of methods in `complete` all kept policies go. Their rows replace those of
    the same method in `assets/results`. Finished tests are kept in `FOLDER/results`. Returns the
    files written.
    """
    complete = checked_methods("complete", study, complete)
    folder, target = store.as_path("folder", folder), store.as_path("assets", assets)
    files = _files(study, None, folder)
    options: Any = {"folder": folder / "results", "checkpoints": folder, "progress": progress}
    tables, written, seeds = evaluate(study, files, **options), [], [0]
    for name, file in files.items():
        if file is None:
            continue
        tensors, record = store.load_checkpoint(file, study=study.name, method=name)
        earlier = () if name in complete else marks_of(tensors)[:-1]
        unwanted = tuple(f"{mark:08d}." for mark in earlier)
        chosen = {key: value for key, value in tensors.items() if not key.startswith(unwanted)}
        path = target / "checkpoints" / file.name
        written.append(store.save_checkpoint(path, chosen, record))
        store.write_json(path.with_suffix(".json"), record)
        seeds = max(seeds, record["seeds"], key=len)
    made = store.provenance(f"python -m cmc ship {study.name} FOLDER", seeds)
    for table, rows in tables.items():
        path, new = target / "results" / results.file_name(study.name, table), pd.DataFrame(rows)
        if path.is_file():
            old = results.read(path)
            new = pd.concat([old[~old["method"].isin(list(files))], new], ignore_index=True)
        order = {name: k for k, name in enumerate(study.methods)}
        new = new.sort_values("method", key=lambda m: m.map(order), kind="stable")
        written.append(results.write(path.parent, table, new, {"study": study.name, **made}))
    return written
