"""Static figures: arrays in, one matplotlib figure out.

Every function draws into `ax` or, without one, into a new figure, and returns the figure; show it
with `describe(fig, "what is to be seen")`. `labels` are those of the axes, with units; they and
`title` may hold mathtext (`"$z_1$ (m)"`). Named lines have the color of their method
(`METHOD_COLORS`), else the next of the cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from cmc.view.style import BAD, GOOD, NEUTRAL, looks, panels
from cmc.view.style import COLORS as COLORS
from cmc.view.style import CYCLE as CYCLE
from cmc.view.style import METHOD_COLORS as METHOD_COLORS
from cmc.view.style import METHOD_TITLES as METHOD_TITLES
from cmc.view.style import describe as describe
from cmc.view.style import save as save
from cmc.view.style import schematic as schematic


def curves(
    x: ArrayLike,
    lines: Mapping[str, ArrayLike],
    *,
    labels: tuple[str, str],
    log: str = "",
    colors: Sequence[str] | None = None,
    title: str | None = None,
    marks: Mapping[str, float] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw named curves (points,) over one abscissa; `marks` names levels to mark.

    `log` names the logarithmic axes: `""`, `"x"`, `"y"` or `"xy"`.
    """
    ax = _axes(ax)
    for (name, y), (color, style) in zip(lines.items(), looks(lines, colors), strict=True):
        ax.plot(x, y, style, color=color, label=name)
    for name, level in (marks or {}).items():
        ax.axhline(level, color=NEUTRAL, ls="--", lw=1.2, label=name)
    ax.set(**{f"{axis}scale": "log" for axis in log})
    return _finish(ax, labels, title, legend=len(lines) + len(marks or {}) > 1)


def trajectories(
    t: ArrayLike,
    values: ArrayLike,
    *,
    color: str = GOOD,
    name: str | None = None,
    labels: tuple[str, str] = ("time (s)", "$y$"),
    title: str | None = None,
    target: float | None = None,
    log: bool = False,
    ax: Axes | None = None,
) -> Figure:
    """Draw one signal (time, number) or (time,) of trajectories; `target` is a level to mark.

    On a logarithmic axis, what is below 1e-12 of the largest value is rounding, and left out.
    """
    ax, V = _axes(ax), np.asarray(values, float)
    if log:
        ax.set_yscale("log")
        V = np.where(1e-12 * np.nanmax(V, initial=1e-300, where=np.isfinite(V)) < V, V, np.nan)
    # the opacity at which many lines in one color still read as lines
    alpha = float(np.clip(3.0 / max(np.size(V[0]), 1) ** 0.5, 0.25, 0.95))
    lines = ax.plot(t, V, color=color, alpha=alpha, lw=1.3)
    if name:
        lines[0].set_label(name)
    if target is not None:
        ax.axhline(target, color=NEUTRAL, ls="--", lw=1.2, label="_")
    return _finish(ax, labels, title, legend=bool(name))


