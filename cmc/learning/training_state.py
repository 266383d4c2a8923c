"""The whole state of a training: weights, Adam's moments, updates done. Exact to the bit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from cmc import store


class Training(Protocol):
    """What a training must offer to be saved and resumed."""

    parameters: dict[str, nn.Parameter]
    optimiser: torch.optim.Adam
    updates: int
    seeds: tuple[int, ...]


def take(training: Training) -> dict[str, np.ndarray]:
    """Copy the state out, by name.

    The weights are taken as they are, not through `state_dict`, which shows positive networks'
    weights by absolute value and would lose the sign that Adam's moments belong to.
    """
    state = {"updates": np.array(training.updates, dtype=np.int64)}
    for name, parameter in training.parameters.items():
        state[f"weight.{name}"] = parameter.detach().numpy().copy()
        for key, moment in training.optimiser.state.get(parameter, {}).items():
            state[f"{key}.{name}"] = moment.numpy().copy()
    return state


def put(training: Training, state: Mapping[str, np.ndarray]) -> None:
    """Put a state back that `take` returned.

    Raises:
        CheckpointError: if a tensor is missing or has another shape.
    """
    for name, parameter in training.parameters.items():
        found = state.get(f"weight.{name}")
        if found is None or found.shape != tuple(parameter.shape):
            raise store.CheckpointError(
                f"wanted a tensor {name!r} of shape {tuple(parameter.shape)}; "
                f"found {None if found is None else found.shape}"
            )
    with torch.no_grad():
        for name, parameter in training.parameters.items():
            parameter.copy_(torch.from_numpy(state[f"weight.{name}"]))
            shapes = {"step": (), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
            moments = {
                key: torch.from_numpy(state[f"{key}.{name}"].copy()).reshape(shape)
                for key, shape in shapes.items()
                if f"{key}.{name}" in state
            }
            training.optimiser.state.pop(parameter, None)
            if moments:
                training.optimiser.state[parameter] = moments
    training.updates = int(state["updates"].item())


def save(training: Training, path: str | Path, record: Mapping[str, Any]) -> None:
    """Write the state and its record as one safetensors file, atomically."""
    record = {"study": "none", "method": "none", **record}
    record |= {"seeds": list(training.seeds), "updates": training.updates, "kind": "training"}
    store.save_checkpoint(path, take(training), record)


def restore(training: Training, path: str | Path, record: Mapping[str, Any]) -> None:
    """Read a state back and check that it belongs to this training.

    Raises:
        CheckpointError: if the file is damaged, foreign, or of other seeds or settings.
    """
    state, found = store.load_checkpoint(path)
    if found.get("kind") != "training" or "updates" not in state:
        raise store.CheckpointError(f"{path} holds no training state")
    wanted = {**record, "seeds": list(training.seeds)}
    for key in ("study", "method", "seeds", "ppo"):
        if key in wanted and found.get(key) != _as_json(wanted[key]):
            raise store.CheckpointError(
                f"{path}: wanted a training with {key} {wanted[key]!r}, found {found.get(key)!r}"
            )
    put(training, state)


def _as_json(value: Any) -> Any:
    """What JSON makes of a value: tuples become lists."""
    if isinstance(value, Mapping):
        return {key: _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    return value
