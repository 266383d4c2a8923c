"""What a live picture is made of: panels of layers, encoded as frames.

`encode` turns panels and the mapping that a callback returned into one frame: a JSON-able layout
and one block of float32 bytes, which `canvas.js` draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmc.view.layers import Buffer, Data, Layer, PictureError, Source, get_array
from cmc.view.style import CYCLE


@dataclass(frozen=True)
class Panel:
    """Axes with layers; made by `panel`."""

    layers: tuple[Layer, ...]
    look: dict[str, Any]

    def encode(self, data: Data, buffer: Buffer) -> dict[str, Any]:
        """Return the panel's layout, with titles filled in and limits found."""
        made = [layer.encode(data, buffer) for layer in self.layers]
        look = dict(self.look)
        look["title"] = fill(look["title"], data)
        for k, axis in enumerate(("xlim", "ylim")):
            extents = [e[k] for _, e in made if len(e) == 2]
            look[axis] = list(look[axis] or limits(extents, log=bool(look["log"]) and k == 1))
        return {**look, "layers": [layout for layout, _ in made]}


def panel(
    *layers: Layer,
    x: str,
    y: str,
    title: str = "",
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    equal: bool = False,
    log: bool = False,
    size: tuple[int, int] = (420, 320),
) -> Panel:
    """Axes that hold layers; the first layers lie lowest.

    Args:
        layers: what to draw.
        x: label of the horizontal axis with its unit; `$y_1$` and the like are typeset.
        y: label of the vertical axis with its unit.
        title: title; `{key}` is filled from the callback's result, `{rate:.2f}` formatted.
        xlim: limits of the horizontal axis; from the data by default, so that it may jump.
        ylim: limits of the vertical axis.
        equal: one unit is equally long along both axes.
        log: the vertical axis is logarithmic.
        size: width and height in CSS pixels.
    """
    if not layers:
        raise PictureError("wanted at least one layer in the panel")
    colored = []
    cycle = iter(list(CYCLE) * 4)
    for layer in layers:
        look = dict(layer.look)
        if "color" in look and look["color"] is None:
            look["color"] = next(cycle)
        colored.append(Layer(layer.kind, layer.fetch, look))
    for name, given in (("xlim", xlim), ("ylim", ylim)):
        if given is not None and not (np.isfinite(given).all() and given[0] < given[1]):
            raise PictureError(f"{name}: wanted two finite rising numbers, got {given}")
    look = {"x": x, "y": y, "title": title, "xlim": xlim, "ylim": ylim}
    return Panel(tuple(colored), {**look, "equal": equal, "log": log, "size": list(size)})


def encode(panels: Sequence[Panel], data: Data, time: Source | None = None) -> dict[str, Any]:
    """Return one frame: layout of the panels, the status line, the times, and the bytes.

    Args:
        panels: the panels.
        data: what the callback returned; its entry `text`, if any, is shown as a status line.
        time: times (m,) of the time cursor, s; no cursor without them.

    Raises:
        PictureError: if a key is absent or an array has another shape than its layer wants.
    """
    if not isinstance(data, Mapping):
        raise PictureError(f"wanted a mapping of names to arrays, got {type(data).__name__}")
    buffer = Buffer()
    frame: dict[str, Any] = {"panels": [panel.encode(data, buffer) for panel in panels]}
    frame["text"] = str(data.get("text", ""))
    frame["time"] = None
    if time is not None:
        t = get_array(data, time)
        frame["time"] = {"at": buffer.add(t), "shape": list(t.shape)}
    frame["data"] = buffer.tobytes()
    return frame


def limits(extents: Sequence[np.ndarray], *, log: bool) -> tuple[float, float]:
    """Limits that hold all finite values (positive ones on a logarithmic axis), with a margin."""
    values = np.concatenate([np.ravel(e) for e in extents]) if extents else np.zeros(0)
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if values.size == 0:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high * 1e-12)
        return low / 1.5, high * 1.5
    margin = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
    return low - margin, high + margin


def fill(text: str, data: Data) -> str:
    """Fill `{key}` fields of a title, outside of `$...$`, from the numbers and words of `data`."""
    parts = text.split("$")  # every second part is mathematics, whose braces are its own
    if not any("{" in part for part in parts[::2]):
        return text
    plain = {
        key: value.item()
        if isinstance(value, np.ndarray | np.generic) and value.size == 1
        else value
        for key, value in data.items()
    }
    try:
        parts[::2] = [part.format(**plain) for part in parts[::2]]
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise PictureError(
            f"cannot fill the title {text!r} from {sorted(data)}: {error}"
        ) from error
    return "$".join(parts)
