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
from cmc.theory.arrays import checked

_ARRAYS = ("t", "qpos", "tip", "force", "distance")
_ENDS = ("success", "touched")
_MARKER = "marker "


def save(path: str | Path, motion: Mapping[str, Any], record: Mapping[str, Any]) -> Path:
    """Write what a study's `motion` returns, and study and method in `record`, as an npz file."""
    store.as_json("record", record, "study", "method")
    known = (*_ARRAYS, *_ENDS, "text", "markers")
    if not isinstance(motion, Mapping) or (missing := set(known) - set(motion)):
        said = f"without {sorted(missing)}" if isinstance(motion, Mapping) else repr(motion)
        raise ValueError(f"motion: wanted what a study's `motion` returns, got one {said}")
    about = {**record, "text": motion["text"], **{name: bool(motion[name]) for name in _ENDS}}
    arrays: dict[str, Any] = {name: checked(f"motion: {name}", motion[name]) for name in _ARRAYS}
    arrays |= {_MARKER + name: np.asarray(value) for name, value in motion["markers"].items()}
    text = np.array(json.dumps(about, allow_nan=False))
    return store.write_atomic(path, lambda file: np.savez_compressed(file, record=text, **arrays))


def load(path: str | Path) -> dict[str, Any]:
    """Read a file, or a shipped one by its name: `motion`, its `model` made anew, and `record`.

    Raises:
        FileNotFoundError: if no episode of this name is shipped.
        CheckpointError: if the file is damaged, foreign, or does not fit its scene.
    """
    path = store.as_path("path", path)
    file = path if path.suffix else store.asset("episodes", f"{path}.npz")
    try:
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        record = json.loads(str(arrays.pop("record")))
        motion: dict[str, Any] = {name: arrays.pop(name) for name in _ARRAYS}
        model = studies.get(record["study"]).config_of(record["method"]).make(1).worlds.model
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise store.CheckpointError(f"{file} is not a recorded episode: {error}") from error
    wanted, found = (len(motion["t"]), model.nq), motion["qpos"].shape
    if found != wanted:
        raise store.CheckpointError(f"{file}: wanted {wanted} joint positions, found {found}")
    markers = {name.removeprefix(_MARKER): value for name, value in arrays.items()}
    about = {key: record.pop(key) for key in ("text", *_ENDS)}
    return {"model": model, **motion, "markers": markers, **about, "record": record}
