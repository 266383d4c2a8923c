"""Train a study's methods, and load what they learned.

A run is a folder. `STUDY_METHOD.safetensors` holds the kept policies (tensors `MARK.PART.NAME`) and
the learning curve, `METHOD_state.safetensors` the whole state of the training. Both are written at
every kept policy, at least every minute, and on an interrupt; a run that was stopped goes on from
there to the same end, bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from cmc import store
from cmc.learning.state import interruptions, plain, single_thread
from cmc.studies.study import Study, checked_seeds, checked_study
from cmc.theory.arrays import count, need

Callback = Callable[[dict[str, Any]], object]
Progress = Callable[[int, int, str], object]
Folder = str | Path | None
SAVE_EVERY = 60.0  # longest time between two savings of a training, s
MOST = 10**9  # steps or episodes of a training


def train(
    study: Study,
    name: str,
    seeds: Sequence[int] = range(5),
    *,
    length: int | None = None,
    out: Folder = None,
    callback: Callback | None = None,
) -> Path:
    """Train a method and keep its policies; a run that was stopped goes on where it was.

    All seeds are trained in one batch of networks, for `length` steps or episodes each (the study's
    if None), in the folder `out` (`runs/STUDY`). `callback` is called after every segment with
    `done`, `total`, `gain` (seeds,) and, where the training knows it, `success` (seeds,), the share
    of the latest finished episodes. Returns the file with all kept policies, which `load` reads.

    Raises:
        CheckpointError: if the folder holds a run of other seeds or another configuration.
        KeyboardInterrupt: on SIGINT and SIGTERM, once everything is saved.
    """
    method = checked_study(study).method(name)
    total = count(f"length ({study.unit}s)", study.length if length is None else length, MOST)
    need(callable(callback or print), "callback", "a function", callback or print)
    if not method.trained:
        raise ValueError(f"{name!r} has fixed gains: there is nothing to train")
    seeds = checked_seeds(seeds)
    folder = store.as_path("out", Path("runs") / study.name if out is None else out)
    packed = folder / f"{study.name}_{name}.safetensors"
    state = folder / f"{name}_state.safetensors"
    record = _record(study, name, seeds, total)
    identity = {key: record[key] for key in ("study", "method", "configuration")}
    training, (kept, curve) = study.build(name, seeds), _resumed(packed, state, record)
    if curve:
        training.load(state, identity)
        del curve[training.steps // training.stride :]

    def save() -> None:
        rows = {f"{study.gain}s": np.array(curve)} if curve else {}
        store.save_checkpoint(packed, kept | rows, record)  # before the state: a kill in between
        training.save(state, identity)  # repeats segments and loses none

    saved = -SAVE_EVERY  # the first segment is saved: the folder is taken from then on
    with interruptions() as interrupted:
        while training.steps < total and not interrupted():
            with single_thread():
                gain = training.segment()
            curve.append(np.asarray(gain, dtype=np.float32))
            mark = _mark(study, training.steps, training.stride, total)
            if mark is not None:
                kept |= _weights(training, mark)
            try:
                if callback is not None:
                    report = {"done": training.steps, "total": total, "gain": gain}
                    callback(report | {"success": getattr(training, "success", None)})
            except KeyboardInterrupt:
                save()
                raise
            if mark or interrupted() or time.monotonic() - saved > SAVE_EVERY:
                save()
                saved = time.monotonic()
        if interrupted():
            raise KeyboardInterrupt(f"stopped and saved at {study.unit} {training.steps}")
    return packed


def _resumed(
    packed: Path, state: Path, record: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Kept policies and curve of an earlier run in the folder, empty if there is none."""
    if not packed.is_file():
        return {}, []  # a state without its policies belongs to nothing: the run starts afresh
    kept, found = store.load_checkpoint(packed, study=record["study"], method=record["method"])
    advice, own = "use another folder (--out), or move it away", found.get("seeds")
    if own != record["seeds"]:
        if isinstance(own, list) and own == list(range(len(own))):
            advice = f"go on with it by --seeds {len(own)}, {advice}"
        said = f"is a run of seeds {own}, not {record['seeds']}"
    elif found.get("configuration") != record["configuration"]:
        said = "is a run of another configuration"
    elif not state.is_file():
        said = f"has lost its {state.name}, so it ends here"
    else:
        curve = [row for key in ("rewards", "returns") for row in kept.pop(key, ())]
        return kept, curve
    raise store.CheckpointError(f"{packed} {said}: {advice}")


