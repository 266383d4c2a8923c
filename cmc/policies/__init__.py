"""Control policies in torch: positive networks, their unconstrained twins, transforms around them.

A network maps the auxiliary signals s (..., n, 2), which hold (z_i, integral of z_i), to one output
per dimension (..., n). A policy puts the transforms and the sign rule around a network and maps an
observation to a command. Both carry an optional leading axis of seeds, so that several trainings
run as one batched product.
"""

from __future__ import annotations

from cmc.policies.convex import ConvexGradientNetwork
from cmc.policies.fast_tanh import tanh
from cmc.policies.frozen import as_numpy
from cmc.policies.modular import DirectPolicy, ModularPolicy
from cmc.policies.positive import NegativeWeightError, PositiveNetwork
from cmc.policies.stacked import StackedMLP
from cmc.policies.unconstrained import IndependentNetwork, JointNetwork

__all__ = [
    "ConvexGradientNetwork",
    "DirectPolicy",
    "IndependentNetwork",
    "JointNetwork",
    "ModularPolicy",
    "NegativeWeightError",
    "PositiveNetwork",
    "StackedMLP",
    "as_numpy",
    "tanh",
]
