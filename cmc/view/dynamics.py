"""Figures of a plant: fields, trajectories, distances, eigenvalues, matrices; see `figures`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.view.style import (
    BAD,
    COLORS,
    CYCLE,
    GOOD,
    NEUTRAL,
    axes_or_new,
    figure_of,
    label,
    panels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


def grid(x: tuple[float, float], y: tuple[float, float], count: int = 25) -> Array:
    """Points (count, count, 2) of a plane: a field evaluated there can be drawn."""
    return np.stack(np.meshgrid(np.linspace(*x, count), np.linspace(*y, count)), axis=-1)


def phase_portrait(
    points: ArrayLike | None = None,
    vectors: ArrayLike | None = None,
    paths: ArrayLike | None = None,
    *,
    color: str = GOOD,
    labels: tuple[str, str] = ("$y_1$", "$y_2$"),
    title: str | None = None,
    equilibrium: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw a field `vectors` at `points`, both (m, m, 2), and trajectories `paths` over it.

    `points` as made by `grid`; `paths` (time, number, 2), or one (time, 2), with dots at their
    starts; `equilibrium` (2,) or (k, 2) is marked.
    """
    ax = axes_or_new(ax, (5.2, 4.6))
    if points is not None and vectors is not None:
        X, V = np.asarray(points, float), np.asarray(vectors, float)
        if X.ndim != 3 or X.shape != V.shape or X.shape[-1] != 2:
            raise ValueError(
                f"wanted points and vectors (m, m, 2), got {X.shape} and {V.shape}; use grid()"
            )
        speed = np.hypot(V[..., 0], V[..., 1])
        width = 0.5 + 0.9 * np.sqrt(speed / max(float(speed.max()), 1e-300))
        stream = (X[0, :, 0], X[:, 0, 1], V[..., 0], V[..., 1])
        ax.streamplot(*stream, color="#BDBDBD", linewidth=width, density=1.1, arrowsize=0.8)
        ax.set_xlim(X[..., 0].min(), X[..., 0].max())
        ax.set_ylim(X[..., 1].min(), X[..., 1].max())
    if paths is not None:
        P = _as_paths(paths)
        ax.plot(P[..., 0], P[..., 1], color=color, alpha=_alpha(P.shape[1]), lw=1.3)
        ax.plot(P[0, :, 0], P[0, :, 1], "o", color=color, ms=4)
    if equilibrium is not None:
        E = np.atleast_2d(np.asarray(equilibrium, float))
        ax.plot(E[:, 0], E[:, 1], "X", color=COLORS["black"], ms=8, zorder=5)
    label(ax, *labels, title)
    return figure_of(ax)


