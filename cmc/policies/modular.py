"""The modular policy: transforms and the sign rule around one network per dimension."""

from __future__ import annotations

from collections.abc import Mapping

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
            diagonal) and "T_a" (n n, row by row). By default the observation is "s". Without
            "R" its diagonal is the argument `R`; without "T_a" it is the identity, as where the
            environment applies it.
        R: diagonal of R, broadcast to (n,), where the observation does not hold it.
        u0: centre of the command, broadcast to (n,).
        normalise: divide by |R_ii| in place of taking the sign alone, a_i = -pi_i / R_ii, so that
            the slopes of pi are loop gains in 1/s whatever the plant: z_i' = Lambda_i z_i - pi_i.
        integral: False feeds zero in place of the integral, the proportional-only variant.
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
    ) -> None:
        super().__init__()
        self.network, self.normalise, self.integral = network, normalise, integral
        self.n = int(network.n)  # type: ignore[arg-type]
        self.layout = {"s": slice(0, 2 * self.n)} if layout is None else dict(layout)
        if "s" not in self.layout or not set(self.layout) <= {"s", "R", "T_a"}:
            raise ValueError(f"wanted a layout of 's', 'R' and 'T_a'; got {sorted(self.layout)}")
        dtype = next(network.parameters()).dtype
        self.register_buffer("u0", _vector("u0", u0, self.n, dtype), persistent=False)
        self.register_buffer("R", _vector("R", R, self.n, dtype), persistent=False)
        if not bool((self.R != 0).all()):
            raise ValueError(f"wanted no zero on the diagonal of R; got {R!r}")

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d) laid out as `layout` says."""
        s = observation[..., self.layout["s"]].unflatten(-1, (self.n, 2))
        R = observation[..., self.layout["R"]] if "R" in self.layout else self.R
        if "T_a" not in self.layout:
            return self.command(s, R)
        T_a = observation[..., self.layout["T_a"]].unflatten(-1, (self.n, self.n))
        return self.command(s, R, T_a)

    def command(self, s: Tensor, R: Tensor, T_a: Tensor | None = None) -> Tensor:
        """Return u = u0 + T_a a from s (..., n, 2), diag(R) (..., n) and T_a (..., n, n)."""
        factor = 1.0 / R if self.normalise else torch.sign(R)
        pi = self.network(self._visible(s))
        if T_a is None:
            return torch.addcmul(self.u0, factor, pi, value=-1.0)  # constraint_sign
        return self.u0 - (T_a * (factor * pi).unsqueeze(-2)).sum(-1)  # constraint_sign

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes of the network, before the sign rule: s (..., n, 2) to (..., n, 2)."""
        slope = self.network.jacobian(self._visible(s))  # type: ignore[operator]
        return self._visible(slope)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the slopes' magnitude, ([seeds,] n, 2) each."""
        low, high = self.network.slope_bounds()  # type: ignore[operator]
        if not self.integral:
            low[..., 1], high[..., 1] = 0.0, 0.0
        return low, high

    def _visible(self, s: Tensor) -> Tensor:
        return s if self.integral else s * s.new_tensor([1.0, 0.0])


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
        self.register_buffer("u0", _vector("u0", u0, self.n, dtype), persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the command (..., n) for an observation (..., d)."""
        return self.u0 + self.network(observation[..., self.part])


def _vector(name: str, value: ArrayLike, n: int, dtype: torch.dtype) -> Tensor:
    array = np.asarray(value, dtype=np.float64)
    if array.shape not in ((), (1,), (n,)) or not np.isfinite(array).all():
        raise ValueError(f"wanted {name} finite, a number or ({n},); got {value!r}")
    return torch.as_tensor(np.broadcast_to(array, (n,)).copy(), dtype=dtype)
