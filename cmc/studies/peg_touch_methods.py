"""The arms of the peg-touch study: one function that builds the policy of each method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from cmc.policies import (
    ConvexGradientNetwork,
    IndependentNetwork,
    JointNetwork,
    PositiveNetwork,
)

HIDDEN = (32, 32)


class TouchPolicy(nn.Module):
    """a = -pi(s) on the observation s = (z_1, int z_1, z_2, int z_2) of the environment.

    The minus is the sign rule (`constraint_sign`): here R_11 and R_22 are positive everywhere. The
    environment adds u0 and applies T_y and T_a.

    Args:
        network: maps s (..., 2, 2) to (..., 2).
        integral: whether the network sees the integrals; otherwise it gets zeros for them.
    """

    def __init__(self, network: nn.Module, *, integral: bool = True) -> None:
        super().__init__()
        self.network, self.integral = network, integral
        self.n = 2

    def _seen(self, s: Tensor) -> Tensor:
        return s if self.integral else s * s.new_tensor([1.0, 0.0])

    def forward(self, obs: Tensor) -> Tensor:
        """Action (..., 2) for observations (..., 4)."""
        return -self.network(self._seen(obs.unflatten(-1, (2, 2))))

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes before the sign rule, d pi_i / d s_ij, (..., 2, 2); positive is the right sign."""
        slope = self.network.jacobian(self._seen(s))  # type: ignore[operator]
        if slope.ndim > s.ndim:  # a full matrix (..., i, k, j): keep each dimension's own slopes
            slope = torch.diagonal(slope, dim1=-3, dim2=-2).transpose(-1, -2)
        return slope if self.integral else slope * slope.new_tensor([1.0, 0.0])

    def slope_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Guaranteed interval of the slopes' magnitude, ([seeds,] 2, 2) each."""
        low, high = self.network.slope_bounds()  # type: ignore[operator]
        seen = np.array([1.0, float(self.integral)])
        return low * seen, high * seen


class RawPolicy(nn.Module):
    """a = network(x, f, x_d, f_d): no error, no integral, no sign rule."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network, self.n = network, 2

    def forward(self, obs: Tensor) -> Tensor:
        """Action (..., 2) for observations (..., 4)."""
        return self.network(obs)


class JointPolicy(TouchPolicy):
    """One network that sees both signals; its slopes by automatic differentiation."""

    def jacobian(self, s: Tensor) -> Tensor:
        """Each output's slopes in its own dimension's signals, (..., 2, 2)."""
        with torch.enable_grad():
            s = s.detach().requires_grad_(True)
            out = self.network(s)
            rows = [
                torch.autograd.grad(out[..., i].sum(), s, retain_graph=True)[0] for i in range(2)
            ]
        return torch.stack([rows[i][..., i, :] for i in range(2)], dim=-2)


class LinearPI(nn.Module):
    """pi_i = k_i1 z_i + k_i2 int z_i with fixed gains: the control engineer's baseline."""

    gains: Tensor

    def __init__(self, gains: np.ndarray, seeds: Sequence[int] | None = None) -> None:
        super().__init__()
        self.n, self.seeds = 2, None if seeds is None else len(seeds)
        self.register_buffer("gains", torch.as_tensor(gains, dtype=torch.float32))

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate: s (..., 2, 2) to (..., 2)."""
        return (self.gains * s).sum(-1)

    def jacobian(self, s: Tensor) -> Tensor:
        """The gains, repeated over the batch: (..., 2, 2)."""
        return self.gains.expand(s.shape)

    def slope_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The gains are both bounds, ([seeds,] 2, 2) each."""
        gains = self.gains.double().numpy()
        gains = gains if self.seeds is None else np.tile(gains, (self.seeds, 1, 1))
        return gains, gains


@dataclass(frozen=True)
class Method:
    """One arm of the study."""

    title: str
    """Name in figures and tables."""
    interface: str
    """What the environment shows: `auxiliary`, `identity` or `raw`."""
    build: Callable[[Sequence[int] | None, np.ndarray, float], nn.Module]
    """Builds the policy from seeds, the limit on k1 + (h/2) k2, and h."""
    contracting: bool = False
    """Whether the sign of every slope is guaranteed by construction."""
    capped: bool = False
    """Whether the sampled-data bound is met by construction."""
    scaled: bool = False
    """Whether the vertical action is multiplied by a reference over the nominal stiffness."""
    trained: bool = True
    """False for fixed gains."""
    stress: bool = False
    """Whether PPO is set aggressively: large steps, more epochs, no floor under the noise."""


