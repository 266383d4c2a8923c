"""Figures of linear algebra: eigenvalues in the complex plane, matrices and their blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cmc.view.style import CYCLE, GOOD, NEUTRAL, axes_or_new, figure_of, label, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def eigenvalues(
    values: Mapping[str, ArrayLike] | ArrayLike,
    *,
    region: str = "half-plane",
    unit: str = "1/s",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw eigenvalues in the complex plane, with the stable region shaded.

    Args:
        values: complex eigenvalues (any shape), or a mapping from a name (one subsystem each).
        region: `"half-plane"` (continuous time) or `"disc"` (sampled).
        unit: unit of the axes.
        title: optional title.
        ax: where to draw.

    Raises:
        ValueError: if the region is neither.
    """
    if region not in ("half-plane", "disc"):
        raise ValueError(f"wanted region 'half-plane' or 'disc', got {region!r}")
    ax = axes_or_new(ax, (5.2, 4.2))
    groups = values if isinstance(values, Mapping) else {"": values}
    markers = "osD^vP*"
    for k, (name, group) in enumerate(groups.items()):
        z = np.ravel(np.asarray(group, complex))
        color, marker = CYCLE[k % len(CYCLE)], markers[k % len(markers)]
        ax.plot(
            z.real, z.imag, marker, color=color, ms=7, alpha=0.85, label=name or None, clip_on=False
        )
    if region == "disc":
        angle = np.linspace(0, 2 * np.pi, 181)
        ax.fill(np.cos(angle), np.sin(angle), color=GOOD, alpha=0.08, lw=0)
        ax.plot(np.cos(angle), np.sin(angle), color=NEUTRAL, lw=1)
        ax.set_aspect("equal")
    else:
        low, high = ax.get_xlim()
        reach = 0.08 * (high - low)
        ax.set_xlim(min(low, -reach), max(high, reach))
        ax.axvspan(ax.get_xlim()[0], 0, color=GOOD, alpha=0.08, lw=0)
        ax.axvline(0, color=NEUTRAL, lw=1)
    if any(groups):
        ax.legend(loc="best")
    suffix = f" ({unit})" if unit and region == "half-plane" else ""
    label(ax, f"real part{suffix}", f"imaginary part{suffix}", title)
    return figure_of(ax)


def matrix(
    M: ArrayLike,
    *,
    block: int | None = None,
    labels: Sequence[str] | None = None,
    title: str | None = None,
    limit: float | None = None,
    tolerance: float = 1e-9,
    ax: Axes | None = None,
) -> Figure:
    """Draw a matrix as colored, written cells; entries that vanish are left white.

    Args:
        M: matrix (rows, columns).
        block: draw lines around blocks of this size (2 for the subsystem view of F).
        labels: names of the coordinates, for rows and columns.
        title: optional title.
        limit: magnitude of the strongest color; that of the largest entry by default.
        tolerance: an entry below `tolerance` times the largest one counts as zero.
        ax: where to draw.
    """
    A = np.asarray(M, float)
    if A.ndim != 2:
        raise ValueError(f"wanted a matrix (rows, columns), got shape {A.shape}")
    ax = axes_or_new(ax, (0.75 * A.shape[1] + 1.4, 0.7 * A.shape[0] + 0.9))
    largest = float(np.nanmax(np.abs(A), initial=0.0)) or 1.0
    limit = limit or largest
    shown = np.where(np.abs(A) <= tolerance * largest, 0.0, A)
    ax.imshow(shown, cmap="PuOr", vmin=-1.6 * limit, vmax=1.6 * limit, aspect="equal")
    for (i, j), value in np.ndenumerate(shown):
        text = "0" if value == 0 else f"{value:.2g}"
        ax.text(j, i, text, ha="center", va="center", color="#AAAAAA" if value == 0 else "#111111")
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    for axis, size in ((ax.xaxis, A.shape[1]), (ax.yaxis, A.shape[0])):
        axis.set_ticks(range(size), labels=list(labels)[:size] if labels else [""] * size)
    ax.xaxis.tick_top()
    if block:
        for edge in range(0, max(A.shape) + 1, block):
            ax.axhline(edge - 0.5, color="#333333", lw=1.4)
            ax.axvline(edge - 0.5, color="#333333", lw=1.4)
    if title:
        ax.set_title(title, pad=10)
    return figure_of(ax)


def matrices(
    named: Mapping[str, ArrayLike], *, block: int | None = None, labels: Sequence[str] | None = None
) -> Figure:
    """Draw several matrices side by side, each under its name.

    Args:
        named: name (may hold mathtext) to matrix.
        block: as in `matrix`.
        labels: as in `matrix`.
    """
    if not named:
        raise ValueError("wanted at least one matrix, got none")
    widths = [np.asarray(M).shape[1] + 0.8 for M in named.values()]
    heights = [np.asarray(M).shape[0] for M in named.values()]
    size = {"width": min(0.72 * sum(widths), 12.0), "height": 0.6 * max(heights) + 0.9}
    fig, axes = panels(1, len(named), width_ratios=widths, **size)
    for ax, (name, M) in zip(axes[0], named.items(), strict=True):
        matrix(M, block=block, labels=labels, title=name, ax=ax)
    return fig
