"""What a cap on the slopes costs: the training of `peg_touch` under different caps.

Every capped variant meets k1 + (h/2) k2 < coth(h/(2 tau))/K for half the lags and twice the
stiffness, by construction; they differ in how the room under that line is shared out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import nn

from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.studies import peg_touch
from cmc.studies.peg_touch_arms import HIDDEN, SAFETY, TouchConfig, capped, cppo, room
from cmc.studies.study import Method, Test, last

_BYPASS = {
    name: np.array([[0.0, 0.0], shares])
    for name, shares in {
        "i": (0.0, 0.25),
        "p": (0.25, 0.0),
        "both": (0.15, 0.6),
        "scaled": (0.2, 0.5),
    }.items()
}
"""Shares of the vertical room in a linear bypass of k1 and k2; horizontally no cap binds."""


def _quiet(config: TouchConfig) -> TouchConfig:
    """Little noise vertically."""
    return replace(config, noise=(-1.0, -3.0))


def _loud(config: TouchConfig) -> TouchConfig:
    return replace(config, noise=(-1.0, -1.0))


def _scaled(config: TouchConfig) -> TouchConfig:
    """The nominal stiffness is divided out, so that the cap is one on the loop gain."""
    return peg_touch.scaled(config)


def _scaled_quiet(config: TouchConfig) -> TouchConfig:
    return _scaled(_quiet(config))


def _separate(share: float) -> Callable[..., nn.Module]:
    """Give k1 a share of the room and (h/2) k2 the rest."""

    def network(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
        high = SAFETY * room(config, [share, 1.0 - share])
        return ModularPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds, slope_max=high))

    return network


def _joint(bypass: str | None = None, **options: Any) -> Callable[..., nn.Module]:
    """Cap k1 + (h/2) k2."""

    def network(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
        floor = {} if bypass is None else {"slope_min": room(config, _BYPASS[bypass])}
        return capped(config, seeds, **floor, **options)

    return network


def _free_bypass(config: TouchConfig, seeds: Sequence[int]) -> nn.Module:
    low = room(config, _BYPASS["both"])
    return ModularPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds, slope_min=low))


METHODS: dict[str, Method] = {
    name: peg_touch.arm(title, network, adapt)
    for name, title, network, adapt in (
        ("none", "no cap", cppo, _loud),
        ("separate", "half the room to each slope", _separate(0.5), _loud),
        ("separate_p", "nine tenths to k1", _separate(0.9), _loud),
        ("separate_i", "nine tenths to k2", _separate(0.1), _loud),
        ("joint", "joint cap on k1 + (h/2) k2", _joint(), _loud),
        (
            "joint_odd",
            "joint cap, no biases: the product bound is reached",
            _joint(bias=False),
            _loud,
        ),
        ("joint_shallow", "joint cap, one hidden layer", _joint(hidden=(32,)), _loud),
        ("joint_bypass_i", "joint cap, a quarter in a bypass of k2", _joint("i"), _loud),
        ("joint_bypass_p", "joint cap, a quarter in a bypass of k1", _joint("p"), _loud),
        ("joint_bypass", "joint cap, most of it in a bypass", _joint("both"), _loud),
        ("scaled", "joint cap on the loop gain", _joint(), lambda c: _scaled(_loud(c))),
        ("scaled_quiet", "joint cap on the loop gain, little noise", _joint(), _scaled_quiet),
        (
            "scaled_bypass",
            "joint cap on the loop gain, most of it in a bypass, little noise",
            _joint("scaled"),
            _scaled_quiet,
        ),
        (
            "scaled_odd",
            "joint cap on the loop gain, little noise, no biases",
            _joint(bias=False),
            _scaled_quiet,
        ),
        ("joint_quiet", "joint cap, little noise", _joint(), _quiet),
        ("none_bypass", "no cap, the same bypass", _free_bypass, _loud),
        ("none_quiet", "no cap, little noise", cppo, _quiet),
    )
}

STUDY = replace(
    peg_touch.STUDY,
    name="peg_touch_caps",
    about="what a cap on the slopes costs in return",
    methods=METHODS,
    tests=tuple(Test(shift, 1000, peg_touch.change(shift), last) for shift in peg_touch.SHIFTS),
    length=5000,
    every=5000,
)
