"""A policy with its present weights as a plain numpy function: fast for small batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.policies.modular import DirectPolicy, ModularPolicy
from cmc.policies.positive import PositiveNetwork
from cmc.policies.stacked import StackedMLP
from cmc.policies.unconstrained import IndependentNetwork, JointNetwork

Real = NDArray[np.floating]
Function = Callable[[Real], Real]


def as_numpy(policy: nn.Module) -> Function:
    """Return a function from numpy observations to numpy commands, the weights held as they are.

    Tanh networks behind `ModularPolicy` and `DirectPolicy` run in numpy, which for the few rows of
    a control step costs a fifth of a call into torch; any other policy runs in torch.

    Args:
        policy: module from observations to commands.

    Returns:
        The function; it takes what the module takes, in the module's precision, and raises
        ValueError for an observation that is not finite.
    """
    dtype = next(policy.parameters()).detach().cpu().numpy().dtype
    run = _in_numpy(policy) or _in_torch(policy)

    def act(observation: Real) -> Real:
        observation = np.asarray(observation, dtype=dtype)
        if not np.isfinite(observation).all():
            raise ValueError("wanted finite observations; got NaN or infinity")
        return run(observation)

    return act


def _in_torch(policy: nn.Module) -> Function:
    def run(observation: Real) -> Real:
        with torch.inference_mode():
            return policy(torch.from_numpy(observation)).numpy()

    return run


def _in_numpy(policy: nn.Module) -> Function | None:
    """The policy in numpy, or None where only torch will do."""
    if isinstance(policy, DirectPolicy) and isinstance(policy.network, JointNetwork):
        direct, centre, part = _joint(policy.network), policy.u0.numpy().copy(), policy.part
        return lambda observation: centre + direct(observation[..., part])
    if not isinstance(policy, ModularPolicy) or set(policy.layout) != {"s"} or not policy.integral:
        return None
    network, columns, n = policy.network, policy.layout["s"], policy.n
    if isinstance(network, JointNetwork):
        pi = _joint(network)
    elif isinstance(network, (PositiveNetwork, IndependentNetwork)):
        pi = _independent(network)
    else:
        return None
    centre = policy.u0.numpy().copy()
    factor = (1.0 / policy.R if policy.normalise else torch.sign(policy.R)).numpy()
    if isinstance(network, JointNetwork):
        return lambda observation: centre - factor * pi(observation[..., columns])

    def run(observation: Real) -> Real:
        s = observation[..., columns]
        return centre - factor * pi(s.reshape(*s.shape[:-1], n, 2))  # constraint_sign

    return run


def _joint(network: JointNetwork) -> Function:
    evaluate = _layers(network.mlp, list(network.mlp.weights))
    stack, inputs, outputs = network.mlp.stack, network.inputs, network.n

    def run(x: Real) -> Real:
        _check_seeds(x, network.seeds)
        return evaluate(x.reshape(stack, -1, inputs)).reshape(*x.shape[:-1], outputs)

    return run


def _independent(network: PositiveNetwork | IndependentNetwork) -> Function:
    weights, slope = list(network.mlp.weights), None
    if isinstance(network, PositiveNetwork):
        weights = network.positive_weights()
        slope = network.slope_min.numpy().copy() if bool(network.slope_min.any()) else None
    evaluate = _layers(network.mlp, weights)
    n, seeds = network.n, network.seeds or 1

    def run(s: Real) -> Real:
        _check_seeds(s, network.seeds)
        x = s.reshape(seeds, -1, n, 2).swapaxes(1, 2).reshape(seeds * n, -1, 2)
        pi = evaluate(x).reshape(seeds, n, -1).swapaxes(1, 2).reshape(s.shape[:-1])
        return pi if slope is None else pi + (slope * s).sum(-1)

    return run


def _check_seeds(x: Real, seeds: int | None) -> None:
    if seeds is not None and x.shape[0] != seeds:
        raise ValueError(f"wanted a leading axis of {seeds} seeds; got shape {x.shape}")


def _layers(mlp: StackedMLP, weights: Sequence[Tensor]) -> Function:
    """The stacked network with copies of the given weights."""
    W = [weight.detach().numpy().copy() for weight in weights]
    b = [bias.detach().numpy().copy() for bias in mlp.biases]

    def run(x: Real) -> Real:
        for layer, weight in enumerate(W):
            x = np.matmul(x, weight)
            if b:
                x += b[layer]
            if layer < len(W) - 1:
                np.tanh(x, out=x)
        return x

    return run
