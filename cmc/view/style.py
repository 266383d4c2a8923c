"""One look for every figure, and one line of text under each of them.

The look is in `assets/cmc.mplstyle`. Colors are Okabe and Ito's
(https://jfly.uni-koeln.de/color/), which stay apart for the common forms of color blindness.
"""

from __future__ import annotations

import base64
import html
import io
import itertools
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np

from cmc.store import asset, write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "blue": "#0072B2",
    "vermillion": "#D55E00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "yellow": "#F0E442",
    "black": "#222222",
}
"""Okabe-Ito colors by name, in the order of the cycle (yellow and black last)."""

CYCLE = tuple(COLORS.values())
GOOD, BAD, NEUTRAL = COLORS["blue"], COLORS["vermillion"], "#7A7A7A"
"""What holds, what fails, and what is only there for reference."""

_METHODS = {
    # two levels: the peg maze and the peg push
    "ctd3": ("TD3/C-TD3", "#0072B2", "-"),
    "ctd3_paper": ("TD3/C-TD3, the paper's scheme", "#56B4E9", "-"),
    "frozen": ("TD3/frozen random C", "#009E73", "-"),
    "gain": ("TD3/hand-tuned gain", "#E69F00", "-."),
    "td3": ("TD3/TD3, plain critic", "#D55E00", "--"),
    "td3_corrected": ("TD3/TD3, corrected critic", "#CC79A7", "--"),
    "control": ("TD3/Control", "#222222", ":"),
    "ppo_control": ("PPO/Control", "#7A7A7A", ":"),
    "ctd3_tuned": ("TD3/C-TD3, tuned start", "#332288", "-"),
    "frozen_tuned": ("TD3/frozen random C, tuned start", "#999933", "-"),
    "ctd3_positive": ("TD3/C-TD3, corrected critic", "#88CCEE", "-."),
    "ctd3_short": ("TD3/C-TD3, discount .5", "#117733", "-."),
    "ctd3_plain_view": ("TD3/C-TD3, plain view", "#DDCC77", "-."),
    "ctd3_no_bursts": ("TD3/C-TD3, Gaussian noise alone", "#AA4499", "-."),
    "ctd3_no_pull": ("TD3/C-TD3, no pull", "#661100", "-."),
    "hiro": ("HIRO", "#5E3C99", "-."),
    "hiro_matched": ("HIRO, matched noise", "#A79BD0", "-."),
    # one level: the peg that touches
    "cppo": ("C-PPO", "#0072B2", "-"),
    "cppo_capped": ("C-PPO, capped", "#009E73", "-"),
    "cppo_bypass": ("C-PPO, capped, vertical bypass", "#56B4E9", "-"),
    "cppo_scaled": ("C-PPO, capped loop gain", "#117733", "-"),
    "cppo_bounded": ("C-PPO, bounded on both sides", "#44AA99", "-"),
    "cppo_stress": ("C-PPO, stress setting", "#332288", "-"),
    "cppo_identity": ("C-PPO, T_y = T_a = I", "#5E3C99", "-"),
    "cppo_no_integral": ("C-PPO, no integral", "#A79BD0", "-"),
    "ppo": ("PPO, one network per dimension", "#D55E00", "--"),
    "ppo_stress": ("PPO, stress setting", "#882255", "--"),
    "ppo_joint": ("PPO, joint network", "#CC79A7", "--"),
    "ppo_raw": ("PPO, raw inputs", "#DDAA33", "--"),
    "convex_pi": ("Convex-gradient PI", "#E69F00", "-."),
    "pi": ("Hand-tuned PI", "#222222", ":"),
    "pi_scaled": ("Hand-tuned PI, scheduled on stiffness", "#7A7A7A", ":"),
}
METHOD_TITLES = {name: title for name, (title, _, _) in _METHODS.items()}
"""Names of the compared methods in figures and tables."""
METHOD_COLORS = {name: color for name, (_, color, _) in _METHODS.items()}
"""One color a method, the same in every lesson; blue and its neighbors contract by construction."""
METHOD_LINES = {name: line for name, (_, _, line) in _METHODS.items()}
"""Line styles: solid contracts, dashed is free, dotted does not learn, dash-dotted is another."""

_DPI = 144
_CSS_PIXELS_PER_INCH = 84


def method_of(label: str) -> str | None:
    """Return the method that a label names: its name, its title, or what begins with its title."""
    if label in _METHODS:
        return label
    begun = [name for name, title in METHOD_TITLES.items() if label.startswith(title)]
    if begun:
        return max(begun, key=lambda name: len(METHOD_TITLES[name]))
    short = {title.split("/")[-1].split(",")[0]: n for n, title in reversed(METHOD_TITLES.items())}
    return short.get(label)


