"""Figures of results: curves, histograms, learning curves over seeds, regions of parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cmc.view.style import BAD, NEUTRAL, axes_or_new, figure_of, label, looks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
    """Draw named curves over one abscissa.

    Args:
        x: abscissa (points,).
        lines: legend entry to ordinate (points,).
        labels: axis labels with units.
        log: which axes are logarithmic: `""`, `"x"`, `"y"` or `"xy"`.
        colors: one for each curve, in order; the method's own (`style.METHOD_COLORS`) by default.
        title: optional title.
        marks: legend entry to a level that is marked by a horizontal line.
        ax: where to draw.
    """
    ax = axes_or_new(ax)
    for (name, y), (color, style) in zip(lines.items(), _looks(lines, colors), strict=True):
        ax.plot(x, y, style, color=color, label=name)
    for name, level in (marks or {}).items():
        ax.axhline(level, color=NEUTRAL, ls="--", lw=1.2, label=name)
    if "x" in log:
        ax.set_xscale("log")
    if "y" in log:
        ax.set_yscale("log")
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
    """Draw the shares of named samples over common bins, as outlines that can overlap.

    Samples outside of the bins are counted in the outermost bins, so that nothing is hidden.

    Args:
        samples: legend entry to samples (any shape, finite).
        label_x: axis label with unit.
        bins: number of common bins, or their edges.
        log: draw shares on a logarithmic axis.
        colors: as in `curves`.
        title: optional title.
        ax: where to draw.
    """
    ax = axes_or_new(ax)
    flat = {name: np.ravel(np.asarray(x, float)) for name, x in samples.items()}
    edges = np.histogram_bin_edges(np.concatenate(list(flat.values())), bins)
    for (name, x), (color, style) in zip(flat.items(), _looks(flat, colors), strict=True):
        count = np.histogram(np.clip(x, edges[0], edges[-1]), edges)[0]
        share = count / max(x.size, 1)
        ax.stairs(share, edges, color=color, fill=True, alpha=0.25)
        ax.stairs(share, edges, color=color, ls=style, lw=1.8, label=name)
    if log:
        ax.set_yscale("log")
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
    """Draw the median over seeds, the spread from lowest to highest, and thin single seeds.

    Args:
        steps: abscissa (points,).
        runs: method to values (seeds, points); NaN where a seed has no value.
        labels: axis labels with units.
        each_seed: draw every seed as a thin line too.
        colors: as in `curves`.
        title: optional title.
        ax: where to draw.
    """
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
    """Draw a quantity over a plane of two parameters, with the boundary where it meets a level.

    Args:
        x: first parameter (columns,).
        y: second parameter (rows,).
        values: the quantity (rows, columns).
        labels: labels of both axes and of the color bar, with units.
        level: value whose contour is drawn; none with `None`.
        log: which axes are logarithmic: `""`, `"x"`, `"y"` or `"xy"`.
        title: optional title.
        ax: where to draw.
    """
    V = np.asarray(values, float)
    if V.shape != (np.size(y), np.size(x)):
        raise ValueError(f"wanted values ({np.size(y)}, {np.size(x)}), got shape {V.shape}")
    ax = axes_or_new(ax, (6.4, 4.2))
    mesh = ax.pcolormesh(x, y, V, shading="nearest", cmap="cividis")
    if level is not None and np.nanmin(V) < level < np.nanmax(V):
        ax.contour(x, y, V, levels=[level], colors=[BAD], linewidths=2)
    if "x" in log:
        ax.set_xscale("log")
    if "y" in log:
        ax.set_yscale("log")
    ax.grid(visible=False)
    figure = figure_of(ax)
    figure.colorbar(mesh, ax=ax, label=labels[2])
    label(ax, labels[0], labels[1], title)
    return figure


def _looks(names: Iterable[str], colors: Sequence[str] | None) -> list[tuple[str, str]]:
    """A color and a line style for each name; given colors are dashed from the second round on."""
    if colors is None:
        return looks(names)
    styles = ("-", "--", "-.", ":")
    return [(colors[k % len(colors)], styles[k // len(colors) % 4]) for k, _ in enumerate(names)]
