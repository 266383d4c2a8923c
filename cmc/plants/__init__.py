"""Named systems that the lessons, the tests and the environments share."""

from __future__ import annotations

from typing import Any

from cmc.plants.base import Plant
from cmc.plants.linear import CoupledLags, Lags, LinearPlant, Spiral, UnstableMode
from cmc.plants.loops import FloquetLoop, Loop, TwoAttractorLoop
from cmc.plants.nonlinear import Pendulum, VanDerPol
from cmc.plants.peg import Peg

__all__ = [
    "CoupledLags",
    "FloquetLoop",
    "Lags",
    "LinearPlant",
    "Loop",
    "Peg",
    "Pendulum",
    "Plant",
    "Spiral",
    "TwoAttractorLoop",
    "UnstableMode",
    "VanDerPol",
    "get",
    "loop",
    "loop_names",
    "names",
]

_PLANTS: dict[str, type[Plant]] = {
    kind.name: kind for kind in (CoupledLags, Lags, Peg, Pendulum, Spiral, UnstableMode, VanDerPol)
}
_LOOPS: dict[str, type[FloquetLoop] | type[TwoAttractorLoop]] = {
    kind.name: kind for kind in (FloquetLoop, TwoAttractorLoop)
}


def names() -> tuple[str, ...]:
    """Names of the plants that `get` builds."""
    return tuple(sorted(_PLANTS))


def get(name: str, **params: Any) -> Plant:
    """Build a plant by name; `params` go to its constructor.

    Raises:
        ValueError: if there is no such plant.
    """
    if name not in _PLANTS:
        raise ValueError(f"no plant is called {name!r}; there are {', '.join(names())}")
    return _PLANTS[name](**params)


def loop_names() -> tuple[str, ...]:
    """Names of the counter-example loops that `loop` builds."""
    return tuple(sorted(_LOOPS))


def loop(name: str, **params: Any) -> Loop:
    """Build a counter-example loop by name; `params` go to its constructor.

    Raises:
        ValueError: if there is no such loop.
    """
    if name not in _LOOPS:
        raise ValueError(f"no loop is called {name!r}; there are {', '.join(loop_names())}")
    return _LOOPS[name](**params)
