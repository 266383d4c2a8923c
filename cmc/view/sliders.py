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
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import ipywidgets as widgets
import numpy as np

from cmc.view.canvas import Canvas, frame_table
from cmc.view.canvas import LiveCurve as LiveCurve
from cmc.view.picture import Panel, Source, encode
from cmc.view.picture import band as band
from cmc.view.picture import cells as cells
from cmc.view.picture import lines as lines
from cmc.view.picture import panel as panel
from cmc.view.picture import paths as paths
from cmc.view.picture import points as points
from cmc.view.picture import rule as rule
from cmc.view.picture import shade as shade

_DEBOUNCE = 0.004  # s: changes that came while a picture was made are answered by one more


@dataclass(frozen=True)
class Control:
    """What moves a picture; made by `slider`, `choice` or `toggle`.

    `values` are all that it can have, in order.
    """

    kind: type[widgets.ValueWidget]
    start: Any
    values: list[Any]
    label: str
    unit: str = ""
    more: dict[str, Any] = field(default_factory=dict)

    def widget(self, name: str, *, slow: bool) -> widgets.ValueWidget:
        """The control, under its label and unit."""
        slides = {"continuous_update": not slow} if self.is_slider else {}
        return self.kind(
            value=self.start,
            description=(self.label or name) + (f" ({self.unit})" if self.unit else ""),
            style={"description_width": "initial"},
            layout={"width": "28em"},
            **slides,
            **self.more,
        )

    @property
    def is_slider(self) -> bool:
        """Whether a number moves between two ends."""
        return self.kind in (widgets.IntSlider, widgets.FloatSlider)

    @property
    def probes(self) -> list[Any]:
        """Values that the callback must survive: the ends of a slider, or all."""
        return [self.values[0], self.values[-1]] if self.is_slider else self.values


def slider(
    low: float,
    high: float,
    start: float | None = None,
    *,
    step: float | None = None,
    label: str = "",
    unit: str = "",
) -> Control:
    """A slider from `low` to `high` that begins at `start` (the middle by default).

    `step` is what an arrow key adds: 1, or a hundredth of the range. Whole numbers throughout make
    an integer slider.
    """
    whole = isinstance(low, int) and isinstance(high, int) and isinstance(start, int | None)
    if step is None:
        step = 1 if whole else (high - low) / 100
    if start is None:
        start = (low + high) // 2 if whole else (low + high) / 2
    if not (np.isfinite([low, high, start, step]).all() and low <= start <= high and low < high):
        raise ValueError(f"wanted finite low <= start <= high, got {low}, {start}, {high}")
    if not 0 < step <= high - low:
        raise ValueError(f"wanted 0 < step <= {high - low}, got {step}")
    whole = whole and isinstance(step, int)
    low, high, start, step = map(int if whole else float, (low, high, start, step))
    steps = [low + k * step for k in range(int(np.ceil((high - low) / step - 1e-9)))]
    values = [v for v in (*steps, high) if abs(v - start) >= 1e-9 * (high - low)]
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    more: dict[str, Any] = {"min": low, "max": high, "step": step}
    more["readout_format"] = "d" if whole else f".{digits}f"
    kind = widgets.IntSlider if whole else widgets.FloatSlider
    return Control(kind, start, sorted([*values, start]), label, unit, more)


def choice(*options: Any, start: Any = None, label: str = "") -> Control:
    """A list to choose one of `options` from; the first one by default."""
    if len(options) < 2:
        raise ValueError(f"wanted at least two options, got {options}")
    start = options[0] if start is None else start
    if start not in options:
        raise ValueError(f"wanted a start among {options}, got {start!r}")
    return Control(widgets.Dropdown, start, list(options), label, more={"options": options})


def toggle(start: bool = False, *, label: str = "") -> Control:
    """A check box."""
    return Control(widgets.Checkbox, start, [False, True], label, more={"indent": True})


