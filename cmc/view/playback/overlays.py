"""What is drawn over the scene: a trail, a marker that may move, an arrow, a word beside a part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Okabe-Ito, readable with every kind of color vision
BLUE, ORANGE, GREEN, VERMILION, PURPLE = 0x0072B2, 0xE69F00, 0x009E73, 0xD55E00, 0xCC79A7
_MARKER_COLORS = (ORANGE, GREEN, PURPLE)


@dataclass(frozen=True)
class Trail:
    """The path (T, 3) of a point, m, drawn up to the current time."""

    name: str
    points: Array
    color: int = BLUE
    radius: float = 0.0004


@dataclass(frozen=True)
class Marker:
    """A see-through ball at (T, 3) or (3,), m; rows of NaN hide it; None: the next free color."""

    name: str
    points: Array
    color: int | None = None
    radius: float = 0.002


@dataclass(frozen=True)
class Arrow:
    """A vector (T, 3) drawn at (T, 3) or (3,), `scale` metres per unit; short ones are hidden.

    Attributes:
        points: where the arrow starts, m.
        vectors: what it shows, in any unit (N for a force).
        scale: metres per unit.
        radius: radius of the shaft, m.
        color: 0xRRGGBB.
        threshold: vectors shorter than this are not drawn.
        name: filled in by `record`.
    """

    points: ArrayLike
    vectors: ArrayLike
    scale: float = 0.005
    radius: float = 0.0006
    color: int = VERMILION
    threshold: float = 1e-3
    name: str = ""


@dataclass(frozen=True)
class Label:
    """A word beside a point (T, 3), m, of the same size from near and far."""

    name: str
    points: Array


Overlay = Trail | Marker | Arrow | Label


def trail(name: str, points: Array) -> Trail:
    """Trail whose tube is as thin as the path is small: 0.4 % of it, 0.1 mm to 4 mm."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return Trail(name, points, radius=float(np.clip(0.004 * size, 1e-4, 4e-3)))


def as_overlays(
    frames: int, markers: Mapping[str, ArrayLike | Marker], arrows: Mapping[str, Arrow]
) -> list[Overlay]:
    """Markers and arrows with every array broadcast to (frames, 3).

    Raises:
        ValueError: for arrays that do not broadcast, or arrows that are not finite.
    """
    out: list[Overlay] = []
    for i, (name, given) in enumerate(markers.items()):
        marker = given if isinstance(given, Marker) else Marker(name, np.asarray(given))
        free = _MARKER_COLORS[i % len(_MARKER_COLORS)]
        color = free if marker.color is None else marker.color
        out.append(Marker(name, rows_of(name, marker.points, frames), color, marker.radius))
    for name, arrow in arrows.items():
        points, vectors = (rows_of(name, a, frames) for a in (arrow.points, arrow.vectors))
        if not (np.isfinite(points).all() and np.isfinite(vectors).all()):
            raise ValueError(f"arrow {name!r} must be finite")
        look = (arrow.scale, arrow.radius, arrow.color, arrow.threshold)
        out.append(Arrow(points, vectors, *look, name=name))
    return out


def rows_of(name: str, array: ArrayLike, frames: int) -> Array:
    """An array (3,) or (frames, 3) as (frames, 3); the name is for the error."""
    rows = np.asarray(array, dtype=float)
    if rows.shape not in ((3,), (frames, 3)):
        raise ValueError(f"{name!r} must have shape (3,) or ({frames}, 3), got {rows.shape}")
    return np.broadcast_to(rows, (frames, 3))
