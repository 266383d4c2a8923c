"""Train a study's methods, load what they learned, test it, and ship it.

A run is a folder. `STUDY_METHOD.safetensors` holds the kept policies (tensors `MARK.PART.NAME`) and
the learning curve, `METHOD_state.safetensors` the whole state of the training. Both are written at
every kept policy, at least every minute, and on an interrupt; a run that was stopped goes on from
there to the same end, bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cmc import store
from cmc.learning.state import interruptions, single_thread
from cmc.studies.study import Study

Callback = Callable[[dict[str, Any]], object]
Progress = Callable[[int, int, str], object]
Folder = str | Path | None
SAVE_EVERY = 60.0
"""Longest time between two savings of a training, s."""


# -- training -------------------------------------------------------------------------------------


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

    Args:
        study: what is trained.
        name: one of its methods.
        seeds: one training for each, all in one batch of networks.
        length: steps or episodes of each seed, in place of the study's.
        out: folder of the run, by default `runs/STUDY`.
        callback: called after every segment with `done`, `total`, `gain` (seeds,) and, where the
            training knows it, `success` (seeds,), the share of the latest finished episodes.

    Returns:
        The checkpoint file with all kept policies, which `load` reads.

    Raises:
        ValueError: for an unknown method, one without training, no seed or no length.
        CheckpointError: if the folder holds a run of other seeds or another configuration.
        KeyboardInterrupt: on SIGINT and SIGTERM, once everything is saved.
    """
    total = study.length if length is None else length
    if total < 1:
        raise ValueError(f"{study.unit}s: wanted at least 1, got {total}")
    if not study.method(name).trained:
        raise ValueError(f"{name!r} has fixed gains: there is nothing to train")
    training = study.build(name, list(seeds))
    folder = Path(out) if out is not None else Path("runs") / study.name
    packed = folder / f"{study.name}_{name}.safetensors"
    state = folder / f"{name}_state.safetensors"
    record = _record(study, name, seeds, total)
    identity = {key: record[key] for key in ("study", "method", "configuration")}
    kept, curve = _resumed(packed, state, record)
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
    advice = "use another folder (--out), or move it away"
    for key, value in (("seeds", record["seeds"]), ("configuration", record["configuration"])):
        if found.get(key) != value:
            what = f"seeds {found.get(key)}, not {value}" if key == "seeds" else f"another {key}"
            raise store.CheckpointError(f"{packed} is a run of {what}: {advice}")
    curve = [row for key in ("rewards", "returns") for row in kept.pop(key, ())]
    if not state.is_file():
        raise store.CheckpointError(
            f"{packed} has lost its {state.name}, so it ends here: {advice}"
        )
    return kept, curve


def _mark(study: Study, done: int, stride: int, total: int) -> int | None:
    """The step under which the present policy is kept, if it is."""
    every, last = study.every, done >= total
    if last and done % every >= stride:
        return done
    crossed = done // every > (done - stride) // every
    return done // every * every if last or crossed else None


def _weights(training: Any, mark: int) -> dict[str, np.ndarray]:
    """Weights that act, by the names that `load` looks for."""
    return {
        f"{mark:08d}.{part}.{key}": value.detach().numpy().copy()
        for part, module in training.actors().items()
        for key, value in module.state_dict().items()
    }


def _record(study: Study, name: str, seeds: Sequence[int], total: int) -> dict[str, Any]:
    command = f"python -m cmc train {study.name} --method {name} --seeds {len(seeds)}"
    made = store.provenance(f"{command} --{study.unit}s {total}", [int(seed) for seed in seeds])
    settings = {"every": study.every, **plain(study.config_of(name))}
    return {"study": study.name, "method": name, "configuration": settings, **made}


