"""Recorded episodes: what a 3D page needs, without a policy and without stepping the physics.

A recording is one npz file of plain arrays (never pickled); the scene is made from the study's
configuration when it is read.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cmc import store, studies

_ARRAYS = ("t", "qpos", "tip", "force", "distance")
_ENDS = ("success", "touched")
_MARKER = "marker "


def save(path: str | Path, motion: Mapping[str, Any], record: Mapping[str, Any]) -> Path:
    """Write what a study's `motion` returns as an npz file, atomically.

    Raises:
        ValueError: if the record lacks `study` or `method`, which made the scene.
    """
    missing = {"study", "method"} - set(record)
    if missing:
        raise ValueError(f"the record of an episode lacks {sorted(missing)}")
    about = {**record, "text": motion["text"]}
    about |= {name: bool(motion[name]) for name in _ENDS}
    arrays: dict[str, Any] = {name: np.asarray(motion[name]) for name in _ARRAYS}
    arrays |= {_MARKER + name: np.asarray(value) for name, value in motion["markers"].items()}
    about_text = np.array(json.dumps(about, allow_nan=False))
    return store.write_atomic(
        path, lambda file: np.savez_compressed(file, record=about_text, **arrays)
    )


def load(path: str | Path) -> dict[str, Any]:
    """Read a file, or a shipped one by its name: `motion`, its `model` made anew, and `record`.

    Raises:
        FileNotFoundError: if no episode of this name is shipped.
        CheckpointError: if the file is damaged, foreign, or does not fit its scene.
    """
    path = Path(path)
    file = path if path.suffix else store.asset("episodes", f"{path}.npz")
    try:
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        record = json.loads(str(arrays.pop("record")))
        motion: dict[str, Any] = {name: arrays.pop(name) for name in _ARRAYS}
        model = studies.get(record["study"]).config_of(record["method"]).make(1).worlds.model
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise store.CheckpointError(f"{file} is not a recorded episode: {error}") from error
    if motion["qpos"].shape != (len(motion["t"]), model.nq):
        raise store.CheckpointError(
            f"{file}: wanted {(len(motion['t']), model.nq)} joint positions, found "
            f"{motion['qpos'].shape}"
        )
    markers = {name.removeprefix(_MARKER): value for name, value in arrays.items()}
    about = {key: record.pop(key) for key in ("text", *_ENDS)}
    return {"model": model, **motion, "markers": markers, **about, "record": record}
