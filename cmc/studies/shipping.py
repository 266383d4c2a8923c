"""Put trainings of different seeds together, and choose what of a run is shipped."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cmc import results, store
from cmc.studies.evaluation import evaluate
from cmc.studies.runner import Folder, Progress, marks_of
from cmc.studies.study import Study


def ship(
    study: Study,
    folder: str | Path,
    assets: str | Path = "assets",
    *,
    complete: Collection[str] = (),
    tests: Folder = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Test every method of a run and put its policies and tables among the assets.

    The last policy of each method goes to `assets/checkpoints`, bit by bit, with the run's record
    beside it as JSON. Its rows replace those of the same method in `assets/results`.

    Args:
        study: of the run.
        folder: of its checkpoints.
        assets: where the assets are.
        complete: methods of which all kept policies are shipped, not only the last.
        tests: folder of finished tests, by default `FOLDER/results`.
        progress: see `evaluate`.

    Returns:
        The files written.

    Raises:
        ValueError: for an unknown method.
        FileNotFoundError: if the folder holds no checkpoint of the study.
        CheckpointError: if one is damaged or of another study.
    """
    for name in complete:
        study.method(name)
    files = {name: Path(folder) / f"{study.name}_{name}.safetensors" for name in study.methods}
    files = {name: file for name, file in files.items() if file.is_file()}
    fixed = [name for name, method in study.methods.items() if not method.trained]
    if not files and len(fixed) < len(study.methods):
        raise FileNotFoundError(f"no checkpoint of {study.name} in {folder}")
    kept = Path(folder) / "results" if tests is None else tests
    names = [*files, *fixed]
    tables = evaluate(study, names, folder=kept, checkpoints=folder, progress=progress)
    written, seeds = [], [0]
    for name, file in files.items():
        tensors, record = store.load_checkpoint(file, study=study.name, method=name)
        marks = marks_of(tensors)
        unwanted = () if name in complete else tuple(f"{mark:08d}." for mark in marks[:-1])
        chosen = {key: value for key, value in tensors.items() if not key.startswith(unwanted)}
        target = Path(assets) / "checkpoints" / file.name
        written.append(store.save_checkpoint(target, chosen, record))
        store.write_json(target.with_suffix(".json"), record)
        seeds = max(seeds, record["seeds"], key=len)
    made = store.provenance(f"python -m cmc ship {study.name} FOLDER", seeds)
    for table, rows in tables.items():
        there = Path(assets) / "results" / results.file_name(study.name, table)
        new = pd.DataFrame(rows)
        if there.is_file():
            old = results.read(there)
            new = pd.concat([old[~old["method"].isin(names)], new], ignore_index=True)
        order = {name: k for k, name in enumerate(study.methods)}
        new = new.sort_values("method", key=lambda m: m.map(order), kind="stable")
        written.append(results.write(there.parent, table, new, {"study": study.name, **made}))
    return written


def merge(paths: Sequence[Path], out: Path) -> Path:
    """Put checkpoints of the same method and different seeds together.

    Raises:
        CheckpointError: if they are of different studies, methods, configurations or lengths.
    """
    loaded = [store.load_checkpoint(path) for path in paths]
    tensors, record = loaded[0]
    for path, (others, found) in zip(paths, loaded, strict=True):
        for key in ("study", "method", "configuration"):
            if found.get(key) != record.get(key):
                raise store.CheckpointError(f"{path}: {key} differs from that of {paths[0]}")
        if set(others) != set(tensors):
            raise store.CheckpointError(f"{path}: other policies are kept than in {paths[0]}")
    joined = {
        # curves are (time, seeds); weights have the seeds first
        key: np.concatenate([part[key] for part, _ in loaded], axis=int(not key[0].isdigit()))
        for key in tensors
    }
    seeds = [seed for _, found in loaded for seed in found["seeds"]]
    command = str(record.get("command", ""))
    group = f"--seeds {len(seeds)} --group {len(record['seeds'])}"
    command = re.sub(r"--seeds \d+", group, command)
    return store.save_checkpoint(out, joined, {**record, "seeds": seeds, "command": command})
