"""Exercises of lesson 13: orders, the longest hold, what a limit can hold, a plant of one's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close
from cmc.plants import Plant
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.theory.certify import certify
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region

Array = NDArray[np.float64]


@check("13-order")
def order(answer: Callable[[Array], Any]) -> None:
    """Judge `my_order(f_y)`: upper triangular in that order, None where two drive each other."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 5, 6):
        names = rng.permutation(n)
        f_y = np.triu(rng.uniform(0.5, 1.5, (n, n)) * (rng.random((n, n)) < 0.6))[names][:, names]
        found = answer(f_y.copy())
        expect(found is not None, f"an order exists for\n{f_y.round(1)}")
        found = [int(i) for i in found]
        expect(sorted(found) == list(range(n)), f"{found} is no order of {n} signals")
        below = np.tril(f_y[found][:, found], -1)
        expect(not below.any(), f"in the order {found} a signal still drives one after it")
    ring = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])
    expect(answer(ring) is None, "in a ring of three everybody is driven: there is no order")


@check("13-hold")
def hold(answer: Callable[[Callable[[float], bool], float, float], float]) -> None:
    """Judge `my_hold(proved, low, high)`: the largest proved h to 1 %, with few questions."""
    for edge, low, high in ((0.37, 0.05, 3.0), (2.9, 0.05, 3.0), (0.051, 0.05, 3.0)):
        asked: list[float] = []

        def proved(h: float, edge: float = edge, asked: list[float] = asked) -> bool:
            asked.append(h)
            return h <= edge

        found = answer(proved, low, high)
        expect(found is not None, "the hold is None; does your function return something?")
        expect(found <= edge, f"{found:.4g} s is not proved, the edge is at {edge:.4g} s")
        expect(found >= 0.99 * edge, f"{found:.4g} s falls short of {edge:.4g} s by over 1 %")
        expect(len(asked) <= 30, f"{len(asked)} questions, wanted at most 30")


@check("13-angle")
def angle(answer: Callable[[float], float]) -> None:
    """Judge `my_angle(limit)`: 3 limit = 15 sin(angle), 90 degrees where it always suffices."""
    for limit in (0.5, 2.0, 4.9):
        found = answer(limit)
        expect_close(found, np.arcsin(3 * limit / 15), f"the angle that {limit} Nm can hold")
    for limit in (5.0, 8.0):
        expect_close(answer(limit), np.pi / 2, f"with {limit} Nm every angle up to 90 degrees:")


@check("13-own")
def own(answer: Callable[[], Any]) -> None:
    """Judge `my_plant()`: f, y, u, floor, cap; not linear, n >= 2, certified in the middle."""
    found = answer()
    expect(
        isinstance(found, tuple) and len(found) == 5, "wanted five things: f, y, u, floor and cap"
    )
    f, y, u, floor, cap = found
    plant = Plant.from_function(f, y=y, u=u)
    expect(plant.n >= 2, f"wanted at least two signals, got {plant.n}")
    expect(not plant.constant, "this plant is linear: its Jacobians are the same everywhere")
    fits = [option for option in transforms_that_fit(plant) if option.possible]
    expect(fits, "no transforms fit; print transforms_that_fit(plant)")
    middle, half = (plant.y_low + plant.y_high) / 2, (plant.y_high - plant.y_low) / 2
    network = PositiveNetwork(plant.n, slope_min=floor, slope_max=cap)
    policy = ModularPolicy(network, u0=plant.hold(middle))
    box = Region(middle - half / 2, middle + half / 2, integral=0.5, points=5)
    said = certify(policy, plant, region=box, transforms=fits[0].transforms, y_ref=middle)
    expect(said, f"with {fits[0].name}: {said}")
