"""Policies: the transforms and the sign rule around a network, and the same as a numpy function."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.policies.stacked import SignalNetwork, check_tensor, tanh
from cmc.theory.arrays import Array, checked, filled, need

Real = NDArray[np.floating]
Function = Callable[[Real], Real]


class ModularPolicy(nn.Module):
    """u = u0 + T_a a with a_i = -sign(R_ii) pi_i(z_i, integral of z_i) and z = T_y y.

    Along z' = Lambda z + R a the slope of the command has the opposite sign of R_ii, and nothing
    else flips a sign (`constraint_sign`).

    Args:
        network: maps s (..., n, 2) to (..., n); has an attribute `n`.
        layout: where an observation holds "s" (2 n numbers, (n, 2) row by row) or, in its place,
            "z" and "integral" (n each); "R" (n, the diagonal) and "T_a" (n n, row by row). By
            default the observation is "s". Without "R" its diagonal is the argument `R`; without
            "T_a" it is the identity, as where the environment applies it.
        R: diagonal of R, broadcast to (n,), where the observation does not hold it.
        u0: centre of the command, broadcast to (n,).
        normalise: divide by |R_ii| in place of taking the sign alone, a_i = -pi_i / R_ii, so that
            the slopes of pi are loop gains in 1/s whatever the plant: z_i' = Lambda_i z_i - pi_i.
        integral: False feeds zero in place of the integral, the proportional-only variant.
        squash: tanh(pi_i) in place of pi_i: commands within 1 of u0. Since tanh' <= 1, upper bounds
            on the slopes of pi hold for the command too.
    """

    u0: Tensor
    R: Tensor

    def __init__(
        self,
        network: nn.Module,
        *,
        layout: Mapping[str, slice] | None = None,
        R: ArrayLike = 1.0,
        u0: ArrayLike = 0.0,
        normalise: bool = False,
        integral: bool = True,
        squash: bool = False,
    ) -> None:
        super().__init__()
        _check_network(network)
        self.network, self.normalise, self.integral = network, normalise, integral
        self.squash = squash
        self.n = int(network.n)  # type: ignore[arg-type]
        fits = layout is None or isinstance(layout, Mapping)
        need(fits, "layout", "a mapping of names to slices", layout)
        self.layout = {"s": slice(0, 2 * self.n)} if layout is None else dict(layout)
        parts = self.layout.values()
        signals = set(self.layout) - {"R", "T_a"} if all(isinstance(p, slice) for p in parts) else 0
        if signals not in ({"s"}, {"z", "integral"}):
            raise ValueError(
                "layout needs slices for 's' (or 'z' and 'integral'), 'R' and 'T_a'; "
                f"got {self.layout}"
            )
        dtype = _dtype(network)
        for name, value in (("u0", u0), ("R", R)):
            vector = torch.as_tensor(filled(name, value, self.n), dtype=dtype)
            self.register_buffer(name, vector, persistent=False)
        if not bool((self.R != 0).all()):
            raise ValueError(f"R needs a diagonal without zeros, got {R!r:.60}")

    def signals(self, observation: Any) -> Any:
        """The signals s (..., n, 2) that an observation (..., d) holds; torch or numpy."""
        names = ("s",) if "s" in self.layout else ("z", "integral")
        parts = [observation[..., self.layout[name]] for name in names] if observation.ndim else []
        if not parts or any(part.shape[-1] != 2 * self.n // len(names) for part in parts):
            raise ValueError(
                f"observation needs shape (..., d) with {' and '.join(names)} at "
                f"{[self.layout[name] for name in names]}, got {tuple(observation.shape)}"
            )
        if len(parts) == 1:
            return parts[0].reshape(*parts[0].shape[:-1], self.n, 2)
        return torch.stack(parts, -1) if isinstance(observation, Tensor) else np.stack(parts, -1)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d) laid out as `layout` says."""
        check_tensor("observation", observation)
        s = self.signals(observation)
        R = observation[..., self.layout["R"]] if "R" in self.layout else self.R
        if "T_a" not in self.layout:
            return self.command(s, R)
        T_a = observation[..., self.layout["T_a"]].unflatten(-1, (self.n, self.n))
        return self.command(s, R, T_a)

    def command(self, s: Tensor, R: Tensor, T_a: Tensor | None = None) -> Tensor:
        """Return u = u0 + T_a a from s (..., n, 2), diag(R) (..., n) and T_a (..., n, n)."""
        check_tensor("s", s)
        check_tensor("R", R, self.n)
        factor = 1.0 / R if self.normalise else torch.sign(R)
        pi = self.network(self._visible(s))
        pi = tanh(pi) if self.squash else pi
        if T_a is None:
            return torch.addcmul(self.u0, factor, pi, value=-1.0)  # constraint_sign
        check_tensor("T_a", T_a, self.n, self.n)
        return self.u0 - (T_a * (factor * pi).unsqueeze(-2)).sum(-1)  # constraint_sign

    def jacobian(self, s: Tensor) -> Tensor:
        """Own slopes d pi_i / d s_ij of the network, before the sign rule, (..., n, 2)."""
        check_tensor("s", s)
        slope = self.network.jacobian(self._visible(s))  # type: ignore[operator]
        if slope.ndim > s.ndim:  # a full matrix (..., i, k, j)
            slope = torch.diagonal(slope, dim1=-3, dim2=-2).transpose(-1, -2)
        return self._visible(slope)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the slopes' magnitude, ([seeds,] n, 2) each."""
        if not hasattr(self.network, "slope_bounds"):
            name = type(self.network).__name__
            raise TypeError(f"{name} has no slope_bounds(): nothing bounds its slopes")
        low, high = self.network.slope_bounds()  # type: ignore[operator]
        seen = np.array([1.0, float(self.integral)])
        return low * seen * (not self.squash), high * seen  # tanh saturates

    def _visible(self, s: Tensor) -> Tensor:
        return s if self.integral else s * s.new_tensor([1.0, 0.0])


