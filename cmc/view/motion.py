"""Figures of motion: phase portraits, trajectories over time, distances between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.view.style import BAD, COLORS, GOOD, NEUTRAL, axes_or_new, figure_of, label, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


def grid(x: tuple[float, float], y: tuple[float, float], count: int = 25) -> Array:
    """Return points of a plane, (count, count, 2): a field evaluated there can be drawn.

    Args:
        x: lowest and highest value of the first coordinate.
        y: lowest and highest value of the second coordinate.
        count: points along each side.
    """
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
    """Draw a plane vector field with trajectories over it.

    Args:
        points: where the field is known, (m, m, 2), as made by `grid`.
        vectors: the field there, (m, m, 2).
        paths: trajectories (time, number, 2), or one (time, 2); starts are dots.
        color: color of the trajectories.
        labels: axis labels with units.
        title: optional title.
        equilibrium: points to mark, (2,) or (k, 2).
        ax: where to draw.
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
        P = as_paths(paths)
        ax.plot(P[..., 0], P[..., 1], color=color, alpha=line_alpha(P.shape[1]), lw=1.3)
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
    """Draw one signal of several trajectories over time.

    Args:
        t: times (time,), s.
        values: the signal (time, number) or (time,).
        color: one color for the whole bundle.
        name: legend entry of the bundle.
        labels: axis labels with units.
        title: optional title.
        target: a level to mark.
        ax: where to draw.
    """
    ax = axes_or_new(ax)
    V = np.asarray(values, float)
    V = V[:, None] if V.ndim == 1 else V
    lines = ax.plot(t, V, color=color, alpha=line_alpha(V.shape[1]), lw=1.3)
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
    """Draw distances between trajectories on a logarithmic scale, with their envelope.

    The envelope is `overshoot * d_max(0) * exp(-rate * t)`.

    Args:
        t: times (time,), s.
        distance: distances (time, number) or (time,), not negative.
        rate: contraction rate, 1/s; no envelope without it.
        overshoot: factor by which a transient may exceed the first distance.
        color: color of the distances.
        name: legend entry of the distances.
        labels: axis labels with units.
        title: optional title.
        ax: where to draw.
    """
    ax = axes_or_new(ax)
    t, D = np.asarray(t, float), np.asarray(distance, float)
    D = D[:, None] if D.ndim == 1 else D
    # Below this floor a distance is rounding, and would only stretch the axis.
    floor = 1e-12 * max(float(np.nanmax(D, initial=0.0, where=np.isfinite(D))), 1e-300)
    D = np.where(floor < D, D, np.nan)
    lines = ax.semilogy(t, D, color=color, alpha=line_alpha(D.shape[1]), lw=1.3)
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
    """Two panels: one component of converging trajectories, and the distances to their first.

    Args:
        t: times (time,), s.
        paths: trajectories (time, number, n).
        rate: contraction rate of the envelope, 1/s.
        overshoot: factor of the envelope.
        component: which component the left panel shows.
        labels: labels of the left and the right vertical axis, with units.
        color: color of the bundle.
    """
    P = as_paths(paths)
    fig, axes = panels(1, 2, width=9.0, height=3.4)
    trajectories(t, P[..., component], color=color, labels=("time (s)", labels[0]), ax=axes[0, 0])
    apart = np.linalg.norm(P[:, 1:] - P[:, :1], axis=-1)
    names = ("time (s)", labels[1])
    distances(t, apart, rate=rate, overshoot=overshoot, color=color, labels=names, ax=axes[0, 1])
    return fig


def as_paths(paths: ArrayLike) -> Array:
    """Return trajectories as (time, number, n), from that or from one (time, n).

    Raises:
        ValueError: if there are other than two or three axes, or fewer than two coordinates.
    """
    P = np.asarray(paths, float)
    P = P[:, None, :] if P.ndim == 2 else P
    if P.ndim != 3 or P.shape[-1] < 2:
        raise ValueError(f"wanted trajectories (time, number, n >= 2), got shape {np.shape(paths)}")
    return P


def line_alpha(number: int) -> float:
    """Opacity at which `number` lines in one color still read as lines."""
    return float(np.clip(3.0 / max(number, 1) ** 0.5, 0.25, 0.95))
