"""The widget that draws frames in the browser, with a kernel or from a table without one.

A table holds a picture for every position of the controls. Where all combinations of the controls'
values are few, each has its picture; else each control is moved alone, the others at their start.
Arrays become 16-bit shares of their range over all pictures (small ones stay as they are), pictures
become differences to the one before, high and low bytes lie apart, and the whole is deflated.
`frames.js` reads it.
"""

from __future__ import annotations

import itertools
import json
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets
from numpy.typing import NDArray

from cmc.view.picture import Data, Panel, Source, encode, lines, panel
from cmc.view.style import CYCLE

_FOLDER = Path(__file__).parent
STYLE = _FOLDER / "canvas.css"
SCRIPT = "".join((_FOLDER / name).read_text("utf-8") for name in ("frames.js", "canvas.js"))
"""The widget's module: `frames.js` and `canvas.js` in one."""

_LARGEST_GRID = 450  # most combinations that are all drawn; beyond, one control moves at a time
_EXACT = 64  # arrays of at most so many numbers travel as float32
_CODES = 65532  # shares of the range; the three codes above are -inf, inf and nan


class Canvas(anywidget.AnyWidget):
    """Panels drawn by the browser from arrays that the kernel sends.

    A frame is sent whole; the browser draws the newest one at its next repaint, so that frames
    which arrive faster than they can be drawn are skipped. Without a kernel the pictures of `table`
    follow the widgets named in `controls`; without those, `note` says that the
    picture is stale. `error`, if any, is shown beside the picture, which is then grayed.
    """

    _esm = SCRIPT
    _css = STYLE
    frame = traitlets.Dict().tag(sync=True)
    description = traitlets.Unicode().tag(sync=True)
    error = traitlets.Unicode().tag(sync=True)
    note = traitlets.Unicode().tag(sync=True)
    controls = traitlets.List(traitlets.Unicode()).tag(sync=True)
    values: traitlets.List[Any] = traitlets.List().tag(sync=True)
    table: traitlets.Dict[str, Any] = traitlets.Dict().tag(sync=True)

    def __init__(
        self, panels: Sequence[Panel], description: str, time: Source | None = None
    ) -> None:
        if not description.strip():
            raise ValueError("wanted a description of the picture, for readers who do not see it")
        super().__init__(description=description)
        self.panels, self.time, self._serial = tuple(panels), time, 0

    def show(self, data: Data) -> None:
        """Send a frame made of `data`, if they fit the layers, and take back an earlier error."""
        frame = encode(self.panels, data, self.time)
        self._serial += 1
        with self.hold_sync():
            self.frame = {"serial": self._serial, **frame}
            self.error = ""


class LiveCurve(Canvas):
    """A curve that grows while a training loop runs: call `add` from its callback.

    At most ten frames a second are sent, so that drawing does not slow the training.
    """

    def __init__(
        self, names: Sequence[str] = ("return",), *, x: str = "environment steps", y: str = "return"
    ) -> None:
        self.names, self._sent = tuple(names), -np.inf
        self._points: dict[str, list[float]] = {name: [] for name in ("x", *self.names)}
        made = [
            lines("x", name, color=CYCLE[k % len(CYCLE)], label=name if len(self.names) > 1 else "")
            for k, name in enumerate(self.names)
        ]
        describe = "A learning curve that grows while the training runs."
        super().__init__([panel(*made, x=x, y=y, size=(560, 300))], describe)
        self.finish()

    def add(self, x: float, *values: float, **named: float) -> None:
        """Append one point to every curve, by order or by name; one without a value gets a gap."""
        if len(values) > len(self.names) or not named.keys() <= set(self.names):
            raise ValueError(f"wanted values of {self.names}, got {values} and {sorted(named)}")
        given = {"x": x, **dict(zip(self.names, values, strict=False)), **named}
        for name, curve in self._points.items():
            curve.append(float(given.get(name, np.nan)))
        if time.monotonic() - self._sent >= 0.1:
            self._sent = time.monotonic()
            self.finish()

    def finish(self, text: str = "") -> None:
        """Draw the last points, with a closing line of text."""
        points = {name: np.array(c or [np.nan]) for name, c in self._points.items()}
        self.show({**points, "text": text})


def frame_table(
    values: Sequence[Sequence[Any]], starts: Sequence[int], picture: Callable[..., dict[str, Any]]
) -> dict[str, Any]:
    """Pictures for the values of controls as a table that `frames.js` reads.

    `starts` are the indices of the controls' first values; `picture` makes one value a control a
    frame of `picture.encode`, or `{"error": text}`.
    """
    full = int(np.prod([len(v) for v in values])) <= _LARGEST_GRID
    start = [v[k] for v, k in zip(values, starts, strict=True)]
    alone = ([*start[:k], v, *start[k + 1 :]] for k, each in enumerate(values) for v in each)
    frames = [picture(*each) for each in (itertools.product(*values) if full else alone)]
    blocks = [list(_blocks(frame)) for frame in frames]
    ranges = [_range([f[k] for f in blocks if k < len(f)]) for k in range(max(map(len, blocks)))]
    words = [_words(found, ranges) for found in blocks]
    before = [np.zeros(0, np.uint16), *words[:-1]]
    changes = [w - b if w.size == b.size else w for w, b in zip(words, before, strict=True)]
    flat = np.concatenate(changes)
    halves = (flat >> 8).astype(np.uint8).tobytes() + (flat & 255).astype(np.uint8).tobytes()
    layouts = [{k: v for k, v in frame.items() if k != "data"} for frame in frames]
    return {
        "full": full,
        "counts": [len(v) for v in values],
        "starts": list(starts),
        "ranges": ranges,
        "sizes": [int(w.size) for w in words],
        "layouts": zlib.compress(json.dumps(layouts, allow_nan=False).encode(), 9),
        "words": zlib.compress(halves, 9),
    }


def _blocks(frame: Mapping[str, Any]) -> Iterator[NDArray[np.float32]]:
    """The arrays of a frame in the order of its bytes; large ones on a log axis as logarithms."""
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
        if log and array.size > _EXACT:
            with np.errstate(divide="ignore", invalid="ignore"):
                array = np.where(array > 0, np.log10(array), np.nan).astype(np.float32)
        yield array


def _range(parts: Sequence[NDArray[np.float32]]) -> list[float]:
    """Lowest and highest finite number of one block over all frames."""
    flat = np.concatenate([part[np.isfinite(part)] for part in parts])
    return [float(flat.min()), float(flat.max())] if flat.size else [0.0, 1.0]


def _words(blocks: Sequence[NDArray[np.float32]], ranges: Sequence[Any]) -> NDArray[np.uint16]:
    """One frame as 16-bit words."""
    out = [np.zeros(0, np.uint16)]
    for array, (low, high) in zip(blocks, ranges, strict=False):
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