def plain(value: Any) -> Any:
    """What JSON makes of a configuration: dataclasses become objects, arrays and tuples lists."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, type) or callable(value):
        return value.__name__
    return [plain(item) for item in value] if isinstance(value, (tuple, list)) else value


# -- what was learned -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Loaded:
    """A kept policy of all seeds, or of one.

    Attributes:
        policy: as the study's tests take it, with a leading axis of seeds.
        mark: its step or episode; 0 for fixed gains.
        seeds: the trainings.
        record: of the run.
    """

    policy: Any
    mark: int
    seeds: list[int]
    record: dict[str, Any]


def load(
    study: Study,
    name: str,
    mark: int | None = None,
    *,
    seed: int | None = None,
    path: Folder = None,
) -> Loaded:
    """A trained policy; fixed gains need no file.

    Args:
        study: of the policy.
        name: method.
        mark: step or episode of a kept policy; the last one if None.
        seed: position of one seed, for a leading axis of one; None for all seeds.
        path: checkpoint file; the shipped one if None.

    Raises:
        ValueError: for an unknown method, step or seed.
        FileNotFoundError: if no file is given and none is shipped.
        CheckpointError: if the file is damaged, foreign, or of another study or method.
    """
    light = replace(study, config=study.light(study.config))
    if not study.method(name).trained:
        return Loaded(light.build(name, [0]).acting(), 0, [0], {})
    file = find(study, name) if path is None else Path(path)
    tensors, record = store.load_checkpoint(file, study=study.name, method=name)
    found = marks_of(tensors)
    seeds = record.get("seeds")
    if not (found and isinstance(seeds, list) and seeds):
        raise store.CheckpointError(f"{file}: wanted kept policies and seeds, found none")
    mark = found[-1] if mark is None else mark
    if mark not in found:
        raise ValueError(f"{study.unit}: wanted one of {found}, got {mark}")
    if seed is not None and not 0 <= seed < len(seeds):
        raise ValueError(f"seed: wanted a position from 0 to {len(seeds) - 1}, got {seed}")
    chosen = seeds if seed is None else [seeds[seed]]
    training = light.build(name, chosen)
    for part, module in training.actors().items():
        starts = (f"{mark:08d}.{part}.", f"{mark:06d}.")  # the second is an older form
        state = {
            key.removeprefix(start): torch.from_numpy(value)
            for start in starts
            for key, value in tensors.items()
            if key.startswith(start)
        }
        _put(module, state, len(seeds), seed, file)
    return Loaded(training.acting(), mark, chosen, record)


def _put(module: Any, state: dict[str, Any], seeds: int, seed: int | None, file: Path) -> None:
    """Give a network its weights; constants that the file lacks follow from the configuration."""
    own, fitted = module.state_dict(), {}
    for key, value in state.items() if own else ():
        # older files say `net` for `network`, and leave the layers of a planner unnamed
        names = (key, key.replace("net.", "network.", 1), key.replace("net.", "network.mlp.", 1))
        name = next((name for name in names if name in own), None)
        if name is None:
            raise store.CheckpointError(f"{file}: wanted tensors {sorted(own)}, got {key!r}")
        if seed is not None and value.numel() == seeds * own[name].numel():
            value = value.reshape(seeds, *own[name].shape)[seed]
        if value.shape != own[name].shape:
            shapes = f"wanted {tuple(own[name].shape)}, got {tuple(value.shape)}"
            raise store.CheckpointError(f"{file}: shape of {name}: {shapes}")
        fitted[name] = value
    if missing := {key for key, _ in module.named_parameters()} - set(fitted):
        raise store.CheckpointError(f"{file}: lacks tensors {sorted(missing)}")
    module.load_state_dict(fitted, strict=False)
    module.eval()


def marks_of(tensors: Mapping[str, Any]) -> list[int]:
    """Steps or episodes of the kept policies among a checkpoint's tensors."""
    return sorted({int(start) for key in tensors if (start := key.split(".")[0]).isdigit()})


def find(study: Study, name: str, checkpoints: Folder = None) -> Path:
    """Checkpoint file of a method: in the folder, else the shipped one, else that of `runs`.

    Raises:
        ValueError: for an unknown method.
    """
    study.method(name)
    file = f"{study.name}_{name}.safetensors"
    if checkpoints is not None:
        return Path(checkpoints) / file
    try:
        return store.asset("checkpoints", file)
    except FileNotFoundError:
        return Path("runs") / study.name / file
