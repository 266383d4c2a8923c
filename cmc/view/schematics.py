"""The paper's schematic figures, redrawn by code. Nothing here is data.

Each function returns a figure for `cmc.view.figures.describe`. Coordinates are in units of the
figure; every box and arrow is placed by hand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from cmc.view.style import COLORS, NEUTRAL, panels, use_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Point = tuple[float, float]

INK = COLORS["black"]
PHYSICAL, LATENT, AUXILIARY = COLORS["orange"], COLORS["sky"], COLORS["green"]


def signal_flow() -> Figure:
    """Signals across the spaces: physical, latent, auxiliary (paper: `fig:composition`)."""
    fig, ax = _board(9.0, 4.6, (0, 18), (0, 9.2))
    for y, color, name in (
        (6.3, AUXILIARY, "auxiliary space"),
        (3.3, LATENT, "latent space"),
        (0.3, PHYSICAL, "physical space"),
    ):
        _band(ax, (0.2, y), 17.6, 2.6, color, name)
    _box(ax, (9, 1.6), "robot and\nenvironment", width=3.6)
    _box(ax, (9, 4.6), r"$\dot y = f(y, u)$", width=3.6, dashed=True)
    _box(ax, (9, 7.6), r"$a_i = \pi_i(z_i, \int z_i)$", width=4.6, color=AUXILIARY)
    for x, y, text in ((4.4, 1.6, r"$x,\ \dot x$"), (4.4, 4.6, "$y$"), (4.4, 7.6, "$z$")):
        _signal(ax, (x, y), text)
    _signal(ax, (14, 7.6), "$a$")
    _signal(ax, (14, 4.6), "$u$")
    _arrow(ax, (7.2, 1.6), (5.2, 1.6))
    _arrow(ax, (4.4, 2.2), (4.4, 4.0), r"$y = g(x, \dot x)$", (4.6, 3.08))
    _arrow(ax, (4.4, 5.2), (4.4, 7.0), "$z = T_y\\, y$", (4.6, 6.08))
    _arrow(ax, (5.0, 7.6), (6.7, 7.6))
    _arrow(ax, (11.3, 7.6), (13.4, 7.6))
    _arrow(ax, (14, 7.0), (14, 5.2), "$u = T_a\\, a$", (14.2, 6.08))
    _arrow(ax, (14, 4.0), (10.8, 1.6), bend=-0.35)
    _arrow(ax, (13.4, 4.6), (10.8, 4.6), dashed=True)
    _arrow(ax, (7.2, 4.6), (5.0, 4.6), dashed=True)
    return fig


def two_spaces() -> Figure:
    """Contraction moves from the auxiliary to the latent space, with a bounded transient.

    Left, a disc of differences shrinks in the metric M = 1; right, the same discs seen through
    Theta_M^-1 (`theta_m`): nested ellipses, along which a plain distance may grow for a while.
    """
    fig, axes = panels(1, 2, width=9.0, height=3.8)
    angle = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    inverse = np.array([[0.65, 1.0], [0.0, 0.5]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    times = np.linspace(0, 3.6, 200)
    spin = [np.exp(-0.8 * s) * (np.cos(s) * np.eye(2) + np.sin(s) * turn) for s in times]
    for ax, G, name in (
        (axes[0, 0], np.eye(2), "auxiliary space, $(z, a)$: $M$"),
        (axes[0, 1], inverse, r"latent space, $(y, u)$: $\Theta_M^T M\, \Theta_M$"),
    ):
        color = AUXILIARY if G[0, 1] == 0 else COLORS["blue"]
        for s in (0.0, 0.6, 1.3, 2.4):
            edge = G @ (np.exp(-0.8 * s) * circle)
            ax.fill(*edge, color=color, alpha=0.13, lw=0)
            ax.plot(*edge, color=color, lw=1.2)
        for start in (0.7, 2.8, 4.9):
            point = np.array([np.cos(start), np.sin(start)])
            path = np.array([G @ S @ point for S in spin]).T
            ax.plot(*path, color=INK, lw=1.3)
            ax.plot(*path[:, 0], "o", color=INK, ms=4)
        ax.set_aspect("equal")
        ax.set_title(name)
        ax.set(xlim=(-1.5, 1.5), ylim=(-1.2, 1.2), xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    axes[0, 0].annotate(
        r"$\Theta_M^{-1}$",
        (1.28, 0.5),
        (1.0, 0.5),
        xycoords="axes fraction",
        va="center",
        fontsize=13,
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.6},
    )
    return fig


def one_network_per_dimension(n: int = 3) -> Figure:
    """An independent network for each dimension, between T_y and T_a (paper: `fig:policy`).

    Args:
        n: number of dimensions.
    """
    if n < 1:
        raise ValueError(f"wanted at least one dimension, got {n}")
    tall = 2.0 * n
    fig, ax = _board(8.0, 1.0 + 0.95 * n, (0, 18), (-0.4, tall + 0.4))
    _box(ax, (2.6, tall / 2), "$T_y$", width=1.5, height=tall - 0.5, color=LATENT)
    _box(ax, (15.0, tall / 2), "$T_a$", width=1.5, height=tall - 0.5, color=LATENT)
    _arrow(ax, (0.3, tall / 2), (1.8, tall / 2), "$y$", (0.8, tall / 2 + 0.35))
    _arrow(ax, (15.8, tall / 2), (17.5, tall / 2), "$u$", (16.5, tall / 2 + 0.35))
    for k in range(n):
        y, i = tall - 1.0 - 2.0 * k, k + 1
        _box(ax, (10.2, y), rf"$\pi_{i}$", width=2.4, height=1.4, color=AUXILIARY)
        _box(ax, (6.6, y - 0.42), r"$\int$", width=0.9, height=0.7)
        _arrow(ax, (3.4, y + 0.35), (9.0, y + 0.35), f"$z_{i}$", (3.9, y + 0.5))
        _arrow(ax, (4.9, y + 0.35), (6.1, y - 0.42), bend=0.35)
        _arrow(ax, (7.1, y - 0.42), (9.0, y - 0.42), rf"$\int z_{i}$", (7.4, y - 0.25))
        _arrow(ax, (11.4, y), (14.2, y), f"$a_{i}$", (12.5, y + 0.15))
    return fig


def combination(kind: str = "general") -> Figure:
    """Two subsystems and their couplings (paper: `fig:combination_example`).

    Args:
        kind: `"general"`, `"hierarchical"` (the lower left block vanishes, so that subsystem 2
            drives subsystem 1) or `"feedback"` (the couplings are skew to each other).

    Raises:
        ValueError: if the kind is none of these.
    """
    titles = {
        "general": "any two subsystems",
        "hierarchical": r"hierarchical: $F_{21} = 0$",
        "feedback": r"feedback: $F_{12} = -F_{21}^T$",
    }
    if kind not in titles:
        raise ValueError(f"wanted one of {sorted(titles)}, got {kind!r}")
    fig, ax = _board(6.2, 2.9, (0, 12.4), (0, 5.8))
    for x, i in ((3.4, 1), (9.0, 2)):
        _box(ax, (x, 2.4), rf"$\delta_{i} = (\delta z_{i}, \delta a_{i})$", width=3.5, height=1.5)
        loop = FancyArrowPatch(
            (x - 0.9, 3.2),
            (x + 0.9, 3.2),
            connectionstyle="arc3,rad=-1.1",
            arrowstyle="-|>",
            mutation_scale=14,
            color=COLORS["green"],
            lw=1.6,
        )
        ax.add_patch(loop)
        ax.text(x, 4.75, f"$F_{{{i}{i}}}$", ha="center", color=COLORS["green"], fontsize=12)
    color = COLORS["vermillion"]
    if kind == "hierarchical":
        _arrow(ax, (7.2, 2.4), (5.2, 2.4), "$F_{12}$", (5.9, 2.6), color=color)
    else:
        back = "$-F_{12}^T$" if kind == "feedback" else "$F_{21}$"
        _arrow(ax, (7.2, 2.8), (5.2, 2.8), "$F_{12}$", (5.9, 2.98), color=color)
        _arrow(ax, (5.2, 2.0), (7.2, 2.0), back, (5.75, 1.3), color=color)
    ax.set_title(titles[kind], loc="center")
    return fig


def recursion(n: int = 3) -> Figure:
    """Level by level: each subsystem converges once those that drive it have (`fig:combination`).

    Args:
        n: number of subsystems; subsystem n depends on no other.
    """
    if not 2 <= n <= 6:
        raise ValueError(f"wanted 2 to 6 subsystems, got {n}")
    fig, ax = _board(2.0 + 2.0 * n, 0.9 + 0.72 * n, (0, 4.2 * n + 1.6), (-0.2, 1.6 * n + 1.3))
    for stage in range(n):
        x = 2.2 + 4.2 * stage
        ax.text(x, 1.6 * n + 0.75, f"stage {stage + 1}", ha="center", color=NEUTRAL)
        for i in range(1, n + 1):
            y = 0.7 + 1.6 * (n - i)
            level = n - i  # the stage in which subsystem i converges
            if stage < level:
                color, text = "white", rf"$\delta_{i}$ waits"
            elif stage == level:
                color, text = COLORS["orange"], rf"$\delta_{i}$ converges"
            else:
                color, text = AUXILIARY, rf"$\delta_{i} = 0$"
            _box(ax, (x, y), text, width=3.0, height=0.85, color=color)
            if i > 1:
                alive = stage <= level
                _arrow(ax, (x, y + 0.45), (x, y + 1.15), color=INK if alive else "#CCCCCC")
        if stage < n - 1:
            _arrow(ax, (x + 1.65, 0.8 * n), (x + 2.55, 0.8 * n), color=NEUTRAL)
    return fig


def two_level_loop() -> Figure:
    """Planning above, contracting control below (paper: `HRL_model`)."""
    fig, ax = _board(9.4, 3.9, (0, 19.4), (0, 8.0))
    _band(ax, (0.2, 4.9), 19.0, 2.9, COLORS["purple"], "high level, slow")
    _band(ax, (0.2, 0.3), 19.0, 4.3, AUXILIARY, "low level, every step")
    _box(ax, (6.4, 6.3), "planner\n(TD3)", width=2.8, color=COLORS["purple"])
    _box(ax, (3.6, 2.9), "latent signal\n$y = K_1 e + K_2 \\dot e$", width=3.5, height=1.5)
    _box(ax, (8.4, 2.9), "modular policy\n(C-TD3)", width=3.1, height=1.5, color=AUXILIARY)
    _box(ax, (12.7, 2.9), "task-space\ncontroller", width=2.7, height=1.5)
    _box(ax, (17.0, 2.9), "robot and\nenvironment", width=2.9, height=1.5, color=PHYSICAL)
    _arrow(ax, (5.0, 6.3), (3.3, 3.7), "target $x_d$", (4.0, 4.65), bend=0.25)
    _arrow(ax, (5.4, 2.9), (6.8, 2.9), "$y$", (5.9, 3.1))
    _arrow(ax, (10.0, 2.9), (11.3, 2.9), "$u$", (10.5, 3.1))
    _arrow(ax, (14.1, 2.9), (15.5, 2.9), r"$\tau$", (14.6, 3.1))
    _arrow(ax, (17.0, 3.7), (7.9, 6.3), "state, reward", (13.6, 6.45), bend=0.25)
    ax.plot([17.0, 17.0, 3.6], [2.1, 1.0, 1.0], color=INK, lw=1.4)
    _arrow(ax, (3.6, 1.0), (3.6, 2.1))
    ax.text(10.3, 1.15, r"$x,\ \dot x$", ha="center")
    return fig


def _board(width: float, height: float, x: Point, y: Point) -> tuple[Figure, Axes]:
    use_style()
    fig, ax = plt.subplots(figsize=(width, height))
    ax.set(xlim=x, ylim=y)
    ax.set_axis_off()
    return fig, ax


def _band(ax: Axes, at: Point, width: float, height: float, color: str, name: str) -> None:
    round_ = "round,pad=0,rounding_size=0.3"
    ax.add_patch(
        FancyBboxPatch(at, width, height, boxstyle=round_, facecolor=color, alpha=0.14, lw=0)
    )
    ax.text(at[0] + 0.3, at[1] + 0.2, name, va="bottom", color="#555555", fontsize=10)


def _box(
    ax: Axes,
    center: Point,
    text: str,
    *,
    width: float,
    height: float = 1.5,
    color: str = "white",
    dashed: bool = False,
) -> None:
    face = color if color == "white" else _tint(color)
    patch = FancyBboxPatch(
        (center[0] - width / 2, center[1] - height / 2),
        width,
        height,
        boxstyle="round,pad=0,rounding_size=0.15",
        facecolor=face,
        edgecolor=INK,
        lw=1.3,
        ls="--" if dashed else "-",
        zorder=2,
    )
    ax.add_patch(patch)
    ax.text(*center, text, ha="center", va="center", zorder=3)


def _signal(ax: Axes, at: Point, text: str) -> None:
    ax.text(*at, text, ha="center", va="center", fontsize=13, zorder=3)


def _arrow(
    ax: Axes,
    start: Point,
    end: Point,
    text: str = "",
    at: Point = (0.0, 0.0),
    *,
    bend: float = 0.0,
    color: str = INK,
    dashed: bool = False,
) -> None:
    arrow = FancyArrowPatch(
        start,
        end,
        connectionstyle=f"arc3,rad={bend}",
        arrowstyle="-|>",
        mutation_scale=13,
        shrinkA=0,
        shrinkB=0,
        color=color,
        lw=1.4,
        ls="--" if dashed else "-",
        zorder=2,
    )
    ax.add_patch(arrow)
    if text:
        ax.text(*at, text, color=color)


def _tint(color: str, share: float = 0.3) -> tuple[float, float, float]:
    """`color` mixed with white: `share` of it stays."""
    from matplotlib.colors import to_rgb

    red, green, blue = (1 - share * (1 - c) for c in to_rgb(color))
    return red, green, blue
