"""What a live picture is made of: panels of layers, encoded as frames.

A layer names its data by keys of the mapping that a callback returns, or holds arrays itself:
`lines("t", "y")`, `points("eigenvalues")`, `rule(y=0)`. Its color is a name of `style.COLORS` or
hexadecimal, by default the next of the cycle. `encode` turns panels and a callback's mapping into
one frame: a JSON-able layout and one block of float32 bytes, which `canvas.js` draws.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmc.view.style import COLORS, CYCLE, NEUTRAL

Data = Mapping[str, Any]
Source = str | ArrayLike
"""A key of the callback's result, or the array itself."""

_Arrays = dict[str, np.ndarray]
_CURVE = ("label", "width", "alpha", "dash", "head")


@dataclass(frozen=True)
class _Layer:
    """One thing that a panel draws: how it looks, and how `arrange` makes arrays of its sources."""

    kind: str
    look: dict[str, Any]
    sources: tuple[Source, ...] = ()
    wanted: str = ""
    arrange: Callable[..., _Arrays | None] = dict
    name: str = ""

    def fetch(self, data: Data) -> _Arrays:
        """The arrays that are drawn; says which shapes were wanted and came."""
        complex_too = self.kind == "points"
        arrays = [_array(data, source, complex_too=complex_too) for source in self.sources]
        made = self.arrange(*arrays)
        if made is None:
            came = " and ".join(str(array.shape) for array in arrays)
            call = f"{self.name or self.kind}({', '.join(map(_name, self.sources))})"
            raise ValueError(f"{call}: wanted {self.wanted}, got {came}")
        return made


@dataclass(frozen=True)
class Panel:
    """Axes with layers; made by `panel`."""

    layers: tuple[_Layer, ...]
    look: dict[str, Any]


def lines(x: Source, y: Source, *, color: str | None = None, **look: Any) -> _Layer:
    """Curves over a common abscissa: x (m,), y (m,) or (m, number).

    `look`: `label`, `width` (px), `alpha`, `dash` (bool), `head` (bool: dots at the time cursor).
    """

    def arrange(X: np.ndarray, Y: np.ndarray) -> _Arrays | None:
        Y = Y[:, None] if Y.ndim == 1 else Y
        return {"x": X, "y": Y.T} if X.ndim == 1 and Y.ndim == 2 and len(X) == len(Y) else None

    wanted = "(m,) and (m, number)"
    return _Layer("lines", _look(color, look, *_CURVE), (x, y), wanted, arrange)


def paths(p: Source, *, color: str | None = None, **look: Any) -> _Layer:
    """Curves in a plane: (time, number, 2), or (time, 2); further coordinates are not drawn.

    `look` as in `lines`; `head` is true by default.
    """

    def arrange(P: np.ndarray) -> _Arrays | None:
        P = P[:, None] if P.ndim == 2 else P
        flat = P.ndim == 3 and P.shape[-1] >= 2
        return {"x": P[..., 0].T, "y": P[..., 1].T} if flat else None

    made = _look(color, {"head": True, **look}, *_CURVE)
    return _Layer("lines", made, (p,), "(time, number, 2)", arrange, "paths")


def points(p: Source, *, color: str | None = None, **look: Any) -> _Layer:
    """Dots: complex numbers (any shape), or (number, 2), or (time, number, 2) for the time cursor.

    `look`: `label`, `radius` (px), `alpha`, `marker` (`"dot"`, `"cross"` or `"ring"`).
    """

    def arrange(P: np.ndarray) -> _Arrays | None:
        if np.iscomplexobj(P):
            P = np.stack([P.real.ravel(), P.imag.ravel()], axis=-1)
        flat = P.ndim in (2, 3) and P.shape[-1] == 2
        return {"x": P[..., 0], "y": P[..., 1]} if flat else None

    made = _look(color, look, "label", "radius", "alpha", "marker")
    return _Layer("points", made, (p,), "complex numbers or (number, 2)", arrange)


