"""Training runs of the two peg studies: policies kept on the way, exact resume, loading."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc import store
from cmc.learning.low_level import Fixed
from cmc.learning.state import interruptions, plain, single_thread
from cmc.studies.old.two_level import Callback, TwoLevelStudy
from cmc.studies.old.two_level_parts import Trainer, build, frozen

SAVE_EVERY = 100.0
"""Seconds of wall time between two saves of a training's state."""


def train(
    study: TwoLevelStudy,
    name: str,
    seeds: Sequence[int] = range(5),
    *,
    steps: int | None = None,
    out: str | Path | None = None,
    callback: Callback | None = None,
) -> Path:
    """Train a method and keep its policies; a run that was stopped goes on where it was.

    Everything is saved at each kept policy, every `SAVE_EVERY` seconds, and on SIGINT and SIGTERM.

    Args:
        study: configuration.
        name: one of the study's methods.
        seeds: one training for each, all in one batch of networks.
        steps: environment steps of each seed, in place of the study's.
        out: folder of the run, by default `runs/STUDY`.
        callback: called after every segment with `steps`, `total_steps` and `reward` (seeds,).

    Returns:
        The checkpoint file with all kept policies, which `load` reads.

    Raises:
        ValueError: for an unknown method, or no seed.
        CheckpointError: if the folder holds a run of another configuration.
        KeyboardInterrupt: on SIGINT and SIGTERM, once the state is saved.
    """
    total = study.steps if steps is None else steps
    if total < 1:
        raise ValueError(f"steps: wanted at least 1, got {total}")
    trainer = build(study, name, list(seeds))
    study = study.of(name)
    folder = Path(out) if out is not None else Path("runs") / study.name
    packed = folder / f"{study.name}_{name}.safetensors"
    state = folder / f"{name}_state.safetensors"
    record = _record(study, name, seeds, total)
    kept: dict[str, np.ndarray] = {}
    curve: list[np.ndarray] = []
    if state.is_file() and packed.is_file():
        trainer.load(state, _identity(record))
        kept, _ = store.load_checkpoint(packed, study=study.name, method=name)
        curve = list(kept.pop("rewards"))[: trainer.steps // trainer.stride]

    def save() -> None:
        store.save_checkpoint(packed, {**kept, "rewards": np.array(curve)}, record)
        trainer.save(state, _identity(record))

    every, saved = study.snapshot_every, time.monotonic()
    with interruptions() as interrupted:
        while trainer.steps < total:
            with single_thread():
                reward = trainer.segment()
            curve.append(reward.astype(np.float32))
            done = trainer.steps
            last = done >= total
            keep = last or done // every > (done - trainer.stride) // every
            if keep:
                mark = done if last and done % every >= trainer.stride else done // every * every
                for key, value in _weights(trainer).items():
                    kept[f"{mark:08d}.{key}"] = value
            try:
                if callback is not None:
                    callback({"steps": done, "total_steps": total, "reward": reward})
            except KeyboardInterrupt:
                save()
                raise
            if keep or interrupted() or time.monotonic() - saved > SAVE_EVERY:
                save()
                saved = time.monotonic()
            if interrupted():
                raise KeyboardInterrupt(f"{name}: stopped and saved at step {done}")
    return packed


def _weights(trainer: Trainer) -> dict[str, np.ndarray]:
    """Weights of both actors."""
    return {
        f"{part}.{key}": value.numpy().copy()
        for part, module in trainer.actors().items()
        for key, value in module.state_dict().items()
    }


def _identity(record: dict[str, Any]) -> dict[str, Any]:
    return {key: record[key] for key in ("study", "method", "configuration")}


def _record(study: TwoLevelStudy, name: str, seeds: Sequence[int], total: int) -> dict[str, Any]:
    command = f"python -m cmc train {study.name} --method {name} --seeds {len(seeds)}"
    command += f" --steps {total}"
    settings = asdict(replace(study, steps=0, episodes=0))
    settings["task_class"] = study.task_class.__name__
    made = store.provenance(command, [int(seed) for seed in seeds])
    return {"study": study.name, "method": name, "configuration": plain(settings), **made}


def checkpoint_path(study: TwoLevelStudy, name: str) -> Path:
    """The shipped checkpoints of a method."""
    study.method(name)
    return store.asset("checkpoints", f"{study.name}_{name}.safetensors")


def marks(study: TwoLevelStudy, name: str, path: str | Path | None = None) -> list[int]:
    """Environment steps of which policies are kept."""
    tensors, _ = store.load_checkpoint(
        path or checkpoint_path(study, name), study=study.name, method=name
    )
    return sorted({int(key.split(".")[0]) for key in tensors if key[0].isdigit()})


def load(
    study: TwoLevelStudy, name: str, step: int | None = None, path: str | Path | None = None
) -> tuple[nn.Module, Fixed, dict[str, Any]]:
    """Planner and low level of all seeds as trained, and the record of the run.

    Args:
        study: configuration.
        name: method.
        step: which of the kept policies; the last one if None.
        path: checkpoint file; the shipped one if None.

    Raises:
        ValueError: for an unknown method or step.
        CheckpointError: if the file is damaged, foreign, or of another study or method.
    """
    path = path or checkpoint_path(study, name)
    tensors, record = store.load_checkpoint(path, study=study.name, method=name)
    found = marks(study, name, path)
    mark = found[-1] if step is None else step
    if mark not in found:
        raise ValueError(f"step: wanted one of {found}, got {step}")
    trainer = build(
        replace(study, hierarchy=replace(study.hierarchy, worlds=1)), name, record["seeds"]
    )
    for part, module in trainer.actors().items():
        start = f"{mark:08d}.{part}."
        state = {
            key.removeprefix(start): torch.from_numpy(value)
            for key, value in tensors.items()
            if key.startswith(start) and not key.endswith(".net.gain")  # once a weight
        }
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise store.CheckpointError(
                f"{path}: the weights do not fit this study: {error}"
            ) from error
    planner = trainer.actors()["planner"]
    return planner.eval(), frozen(trainer.low), record
