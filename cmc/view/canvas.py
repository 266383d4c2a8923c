"""The widget that draws frames in the browser, and a live curve on top of it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets

from cmc.view.layers import Data, Source, lines
from cmc.view.picture import Panel, encode, panel
from cmc.view.style import CYCLE

_FOLDER = Path(__file__).parent
STYLE = _FOLDER / "canvas.css"
SCRIPT = "".join((_FOLDER / name).read_text("utf-8") for name in ("frames.js", "canvas.js"))
"""The widget's module: `frames.js` and `canvas.js` in one."""


class Canvas(anywidget.AnyWidget):
    """Panels drawn by the browser from arrays that the kernel sends.

    A frame is sent whole; the browser draws the newest one at its next repaint, so that frames
    which arrive faster than they can be drawn are skipped. Without a kernel the pictures of `table`
    (`frames.py`) follow the widgets named in `controls`; without those, `note` says that the
    picture is stale.
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
        self._panels, self._time, self._serial = tuple(panels), time, 0

    def show(self, data: Data) -> None:
        """Send a frame made of `data`, and take back an earlier error.

        Raises:
            PictureError: if the data do not fit the layers; nothing is sent then.
        """
        frame = self.encode(data)
        self._serial += 1
        with self.hold_sync():
            self.frame = {"serial": self._serial, **frame}
            self.error = ""

    def encode(self, data: Data) -> dict[str, Any]:
        """The frame that shows `data`."""
        return encode(self._panels, data, self._time)

    def fail(self, message: str) -> None:
        """Show an error beside the picture, which is kept but grayed."""
        self.error = message


class LiveCurve(Canvas):
    """A curve that grows while a training loop runs: call `add` from its callback.

    At most ten frames a second are sent, so that drawing does not slow the training.
    """

    def __init__(
        self,
        names: Sequence[str] = ("return",),
        *,
        x: str = "environment steps",
        y: str = "return",
        describe: str = "A learning curve that grows while the training runs.",
        period: float = 0.1,
    ) -> None:
        self.names = tuple(names)
        self._x: list[float] = []
        self._y: dict[str, list[float]] = {name: [] for name in self.names}
        self._period, self._sent = period, -np.inf
        made = [
            lines("x", name, color=CYCLE[k % len(CYCLE)], label=name if len(self.names) > 1 else "")
            for k, name in enumerate(self.names)
        ]
        super().__init__([panel(*made, x=x, y=y, size=(560, 300))], describe)
        self.show(self.arrays())

    def add(self, x: float, *values: float, **named: float) -> None:
        """Append one point to every curve; a curve without a value gets a gap.

        Args:
            x: abscissa.
            values: values in the order of the names.
            named: values by name.

        Raises:
            ValueError: if there are more values than names, or a name is unknown.
        """
        unknown = set(named) - set(self.names)
        if unknown or len(values) > len(self.names):
            raise ValueError(f"wanted values of {self.names}, got {values} and {sorted(named)}")
        given: Mapping[str, float] = {**dict(zip(self.names, values, strict=False)), **named}
        self._x.append(float(x))
        for name in self.names:
            self._y[name].append(float(given.get(name, np.nan)))
        now = time.monotonic()
        if now - self._sent >= self._period:
            self._sent = now
            self.show(self.arrays())

    def finish(self, text: str = "") -> None:
        """Draw the last points, with a closing line of text."""
        self.show({**self.arrays(), "text": text})

    def arrays(self) -> dict[str, Any]:
        """Return the points so far: `x` and one array a name."""
        if not self._x:
            return {"x": np.full(1, np.nan), **{name: np.full(1, np.nan) for name in self.names}}
        return {"x": np.array(self._x), **{name: np.array(y) for name, y in self._y.items()}}
