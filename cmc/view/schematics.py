"""Old names of `figures.schematic`; `assets/schematics` holds the drawings."""

from __future__ import annotations

from functools import partial

from cmc.view.style import Picture, drawing

signal_flow = partial(drawing, "signal_flow")
two_spaces = partial(drawing, "two_spaces")
two_level_loop = partial(drawing, "two_level_loop")


def one_network_per_dimension(n: int = 3) -> Picture:
    """An independent network for each of three dimensions."""
    return drawing("one_network_per_dimension")


def recursion(n: int = 4) -> Picture:
    """Level by level, four subsystems."""
    return drawing("recursion")


def combination(kind: str = "general") -> Picture:
    """Two subsystems and their couplings: `"general"`, `"hierarchical"` or `"feedback"`."""
    return drawing(f"combination_{kind}")