def band(x: Source, low: Source, high: Source, *, color: str | None = None, **look: Any) -> _Layer:
    """A filled band between two curves, each (m,); `look`: `label`, `alpha`."""

    def arrange(X: np.ndarray, L: np.ndarray, H: np.ndarray) -> _Arrays | None:
        return {"x": X, "y": L, "y2": H} if (len(X),) == X.shape == L.shape == H.shape else None

    made = _look(color, {"alpha": 0.2, **look}, "label", "alpha")
    return _Layer("band", made, (x, low, high), "(m,) thrice", arrange)


def cells(M: Source) -> _Layer:
    """A matrix as colored, written cells: (rows, columns), or (time, rows, columns).

    Put it alone in a panel. NaN is an empty cell; the largest entry has the strongest color.
    """

    def arrange(A: np.ndarray) -> _Arrays | None:
        if A.ndim not in (2, 3):
            return None
        rows, columns = A.shape[-2:]
        corners = {"x": np.array([0.5, columns + 0.5]), "y": np.array([0.5, rows + 0.5])}
        return {"values": A, **corners}

    return _Layer("cells", {}, (M,), "(rows, columns)", arrange)


def shade(
    *, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None, **look: Any
) -> _Layer:
    """A shaded strip between two abscissas or two ordinates (`-inf` and `inf` reach the edge).

    `look`: `color`, `label`, `alpha`.
    """
    axis, strip = _one(x=x, y=y)
    span = [None if np.isinf(v) else float(v) for v in strip]
    made = _look(look.pop("color", "blue"), {"alpha": 0.1, **look}, "label", "alpha")
    return _Layer("shade", {**made, "axis": axis, "span": span})


def rule(*, x: float | str | None = None, y: float | str | None = None, **look: Any) -> _Layer:
    """A straight line across the panel at an abscissa or an ordinate (a number or a key).

    `look`: `color`, `label`, `dash` (bool), `width` (px).
    """
    axis, where = _one(x=x, y=y)
    made = _look(look.pop("color", NEUTRAL), {"dash": True, **look}, "label", "dash", "width")
    look = {**made, "axis": axis}
    return _Layer("rule", look, (where,), "a number", lambda v: {"value": np.ravel(v)[:1]})


def panel(
    *layers: _Layer,
    x: str,
    y: str,
    title: str = "",
    xlim: tuple[float, float] | None = None,
    ylim: tuple[float, float] | None = None,
    equal: bool = False,
    log: bool = False,
    size: tuple[int, int] = (420, 320),
) -> Panel:
    """Axes that hold layers; the first layers lie lowest.

    `x` and `y` label the axes with their units (`$y_1$` and the like are typeset); `{key}` in the
    title is filled from the callback's result, `{rate:.2f}` formatted. Without limits an axis
    follows the data, and may jump. `equal`: one unit is equally long along both axes; `log`: the
    vertical axis is logarithmic; `size` in CSS pixels.
    """
    if not layers:
        raise ValueError("wanted at least one layer in the panel")
    for name, given in (("xlim", xlim), ("ylim", ylim)):
        if given is not None and not (np.isfinite(given).all() and given[0] < given[1]):
            raise ValueError(f"{name}: wanted two finite rising numbers, got {given}")
    cycle = itertools.cycle(CYCLE)
    colored = [
        replace(layer, look={**layer.look, "color": next(cycle)})
        if layer.look.get("color", "") is None
        else layer
        for layer in layers
    ]
    look = {"x": x, "y": y, "title": title, "xlim": xlim, "ylim": ylim}
    return Panel(tuple(colored), {**look, "equal": equal, "log": log, "size": list(size)})


