"""A learned latent signal y = phi(e, e') whose composition contracts by construction.

The hand-made composite variable of a second-order error equation (`cmc.theory.composite`) is linear
and its weights follow from the gains. The paper leaves open what a learned one could be. Here one
positive network an axis, whose two slopes stay between bounds,

    y_i = phi_i(e_i, e_i'),    0 < m_i1 <= d phi_i / d e_i <= M_i1,   0 < m_i2 <= d phi_i / d e_i',

is one. Given y, it is an equation for e' alone, d e' = (d y - phi_1 d e) / phi_2, so that the
errors of two motions with the same y approach each other at a rate of at least m_i1 / M_i2 whatever
was learned. What drives y to zero is a policy with slopes of one sign, as before, and the two
together are judged by `cmc.theory.composite.certify_latent` from the two intervals of slopes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.policies.networks import PositiveNetwork

Array = NDArray[np.float64]


class LatentSignal(nn.Module):
    """y_i = phi_i(e_i, e_i'), zero at zero, with slopes between bounds that no training can break.

    Args:
        n: number of axes.
        slope_min: smallest slopes in (e, e'), positive, broadcast to (n, 2).
        slope_max: largest slopes, broadcast to (n, 2).
        hidden: sizes of the hidden layers.
        seeds: one integer for each leading index, or None for no leading axis.
        dtype: of the parameters.

    Raises:
        ValueError: if a slope may vanish, or the bounds leave no room.
    """

    def __init__(
        self,
        n: int,
        *,
        slope_min: ArrayLike,
        slope_max: ArrayLike,
        hidden: Sequence[int] = (16, 16),
        seeds: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if not (np.asarray(slope_min, dtype=float) > 0).all():
            raise ValueError(
                f"wanted slope_min above 0, so that e' can be told from y; got {slope_min!r}"
            )
        self.network = PositiveNetwork(
            n,
            hidden=hidden,
            seeds=seeds,
            bias=False,
            slope_min=slope_min,
            slope_max=slope_max,
            dtype=dtype,
        )
        self.n = n

    def forward(self, e: Tensor, e_dot: Tensor) -> Tensor:
        """Latent signal of errors and their rates, (..., n) each, to (..., n)."""
        return self.network(torch.stack([e, e_dot], dim=-1))

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the slopes in (e, e'), ([seeds,] n, 2) each."""
        return self.network.slope_bounds()

    @property
    def composition_rate(self) -> Array:
        """Smallest slope in e over the largest in e', 1/s, ([seeds,] n)."""
        low, high = self.slope_bounds()
        return low[..., 0] / high[..., 1]


def improve(
    signal: LatentSignal,
    policy: nn.Module,
    gains: tuple[float, float],
    starts: ArrayLike,
    *,
    effort: float,
    duration: float,
    steps: int = 100,
    updates: int = 150,
    rate: float = 0.02,
) -> list[float]:
    """Learn signal and policy together, by the gradient of a simulated cost.

    The cost is the mean over starts of int e^2 + effort p^2 dt for e'' = -p, with the whole command
    p = K_p e + K_d e' + pi(y, int y), held over each step.

    Args:
        signal: what is learned; a signal without parameters that need gradients is kept.
        policy: maps s = (y, int y), (..., n, 2), to (..., n), slopes positive.
        gains: K_p and K_d of the task-space controller.
        starts: errors and rates, (N, n, 2).
        effort: price of the command.
        duration: s.
        steps: commands in that time.
        updates: steps of Adam.
        rate: learning rate.

    Returns:
        The cost before each update, and after the last.
    """
    start = torch.as_tensor(np.asarray(starts), dtype=torch.float64)
    learned = [p for p in [*signal.parameters(), *policy.parameters()] if p.requires_grad]
    optimiser = torch.optim.Adam(learned, lr=rate)
    h, costs = duration / steps, []
    for update in range(updates + 1):
        e, e_dot = start[..., 0], start[..., 1]
        integral, cost = torch.zeros_like(e), torch.zeros((), dtype=torch.float64)
        for _ in range(steps):
            y = signal(e, e_dot)
            integral = integral + h * y
            p = gains[0] * e + gains[1] * e_dot + policy(torch.stack([y, integral], dim=-1))
            cost = cost + h * (e.square() + effort * p.square()).sum(-1).mean()
            e, e_dot = e + h * e_dot - h * h / 2 * p, e_dot - h * p  # exact under a held p
        costs.append(float(cost.detach()))
        if update < updates:
            optimiser.zero_grad()
            cost.backward()
            optimiser.step()
    return costs
