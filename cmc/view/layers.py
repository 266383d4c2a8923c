"""Layers of a live picture: what a panel draws, filled from the arrays of a callback.

A layer names its data by keys of the mapping that a callback returns, or holds arrays itself:
`lines("t", "y")`, `points("eigenvalues")`, `rule(y=0)`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.view.style import COLORS, NEUTRAL

Data = Mapping[str, Any]
Source = str | ArrayLike
"""A key of the callback's result, or the array itself."""


class PictureError(ValueError):
    """Data that a layer cannot draw: an absent key, or an array of another shape."""


@dataclass
class Buffer:
    """Float32 numbers that travel with one frame, and where each block of them begins."""

    blocks: list[NDArray[np.float32]] = field(default_factory=list)
    size: int = 0

    def add(self, array: ArrayLike) -> int:
        """Append an array and return the offset of its first number."""
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite: a gap
            block = np.ascontiguousarray(array, dtype=np.float32).ravel()
        offset, self.size = self.size, self.size + block.size
        self.blocks.append(block)
        return offset

    def tobytes(self) -> bytes:
        """All blocks in order, as bytes."""
        return b"".join(block.tobytes() for block in self.blocks)


@dataclass(frozen=True)
class Layer:
    """One thing that a panel draws: how to fetch its data, and how it looks."""

    kind: str
    fetch: Callable[[Data], dict[str, np.ndarray]]
    look: dict[str, Any]

    def encode(self, data: Data, buffer: Buffer) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Return the layer's layout, and its x and y values for the limits of the axes."""
        arrays = self.fetch(data)
        layout: dict[str, Any] = {"kind": self.kind, **self.look}
        for name, array in arrays.items():
            layout[name] = {"at": buffer.add(array), "shape": list(array.shape)}
        extent = [arrays[name] for name in ("x", "y") if name in arrays]
        if "y2" in arrays:
            extent[1] = np.concatenate([arrays["y"], arrays["y2"]])
        return layout, extent


def lines(x: Source, y: Source, *, color: str | None = None, **look: Any) -> Layer:
    """Curves over a common abscissa: x (m,), y (m,) or (m, number).

    Args:
        x: abscissa.
        y: one curve, or several as columns.
        color: name or hexadecimal color; the next of the cycle by default.
        look: `label`, `width` (px), `alpha`, `dash` (bool), `head` (bool: dots at the time cursor).
    """

    def fetch(data: Data) -> dict[str, np.ndarray]:
        X, Y = get_array(data, x), get_array(data, y)
        Y = Y[:, None] if Y.ndim == 1 else Y
        if X.ndim != 1 or Y.ndim != 2 or len(X) != len(Y):
            raise PictureError(
                f"lines({_name(x)}, {_name(y)}): wanted (m,) and (m, number), "
                f"got {X.shape} and {Y.shape}"
            )
        return {"x": X, "y": Y.T}

    return Layer("lines", fetch, _look(color, look, "label", "width", "alpha", "dash", "head"))


def paths(p: Source, *, color: str | None = None, **look: Any) -> Layer:
    """Curves in a plane: (time, number, 2), or (time, 2); further coordinates are not drawn.

    Args:
        p: the trajectories.
        color: as in `lines`.
        look: as in `lines`; `head` is true by default.
    """

    def fetch(data: Data) -> dict[str, np.ndarray]:
        P = get_array(data, p)
        P = P[:, None] if P.ndim == 2 else P
        if P.ndim != 3 or P.shape[-1] < 2:
            raise PictureError(f"paths({_name(p)}): wanted (time, number, 2), got {P.shape}")
        return {"x": P[..., 0].T, "y": P[..., 1].T}

    look = {"head": True, **look}
    return Layer("lines", fetch, _look(color, look, "label", "width", "alpha", "dash", "head"))


def points(p: Source, *, color: str | None = None, **look: Any) -> Layer:
    """Dots: complex numbers (any shape), or (number, 2), or (time, number, 2) for the time cursor.

    Args:
        p: the dots.
        color: as in `lines`.
        look: `label`, `radius` (px), `alpha`, `marker` (`"dot"`, `"cross"` or `"ring"`).
    """

    def fetch(data: Data) -> dict[str, np.ndarray]:
        P = get_array(data, p, complex_too=True)
        if np.iscomplexobj(P):
            P = np.stack([P.real.ravel(), P.imag.ravel()], axis=-1)
        if P.ndim not in (2, 3) or P.shape[-1] != 2:
            raise PictureError(
                f"points({_name(p)}): wanted complex numbers or (number, 2), got {P.shape}"
            )
        return {"x": P[..., 0], "y": P[..., 1]}

    return Layer("points", fetch, _look(color, look, "label", "radius", "alpha", "marker"))


