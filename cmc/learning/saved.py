"""Files of unfinished trainings on tasks: what they hold, and what is refused."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from cmc import store


def save_training(
    path: str | Path,
    arrays: Mapping[str, np.ndarray],
    record: Mapping[str, Any],
    seeds: Sequence[int],
    state: Mapping[str, Any],
) -> None:
    """Write arrays and state of a training, atomically; `state` holds its `settings`."""
    made = {"study": "none", "method": "none", **record, "seeds": list(seeds)}
    store.save_checkpoint(path, arrays, {**made, "kind": "training", "state": dict(state)})


def saved_training(
    path: str | Path, record: Mapping[str, Any], seeds: Sequence[int], settings: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `save_training` wrote.

    Raises:
        CheckpointError: if the file is damaged, or of another training, seeds or settings.
    """
    arrays, found = store.load_checkpoint(path)
    wanted = {**record, "seeds": list(seeds), "kind": "training"}
    for key, value in wanted.items():
        if found.get(key) != value:
            raise store.CheckpointError(
                f"{path}: wanted a training with {key} {value!r}, found {found.get(key)!r}"
            )
    state = found["state"]
    plain = {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}
    if state["settings"] != plain:
        raise store.CheckpointError(f"{path}: was trained with {state['settings']}")
    return arrays, state


@contextmanager
def interruptions() -> Iterator[Callable[[], bool]]:
    """Hold SIGINT and SIGTERM back, so that a training stops between two steps, once it is saved.

    Yields:
        A function that tells whether one came. Outside the main thread signals stay as they are.
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
