"""The widget that draws frames in the browser, with a kernel or from a table without one.

A table holds a picture for every position of the controls. Where all combinations of the controls'
values are few, each has its picture; else each control is moved alone, the others at their start.
Large arrays are rounded to what the eye can tell, pictures become differences to the one before (of
their float32 as whole numbers), first to fourth bytes lie apart, and the whole is deflated.
`frames.js` reads it.
"""

from __future__ import annotations

import itertools
import json
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets
from numpy.typing import NDArray

from cmc.view.picture import Data, Panel, Source, encode, lines, panel

_FOLDER = Path(__file__).parent
STYLE = _FOLDER / "canvas.css"
SCRIPT = "".join((_FOLDER / name).read_text("utf-8") for name in ("frames.js", "canvas.js"))
"""The widget's module: `frames.js` and `canvas.js` in one."""

_LARGEST_GRID = 450  # most combinations that are all drawn; beyond, one control moves at a time
_EXACT = 64  # arrays of at most so many numbers are not rounded


class Canvas(anywidget.AnyWidget):
    """Panels drawn by the browser from arrays that the kernel sends.

    The browser draws the newest frame at its next repaint and skips those before. Without a kernel
    the pictures of `table` follow the widgets named in `controls`; without a table, `note` says
    that they are stale. `error`, if any, is shown beside the picture, which is then grayed.
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
        made = [lines("x", name, label=name if len(self.names) > 1 else "") for name in self.names]
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
    words = [_rounded(frame).view(np.uint32) for frame in frames]
    before = [np.zeros(0, np.uint32), *words[:-1]]
    changes = [w - b if w.size == b.size else w for w, b in zip(words, before, strict=True)]
    planes = np.concatenate(changes).astype("<u4").view(np.uint8).reshape(-1, 4).T
    layouts = [{k: v for k, v in frame.items() if k != "data"} for frame in frames]
    return {
        "full": full,
        "counts": [len(v) for v in values],
        "starts": list(starts),
        "sizes": [int(w.size) for w in words],
        "layouts": zlib.compress(json.dumps(layouts, allow_nan=False).encode(), 9),
        "words": zlib.compress(planes.tobytes(), 9),
    }


def _rounded(frame: Mapping[str, Any]) -> NDArray[np.float32]:
    """The numbers of a frame; in large arrays to 1/32768 of their axis, or 1/1024 where it is log.

    Steps are powers of two, so that the last bits are zeros, which deflate well.
    """
    numbers = np.frombuffer(frame.get("data", b""), np.float32).copy()
    for axes, layer in ((a, layer) for a in frame.get("panels", ()) for layer in a["layers"]):
        for name in layer.keys() & {"x", "y", "y2"}:
            at, size = layer[name]["at"], int(np.prod(layer[name]["shape"]))
            part, (low, high) = numbers[at : at + size], axes["xlim" if name == "x" else "ylim"]
            if size > _EXACT and axes["log"] and name != "x":
                mantissa, exponent = np.frexp(part)
                part[:] = np.ldexp(np.round(mantissa * 1024) / 1024, exponent)
            elif size > _EXACT:
                step = np.float32(2.0 ** np.floor(np.log2(high - low)) / 32768)
                part[:] = np.round(part / step) * step
    return numbers
