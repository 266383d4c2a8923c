"""Control policies in torch: positive networks, their unconstrained twins, transforms around them.

A network maps the auxiliary signals s (..., n, 2), which hold (z_i, integral of z_i), to one output
per dimension (..., n); a policy puts the transforms and the sign rule around it and maps an
observation to a command. An optional leading axis of seeds runs several trainings as one batch.
"""

from __future__ import annotations

from cmc.policies.modular import DirectPolicy, ModularPolicy, as_numpy
from cmc.policies.networks import LinearNetwork, NegativeWeightError, PositiveNetwork
from cmc.policies.rivals import ConvexGradientNetwork, IndependentNetwork, JointNetwork
from cmc.policies.stacked import StackedMLP, tanh

__all__ = [
    "ConvexGradientNetwork",
    "DirectPolicy",
    "IndependentNetwork",
    "JointNetwork",
    "LinearNetwork",
    "ModularPolicy",
    "NegativeWeightError",
    "PositiveNetwork",
    "StackedMLP",
    "as_numpy",
    "tanh",
]
