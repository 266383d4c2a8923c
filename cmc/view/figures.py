"""Static figures: arrays in, one matplotlib figure out.

Every function draws into `ax` or, without one, into a new figure, and returns the figure; show it
with `describe(fig, "what is to be seen")`. `labels` are those of the axes, with units; they and
`title` may hold mathtext (`"$z_1$ (m)"`). `log` names the logarithmic axes: `""`, `"x"`, `"y"` or
`"xy"`. Named lines have the color of their method (`METHOD_COLORS`), else the next of the cycle.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cmc.view.dynamics import (
    convergence,
    distances,
    eigenvalues,
    grid,
    matrices,
    matrix,
    phase_portrait,
    trajectories,
)
from cmc.view.style import (
    BAD,
    COLORS,
    CYCLE,
    GOOD,
    METHOD_COLORS,
    METHOD_TITLES,
    NEUTRAL,
    axes_or_new,
    describe,
    figure_of,
    label,
    looks,
    panels,
    save,
    schematic,
    use_style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "BAD",
    "COLORS",
    "CYCLE",
    "GOOD",
    "METHOD_COLORS",
    "METHOD_TITLES",
    "NEUTRAL",
    "convergence",
    "curves",
    "describe",
    "distances",
    "eigenvalues",
    "grid",
    "histogram",
    "label",
    "learning_curves",
    "matrices",
    "matrix",
    "panels",
    "phase_portrait",
    "region",
    "save",
    "schematic",
    "seed_dots",
    "trajectories",
    "use_style",
]


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
    """Draw named curves (points,) over one abscissa; `marks` names levels to mark."""
    ax = axes_or_new(ax)
    for (name, y), (color, style) in zip(lines.items(), _looks(lines, colors), strict=True):
        ax.plot(x, y, style, color=color, label=name)
    for name, level in (marks or {}).items():
        ax.axhline(level, color=NEUTRAL, ls="--", lw=1.2, label=name)
    _logarithmic(ax, log)
    if len(lines) + len(marks or {}) > 1:
        ax.legend(loc="best")
    label(ax, *labels, title)
    return figure_of(ax)


def histogram(
    samples: Mapping[str, ArrayLike],
    *,
    label_x: str,
    bins: int | ArrayLike = 40,
    log: bool = False,
    colors: Sequence[str] | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw the shares of named samples over common bins (a number, or edges), as outlines.

    Samples outside of the bins are counted in the outermost bins, so that nothing is hidden.
    """
    ax = axes_or_new(ax)
    flat = {name: np.ravel(np.asarray(x, float)) for name, x in samples.items()}
    edges = np.histogram_bin_edges(np.concatenate(list(flat.values())), bins)
    for (name, x), (color, style) in zip(flat.items(), _looks(flat, colors), strict=True):
        share = np.histogram(np.clip(x, edges[0], edges[-1]), edges)[0] / max(x.size, 1)
        ax.stairs(share, edges, color=color, fill=True, alpha=0.25)
        ax.stairs(share, edges, color=color, ls=style, lw=1.8, label=name)
    _logarithmic(ax, "y" if log else "")
    if len(flat) > 1:
        ax.legend(loc="best")
    label(ax, label_x, "share of samples", title)
    return figure_of(ax)


def learning_curves(
    steps: ArrayLike,
    runs: Mapping[str, ArrayLike],
    *,
    labels: tuple[str, str] = ("environment steps", "return"),
    each_seed: bool = True,
    colors: Sequence[str] | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw medians over seeds of named runs (seeds, points), their range, and thin single seeds."""
    ax = axes_or_new(ax)
    x = np.asarray(steps, float)
    for (name, values), (color, style) in zip(runs.items(), _looks(runs, colors), strict=True):
        Y = np.atleast_2d(np.asarray(values, float))
        if Y.shape[-1] != x.size:
            raise ValueError(f"{name}: wanted (seeds, {x.size}) values, got shape {Y.shape}")
        seeds = f" ({Y.shape[0]} seeds)" if Y.shape[0] > 1 else ""
        median = np.nanmedian(Y, axis=0)
        ax.plot(x, median, style, color=color, lw=2.2, label=f"{name}{seeds}")
        if Y.shape[0] > 1:
            low, high = np.nanmin(Y, axis=0), np.nanmax(Y, axis=0)
            ax.fill_between(x, low, high, color=color, alpha=0.15, lw=0)
            if each_seed:
                ax.plot(x, Y.T, color=color, lw=0.7, alpha=0.5)
    ax.legend(loc="best")
    label(ax, *labels, title)
    return figure_of(ax)


def region(
    x: ArrayLike,
    y: ArrayLike,
    values: ArrayLike,
    *,
    labels: tuple[str, str, str],
    level: float | None = 0.0,
    log: str = "",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a quantity (rows, columns) over two parameters, and where it meets `level`.

    `x` is (columns,), `y` (rows,); the third label is that of the color bar.
    """
    V = np.asarray(values, float)
    if V.shape != (np.size(y), np.size(x)):
        raise ValueError(f"wanted values ({np.size(y)}, {np.size(x)}), got shape {V.shape}")
    ax = axes_or_new(ax, (6.4, 4.2))
    mesh = ax.pcolormesh(x, y, V, shading="nearest", cmap="cividis")
    if level is not None and np.nanmin(V) < level < np.nanmax(V):
        ax.contour(x, y, V, levels=[level], colors=[BAD], linewidths=2)
    _logarithmic(ax, log)
    ax.grid(visible=False)
    figure_of(ax).colorbar(mesh, ax=ax, label=labels[2])
    label(ax, labels[0], labels[1], title)
    return figure_of(ax)


def seed_dots(
    groups: Mapping[str, ArrayLike],
    *,
    label_x: str,
    xlim: tuple[float, float] | None = None,
    marks: Sequence[float] = (),
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a row for each group (seeds,), the first on top: dots, the mean, the range.

    Dots of equal value are moved apart, so that each can be counted; `marks` are vertical lines.
    """
    ax = axes_or_new(ax, (7.0, 0.9 + 0.42 * max(len(groups), 1)))
    for row, (values, (color, _)) in enumerate(zip(groups.values(), looks(groups), strict=True)):
        x = np.sort(np.asarray(values, float))
        ax.plot([x[0], x[-1]], [row, row], color=color, lw=1.5, alpha=0.5)
        ax.plot([x.mean()] * 2, [row - 0.3, row + 0.3], color=color, lw=2.5)
        ax.plot(x, row + 0.22 * np.linspace(-1, 1, x.size), "o", color=color, ms=5, alpha=0.8)
    for mark in marks:
        ax.axvline(mark, color=NEUTRAL, ls="--", lw=1.2)
    ax.set_yticks(range(len(groups)), list(groups))
    ax.set_ylim(len(groups) - 0.4, -0.6)
    if xlim is not None:
        ax.set_xlim(*xlim)
    label(ax, label_x, "", title)
    return figure_of(ax)


def _looks(names: Iterable[str], colors: Sequence[str] | None) -> list[tuple[str, str]]:
    """A color and a line style for each name; given colors are dashed from the second round on."""
    if colors is None:
        return looks(names)
    styles = ("-", "--", "-.", ":")
    return [(colors[k % len(colors)], styles[k // len(colors) % 4]) for k, _ in enumerate(names)]


def _logarithmic(ax: Axes, log: str) -> None:
    if "x" in log:
        ax.set_xscale("log")
    if "y" in log:
        ax.set_yscale("log")
