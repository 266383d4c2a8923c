"""Controls of a live picture: a number between two ends, one of several values, a check box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ipywidgets as widgets
import numpy as np


@dataclass(frozen=True)
class Slider:
    """A number to move between two ends; made by `slider`."""

    low: float
    high: float
    start: float
    step: float
    label: str
    unit: str

    @property
    def probes(self) -> list[Any]:
        """Values that the callback must survive: the ends."""
        return [self.low, self.high]

    @property
    def values(self) -> list[Any]:
        """All values that the control can have, its start among them, in order."""
        count = int(np.ceil((self.high - self.low) / self.step - 1e-9)) + 1
        steps = {min(self.low + k * self.step, self.high) for k in range(count)}
        near = {v for v in steps if abs(v - self.start) < 1e-9 * (self.high - self.low)}
        return sorted(steps - near | {self.start})

    def widget(self, name: str, *, slow: bool) -> widgets.ValueWidget:
        """Return the control, labeled by its unit."""
        unit = f" ({self.unit})" if self.unit else ""
        whole = all(isinstance(v, int) for v in (self.low, self.high, self.start, self.step))
        kind = widgets.IntSlider if whole else widgets.FloatSlider
        digits = max(0, int(np.ceil(-np.log10(self.step) - 1e-9)))
        return kind(
            value=self.start,
            min=self.low,
            max=self.high,
            step=self.step,
            description=f"{self.label or name}{unit}",
            continuous_update=not slow,
            readout_format="d" if whole else f".{digits}f",
            style={"description_width": "initial"},
            layout={"width": "28em"},
        )


@dataclass(frozen=True)
class Choice:
    """One of several values; made by `choice` or `toggle`."""

    options: tuple[Any, ...]
    start: Any
    label: str

    @property
    def is_box(self) -> bool:
        """Whether a check box shows it."""
        return len(self.options) == 2 and all(isinstance(o, bool) for o in self.options)

    @property
    def probes(self) -> list[Any]:
        """Values that the callback must survive: all of them."""
        return list(self.options)

    @property
    def values(self) -> list[Any]:
        """All values that the control can have, in order; a box is off, then on."""
        return [False, True] if self.is_box else list(self.options)

    def widget(self, name: str, *, slow: bool) -> widgets.ValueWidget:
        """Return the control: a check box for two truth values, a list otherwise."""
        kind: Any = widgets.Dropdown
        more: dict[str, Any] = {"options": self.options}
        if self.is_box:
            kind, more = widgets.Checkbox, {"indent": True}
        return kind(
            value=self.start,
            description=self.label or name,
            style={"description_width": "initial"},
            layout={"width": "28em"},
            **more,
        )


Control = Slider | Choice


def slider(
    low: float,
    high: float,
    start: float | None = None,
    *,
    step: float | None = None,
    label: str = "",
    unit: str = "",
) -> Slider:
    """A slider from `low` to `high` that begins at `start` (the middle by default).

    Whole numbers throughout make an integer slider.

    Args:
        low: lower end.
        high: upper end.
        start: first value.
        step: what an arrow key adds; 1, or a hundredth of the range.
        label: text before the slider; the parameter's name by default.
        unit: unit of the value.

    Raises:
        ValueError: if the numbers are not finite or not in order.
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
    if not whole or not isinstance(step, int):
        low, high, start, step = float(low), float(high), float(start), float(step)
    return Slider(low, high, start, step, label, unit)


def choice(*options: Any, start: Any = None, label: str = "") -> Choice:
    """A list to choose one of `options` from; the first one by default."""
    if len(options) < 2:
        raise ValueError(f"wanted at least two options, got {options}")
    start = options[0] if start is None else start
    if start not in options:
        raise ValueError(f"wanted a start among {options}, got {start!r}")
    return Choice(tuple(options), start, label)


def toggle(start: bool = False, *, label: str = "") -> Choice:
    """A check box."""
    return Choice((False, True), start, label)
