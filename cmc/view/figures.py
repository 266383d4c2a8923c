"""Static figures: arrays in, one matplotlib figure out. This module is the one door to all of them.

Every function draws into `ax` or, without one, into a new figure, and returns the figure; show it
with `describe(fig, "what is to be seen")`. Labels hold units and may hold mathtext
(`"$z_1$ (m)"`).
"""

from cmc.view.algebra import eigenvalues, matrices, matrix
from cmc.view.motion import convergence, distances, grid, phase_portrait, trajectories
from cmc.view.results import curves, histogram, learning_curves, region
from cmc.view.spread import seed_dots
from cmc.view.style import (
    BAD,
    COLORS,
    CYCLE,
    GOOD,
    METHOD_COLORS,
    METHOD_TITLES,
    NEUTRAL,
    describe,
    label,
    panels,
    save,
    use_style,
)

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
    "seed_dots",
    "trajectories",
    "use_style",
]
