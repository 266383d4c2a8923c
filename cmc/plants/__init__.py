"""Named systems that the lessons, the tests and the environments share."""

from __future__ import annotations

from typing import Any

from cmc.plants.base import LinearPlant, Plant
from cmc.plants.named import CoupledLags, Lags, Pendulum, Spiral, UnstableMode
from cmc.plants.peg import Peg

__all__ = [
    "CoupledLags",
    "Lags",
    "LinearPlant",
    "Peg",
    "Pendulum",
    "Plant",
    "Spiral",
    "UnstableMode",
    "get",
    "names",
]

_PLANTS: dict[str, type[Plant]] = {
    kind.name: kind for kind in (CoupledLags, Lags, Peg, Pendulum, Spiral, UnstableMode)
}


def names() -> tuple[str, ...]:
    """Names of the plants that `get` builds."""
    return tuple(sorted(_PLANTS))


def get(name: str, **params: Any) -> Plant:
    """Build a plant by name; `params` go to its constructor."""
    if not isinstance(name, str) or name not in _PLANTS:
        raise ValueError(f"name needs one of {', '.join(names())}; got {name!r:.60}")
    return _PLANTS[name](**params)
