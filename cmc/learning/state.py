"""A training between two steps: its whole state in a file, its interruptions, its one thread.

What is written decides everything that follows: a training that was stopped, or killed, and goes
on from its file ends with the weights, bit for bit, of one that was not.
"""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc import store

Arrays = dict[str, np.ndarray]
State = tuple[Arrays, dict[str, Any]]
"""Arrays by name, and what JSON can hold."""
Learners = list[tuple[Mapping[str, nn.Parameter], torch.optim.Optimizer | None]]
"""Weights by name, and their Adam if they have one."""


class Kept:
    """Something whose state goes into a file.

    Attributes:
        kept: names of attributes that decide what follows: numbers, arrays, lists of random
            generators (None, "numbers"), and parts that are `Kept` themselves.
    """

    kept: tuple[str, ...] = ()

    def learners(self) -> Learners:
        """Networks that decide what follows."""
        return []

    def state(self) -> State:
        """Everything that decides what follows."""
        arrays: Arrays = {}
        record: dict[str, Any] = {}
        for parameters, adam in self.learners():
            # as they are: `state_dict` shows those of positive networks by absolute value
            for name, parameter in parameters.items():
                arrays[name] = parameter.detach().numpy().copy()
                for key, moment in adam.state.get(parameter, {}).items() if adam else ():
                    arrays[f"{name}/{key}"] = moment.numpy().copy()
        for name in self.kept:
            value = getattr(self, name)
            if isinstance(value, Kept):
                found, record[name] = value.state()
                arrays |= {f"{name}/{key}": array for key, array in found.items()}
            elif isinstance(value, np.ndarray):
                arrays[name] = value.copy()
            elif isinstance(value, list):
                record[name] = [generator.bit_generator.state for generator in value]
            else:
                record[name] = value
        return arrays, record

    @torch.no_grad()
    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`; a CheckpointError if tensors are missing or of another shape."""
        for parameters, adam in self.learners():
            for name, parameter in parameters.items():
                found, shape = arrays.get(name), tuple(parameter.shape)
                if found is None or found.shape != shape:
                    came = None if found is None else found.shape
                    raise store.CheckpointError(f"{name}: wanted shape {shape}, found {came}")
                parameter.copy_(torch.from_numpy(found))
                if adam is not None:  # files hold no scalars: a step count has come back as (1,)
                    moments = under(arrays, f"{name}/").items()
                    adam.state[parameter] = {
                        key: torch.tensor(value).reshape(() if key == "step" else shape)
                        for key, value in moments
                    }
        for name in self.kept:
            value = getattr(self, name)
            if isinstance(value, Kept):
                value.restore(under(arrays, f"{name}/"), record[name])
            elif isinstance(value, np.ndarray):
                value[:] = arrays[name]
            elif isinstance(value, list):
                for generator, stands in zip(value, record[name], strict=True):
                    generator.bit_generator.state = stands
            else:
                setattr(self, name, record[name])


class Resumable(Kept):
    """A training that can be written to a file and go on from it.

    Attributes:
        seeds: one integer for each training of the stack.
        config: a dataclass; a file of other settings is refused.
    """

    seeds: tuple[int, ...]
    config: Any

    def save(self, path: str | Path, record: Mapping[str, Any] | None = None) -> None:
        """Write the state, and in `record` study, method, and what else a file must agree with."""
        arrays, state = self.state()
        made = {"study": "none", "method": "none", **self._identity(record)}
        store.save_checkpoint(path, arrays, {**made, "kind": "training", "state": state})

    def _identity(self, record: Mapping[str, Any] | None) -> dict[str, Any]:
        """What a file must agree with."""
        own = {"seeds": list(self.seeds), "settings": asdict(self.config)}
        return dict(plain({**(record or {}), **own}))

    def load(self, path: str | Path, record: Mapping[str, Any] | None = None) -> None:
        """Go on from a file; a CheckpointError if it is damaged or of another training."""
        arrays, found = store.load_checkpoint(path)
        if found.get("kind") != "training":
            raise store.CheckpointError(f"{path} holds no training state")
        for key, value in self._identity(record).items():
            if found.get(key) != value:
                said = f"wanted a training with {key} {value!r}, found {found.get(key)!r}"
                raise store.CheckpointError(f"{path}: {said}")
        self.restore(arrays, found["state"])


def under(arrays: Mapping[str, np.ndarray], start: str) -> Arrays:
    """The arrays whose names begin with `start`, without it."""
    return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}


def plain(value: Any) -> Any:
    """What JSON makes of a value: tuples and arrays become lists, and classes their names."""
    text = json.dumps(value, default=lambda x: x.tolist() if hasattr(x, "tolist") else x.__name__)
    return json.loads(text)


@contextmanager
def interruptions() -> Iterator[Callable[[], bool]]:
    """Hold SIGINT and SIGTERM back, so that a training stops between two steps, once it is saved.

    Yields a function that tells whether one came; outside the main thread signals stay as they are.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def single_thread() -> Iterator[None]:
    """Keep torch to one thread: on products this small more threads only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
