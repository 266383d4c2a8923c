"""A picture for every position of the controls, packed small: sliders live without a kernel.

Where all combinations of the controls' values are few, each has its picture; else each control is
moved alone, the others at their start. Arrays become 16-bit shares of their range over all
pictures (small ones stay as they are), pictures become differences to the one before, high and low
bytes lie apart, and the whole is deflated. `frames.js` reads it.
"""

from __future__ import annotations

import itertools
import json
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint16]
LARGEST_GRID = 450
"""Most combinations that are all drawn; beyond, one control moves at a time."""

_EXACT = 64  # arrays of at most so many numbers travel as float32
_CODES = 65532  # shares of the range; the three codes above are -inf, inf and nan


def frame_table(
    values: Sequence[Sequence[Any]], starts: Sequence[int], picture: Callable[..., dict[str, Any]]
) -> dict[str, Any]:
    """Return pictures for the values of controls as a table that `frames.js` reads.

    Args:
        values: values of each control.
        starts: index of each control's first value.
        picture: from one index a control to a frame of `picture.encode`, or `{"error": text}`.
    """
    counts = [len(v) for v in values]
    full = int(np.prod(counts)) <= LARGEST_GRID
    frames = [picture(*index) for index in _positions(counts, starts, full)]
    blocks = [list(_blocks(frame)) for frame in frames]
    ranges = _ranges(blocks)
    words = [_words(found, ranges) for found in blocks]
    before = [np.zeros(0, np.uint16), *words[:-1]]
    changes = [w - b if w.size == b.size else w for w, b in zip(words, before, strict=True)]
    flat = np.concatenate(changes) if changes else np.zeros(0, np.uint16)
    halves = (flat >> 8).astype(np.uint8).tobytes() + (flat & 255).astype(np.uint8).tobytes()
    layouts = [{k: v for k, v in frame.items() if k != "data"} for frame in frames]
    return {
        "full": full,
        "counts": counts,
        "starts": list(starts),
        "ranges": [list(r) for r in ranges],
        "sizes": [int(w.size) for w in words],
        "layouts": zlib.compress(json.dumps(layouts, allow_nan=False).encode(), 9),
        "words": zlib.compress(halves, 9),
    }


def _positions(
    counts: Sequence[int], starts: Sequence[int], full: bool
) -> Iterator[tuple[int, ...]]:
    """Indices of the controls in the order of the table."""
    if full:
        yield from itertools.product(*map(range, counts))
        return
    for k, count in enumerate(counts):
        for i in range(count):
            yield (*starts[:k], i, *starts[k + 1 :])


def _blocks(frame: Mapping[str, Any]) -> Iterator[tuple[NDArray[np.float32], bool]]:
    """The arrays of a frame in the order of its bytes, and whether their axis is logarithmic."""
    if "error" in frame:
        return
    found = [
        (ref, bool(panel["log"]) and name in ("y", "y2"))
        for panel in frame["panels"]
        for layer in panel["layers"]
        for name, ref in layer.items()
        if isinstance(ref, dict) and "at" in ref
    ]
    if frame["time"]:
        found.append((frame["time"], False))
    numbers = np.frombuffer(frame["data"], np.float32)
    for ref, log in sorted(found, key=lambda item: item[0]["at"]):
        array = numbers[ref["at"] : ref["at"] + int(np.prod(ref["shape"]))]
        yield _logarithm(array) if log and array.size > _EXACT else array, log


def _logarithm(array: NDArray[np.float32]) -> NDArray[np.float32]:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(array > 0, np.log10(array), np.nan).astype(np.float32)


def _ranges(blocks: Sequence[Sequence[tuple[NDArray[np.float32], bool]]]) -> list[Any]:
    """Lowest and highest finite number of each block over all frames."""
    found: list[Any] = []
    for k in range(max(map(len, blocks), default=0)):
        parts = [frame[k][0] for frame in blocks if k < len(frame)]
        flat = np.concatenate([part[np.isfinite(part)] for part in parts])
        found.append((float(flat.min()), float(flat.max())) if flat.size else (0.0, 1.0))
    return found


def _words(blocks: Sequence[tuple[NDArray[np.float32], bool]], ranges: Sequence[Any]) -> Words:
    """One frame as 16-bit words."""
    out = [np.zeros(0, np.uint16)]
    for (array, _), (low, high) in zip(blocks, ranges, strict=False):
        if array.size <= _EXACT:
            out.append(array.view(np.uint16))
            continue
        with np.errstate(invalid="ignore"):
            share = (array.astype(float) - low) / ((high - low) or 1.0) * _CODES
            code = np.round(np.nan_to_num(share, nan=0, posinf=0, neginf=0)).astype(np.uint16)
        code[np.isneginf(array)], code[np.isposinf(array)] = _CODES + 1, _CODES + 2
        code[np.isnan(array)] = _CODES + 3
        out.append(code)
    return np.concatenate(out)
