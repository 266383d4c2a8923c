"""Figures of spread: one dot for each seed, and the mean with its range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cmc.view.style import axes_or_new, figure_of, label, looks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def seed_dots(
    groups: Mapping[str, ArrayLike],
    *,
    label_x: str,
    xlim: tuple[float, float] | None = None,
    marks: Sequence[float] = (),
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw one row for each group: a dot for each seed, a bar at the mean, a line over the range.

    Dots of equal value are moved apart, so that each can be counted.

    Args:
        groups: row label to values (seeds,); the first is on top.
        label_x: axis label with unit.
        xlim: limits of the axis.
        marks: values marked by vertical lines.
        title: optional title.
        ax: where to draw.
    """
    ax = axes_or_new(ax, (7.0, 0.9 + 0.42 * max(len(groups), 1)))
    for row, (values, (color, _)) in enumerate(zip(groups.values(), looks(groups), strict=True)):
        x = np.sort(np.asarray(values, float))
        ax.plot([x[0], x[-1]], [row, row], color=color, lw=1.5, alpha=0.5)
        ax.plot([x.mean()] * 2, [row - 0.3, row + 0.3], color=color, lw=2.5)
        ax.plot(x, row + 0.22 * np.linspace(-1, 1, x.size), "o", color=color, ms=5, alpha=0.8)
    for mark in marks:
        ax.axvline(mark, color="#7A7A7A", ls="--", lw=1.2)
    ax.set_yticks(range(len(groups)), list(groups))
    ax.set_ylim(len(groups) - 0.4, -0.6)
    if xlim is not None:
        ax.set_xlim(*xlim)
    label(ax, label_x, "", title)
    return figure_of(ax)