def matrix(
    M: ArrayLike,
    *,
    block: int | None = None,
    labels: Sequence[str] | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a matrix (rows, columns) as colored, written cells; entries that vanish are white.

    Lines stand around blocks of size `block`; `labels` name the coordinates. An entry below 1e-9
    of the largest counts as zero.
    """
    A = np.asarray(M, float)
    if A.ndim != 2:
        raise ValueError(f"wanted a matrix (rows, columns), got shape {A.shape}")
    ax = _axes(ax, (0.75 * A.shape[1] + 1.4, 0.7 * A.shape[0] + 0.9))
    largest = float(np.nanmax(np.abs(A), initial=0.0)) or 1.0
    shown = np.where(np.abs(A) <= 1e-9 * largest, 0.0, A)
    ax.imshow(shown, cmap="PuOr", vmin=-1.6 * largest, vmax=1.6 * largest, aspect="equal")
    for (i, j), value in np.ndenumerate(shown):
        text, color = ("0", "#AAAAAA") if value == 0 else (f"{value:.2g}", "#111111")
        ax.text(j, i, text, ha="center", va="center", color=color)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    for axis, size in ((ax.xaxis, A.shape[1]), (ax.yaxis, A.shape[0])):
        axis.set_ticks(range(size), labels=list(labels)[:size] if labels else [""] * size)
    ax.xaxis.tick_top()
    for edge in range(0, max(A.shape) + 1, block) if block else ():
        ax.axhline(edge - 0.5, color="#333333", lw=1.4)
        ax.axvline(edge - 0.5, color="#333333", lw=1.4)
    ax.set_title(title or "", pad=10)
    return ax.get_figure(root=True)  # type: ignore[return-value]


def matrices(
    named: Mapping[str, ArrayLike], *, block: int | None = None, labels: Sequence[str] | None = None
) -> Figure:
    """Draw several matrices side by side, each under its name; `block`, `labels` as in `matrix`."""
    if not named:
        raise ValueError("wanted at least one matrix, got none")
    widths = [np.shape(M)[1] + 0.8 for M in named.values()]
    height = 0.6 * max(np.shape(M)[0] for M in named.values()) + 0.9
    width = min(0.72 * sum(widths), 12.0)
    fig, axes = panels(1, len(named), width=width, height=height, width_ratios=widths)
    for ax, (name, M) in zip(axes[0], named.items(), strict=True):
        matrix(M, block=block, labels=labels, title=name, ax=ax)
    return fig


def histogram(
    samples: Mapping[str, ArrayLike],
    *,
    label_x: str,
    bins: int | ArrayLike = 40,
    colors: Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the shares of named samples over common bins (a number, or edges), as outlines.

    Samples outside of the bins are counted in the outermost bins, so that nothing is hidden.
    """
    ax = _axes(ax)
    flat = {name: np.ravel(np.asarray(x, float)) for name, x in samples.items()}
    edges = np.histogram_bin_edges(np.concatenate(list(flat.values())), bins)
    for (name, x), (color, style) in zip(flat.items(), looks(flat, colors), strict=True):
        share = np.histogram(np.clip(x, edges[0], edges[-1]), edges)[0] / max(x.size, 1)
        ax.stairs(share, edges, color=color, fill=True, alpha=0.25)
        ax.stairs(share, edges, color=color, ls=style, lw=1.8, label=name)
    return _finish(ax, (label_x, "share of samples"), legend=len(flat) > 1)


def region(
    x: ArrayLike,
    y: ArrayLike,
    values: ArrayLike,
    *,
    labels: tuple[str, str, str],
    level: float | None = 0.0,
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a quantity (rows, columns) over two parameters, and where it meets `level`.

    `x` is (columns,), `y` (rows,); the third label is that of the color bar.
    """
    V = np.asarray(values, float)
    if V.shape != (np.size(y), np.size(x)):
        raise ValueError(f"wanted values ({np.size(y)}, {np.size(x)}), got shape {V.shape}")
    ax = _axes(ax, (6.4, 4.2))
    mesh = ax.pcolormesh(x, y, V, shading="nearest", cmap="cividis")
    if level is not None and np.nanmin(V) < level < np.nanmax(V):
        ax.contour(x, y, V, levels=[level], colors=[BAD], linewidths=2)
    ax.grid(visible=False)
    fig = _finish(ax, labels[:2], title)
    fig.colorbar(mesh, ax=ax, label=labels[2])
    return fig


def label(ax: Axes, x: str, y: str, title: str | None = None) -> None:
    """Label both axes (units in the label: `"time (s)"`) and set an optional title."""
    ax.set(xlabel=x, ylabel=y)
    if title:
        ax.set_title(title)


def _axes(ax: Axes | None, size: tuple[float, float] = (7.0, 3.6)) -> Axes:
    """`ax`, or the axes of a new figure of a size in inches."""
    return ax or panels(width=size[0], height=size[1])[1][0, 0]


def _finish(
    ax: Axes, labels: tuple[str, str], title: str | None = None, *, legend: bool = False
) -> Figure:
    """Label the axes, and return the figure that they lie in."""
    if legend:
        ax.legend(loc="best")
    label(ax, *labels, title)
    return ax.get_figure(root=True)  # type: ignore[return-value]
