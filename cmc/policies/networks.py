"""One network per dimension whose slopes are positive and bounded: tanh, or plain gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from cmc.policies.stacked import SignalNetwork, StackedMLP, check_seeds, check_signals
from cmc.theory.arrays import Array, checked, count, filled


class NegativeWeightError(ValueError):
    """A checkpoint holds negative weights where the sign condition needs positive ones."""


class PositiveNetwork(SignalNetwork):
    """pi_i(s_i) = m_i . s_i + W_l tanh(... tanh(W_1 s_i + b_1)) + b_l, with W >= 0, for each i.

    With positive weights every slope is positive (`product`, `constraint_sign`). The linear bypass
    m holds each slope above m, also where tanh saturates, and the cap scales the tanh network so
    that each slope stays below M:  m_ij <= d pi_i / d s_ij <= M_ij  everywhere, by construction.
    The paper's network is the case m = 0 without a cap.

    Since tanh' <= 1, the product P_i = W_1 W_2 ... W_l bounds the slopes of a positive network, and
    without biases it is the slope at 0. Input j is scaled by min(1, (M_ij - m_ij)/P_ij), and for a
    joint cap the output by min(1, (limit - v . m_i)/(v . P_i)), so that v . slope <= limit.

    Args:
        n: number of dimensions.
        hidden, seeds, dtype: see `StackedMLP`.
        bias: without biases the policy is odd, pi(-s) = -pi(s), and zero at zero.
        slope_min: m >= 0, broadcast to (n, 2): proportional and integral slope.
        slope_max: M > m, broadcast to (n, 2), or None for no cap.
        joint_cap: pair (v, limit), v >= 0 broadcast to (n, 2) and limit > 0 broadcast to (n,):
            the cap v . slope <= limit, such as the sampled-data bound with v = (1, h/2).
    """

    slope_min: Tensor
    room: Tensor | None
    joint: Tensor | None

    def __init__(
        self,
        n: int,
        *,
        hidden: Sequence[int] = (32, 32),
        seeds: Sequence[int] | None = None,
        bias: bool = True,
        slope_min: ArrayLike = 0.0,
        slope_max: ArrayLike | None = None,
        joint_cap: tuple[ArrayLike, ArrayLike] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        n = count("n", n)
        mlp = StackedMLP(
            2, 1, hidden, copies=n, seeds=seeds, bias=bias, start="positive", dtype=dtype
        )
        super().__init__(n, mlp)
        low = filled("slope_min", slope_min, n, 2, least=0.0)
        room = joint = None
        if slope_max is not None:
            high = filled("slope_max", slope_max, n, 2, least=0.0)
            if not (high > low).all():
                raise ValueError(f"slope_max needs values above slope_min; got {high} and {low}")
            room = high - low
        if joint_cap is not None:
            if not isinstance(joint_cap, (list, tuple)) or len(joint_cap) != 2:
                raise ValueError(f"joint_cap needs a pair (weights, limit), got {joint_cap!r:.60}")
            weight = filled("joint_cap weights", joint_cap[0], n, 2, least=0.0)
            limit = filled("joint_cap limit", joint_cap[1], n, least=0.0)
            left = limit - (weight * low).sum(-1)
            if not ((left > 0).all() and (weight.sum(-1) > 0).all()):
                raise ValueError(
                    f"joint_cap {limit} leaves no room above slope_min {low} "
                    f"for the weights {weight}"
                )
            joint = weight / left[:, None]  # v . P / left <= 1
        self._bypass = bool(low.any())
        for name, value in (("slope_min", low), ("room", room), ("joint", joint)):
            tensor = None if value is None else torch.as_tensor(value, dtype=dtype)
            self.register_buffer(name, tensor, persistent=False)
        self.register_state_dict_post_hook(_export_positive)
        self.register_load_state_dict_pre_hook(_refuse_negative)

    def used_weights(self) -> list[Tensor]:
        """Weights (stack, in, out) as used: absolute values, caps on the first and last."""
        weights = [weight.abs() for weight in self.mlp.weights]
        if self.room is None and self.joint is None:
            return weights
        product = _product(weights).reshape(-1, self.n, 2)
        if self.room is not None:
            scale = (self.room / product).clamp(max=1.0)
            product = product * scale
            weights[0] = weights[0] * scale.reshape(-1, 2, 1)
        if self.joint is not None:
            scale = (1.0 / (self.joint * product).sum(-1)).clamp(max=1.0)
            weights[-1] = weights[-1] * scale.reshape(-1, 1, 1)
        return weights

    def outputs_of(self, out: Any, s: Any) -> Any:
        """What the stack answers, with the bypass, (..., n)."""
        pi = super().outputs_of(out, s)
        if not self._bypass:
            return pi
        low = self.slope_min if isinstance(s, Tensor) else self.slope_min.numpy()
        return pi + (low * s).sum(-1)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes d pi_i / d s_ij in closed form (`product`): s (..., n, 2) to (..., n, 2)."""
        return super().jacobian(s) + self.slope_min

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of each slope for the present weights, ([seeds,] n, 2) each.

        The lower end of an uncapped, bypass-free network is 0 and is only approached.
        """
        with torch.no_grad():
            low = self.slope_min.double().cpu().numpy()
            high = _product([weight.double() for weight in self.used_weights()]).cpu().numpy()
        high = high.reshape(*([self.seeds] if self.seeds else []), self.n, 2) + low
        return np.broadcast_to(low, high.shape).copy(), high


class LinearNetwork(nn.Module):
    """pi_i = k_i1 z_i + k_i2 integral of z_i with fixed gains: the control engineer's baseline.

    The gains k (n, 2) are not part of the state dict; `seeds` give bounds their leading axis.
    """

    gains: Tensor

    def __init__(self, gains: ArrayLike, seeds: Sequence[int] | None = None) -> None:
        super().__init__()
        found = torch.as_tensor(checked("gains", gains, "n 2").astype(np.float32))
        self.n, self.seeds = len(found), len(check_seeds(seeds) or ()) or None
        self.register_buffer("gains", found, persistent=False)

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate: s (..., n, 2) to (..., n)."""
        check_signals(s, self.n, self.seeds)
        return (self.gains * s).sum(-1)

    def jacobian(self, s: Tensor) -> Tensor:
        """The gains, repeated over the batch: (..., n, 2)."""
        check_signals(s, self.n, self.seeds)
        return self.gains.expand(s.shape)

    def slope_bounds(self) -> tuple[Array, Array]:
        """The gains are both bounds, ([seeds,] n, 2) each."""
        gains = np.tile(self.gains.double().cpu().numpy(), (self.seeds, 1, 1) if self.seeds else 1)
        return gains, gains.copy()


def _product(weights: Sequence[Tensor]) -> Tensor:
    """W_1 W_2 ... W_l (stack, 2): the largest slope that tanh' <= 1 allows."""
    product = weights[-1]
    for weight in weights[-2::-1]:
        product = weight @ product
    return product[..., 0]


def _export_positive(module: nn.Module, state: dict[str, Any], prefix: str, *_rest: Any) -> None:
    """Write weights to a state dict as they are used, so that a file shows their sign."""
    for name in state:
        if name.startswith(f"{prefix}mlp.weights."):
            state[name] = state[name].abs()


def _refuse_negative(module: nn.Module, state: Mapping[str, Any], prefix: str, *_rest: Any) -> None:
    """Refuse a state dict whose weights are not positive or not finite."""
    for name, value in state.items():
        if name.startswith(f"{prefix}mlp.weights.") and not bool((value >= 0).all()):
            count = int((~(value >= 0)).sum())
            raise NegativeWeightError(
                f"wanted positive weights in {name!r}; {count} of {value.numel()} "
                f"are negative or not numbers (smallest {float(value.min()):.3g})"
            )