def arrows(at: Source, vectors: Source, *, color: str = "#B5B5B5") -> Layer:
    """A vector field on a grid: both (rows, columns, 2); the longest arrow spans one cell."""

    def fetch(data: Data) -> dict[str, np.ndarray]:
        X, V = get_array(data, at), get_array(data, vectors)
        if X.ndim != 3 or X.shape != V.shape or X.shape[-1] != 2 or min(X.shape[:2]) < 2:
            raise PictureError(
                f"arrows({_name(at)}, {_name(vectors)}): wanted twice (rows, columns, 2), "
                f"got {X.shape} and {V.shape}"
            )
        cell = np.array([np.ptp(X[..., 0]), np.ptp(X[..., 1])]) / (np.array(X.shape[1::-1]) - 1)
        scaled = V / cell
        length = np.linalg.norm(scaled, axis=-1, keepdims=True)
        longest = float(np.nanmax(np.where(np.isfinite(length), length, 0.0)))
        # The square root keeps slow places visible beside fast ones.
        share = np.sqrt(length / longest) if longest > 0 else length
        unit = np.divide(scaled, length, out=np.zeros_like(scaled), where=length > 0)
        tips = 0.9 * share * unit * cell
        flat = {"x": X[..., 0], "y": X[..., 1], "dx": tips[..., 0], "dy": tips[..., 1]}
        return {name: array.ravel() for name, array in flat.items()}

    return Layer("arrows", fetch, _look(color, {}))


def band(x: Source, low: Source, high: Source, *, color: str | None = None, **look: Any) -> Layer:
    """A filled band between two curves, each (m,)."""

    def fetch(data: Data) -> dict[str, np.ndarray]:
        X, L, H = (get_array(data, source) for source in (x, low, high))
        if X.ndim != 1 or X.shape != L.shape or X.shape != H.shape:
            raise PictureError(
                f"band({_name(x)}, ...): wanted (m,) thrice, got {X.shape}, {L.shape}, {H.shape}"
            )
        return {"x": X, "y": L, "y2": H}

    return Layer("band", fetch, _look(color, {"alpha": 0.2, **look}, "label", "alpha"))


def cells(M: Source, limit: float | None = None) -> Layer:
    """A matrix as colored, written cells: (rows, columns), or (time, rows, columns).

    Put it alone in a panel. NaN is an empty cell.

    Args:
        M: the matrix.
        limit: magnitude of the strongest color; the largest entry (of all times) by default.
    """

    def fetch(data: Data) -> dict[str, np.ndarray]:
        A = get_array(data, M)
        if A.ndim not in (2, 3):
            raise PictureError(f"cells({_name(M)}): wanted (rows, columns), got {A.shape}")
        rows, columns = A.shape[-2:]
        corners = {"x": np.array([0.5, columns + 0.5]), "y": np.array([0.5, rows + 0.5])}
        return {"values": A, **corners}

    return Layer("cells", fetch, {"limit": limit})


def shade(
    *, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None, **look: Any
) -> Layer:
    """A shaded strip between two abscissas or two ordinates (`-inf` and `inf` reach the edge).

    Args:
        x: from and to along the horizontal axis.
        y: from and to along the vertical axis.
        look: `color`, `label`, `alpha`.
    """
    if (x is None) == (y is None):
        raise PictureError("wanted x=(low, high) or y=(low, high)")
    span = [None if np.isinf(v) else float(v) for v in (x or y or ())]
    made = _look(look.pop("color", "blue"), {"alpha": 0.1, **look}, "label", "alpha")
    return Layer("shade", lambda data: {}, {**made, "axis": "x" if x else "y", "span": span})


def rule(*, x: float | str | None = None, y: float | str | None = None, **look: Any) -> Layer:
    """A straight line across the panel at an abscissa or an ordinate (a number or a key).

    Args:
        x: where a vertical line stands.
        y: where a horizontal line lies.
        look: `color`, `label`, `dash` (bool), `width` (px).
    """
    if (x is None) == (y is None):
        raise PictureError("wanted x=number or y=number")
    where: Any = y if x is None else x

    def fetch(data: Data) -> dict[str, np.ndarray]:
        return {"value": np.atleast_1d(get_array(data, where))[:1]}

    made = _look(look.pop("color", NEUTRAL), {"dash": True, **look}, "label", "dash", "width")
    return Layer("rule", fetch, {**made, "axis": "y" if x is None else "x"})


def get_array(data: Data, source: Source, *, complex_too: bool = False) -> np.ndarray:
    """Return the numbers that `source` names in `data`, or holds itself, as floats.

    Raises:
        PictureError: if the key is absent, or what it names is empty or no numbers.
    """
    if isinstance(source, str):
        if source not in data:
            raise PictureError(f"the callback returned no {source!r}, only {sorted(data)}")
        value = data[source]
    else:
        value = source
    array = np.asarray(value)
    if array.dtype.kind not in "biuf" + "c" * complex_too or array.size == 0:
        raise PictureError(
            f"{_name(source)}: wanted numbers, got {array.dtype} of shape {array.shape}"
        )
    return array if array.dtype.kind == "c" else array.astype(float)


def _name(source: Source) -> str:
    return repr(source) if isinstance(source, str) else "array"


def _look(color: str | None, look: dict[str, Any], *known: str) -> dict[str, Any]:
    unknown = set(look) - set(known)
    if unknown:
        raise TypeError(f"unknown look {sorted(unknown)}; there are: {sorted(known)}")
    return {**look, "color": COLORS.get(color, color) if color else None}