class Explorer(widgets.VBox):
    """Controls (by name) above a canvas that follows them; made by `explore`.

    `errors` holds one text for each time the callback failed after the first picture.
    """

    def __init__(
        self,
        callback: Callable[..., Mapping[str, Any]],
        canvas: Canvas,
        controls: Mapping[str, Control],
        slow: bool,
    ) -> None:
        self.callback, self.canvas = callback, canvas
        self.errors: list[str] = []
        self._wanted: asyncio.TimerHandle | None = None
        self._answered = 0.0  # when the last picture was done
        self.controls = {name: c.widget(name, slow=slow) for name, c in controls.items()}
        for values in _probes(controls, corners=not slow):
            self.evaluate(**values)  # raises: a broken callback fails the cell
        button = widgets.Button(
            description="Reset", tooltip="back to the first values", layout={"width": "6em"}
        )
        self._first = self.values
        button.on_click(lambda _: self.reset())
        for widget in self.controls.values():
            widget.observe(self._changed, "value")
        row = widgets.Box([*self.controls.values(), button], layout={"flex_flow": "row wrap"})
        super().__init__([row, self.canvas])
        # What the page needs to go on without a kernel, or to say that it cannot.
        canvas.controls = [widget.model_id for widget in self.controls.values()]
        canvas.values = [c.values if c.is_slider else None for c in controls.values()]

    @property
    def values(self) -> dict[str, Any]:
        """Present values of the controls."""
        return {name: widget.value for name, widget in self.controls.items()}

    def evaluate(self, **values: Any) -> Mapping[str, Any]:
        """Show what the callback makes of the controls' values, replaced by `values`."""
        data = self.callback(**{**self.values, **values})
        self.canvas.show(data)
        return data

    def reset(self) -> None:
        """Move every control back to its first value."""
        for name, widget in self.controls.items():
            widget.value = self._first[name]

    def _changed(self, _: Any) -> None:
        if self._wanted is not None:
            return
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:
            loop = None
        if loop is None or monotonic() - self._answered > _DEBOUNCE:
            self._refresh()  # at once: nothing has waited
        else:
            self._wanted = loop.call_later(_DEBOUNCE, self._refresh)

    def _refresh(self) -> None:
        self._wanted = None
        try:
            self.evaluate()
        except Exception as error:
            # A handler's exception would reach nobody: it is shown and kept instead.
            at = ", ".join(f"{name} = {value}" for name, value in self.values.items())
            self.errors.append(f"{_said(error)} (at {at})")
            self.canvas.error = self.errors[-1]
        self._answered = monotonic()


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
        frames: also make the pictures of all positions of the controls, so that exported HTML, a
            static site and a reopened notebook are live without a kernel; by default only where the
            environment variable CMC_EXPORT is 1, as it takes its time.
        controls: parameter name to `slider`, `choice` or `toggle`.
    """
    if not controls:
        raise ValueError("wanted at least one slider")
    canvas = Canvas(panels, describe, time)
    made = Explorer(callback, canvas, controls, slow)
    if os.environ.get("CMC_EXPORT", "0") not in ("", "0") if frames is None else frames:

        def picture(*values: Any) -> dict[str, Any]:
            try:
                return encode(panels, callback(**dict(zip(controls, values, strict=True))), time)
            except Exception as error:
                return {"error": _said(error)}

        starts = [c.values.index(c.start) for c in controls.values()]
        canvas.table = frame_table([c.values for c in controls.values()], starts, picture)
    return made


def _probes(controls: Mapping[str, Control], *, corners: bool) -> Iterator[dict[str, Any]]:
    """Values to try a callback with: each end alone, corners of up to three controls, the start.

    The start comes last, so that its picture is the one that stays.
    """
    start = {name: control.start for name, control in controls.items()}
    yield from ({**start, name: value} for name, c in controls.items() for value in c.probes)
    ends = [c.probes for c in controls.values()]
    if corners and 1 < len(ends) <= 3 and np.prod([len(values) for values in ends]) <= 16:
        yield from (dict(zip(controls, corner, strict=True)) for corner in itertools.product(*ends))
    yield start


def _said(error: Exception) -> str:
    return "".join(traceback.format_exception_only(error)).strip()