def encode(panels: Sequence[Panel], data: Data, time: Source | None = None) -> dict[str, Any]:
    """One frame: layout of the panels, the status line, the times (m,), s, and the bytes.

    The entry `text` of `data`, if any, is the status line; `time` is that of the time cursor.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"wanted a mapping of names to arrays, got {type(data).__name__}")
    blocks: list[np.ndarray] = []

    def put(array: np.ndarray) -> dict[str, Any]:
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite: a gap
            blocks.append(np.ascontiguousarray(array, dtype=np.float32))
        return {"at": sum(b.size for b in blocks[:-1]), "shape": list(array.shape)}

    laid_out = [_lay_out(panel, data, put) for panel in panels]
    moments = None if time is None else put(_array(data, time))
    frame = {"panels": laid_out, "text": str(data.get("text", "")), "time": moments}
    return {**frame, "data": b"".join(block.tobytes() for block in blocks)}


def _lay_out(panel: Panel, data: Data, put: Callable[[np.ndarray], Any]) -> dict[str, Any]:
    """A panel's layout, with titles filled in, limits found and arrays put into the frame."""
    made = [layer.fetch(data) for layer in panel.layers]
    look = {**panel.look, "title": _fill(panel.look["title"], data)}
    for limit, names in (("xlim", ("x",)), ("ylim", ("y", "y2"))):
        extents = [arrays[name] for arrays in made for name in names if name in arrays]
        log = look["log"] and limit == "ylim"
        look[limit] = list(look[limit] or _limits(extents, log=log))
    look["layers"] = [
        {"kind": layer.kind, **layer.look, **{name: put(array) for name, array in arrays.items()}}
        for layer, arrays in zip(panel.layers, made, strict=True)
    ]
    return look


def _limits(extents: Sequence[np.ndarray], *, log: bool) -> tuple[float, float]:
    """Limits that hold all finite values (positive ones on a logarithmic axis), with a margin."""
    values = np.concatenate([np.zeros(0), *map(np.ravel, extents)])
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if values.size == 0:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return max(low, high * 1e-12) / 1.5, high * 1.5
    margin = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
    return low - margin, high + margin


def _fill(text: str, data: Data) -> str:
    """Fill `{key}` fields of a title, outside of `$...$`, from the numbers and words of `data`."""
    parts = text.split("$")  # every second part is mathematics, whose braces are its own
    if not any("{" in part for part in parts[::2]):
        return text
    plain = {key: v.item() if getattr(v, "size", 0) == 1 else v for key, v in data.items()}
    try:
        parts[::2] = [part.format(**plain) for part in parts[::2]]
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise ValueError(f"cannot fill the title {text!r} from {sorted(data)}: {error}") from error
    return "$".join(parts)


def _array(data: Data, source: Source, *, complex_too: bool = False) -> np.ndarray:
    """The numbers that `source` names in `data`, or holds itself, as floats."""
    if isinstance(source, str) and source not in data:
        raise ValueError(f"the callback returned no {source!r}, only {sorted(data)}")
    array = np.asarray(data[source] if isinstance(source, str) else source)
    if array.dtype.kind not in "biuf" + "c" * complex_too or array.size == 0:
        raise ValueError(
            f"{_name(source)}: wanted numbers, got {array.dtype} of shape {array.shape}"
        )
    return array if array.dtype.kind == "c" else array.astype(float)


def _one(**given: Any) -> tuple[str, Any]:
    """The one axis that is given, and what."""
    found = [(axis, value) for axis, value in given.items() if value is not None]
    if len(found) != 1:
        raise ValueError(f"wanted x=... or y=..., got {given}")
    return found[0]


def _name(source: Source) -> str:
    return repr(source) if isinstance(source, str) else "array"


def _look(color: str | None, look: dict[str, Any], *known: str) -> dict[str, Any]:
    if unknown := set(look) - set(known):
        raise TypeError(f"unknown look {sorted(unknown)}; there are: {sorted(known)}")
    return {**look, "color": COLORS.get(color, color) if color else None}