Seeds = Sequence[int] | None


def _ppo(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(IndependentNetwork(2, hidden=HIDDEN, seeds=seeds))


def _cppo(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds))


def _joint(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return JointPolicy(JointNetwork(2, hidden=HIDDEN, seeds=seeds))


def _raw(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return RawPolicy(JointNetwork(2, inputs=4, hidden=HIDDEN, seeds=seeds))


def _capped(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    cap = ((1.0, h / 2), SAFETY * limit)
    return TouchPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds, joint_cap=cap))


def _bounded(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    cap = ((1.0, h / 2), SAFETY * limit)
    floor = 0.5 * FLOOR * np.stack([limit, limit / (h / 2)], axis=-1)
    net = PositiveNetwork(2, hidden=HIDDEN, seeds=seeds, joint_cap=cap, slope_min=floor)
    return TouchPolicy(net)


def _bypass(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    cap = ((1.0, h / 2), SAFETY * limit)
    floor = np.stack([limit, limit / (h / 2)], axis=-1) * BYPASS
    net = PositiveNetwork(2, hidden=HIDDEN, seeds=seeds, joint_cap=cap, slope_min=floor)
    return TouchPolicy(net)


def _no_integral(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(PositiveNetwork(2, hidden=HIDDEN, seeds=seeds), integral=False)


def _convex(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(ConvexGradientNetwork(2, hidden=HIDDEN[0], seeds=seeds))


def _pi(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(LinearPI(np.array([[2.0, 40.0], [0.02, 8.0]]), seeds))


def _pi_scaled(seeds: Seeds, limit: np.ndarray, h: float) -> nn.Module:
    return TouchPolicy(LinearPI(np.array([[2.0, 40.0], [0.012, 5.6]]), seeds))


SAFETY = 0.98
"""Share of the sampled-data limit that a cap leaves to the policy: our choice."""
FLOOR = 0.05
"""Share of the limit below which `cppo_bounded` holds no slope (half of it each): our choice."""
BYPASS = np.array([[0.0, 0.0], [0.15, 0.6]])
"""Shares of the limit that `cppo_bypass` puts into a linear bypass, vertically: our choice."""


METHODS: dict[str, Method] = {
    "cppo": Method("C-PPO", "auxiliary", _cppo, contracting=True),
    "ppo": Method("PPO, one network per dimension", "auxiliary", _ppo),
    "cppo_capped": Method("C-PPO, capped", "auxiliary", _capped, contracting=True, capped=True),
    "cppo_bypass": Method(
        "C-PPO, capped, vertical bypass", "auxiliary", _bypass, contracting=True, capped=True
    ),
    "cppo_scaled": Method(
        "C-PPO, capped loop gain", "auxiliary", _capped, contracting=True, capped=True, scaled=True
    ),
    "ppo_stress": Method("PPO, stress setting", "auxiliary", _ppo, stress=True),
    "cppo_stress": Method(
        "C-PPO, stress setting", "auxiliary", _cppo, contracting=True, stress=True
    ),
    "ppo_joint": Method("PPO, joint network", "auxiliary", _joint),
    "ppo_raw": Method("PPO, raw inputs", "raw", _raw),
    "cppo_identity": Method("C-PPO, T_y = T_a = I", "identity", _cppo, contracting=True),
    "cppo_bounded": Method(
        "C-PPO, bounded on both sides", "auxiliary", _bounded, contracting=True, capped=True
    ),
    "cppo_no_integral": Method("C-PPO, no integral", "auxiliary", _no_integral, contracting=True),
    "convex_pi": Method("Convex-gradient PI", "auxiliary", _convex),
    "pi": Method("Hand-tuned PI", "auxiliary", _pi, contracting=True, trained=False),
    "pi_scaled": Method(
        "Hand-tuned PI, scheduled on stiffness",
        "auxiliary",
        _pi_scaled,
        contracting=True,
        capped=True,
        scaled=True,
        trained=False,
    ),
}


def method(name: str) -> Method:
    """The method of this name.

    Raises:
        ValueError: if there is none.
    """
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; wanted one of {sorted(METHODS)}")
    return METHODS[name]
