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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from cmc.policies.networks import PositiveNetwork
from cmc.theory.arrays import Array, checked, count, need, number


class LatentSignal(PositiveNetwork):
    """y_i = phi_i(e_i, e_i'), zero at zero, with slopes between bounds that no training can break.

    Args:
        n: number of axes.
        slope_min, slope_max: bounds on the slopes in (e, e'), positive, broadcast to (n, 2).
        hidden: sizes of the hidden layers.
    """

    def __init__(
        self,
        n: int,
        *,
        slope_min: ArrayLike,
        slope_max: ArrayLike,
        hidden: Sequence[int] = (16, 16),
    ) -> None:
        checked("slope_min", slope_min, above=0.0)  # so that e' can be told from y
        bounds: dict[str, Any] = {"slope_min": slope_min, "slope_max": slope_max}
        super().__init__(n, hidden=hidden, bias=False, dtype=torch.float64, **bounds)

    def forward(self, e: Tensor, e_dot: Tensor) -> Tensor:  # type: ignore[override]
        """Latent signal of errors and their rates, (..., n) each, to (..., n)."""
        return super().forward(torch.stack([e, e_dot], dim=-1))

    @property
    def composition_rate(self) -> Array:
        """Smallest slope in e over the largest in e', 1/s, (n,)."""
        low, high = self.slope_bounds()
        return low[:, 0] / high[:, 1]


@dataclass(frozen=True)
class Trial:
    """What a motion costs: the mean over starts of int |e|^2 + effort |w|^2 dt for e'' = -p.

    Attributes:
        starts: errors and rates, (N, n, 2).
        effort: price of w.
        duration: s.
        steps: of it; p is held over each.
        priced: w (N, n) of e, e' and p (N, n), such as the torque behind p; p by default.
    """

    starts: ArrayLike
    effort: float
    duration: float
    steps: int = 100
    priced: Callable[[Tensor, Tensor, Tensor], Tensor] = lambda e, e_dot, p: p

    def __post_init__(self) -> None:
        checked("starts", self.starts, "N n 2")
        number("effort", self.effort, least=0.0)
        number("duration", self.duration, above=0.0)
        count("steps", self.steps, 100_000)
        need(callable(self.priced), "priced", "a function", self.priced)

    def cost(self, act: Callable[[Tensor, Tensor, int], Tensor]) -> Tensor:
        """The cost of p = act(e, e', k) at step k."""
        start = torch.as_tensor(np.asarray(self.starts), dtype=torch.float64)
        e, e_dot = start.unbind(-1)
        h, cost = self.duration / self.steps, torch.zeros((), dtype=torch.float64)
        for k in range(self.steps):
            p = act(e, e_dot, k)
            w = self.priced(e, e_dot, p)
            cost = cost + h * (e.square() + self.effort * w.square()).sum(-1).mean()
            e, e_dot = e + h * e_dot - h * h / 2 * p, e_dot - h * p  # exact under a held p
        return cost

    def optimum(self, rounds: int = 20) -> float:
        """The least cost of all p (steps, N, n), without feedback or any other constraint."""
        p = torch.zeros(self.steps, *np.shape(self.starts)[:2], dtype=torch.float64)
        search = torch.optim.LBFGS([p.requires_grad_()], line_search_fn="strong_wolfe")

        def cost() -> Any:
            search.zero_grad()
            value = self.cost(lambda e, e_dot, k: p[k])
            value.backward()
            return value

        return min(search.step(cost).item() for _ in range(rounds))


def improve(
    signal: Callable[[Tensor, Tensor], Tensor],
    policy: nn.Module,
    gains: tuple[float, float],
    trial: Trial,
    *,
    updates: int = 150,
    rate: float = 0.02,
) -> list[float]:
    """Learn signal and policy together by Adam, on p = K_p e + K_d e' + pi(y, int y).

    The signal gives y (N, n) of e and e' and is kept where it is no module; the policy maps
    s = (y, int y), (..., n, 2), to (..., n); `gains` are K_p and K_d, `updates` Adam's, of step
    `rate`. Returns the cost before each update, and after the last.
    """
    need(callable(signal), "signal", "a function", signal)
    need(isinstance(policy, nn.Module), "policy", "a torch module", policy)
    need(isinstance(trial, Trial), "trial", "a Trial", trial)
    checked("gains", gains, "2")
    updates, rate = count("updates", updates), number("rate", rate, above=0.0)
    parts = [part for part in (signal, policy) if isinstance(part, nn.Module)]
    optimiser = torch.optim.Adam([p for part in parts for p in part.parameters()], lr=rate)
    integral = torch.zeros(())

    def act(e: Tensor, e_dot: Tensor, k: int) -> Tensor:
        nonlocal integral
        y = signal(e, e_dot)
        integral = (integral if k else 0.0) + trial.duration / trial.steps * y
        return gains[0] * e + gains[1] * e_dot + policy(torch.stack([y, integral], dim=-1))

    costs = []
    for _ in range(updates):
        optimiser.zero_grad()
        cost = trial.cost(act)
        cost.backward()  # type: ignore[no-untyped-call]
        costs.append(float(cost.detach()))
        optimiser.step()
    with torch.no_grad():
        return [*costs, float(trial.cost(act))]