def _mark(study: Study, done: int, stride: int, total: int) -> int | None:
    """The step under which the present policy is kept, if it is."""
    whole = done // study.every * study.every
    if done >= total and done - whole >= stride:
        return done
    return whole if done >= total or whole > done - stride else None


def _weights(training: Any, mark: int) -> dict[str, np.ndarray]:
    """Weights that act, by the names that `load` looks for."""
    return {
        f"{mark:08d}.{part}.{key}": value.detach().numpy().copy()
        for part, module in training.actors().items()
        for key, value in module.state_dict().items()
    }


def _record(study: Study, name: str, seeds: Sequence[int], total: int) -> dict[str, Any]:
    """The record of a run."""
    command = f"python -m cmc train {study.name} --method {name} --seeds {len(seeds)}"
    made = store.provenance(f"{command} --{study.unit}s {total}", list(seeds))
    settings = plain({"every": study.every, **asdict(study.config_of(name))})
    return {"study": study.name, "method": name, "configuration": settings, **made}


class Loaded(NamedTuple):
    """A kept policy of all seeds, or of one."""

    policy: Any  # as the study's tests take it, with a leading axis of seeds
    mark: int  # its step or episode; 0 for fixed gains
    seeds: list[int]  # the trainings
    marks: list[int]  # of all policies that are kept


def load(
    study: Study,
    name: str,
    mark: int | None = None,
    *,
    seed: int | None = None,
    path: Folder = None,
) -> Loaded:
    """A trained policy; fixed gains need no file.

    `mark` is the step or episode of a kept policy (the last one if None), `seed` the position of
    one seed, for a leading axis of one (all seeds if None), `path` a checkpoint file in place of
    the shipped one.
    """
    file = find(study, name) if path is None else store.as_path("path", path)
    light = replace(study, config=study.light(study.config))
    if not study.method(name).trained:
        if path is not None:
            raise ValueError(f"path: {name!r} has fixed gains and no checkpoint, got {path}")
        return Loaded(light.build(name, [0]).acting(), 0, [0], [0])
    tensors, record = store.load_checkpoint(file, study=study.name, method=name)
    found, seeds = marks_of(tensors), record.get("seeds")
    if not (found and isinstance(seeds, list) and seeds):
        raise store.CheckpointError(f"{file}: wanted kept policies and seeds, found none")
    mark = found[-1] if mark is None else mark
    if mark not in found:
        raise ValueError(f"mark ({study.unit}): wanted one of {found}, got {mark}")
    if seed is not None and (isinstance(seed, bool) or seed not in range(len(seeds))):
        raise ValueError(f"seed: wanted a position from 0 to {len(seeds) - 1}, got {seed}")
    chosen = seeds if seed is None else [seeds[seed]]
    training = light.build(name, chosen)
    for part, module in training.actors().items():
        state = {}
        for key, wanted in module.state_dict().items():
            value, shape = tensors.get(f"{mark:08d}.{part}.{key}"), tuple(wanted.shape)
            if value is not None and seed is not None and value.size == len(seeds) * wanted.numel():
                value = value.reshape(len(seeds), *shape)[seed]
            if value is None or value.shape != shape:
                came = "none" if value is None else value.shape
                raise store.CheckpointError(f"{file}: shape of {key}: wanted {shape}, got {came}")
            state[key] = torch.from_numpy(value)
        module.load_state_dict(state)
        module.eval()
    return Loaded(training.acting(), mark, chosen, found)


def marks_of(tensors: Mapping[str, Any]) -> list[int]:
    """Steps or episodes of the kept policies among a checkpoint's tensors."""
    return sorted({int(start) for key in tensors if (start := key.split(".")[0]).isdigit()})


def find(study: Study, name: str, checkpoints: Folder = None) -> Path:
    """Checkpoint file of a method: in the folder, else the shipped one, else that of `runs`."""
    checked_study(study).method(name)
    file = f"{study.name}_{name}.safetensors"
    if checkpoints is not None:
        return store.as_path("checkpoints", checkpoints) / file
    try:
        return store.asset("checkpoints", file)
    except FileNotFoundError:
        return Path("runs") / study.name / file
