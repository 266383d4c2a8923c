"""The unconstrained twins of the positive network: the baselines, which differ in nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cmc.policies.stacked import StackedMLP, from_stack, to_stack


class IndependentNetwork(nn.Module):
    """One network per dimension on its own (z_i, integral of z_i), weights of any sign.

    Args:
        n: number of dimensions.
        hidden: sizes of the hidden layers.
        seeds: one integer for each leading index, or None for no leading axis.
        last: factor on the last layer's start.
        dtype: of the parameters.
    """

    def __init__(
        self,
        n: int,
        *,
        hidden: Sequence[int] = (32, 32),
        seeds: Sequence[int] | None = None,
        last: float = 0.1,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.n = n
        self.mlp = StackedMLP(2, 1, hidden, copies=n, seeds=seeds, last=last, dtype=dtype)
        self.seeds = None if self.mlp.seeds is None else len(self.mlp.seeds)

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate the networks: s (..., n, 2) to (..., n); with seeds s is (seeds, ..., n, 2)."""
        out = self.mlp(to_stack(s, self.seeds, self.n))
        return from_stack(out[..., 0], s, self.seeds)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes d pi_i / d s_ij in closed form (`product`): s (..., n, 2) to (..., n, 2)."""
        slope = self.mlp.slopes(to_stack(s, self.seeds, self.n), list(self.mlp.weights))
        return from_stack(slope, s, self.seeds)


class JointNetwork(nn.Module):
    """One network that sees the signals of all dimensions, weights of any sign.

    Args:
        n: number of dimensions, that is outputs.
        inputs: size of the flat input; by default 2 n, the auxiliary signals of all dimensions.
        hidden: sizes of the hidden layers.
        seeds: one integer for each leading index, or None for no leading axis.
        last: factor on the last layer's start.
        dtype: of the parameters.
    """

    def __init__(
        self,
        n: int,
        *,
        inputs: int | None = None,
        hidden: Sequence[int] = (32, 32),
        seeds: Sequence[int] | None = None,
        last: float = 0.1,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.n = n
        self.inputs = 2 * n if inputs is None else inputs
        self.flat = inputs is not None
        self.mlp = StackedMLP(self.inputs, n, hidden, seeds=seeds, last=last, dtype=dtype)
        self.seeds = None if self.mlp.seeds is None else len(self.mlp.seeds)

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate the network: s (..., n, 2), or (..., inputs) if sizes were given, to (..., n).

        Raises:
            ValueError: if the last axes or the leading axis of seeds have another size.
        """
        x = s if self.flat else s.flatten(-2)
        stack = self.mlp.stack
        if x.shape[-1] != self.inputs or (self.seeds is not None and x.shape[0] != stack):
            lead = "" if self.seeds is None else f"{stack}, "
            raise ValueError(f"wanted ({lead}..., {self.inputs}) flat inputs; got {tuple(x.shape)}")
        out = self.mlp(x.reshape(stack, -1, self.inputs))
        return out.reshape(*x.shape[:-1], self.n)
