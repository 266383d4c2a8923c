"""The modular policy: transforms and the sign rule around one network per dimension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

Array = NDArray[np.float64]


class ModularPolicy(nn.Module):
    """u = u0 + T_a a with a_i = -sign(R_ii) pi_i(z_i, integral of z_i) and z = T_y y.

    The input is the latent signal y whose dynamics are z' = Lambda z + R a; the slope of the
    command has the opposite sign of R_ii and nothing else flips a sign (`constraint_sign`).

    Args:
        network: maps s (..., n, 2) to (..., n); has an attribute `n`.
        layout: where an observation holds "s" (2 n numbers, (n, 2) row by row), "R" (n, the
            diagonal) and "T_a" (n n, row by row); without "T_a" it is the identity. Needed for
            `forward`.
        u0: centre of the command, broadcast to (n,).
        normalise: divide by |R_ii| in place of taking the sign alone, a_i = -pi_i / R_ii, so that
            the slopes of pi are loop gains in 1/s whatever the plant: z_i' = Lambda_i z_i - pi_i.
    """

    u0: Tensor

    def __init__(
        self,
        network: nn.Module,
        *,
        layout: Mapping[str, slice] | None = None,
        u0: ArrayLike = 0.0,
        normalise: bool = False,
    ) -> None:
        super().__init__()
        if layout is not None and not {"s", "R"} <= set(layout):
            raise ValueError(f"wanted a layout with 's' and 'R'; got {sorted(layout)}")
        self.network, self.normalise = network, normalise
        self.n = int(network.n)  # type: ignore[arg-type]
        self.layout = None if layout is None else dict(layout)
        dtype = next(network.parameters()).dtype
        centre = np.broadcast_to(np.asarray(u0, dtype=np.float64), (self.n,))
        self.register_buffer("u0", torch.as_tensor(centre.copy(), dtype=dtype))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d) laid out as `layout` says."""
        if self.layout is None:
            raise ValueError("this policy has no observation layout; use `command`")
        s = observation[..., self.layout["s"]].unflatten(-1, (self.n, 2))
        R = observation[..., self.layout["R"]]
        if "T_a" not in self.layout:
            return self.command(s, R)
        T_a = observation[..., self.layout["T_a"]].unflatten(-1, (self.n, self.n))
        return self.command(s, R, T_a)

    def command(self, s: Tensor, R: Tensor, T_a: Tensor | None = None) -> Tensor:
        """Return u = u0 + T_a a from s (..., n, 2), diag(R) (..., n) and T_a (..., n, n)."""
        factor = 1.0 / R if self.normalise else torch.sign(R)
        a = -factor * self.network(s)  # constraint_sign
        if T_a is not None:
            a = (T_a * a.unsqueeze(-2)).sum(-1)
        return self.u0 + a

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes of the network, before the sign rule: s (..., n, 2) to (..., n, 2)."""
        return self.network.jacobian(s)  # type: ignore[operator]

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the slopes' magnitude, ([seeds,] n, 2) each."""
        return self.network.slope_bounds()  # type: ignore[operator]


class DirectPolicy(nn.Module):
    """u = u0 + network(part of the observation): no transforms, no sign rule.

    Args:
        network: maps the flat part (..., k) to (..., n), such as `JointNetwork(n, inputs=k)`.
        part: which entries of the observation it sees.
        u0: centre of the command, broadcast to (n,).
    """

    u0: Tensor

    def __init__(self, network: nn.Module, *, part: slice, u0: ArrayLike = 0.0) -> None:
        super().__init__()
        self.network, self.part = network, part
        self.n = int(network.n)  # type: ignore[arg-type]
        dtype = next(network.parameters()).dtype
        centre = np.broadcast_to(np.asarray(u0, dtype=np.float64), (self.n,))
        self.register_buffer("u0", torch.as_tensor(centre.copy(), dtype=dtype))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d)."""
        return self.u0 + self.network(observation[..., self.part])


def as_numpy(policy: nn.Module) -> Any:
    """Return a function from numpy observations to numpy commands that runs `policy`.

    Raises (from the returned function):
        ValueError: if an observation is not finite.
    """
    dtype = next(policy.parameters()).dtype

    def act(observation: np.ndarray) -> np.ndarray:
        if not np.isfinite(observation).all():
            raise ValueError("wanted finite observations; got NaN or infinity")
        with torch.no_grad():
            return policy(torch.as_tensor(observation, dtype=dtype)).numpy()

    return act
