"""Sliders beside a picture that the browser draws. This module is the one door to live pictures.

    def motion(damping: float) -> dict:          # a plain function: numbers in, arrays out
        ...
        return {"t": t, "y": y, "text": f"rate {rate:.2f} 1/s"}

    explore(
        motion,
        panel(lines("t", "y"), x="time (s)", y="position (m)", ylim=(-2, 2)),
        damping=slider(0.0, 3.0, 0.5, unit="1/s"),
        describe="Twenty motions approach each other faster when damping grows.",
    )

The callback is called at once for the first values and for the ends of every slider, outside of
any handler: if it fails there, the cell fails. What fails later is shown beside the picture and
kept in `.errors`.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import ipywidgets as widgets
import numpy as np

from cmc.view.canvas import Canvas, LiveCurve
from cmc.view.controls import Choice, Control, Slider, choice, slider, toggle
from cmc.view.frames import frame_table
from cmc.view.layers import Source, arrows, band, cells, lines, paths, points, rule, shade
from cmc.view.picture import Panel, panel

__all__ = [
    "Choice",
    "Explorer",
    "LiveCurve",
    "Slider",
    "arrows",
    "band",
    "cells",
    "choice",
    "explore",
    "lines",
    "panel",
    "paths",
    "points",
    "rule",
    "shade",
    "slider",
    "toggle",
]

_DEBOUNCE = 0.004  # s: changes that wait in the kernel's queue are answered by one frame


class Explorer(widgets.VBox):
    """Controls above a canvas that follows them; made by `explore`.

    Attributes:
        canvas: the picture.
        controls: name to ipywidgets control.
        errors: one text for each time the callback failed after the first picture.
    """

    def __init__(
        self,
        callback: Callable[..., Mapping[str, Any]],
        panels: tuple[Panel, ...],
        controls: Mapping[str, Control],
        describe: str,
        time: Source | None = None,
        slow: bool = False,
        frames: bool = False,
    ) -> None:
        if not controls:
            raise ValueError("wanted at least one slider")
        self.callback = callback
        self.errors: list[str] = []
        self._wanted: asyncio.TimerHandle | None = None
        self.controls = {name: c.widget(name, slow=slow) for name, c in controls.items()}
        self.canvas = Canvas(panels, describe, time)
        for values in probes(controls, corners=not slow):
            self.evaluate(**values)  # raises: a broken callback fails the cell
        self._reset = widgets.Button(
            description="Reset", tooltip="back to the first values", layout={"width": "6em"}
        )
        self._reset.on_click(lambda _: self.reset())
        self._first = {name: widget.value for name, widget in self.controls.items()}
        for widget in self.controls.values():
            widget.observe(self._changed, "value")
        row = widgets.Box([*self.controls.values(), self._reset], layout={"flex_flow": "row wrap"})
        super().__init__([row, self.canvas])
        # What the page needs to go on without a kernel, or to say that it cannot.
        self.canvas.controls = [widget.model_id for widget in self.controls.values()]
        kinds = controls.values()
        self.canvas.values = [c.values if isinstance(c, Slider) else None for c in kinds]
        if frames:
            self.canvas.table = self._table(controls)

    @property
    def values(self) -> dict[str, Any]:
        """Present values of the controls."""
        return {name: widget.value for name, widget in self.controls.items()}

    def evaluate(self, **values: Any) -> Mapping[str, Any]:
        """Call the callback with the controls' values, replaced by `values`, and show the result.

        Raises:
            Exception: whatever the callback raises.
            PictureError: if its arrays do not fit the layers.
        """
        data = self.callback(**{**self.values, **values})
        self.canvas.show(data)
        return data

    def _table(self, controls: Mapping[str, Control]) -> dict[str, Any]:
        """Pictures for all positions of the controls; those that fail hold the error."""
        values = [control.values for control in controls.values()]
        starts = [v.index(c.start) for v, c in zip(values, controls.values(), strict=True)]

        def picture(*index: int) -> dict[str, Any]:
            chosen = {name: v[k] for name, v, k in zip(controls, values, index, strict=True)}
            try:
                return self.canvas.encode(self.callback(**chosen))
            except Exception as error:
                return {"error": "".join(traceback.format_exception_only(error)).strip()}

        return frame_table(values, starts, picture)

    def reset(self) -> None:
        """Move every control back to its first value."""
        for name, widget in self.controls.items():
            widget.value = self._first[name]

    def _changed(self, _: Any) -> None:
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            self._refresh()
            return
        if self._wanted is None:
            self._wanted = loop.call_later(_DEBOUNCE, self._refresh)

    def _refresh(self) -> None:
        self._wanted = None
        values = self.values
        try:
            self.evaluate()
        except Exception as error:
            # A handler's exception would reach nobody: it is shown and kept instead.
            said = "".join(traceback.format_exception_only(error)).strip()
            at = ", ".join(f"{name} = {value}" for name, value in values.items())
            self.errors.append(f"{said} (at {at})")
            self.canvas.fail(self.errors[-1])


def explore(
    callback: Callable[..., Mapping[str, Any]],
    *panels: Panel,
    describe: str,
    time: Source | None = None,
    slow: bool = False,
    frames: bool | None = None,
    **controls: Control,
) -> Explorer:
    """Show a picture that follows sliders.

    The callback takes the controls' values by name and returns a mapping of names to arrays; the
    panels' layers say which of them are drawn. Its entry `text` becomes the status line. It is
    called at once for the first values and the ends of the sliders, and errors are raised here.

    Args:
        callback: plain function, parameters to arrays.
        panels: what is drawn.
        describe: one sentence for readers who do not see the picture.
        time: key of the times (m,), s, of a time cursor: layers with `head` and dots or cells of
            shape (time, ...) follow it, and a button plays the motion.
        slow: answer only when a slider is released, and try fewer values at first.
        frames: also make the pictures of all positions of the controls (`frames.py`), so that
            exported HTML, a static site and a reopened notebook are live without a kernel; only
            where the environment variable CMC_EXPORT is 1 by default, as it takes its time.
        controls: parameter name to `slider`, `choice` or `toggle`.
    """
    if frames is None:
        frames = os.environ.get("CMC_EXPORT", "0") not in ("", "0")
    return Explorer(callback, panels, controls, describe, time, slow, frames)


def probes(controls: Mapping[str, Control], *, corners: bool) -> Iterator[dict[str, Any]]:
    """Values to try a callback with: each end alone, corners of up to three controls, the start.

    The start comes last, so that its picture is the one that stays.
    """
    start = {name: control.start for name, control in controls.items()}
    for name, control in controls.items():
        yield from ({**start, name: value} for value in control.probes)
    several = 1 < len(controls) <= 3
    if corners and several and np.prod([len(c.probes) for c in controls.values()]) <= 16:
        for ends in itertools.product(*(c.probes for c in controls.values())):
            yield dict(zip(controls, ends, strict=True))
    yield start