class DirectPolicy(nn.Module):
    """u = u0 + network(part of the observation): no transforms, no sign rule.

    The network maps that part, flat (..., k), to (..., n), such as `JointNetwork(n, inputs=k)`;
    with `squash` it is tanh(network), so that commands lie within 1 of u0.
    """

    u0: Tensor

    def __init__(
        self,
        network: nn.Module,
        *,
        part: slice = slice(None),
        u0: ArrayLike = 0.0,
        squash: bool = False,
    ) -> None:
        super().__init__()
        _check_network(network)
        need(isinstance(part, slice), "part", "a slice of the observation", part)
        self.network, self.part, self.squash = network, part, squash
        self.n = int(network.n)  # type: ignore[arg-type]
        centre = torch.as_tensor(filled("u0", u0, self.n), dtype=_dtype(network))
        self.register_buffer("u0", centre, persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d)."""
        value = self.unsquashed(observation)
        return self.u0 + (tanh(value) if self.squash else value)

    def signals(self, observation: Any) -> Any:
        """What the network sees of an observation."""
        return observation[..., self.part]

    def unsquashed(self, observation: Tensor) -> Tensor:
        """The network's values (..., n), before any tanh."""
        return self.network(self.signals(observation))


def _check_network(network: Any) -> None:
    fits = isinstance(network, nn.Module) and hasattr(network, "n")
    need(fits, "network", "a torch module with n", network)


def _dtype(module: nn.Module) -> torch.dtype:
    return next(chain(module.parameters(), module.buffers())).dtype


def as_numpy(policy: nn.Module) -> Function:
    """A function from numpy observations to numpy commands, the weights held as they are.

    It takes what the module takes, in the module's precision, and raises ValueError for an
    observation that is not finite. Stacked tanh networks run in numpy, which for the few rows of a
    control step costs a fifth of a call into torch; any other policy runs in torch.
    """
    need(isinstance(policy, nn.Module), "policy", "a torch module", policy)
    if any(part.device.type != "cpu" for part in chain(policy.parameters(), policy.buffers())):
        policy = copy.deepcopy(policy).cpu()
    dtype = torch.empty(0, dtype=_dtype(policy)).numpy().dtype
    run = _in_numpy(policy)

    def act(observation: Real) -> Real:
        found = checked("observation", observation, "... d").astype(dtype, copy=False)
        if run is not None:
            return run(found)
        with torch.inference_mode():
            return policy(torch.from_numpy(found)).numpy()

    return act


def _in_numpy(policy: nn.Module) -> Function | None:
    """The policy in numpy, or None where only torch will do."""
    if not isinstance(policy, (ModularPolicy, DirectPolicy)):
        return None
    if not isinstance(policy.network, SignalNetwork):
        return None
    factor = np.array(-1.0, dtype=policy.u0.numpy().dtype)
    if isinstance(policy, ModularPolicy):
        if not policy.integral or {"R", "T_a"} & set(policy.layout):
            return None
        factor = (1.0 / policy.R if policy.normalise else torch.sign(policy.R)).numpy()
    pi, centre, squash = _layers(policy.network), policy.u0.numpy().copy(), policy.squash
    signals = policy.signals

    def run(observation: Real) -> Real:
        value = pi(signals(observation))
        return centre - factor * (np.tanh(value) if squash else value)  # constraint_sign

    return run


def _layers(network: SignalNetwork) -> Function:
    """The network with copies of its weights."""
    W = [weight.detach().numpy().copy() for weight in network.used_weights()]
    b = [bias.detach().numpy().copy() for bias in network.mlp.biases]

    def run(s: Real) -> Real:
        x = network.inputs_of(s)
        for layer, weight in enumerate(W):
            x = np.matmul(x, weight)
            if b:
                x += b[layer]
            if layer < len(W) - 1:
                np.tanh(x, out=x)
        return network.outputs_of(x, s)

    return run
