"""What a composition of signals costs: the paper's "loss of optimality", on two mechanisms.

`python -m cmc evaluate composition` computes the table, which lesson 13 shows. Signal and policy
learn together the least int |e|^2 + 0.01 |tau|^2 dt over 3 s, the mean over 8 starts, on
Gymnasium's pendulum near the top and on a two-link arm in a horizontal plane, under the tau that
makes e'' = -p. The optimum is the least cost of all tau from the same starts. All of it is our
choice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from cmc.policies import PositiveNetwork
from cmc.policies.latent_signal import LatentSignal, Trial, improve
from cmc.theory.composite import certify_latent, composite


def _pendulum_torque(e: Tensor, e_dot: Tensor, p: Tensor) -> Tensor:
    """Gymnasium's pendulum, angle'' = 15 sin(angle) + 3 tau, and e = -angle."""
    return (p + 15.0 * torch.sin(e)) / 3.0


def _arm_torque(e: Tensor, e_dot: Tensor, p: Tensor) -> Tensor:
    """H(q) p + C(q, q') q' of `TwoLinkArm()` without gravity, its elbow at 90 degrees at e = 0."""
    bend, rate = torch.pi / 2 - e[..., 1], -e_dot
    c, h = 0.12 * torch.cos(bend), -0.12 * torch.sin(bend)
    first = (0.54 + 2 * c) * p[..., 0] + (0.06 + c) * p[..., 1]
    first = first + h * rate[..., 1] * (2 * rate[..., 0] + rate[..., 1])
    second = (0.06 + c) * p[..., 0] + 0.06 * p[..., 1] - h * rate[..., 0] ** 2
    return torch.stack([first, second], dim=-1)


GAINS = (4.0, 5.0)  # K_p, 1/s^2, and K_d, 1/s
MECHANISMS = {  # starts within +- (e, e'), rad and rad/s, of each axis
    "pendulum": (np.array([[0.3, 0.5]]), _pendulum_torque),
    "two-link arm": (np.full((2, 2), 0.5), _arm_torque),
}
SIGNALS: dict[str, tuple[Any, Any]] = {  # floor and cap: slopes of the signal, of the policy
    "hand-made": (None, ([2.0, 0.5], [8.0, 1.0])),
    "learned": (([2.0, 0.5], [6.0, 2.0]), ([2.0, 0.5], [8.0, 1.0])),
    "learned, wide bounds": (([0.1, 0.05], [8.0, 8.0]), ([0.0, 0.0], [40.0, 4.0])),
}


def _positive(kind: Any, n: int, bounds: Any, **more: Any) -> Any:
    """A small network of this kind, with a floor and a cap under its slopes."""
    return kind(n, hidden=(8,), slope_min=bounds[0], slope_max=bounds[1], **more)


def table(updates: int = 80) -> pd.DataFrame:
    """A row for each mechanism and signal: its cost, % above the optimum, and certified rate."""
    rows: list[tuple[Any, ...]] = []
    for mechanism, (width, torque) in MECHANISMS.items():
        n = len(width)
        starts = np.random.default_rng(0).uniform(-width, width, (8, n, 2))
        trial, model = Trial(starts, 0.01, 3.0, 60, torque), composite(*np.tile(GAINS, (n, 1)).T)
        best = trial.optimum(8)
        for title, (slopes, inner) in SIGNALS.items():
            torch.manual_seed(0)
            policy = _positive(PositiveNetwork, n, inner, bias=False, dtype=torch.float64)
            judged = _positive(LatentSignal, n, slopes) if slopes else model
            K1, K2 = (torch.as_tensor(K) for K in (model.K1, model.K2))
            signal: Any = judged if slopes else lambda e, v, K1=K1, K2=K2: K1 * e + K2 * v
            cost = improve(signal, policy, GAINS, trial, updates=updates, rate=0.05)[-1]
            rate = certify_latent(judged, policy, *GAINS, h=0.05).rate
            rows.append((title, mechanism, updates, cost, 100 * (cost / best - 1), rate))
        rows.append(("optimum", mechanism, 0, best, 0.0, np.nan))
    names = ["method", "test", "step", "cost", "above_percent", "rate"]
    return pd.DataFrame(rows, columns=names).assign(last=True, seed=0).round(4)