def trajectories(
    t: ArrayLike,
    values: ArrayLike,
    *,
    color: str = GOOD,
    name: str | None = None,
    labels: tuple[str, str] = ("time (s)", "$y$"),
    title: str | None = None,
    target: float | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw one signal (time, number) or (time,) of trajectories; `target` is a level to mark."""
    ax = axes_or_new(ax)
    V = _columns(values)
    lines = ax.plot(t, V, color=color, alpha=_alpha(V.shape[1]), lw=1.3)
    if name:
        lines[0].set_label(name)
        ax.legend(loc="best")
    if target is not None:
        ax.axhline(target, color=NEUTRAL, ls="--", lw=1.2, label="_")
    label(ax, *labels, title)
    return figure_of(ax)


def distances(
    t: ArrayLike,
    distance: ArrayLike,
    *,
    rate: float | None = None,
    overshoot: float = 1.0,
    color: str = GOOD,
    name: str = "distance to a reference",
    labels: tuple[str, str] = ("time (s)", "distance"),
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw distances (time, number) or (time,), logarithmically, and their envelope.

    The envelope is `overshoot * d_max(0) * exp(-rate * t)`, `rate` in 1/s; none without a rate.
    """
    ax = axes_or_new(ax)
    t, D = np.asarray(t, float), _columns(distance)
    # Below this floor a distance is rounding, and would only stretch the axis.
    floor = 1e-12 * max(float(np.nanmax(D, initial=0.0, where=np.isfinite(D))), 1e-300)
    D = np.where(floor < D, D, np.nan)
    lines = ax.semilogy(t, D, color=color, alpha=_alpha(D.shape[1]), lw=1.3)
    lines[0].set_label(name)
    if rate is not None:
        envelope = overshoot * np.nanmax(D[0]) * np.exp(-rate * (t - t[0]))
        shown = np.where(envelope > floor, envelope, np.nan)
        ax.semilogy(t, shown, "--", color=BAD, label=f"rate {rate:.3g} 1/s")
    ax.legend(loc="best")
    label(ax, *labels, title)
    return figure_of(ax)


def convergence(
    t: ArrayLike,
    paths: ArrayLike,
    *,
    rate: float | None = None,
    overshoot: float = 1.0,
    component: int = 0,
    labels: tuple[str, str] = ("$y_1$", "distance"),
    color: str = GOOD,
) -> Figure:
    """Two panels: one component of `paths` (time, number, n), and distances to the first path.

    `rate` and `overshoot` as in `distances`; `labels` of the two vertical axes.
    """
    P = _as_paths(paths)
    fig, axes = panels(1, 2, width=9.0, height=3.4)
    trajectories(t, P[..., component], color=color, labels=("time (s)", labels[0]), ax=axes[0, 0])
    apart = np.linalg.norm(P[:, 1:] - P[:, :1], axis=-1)
    names = ("time (s)", labels[1])
    distances(t, apart, rate=rate, overshoot=overshoot, color=color, labels=names, ax=axes[0, 1])
    return fig


def eigenvalues(
    values: Mapping[str, ArrayLike] | ArrayLike,
    *,
    region: str = "half-plane",
    unit: str = "1/s",
    title: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw complex eigenvalues (any shape; a mapping names groups), the stable region shaded.

    `region` is `"half-plane"` (continuous time) or `"disc"` (sampled).
    """
    if region not in ("half-plane", "disc"):
        raise ValueError(f"wanted region 'half-plane' or 'disc', got {region!r}")
    ax = axes_or_new(ax, (5.2, 4.2))
    groups = values if isinstance(values, Mapping) else {"": values}
    for k, (name, group) in enumerate(groups.items()):
        z = np.ravel(np.asarray(group, complex))
        look: dict[str, Any] = {"color": CYCLE[k % len(CYCLE)], "ms": 7}
        marker = "osD^vP*"[k % 7]
        ax.plot(z.real, z.imag, marker, alpha=0.85, clip_on=False, label=name or None, **look)
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
    """Draw a matrix (rows, columns) as colored, written cells; entries that vanish are white.

    Lines stand around blocks of size `block`; `labels` name the coordinates; `limit` is the
    magnitude of the strongest color; an entry below `tolerance` times the largest counts as zero.
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
    if title:
        ax.set_title(title, pad=10)
    return figure_of(ax)


def matrices(
    named: Mapping[str, ArrayLike], *, block: int | None = None, labels: Sequence[str] | None = None
) -> Figure:
    """Draw several matrices side by side, each under its name; `block`, `labels` as in `matrix`."""
    if not named:
        raise ValueError("wanted at least one matrix, got none")
    widths = [np.asarray(M).shape[1] + 0.8 for M in named.values()]
    heights = [np.asarray(M).shape[0] for M in named.values()]
    size = {"width": min(0.72 * sum(widths), 12.0), "height": 0.6 * max(heights) + 0.9}
    fig, axes = panels(1, len(named), width_ratios=widths, **size)
    for ax, (name, M) in zip(axes[0], named.items(), strict=True):
        matrix(M, block=block, labels=labels, title=name, ax=ax)
    return fig


def _columns(values: ArrayLike) -> Array:
    V = np.asarray(values, float)
    return V[:, None] if V.ndim == 1 else V


def _as_paths(paths: ArrayLike) -> Array:
    """Trajectories as (time, number, n), from that or from one (time, n), with n >= 2."""
    P = np.asarray(paths, float)
    P = P[:, None, :] if P.ndim == 2 else P
    if P.ndim != 3 or P.shape[-1] < 2:
        raise ValueError(f"wanted trajectories (time, number, n >= 2), got shape {np.shape(paths)}")
    return P


def _alpha(number: int) -> float:
    """Opacity at which `number` lines in one color still read as lines."""
    return float(np.clip(3.0 / max(number, 1) ** 0.5, 0.25, 0.95))
