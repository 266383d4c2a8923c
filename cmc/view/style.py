"""One look for every figure, and one line of text under each of them.

The look is in `assets/cmc.mplstyle`; titles, colors and lines of the compared methods are in
`assets/methods.csv`. Colors are Okabe and Ito's (https://jfly.uni-koeln.de/color/), which stay
apart for the common forms of color blindness.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import rc_params_from_file
from matplotlib.figure import Figure

from cmc.store import asset, write_atomic

_NAMES = ("blue", "vermillion", "green", "purple", "orange", "sky", "yellow", "black")
CYCLE = tuple(rc_params_from_file(asset("cmc.mplstyle"))["axes.prop_cycle"].by_key()["color"])
COLORS = dict(zip(_NAMES, CYCLE, strict=True))
"""Okabe-Ito colors by name, in the order of the cycle."""

GOOD, BAD, NEUTRAL = COLORS["blue"], COLORS["vermillion"], "#7A7A7A"
"""What holds, what fails, and what is only there for reference."""

with asset("methods.csv").open(encoding="utf-8") as _file:
    METHODS = {row["method"]: row for row in csv.DictReader(_file)}
"""Title, color and line of each compared method, the same in every lesson.

Blue and its neighbors contract by construction. Solid lines contract, dashed ones are free, dotted
ones do not learn, dash-dotted ones are another kind.
"""
METHOD_TITLES = {name: row["title"] for name, row in METHODS.items()}
METHOD_COLORS = {name: row["color"] for name, row in METHODS.items()}

_CSS_PIXELS_PER_INCH = 84


def _method_of(label: str) -> str | None:
    """The method that a label names: its name, its title, or what begins with its title."""
    if label in METHODS:
        return label
    if begun := [name for name, title in METHOD_TITLES.items() if label.startswith(title)]:
        return max(begun, key=lambda name: len(METHOD_TITLES[name]))
    short = {title.split("/")[-1].split(",")[0]: n for n, title in reversed(METHOD_TITLES.items())}
    return short.get(label)


def looks(labels: Iterable[str], colors: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """A color and a line style for each label: its method's, or the next of the cycle.

    Given `colors` take their place, dashed from the second round on.
    """
    if colors is not None:
        rounds = ((color, line) for line in ("-", "--", "-.", ":") for color in colors)
        return [look for _, look in zip(labels, itertools.cycle(rounds), strict=False)]
    known = [METHODS.get(_method_of(label) or "") for label in labels]
    taken = {row["color"] for row in known if row}
    free = itertools.cycle([c for c in CYCLE if c not in taken] or CYCLE)
    styles = itertools.cycle(["-"] * len(CYCLE) + ["--"] * len(CYCLE))
    return [(row["color"], row["line"]) if row else (next(free), next(styles)) for row in known]


def panels(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = 7.5,
    height: float | None = None,
    **kwargs: Any,
) -> tuple[Figure, np.ndarray]:
    """A figure in the course's style, and its axes as an array (rows, columns).

    `width` and `height` of the whole figure in inches, 3.1 a row by default; `kwargs` go to
    `matplotlib.pyplot.subplots` (`sharex`, `width_ratios`, ...).
    """
    plt.style.use(asset("cmc.mplstyle"))
    size = (width, 3.1 * rows if height is None else height)
    return plt.subplots(rows, columns, figsize=size, squeeze=False, **kwargs)


def png(fig: Figure, text: str = "") -> bytes:
    """The figure as a PNG whose `Description` field holds `text`; the figure is closed."""
    stream = io.BytesIO()
    fig.savefig(stream, format="png", metadata={"Description": text, "Software": ""})
    plt.close(fig)
    return stream.getvalue()


def save(fig: Figure, path: str | Path, text: str = "") -> Path:
    """Write the figure as a PNG file with its description inside, and close it."""
    data = png(fig, text)
    return write_atomic(path, lambda file: file.write(data))


def describe(fig: Figure, text: str) -> None:
    """Show a figure with one line under it that says what is to be seen, then close it.

    The line is the image's alternative text too. Outside of IPython nothing is shown.
    """
    if not text.strip() or "\n" in text:
        raise ValueError(f"wanted one line that describes the figure, got {text!r}")
    _display(png(fig, text), text, fig.get_size_inches()[0], "image/png")


def schematic(name: str, text: str) -> None:
    """Show a schematic of `assets/schematics` with a line of text under it."""
    files = {file.stem: file for file in asset("schematics").glob("*.svg")}
    if name not in files:
        raise ValueError(f"no schematic {name!r}; there are {sorted(files)}")
    data = files[name].read_bytes()
    width = re.search(rb'width="([\d.]+)pt"', data)
    assert width is not None
    _display(data, text, float(width[1]) / 72, "image/svg+xml")


def _display(data: bytes, text: str, inches: float, kind: str) -> None:
    """Show an image of a width in inches, with a line of text, where there is a notebook."""
    from IPython import get_ipython
    from IPython.display import display

    if get_ipython() is None:
        return
    encoded, words = base64.b64encode(data).decode(), html.escape(text, quote=True)
    bundle = {"image/png": encoded} if kind == "image/png" else {}
    bundle["text/plain"] = f"Figure: {text}"
    bundle["text/html"] = (
        f'<figure style="margin:0.4em 0"><img alt="{words}" style="max-width:100%" '
        f'width="{round(inches * _CSS_PIXELS_PER_INCH)}" src="data:{kind};base64,{encoded}">'
        f'<figcaption style="font-size:0.95em;color:#777;max-width:52em">{words}'
        "</figcaption></figure>"
    )
    display(bundle, raw=True)