def looks(labels: Iterable[str]) -> list[tuple[str, str]]:
    """Return a color and a line style for each label: its method's, or the next of the cycle."""
    labels = list(labels)
    methods = [method_of(label) for label in labels]
    taken = {METHOD_COLORS[name] for name in methods if name}
    free = itertools.cycle([c for c in CYCLE if c not in taken] or CYCLE)
    styles = itertools.cycle(["-"] * len(CYCLE) + ["--"] * len(CYCLE))
    return [
        (METHOD_COLORS[name], METHOD_LINES[name]) if name else (next(free), next(styles))
        for name in methods
    ]


def use_style() -> None:
    """Set matplotlib's defaults for the course, from `assets/cmc.mplstyle`."""
    plt.style.use(asset("cmc.mplstyle"))


def panels(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = 7.5,
    height: float | None = None,
    **kwargs: Any,
) -> tuple[Figure, np.ndarray]:
    """Return a figure with `rows` x `columns` axes, and the axes as an array (rows, columns).

    Args:
        rows: number of rows.
        columns: number of columns.
        width: width of the whole figure in inches.
        height: height of the whole figure in inches; 3.1 a row by default.
        kwargs: passed to `matplotlib.pyplot.subplots` (`sharex`, `width_ratios`, ...).
    """
    use_style()
    size = (width, 3.1 * rows if height is None else height)
    return plt.subplots(rows, columns, figsize=size, squeeze=False, **kwargs)


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (7.0, 3.6)) -> Axes:
    """Return `ax`, or the axes of a new figure in the style of the course."""
    if ax is not None:
        return ax
    use_style()
    return plt.subplots(figsize=size)[1]


def figure_of(ax: Axes) -> Figure:
    """Return the figure that `ax` lies in."""
    return ax.get_figure(root=True)  # type: ignore[return-value]


def label(ax: Axes, x: str, y: str, title: str | None = None) -> None:
    """Label both axes (units in the label: `"time (s)"`) and set an optional title."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title)


def png(fig: Figure, text: str = "") -> bytes:
    """Return the figure as a PNG whose `Description` field holds `text`."""
    stream = io.BytesIO()
    fig.savefig(stream, format="png", dpi=_DPI, metadata={"Description": text, "Software": ""})
    return stream.getvalue()


def save(fig: Figure, path: str | Path, text: str = "") -> Path:
    """Write the figure as a PNG file with its description inside, and close it."""
    data = png(fig, text)
    plt.close(fig)
    return write_atomic(path, lambda file: file.write(data))


class Picture:
    """An image as bytes, with the line of text that says what it shows."""

    def __init__(self, data: bytes, text: str, width: int, kind: str = "image/png") -> None:
        self.data, self.text, self.width, self.kind = data, text, width, kind

    def _repr_mimebundle_(self, **_: Any) -> dict[str, Any]:
        encoded = base64.b64encode(self.data).decode()
        words = html.escape(self.text, quote=True)
        return {
            **({"image/png": encoded} if self.kind == "image/png" else {}),
            "text/html": (
                f'<figure style="margin:0.4em 0"><img alt="{words}" width="{self.width}" '
                f'style="max-width:100%" src="data:{self.kind};base64,{encoded}">'
                f'<figcaption style="font-size:0.95em;color:#777;max-width:52em">{words}'
                "</figcaption></figure>"
            ),
            "text/plain": f"Figure: {self.text}",
        }


def describe(fig: Figure | Picture, text: str) -> None:
    """Show a figure with one line under it that says what is to be seen, then close it.

    The line is the image's alternative text too. Outside of IPython nothing is shown; the text is
    kept as the figure's label either way.

    Raises:
        ValueError: if the text is empty or longer than one line.
    """
    if not text.strip() or "\n" in text:
        raise ValueError(f"wanted one line that describes the figure, got {text!r}")
    if isinstance(fig, Picture):
        _display(Picture(fig.data, text, fig.width, fig.kind))
        return
    fig.set_label(text)
    width = round(fig.get_size_inches()[0] * _CSS_PIXELS_PER_INCH)
    picture = Picture(png(fig, text), text, width)
    plt.close(fig)
    _display(picture)


def schematic(name: str, text: str | None = None) -> None:
    """Show a schematic of `assets/schematics` with its description, or with `text` in its place.

    Raises:
        ValueError: if there is no such schematic.
    """
    picture = drawing(name)
    describe(picture, text or picture.text)


def drawing(name: str) -> Picture:
    """A schematic as a picture, with the description that its file holds."""
    folder = asset("schematics")
    if not (folder / f"{name}.svg").is_file():
        there = sorted(file.stem for file in folder.glob("*.svg"))
        raise ValueError(f"no schematic {name!r}; there are {there}")
    source = (folder / f"{name}.svg").read_text("utf-8")
    title, points = (re.search(p, source) for p in ("<title>(.*?)</title>", r'width="([\d.]+)pt"'))
    assert title is not None
    assert points is not None
    width = round(float(points[1]) / 72 * _CSS_PIXELS_PER_INCH)
    return Picture(source.encode(), html.unescape(title[1]), width, "image/svg+xml")


def _display(picture: Picture) -> None:
    try:
        from IPython import get_ipython
        from IPython.display import display
    except ImportError:
        return
    if get_ipython() is not None:
        display(picture)
