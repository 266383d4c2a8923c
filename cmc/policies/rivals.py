"""What the positive network is compared with: its unconstrained twins, and the closest peer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cmc.policies.stacked import (
    SignalNetwork,
    StackedMLP,
    as_parameter,
    check_seeds,
    check_signals,
    check_tensor,
    tanh,
)
from cmc.theory.arrays import Array, count, number


class IndependentNetwork(SignalNetwork):
    """One network per dimension on its own (z_i, integral of z_i), weights of any sign."""

    def __init__(
        self,
        n: int,
        *,
        hidden: Sequence[int] = (32, 32),
        seeds: Sequence[int] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        n = count("n", n)
        super().__init__(n, StackedMLP(2, 1, hidden, copies=n, seeds=seeds, last=0.1, dtype=dtype))


class JointNetwork(SignalNetwork):
    """One network that sees the signals of all dimensions, weights of any sign.

    With `inputs` it sees a flat (..., inputs) in place of s (..., n, 2).
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
        n = count("n", n)
        self.inputs = 2 * n if inputs is None else inputs
        self._axes = 2 if inputs is None else 1  # of an input
        mlp = StackedMLP(self.inputs, n, hidden, seeds=seeds, last=last, dtype=dtype)
        super().__init__(n, mlp)

    def inputs_of(self, s: Any) -> Any:
        """Signals (..., n, 2), or flat inputs (..., inputs), to (seeds, batch, inputs)."""
        stack, size = self.seeds or 1, int(np.prod(s.shape[-self._axes :]))
        if size != self.inputs or (self.seeds is not None and s.shape[0] != stack):
            lead = "" if self.seeds is None else f"{stack} seeds, "
            raise ValueError(
                f"s needs ({lead}..., {self.inputs}) flat inputs; got {tuple(s.shape)}"
            )
        return s.reshape(stack, -1, self.inputs)

    def outputs_of(self, out: Any, s: Any) -> Any:
        """What the network answers, (seeds, batch, n), to (..., n)."""
        return out.reshape(*s.shape[: -self._axes], self.n)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes d pi_i / d s_ij of each output in its own signals: s (..., n, 2) to the same."""
        check_tensor("s", s)
        with torch.enable_grad():
            s = s.detach().requires_grad_(True)
            out = self(s)
            rows = [
                torch.autograd.grad(out[..., i].sum(), s, retain_graph=True)[0][..., i, :]
                for i in range(self.n)
            ]
        return torch.stack(rows, dim=-2)


class ConvexGradientNetwork(nn.Module):
    """u = grad phi_P(z) + grad phi_I(integral of z), both phi strictly convex (arXiv 2305.17777).

    Each term is the gradient of phi(z) = sum_h a_h log cosh(w_h . z + b_h) + (mu/2) |z|^2, a >= 0,

        grad phi(z) = W diag(a) tanh(W' z + b) + mu z,

    a strictly monotone map of all dimensions together: its Jacobian W diag(a tanh') W' + mu I is
    symmetric and positive definite, where the positive network has one positive slope a dimension.

    `hidden` is the number of units h of each term.
    """

    def __init__(
        self,
        n: int,
        *,
        hidden: int = 32,
        seeds: Sequence[int] | None = None,
        mu: float = 1e-3,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        n, hidden, mu = count("n", n), count("hidden", hidden), number("mu", mu, above=0.0)
        self.n, self.mu = n, mu
        checked = check_seeds(seeds)
        self.seeds = None if checked is None else len(checked)
        W, a, b = [], [], []
        for seed in checked or (0,):
            rng = np.random.default_rng([seed, n, hidden])
            W.append(rng.standard_normal((2, n, hidden)) / np.sqrt(n))
            a.append(rng.uniform(0.0, 2.0, (2, 1, hidden)) / hidden)
            b.append(rng.uniform(-1.0, 1.0, (2, 1, hidden)))
        self.W, self.a, self.b = (as_parameter(part, dtype) for part in (W, a, b))

    def _stacked(self, s: Tensor) -> Tensor:
        """Move s ([seeds,] ..., n, 2) to (seeds * 2, batch, n): one row for each term."""
        check_tensor("s", s)
        check_signals(s, self.n, self.seeds)
        x = s.reshape(self.seeds or 1, -1, self.n, 2)
        return x.permute(0, 3, 1, 2).reshape(-1, x.shape[1], self.n)

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate both gradients: s (..., n, 2) to (..., n); with seeds (seeds, ..., n, 2)."""
        x = self._stacked(s)
        value = self.a.abs() * tanh(torch.baddbmm(self.b, x, self.W))
        terms = torch.baddbmm(x, value, self.W.transpose(1, 2), beta=self.mu)
        return terms.reshape(-1, 2, *terms.shape[1:]).sum(1).reshape(s.shape[:-1])

    def jacobian(self, s: Tensor) -> Tensor:
        """Full slopes d pi_i / d s_kj in closed form: s (..., n, 2) to (..., n, n, 2)."""
        x = self._stacked(s)
        value = tanh(torch.baddbmm(self.b, x, self.W))
        gain = self.a.abs() * (1.0 - value * value)
        slope = torch.einsum("gih,gbh,gkh->gbik", self.W, gain, self.W)
        slope = slope + self.mu * torch.eye(self.n, dtype=slope.dtype)
        slope = slope.reshape(-1, 2, *slope.shape[1:]).movedim(1, -1)
        return slope.reshape(*s.shape[:-1], self.n, 2)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the diagonal slopes d pi_i / d s_ij, ([seeds,] n, 2) each."""
        with torch.no_grad():
            W, a = self.W.double().cpu(), self.a.abs().double().cpu()
            high = (a * W * W).sum(-1).reshape(-1, 2, self.n).transpose(1, 2).numpy() + self.mu
        high = high[0] if self.seeds is None else high
        return np.full_like(high, self.mu), high
