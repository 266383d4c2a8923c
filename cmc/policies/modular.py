"""Policies: the transforms and the sign rule around a network, and the same as a numpy function."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.policies.networks import LinearNetwork, PositiveNetwork
from cmc.policies.rivals import IndependentNetwork, JointNetwork
from cmc.policies.stacked import StackedMLP, tanh

Array = NDArray[np.float64]
Real = NDArray[np.floating]
Function = Callable[[Real], Real]


class ModularPolicy(nn.Module):
    """u = u0 + T_a a with a_i = -sign(R_ii) pi_i(z_i, integral of z_i) and z = T_y y.

    The input is the latent signal y whose dynamics are z' = Lambda z + R a; the slope of the
    command has the opposite sign of R_ii and nothing else flips a sign (`constraint_sign`).

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
        self.network, self.normalise, self.integral = network, normalise, integral
        self.squash = squash
        self.n = int(network.n)  # type: ignore[arg-type]
        self.layout = {"s": slice(0, 2 * self.n)} if layout is None else dict(layout)
        signals = set(self.layout) - {"R", "T_a"}
        if signals not in ({"s"}, {"z", "integral"}):
            raise ValueError(
                "wanted a layout of 's' (or 'z' and 'integral'), 'R' and 'T_a'; "
                f"got {sorted(self.layout)}"
            )
        dtype = _dtype(network)
        self.register_buffer("u0", _vector("u0", u0, self.n, dtype), persistent=False)
        self.register_buffer("R", _vector("R", R, self.n, dtype), persistent=False)
        if not bool((self.R != 0).all()):
            raise ValueError(f"wanted no zero on the diagonal of R; got {R!r}")
        self.register_load_state_dict_pre_hook(_rename)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d) laid out as `layout` says."""
        if "s" in self.layout:
            s = observation[..., self.layout["s"]].unflatten(-1, (self.n, 2))
        else:
            s = torch.stack([observation[..., self.layout[k]] for k in ("z", "integral")], -1)
        R = observation[..., self.layout["R"]] if "R" in self.layout else self.R
        if "T_a" not in self.layout:
            return self.command(s, R)
        T_a = observation[..., self.layout["T_a"]].unflatten(-1, (self.n, self.n))
        return self.command(s, R, T_a)

    def command(self, s: Tensor, R: Tensor, T_a: Tensor | None = None) -> Tensor:
        """Return u = u0 + T_a a from s (..., n, 2), diag(R) (..., n) and T_a (..., n, n)."""
        factor = 1.0 / R if self.normalise else torch.sign(R)
        pi = self.network(self._visible(s))
        pi = tanh(pi) if self.squash else pi
        if T_a is None:
            return torch.addcmul(self.u0, factor, pi, value=-1.0)  # constraint_sign
        return self.u0 - (T_a * (factor * pi).unsqueeze(-2)).sum(-1)  # constraint_sign

    def jacobian(self, s: Tensor) -> Tensor:
        """Own slopes d pi_i / d s_ij of the network, before the sign rule, (..., n, 2)."""
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
        if self.squash:  # tanh saturates
            low = 0.0 * low
        if not self.integral:
            low[..., 1], high[..., 1] = 0.0, 0.0
        return low, high

    def _visible(self, s: Tensor) -> Tensor:
        return s if self.integral else s * s.new_tensor([1.0, 0.0])


class DirectPolicy(nn.Module):
    """u = u0 + network(part of the observation): no transforms, no sign rule.

    Args:
        network: maps the flat part (..., k) to (..., n), such as `JointNetwork(n, inputs=k)`.
        part: which entries of the observation it sees; all by default.
        u0: centre of the command, broadcast to (n,).
        squash: tanh(network) in place of the network: commands within 1 of u0.
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
        self.network, self.part, self.squash = network, part, squash
        self.n = int(network.n)  # type: ignore[arg-type]
        self.register_buffer("u0", _vector("u0", u0, self.n, _dtype(network)), persistent=False)
        self.register_load_state_dict_pre_hook(_rename)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d)."""
        value = self.unsquashed(observation)
        return self.u0 + (tanh(value) if self.squash else value)

    def unsquashed(self, observation: Tensor) -> Tensor:
        """The network's values (..., n), before any tanh."""
        return self.network(observation[..., self.part])


def _rename(module: nn.Module, state: dict[str, Any], prefix: str, *_rest: Any) -> None:
    """Names of older files: `net` was `network`, or the layers of a direct policy."""
    to = "network." if isinstance(module, ModularPolicy) else "network.mlp."
    for key in [k for k in state if k.startswith(f"{prefix}net.")]:
        state[prefix + to + key.removeprefix(f"{prefix}net.")] = state.pop(key)


def _dtype(module: nn.Module) -> torch.dtype:
    return next(chain(module.parameters(), module.buffers())).dtype


def _vector(name: str, value: ArrayLike, n: int, dtype: torch.dtype) -> Tensor:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (1,), (n,)) or not np.isfinite(array).all():
        raise ValueError(f"wanted {name} finite, a number or ({n},); got {value!r}")
    return torch.as_tensor(np.broadcast_to(array, (n,)).copy(), dtype=dtype)


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
    dtype = torch.empty(0, dtype=_dtype(policy)).numpy().dtype
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
        bound: Any = np.tanh if policy.squash else np.asarray
        return lambda observation: centre + bound(direct(observation[..., part]))
    if not isinstance(policy, ModularPolicy) or {"R", "T_a"} & set(policy.layout):
        return None
    if not policy.integral:
        return None
    network, n = policy.network, policy.n
    pi: Function
    if isinstance(network, JointNetwork) and not network.flat:
        joint = _joint(network)
        pi = lambda s: joint(s.reshape(*s.shape[:-2], 2 * n))  # noqa: E731
    elif isinstance(network, (PositiveNetwork, IndependentNetwork)):
        pi = _independent(network)
    elif isinstance(network, LinearNetwork):
        gains = network.gains.numpy().copy()
        pi = lambda s: (gains * s).sum(-1)  # noqa: E731
    else:
        return None
    centre, squash, layout = policy.u0.numpy().copy(), policy.squash, policy.layout
    factor = (1.0 / policy.R if policy.normalise else torch.sign(policy.R)).numpy()

    def run(observation: Real) -> Real:
        if "s" in layout:
            columns = observation[..., layout["s"]]
            s = columns.reshape(*columns.shape[:-1], n, 2)
        else:
            s = np.stack([observation[..., layout["z"]], observation[..., layout["integral"]]], -1)
        value = pi(s)
        return centre - factor * (np.tanh(value) if squash else value)  # constraint_sign

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
