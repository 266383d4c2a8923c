"""A stack of tanh networks of equal shape, evaluated as one batched product a layer; fast tanh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

Start = Literal["positive", "signed"]
NARROW = 16
"""Columns below which a product is computed from the transposes."""


def check_seeds(seeds: Sequence[int] | None) -> tuple[int, ...] | None:
    """Return the seeds as a tuple, or None for one network without a leading axis.

    Raises:
        ValueError: if there is no seed, or one is negative.
    """
    if seeds is None:
        return None
    seeds = tuple(int(seed) for seed in seeds)
    if not seeds or min(seeds) < 0:
        raise ValueError(f"wanted at least one seed, none of them negative; got {seeds}")
    return seeds


class StackedMLP(nn.Module):
    """Tanh networks x -> W_l tanh(... tanh(W_1 x + b_1)) + b_l, one for each index of a stack.

    The stack is the product of the seeds (if any) and `copies`; all networks of the stack are
    evaluated by one `baddbmm` a layer. Each seed draws its own start, so that a network does not
    depend on which others are in the stack.

    Args:
        inputs: size of the input.
        outputs: size of the output.
        hidden: sizes of the hidden layers, at least one.
        copies: networks a seed (one per dimension), or 1.
        seeds: one integer for each leading index, or None for no leading axis (start from 0).
        bias: whether layers have biases; without them the network is odd.
        start: "positive" draws weights from U(0, 2)/fan_in and hidden biases from U(-1, 1);
            "signed" draws weights from N(0, 1)/sqrt(fan_in), no biases, last layer times `last`.
        last: factor on the last layer's start.
        dtype: of the parameters.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        hidden: Sequence[int] = (32, 32),
        *,
        copies: int = 1,
        seeds: Sequence[int] | None = None,
        bias: bool = True,
        start: Start = "signed",
        last: float = 1.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        sizes = (inputs, *hidden, outputs)
        if len(sizes) < 3 or min(sizes) < 1 or copies < 1:
            raise ValueError(
                "wanted positive sizes and at least one hidden layer; got "
                f"inputs {inputs}, hidden {tuple(hidden)}, outputs {outputs}, copies {copies}"
            )
        self.seeds = check_seeds(seeds)
        self.copies, self.bias = copies, bias
        weights, biases = [], []
        for layer, (fan_in, fan_out) in enumerate(zip(sizes, sizes[1:], strict=False)):
            final = layer == len(sizes) - 2
            drawn = [
                _draw(seed, layer, (copies, fan_in, fan_out), start, last if final else 1.0)
                for seed in self.seeds or (0,)
            ]
            weight, shift = (np.concatenate(part) for part in zip(*drawn, strict=True))
            weights.append(nn.Parameter(torch.as_tensor(weight, dtype=dtype)))
            if bias:
                shift = 0.0 * shift if final or start == "signed" else shift
                biases.append(nn.Parameter(torch.as_tensor(shift, dtype=dtype)))
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList(biases)

    @property
    def stack(self) -> int:
        """Number of networks in the stack."""
        return len(self.seeds or (0,)) * self.copies

    def forward(self, x: Tensor) -> Tensor:
        """Evaluate all networks: x (stack, batch, inputs) to (stack, batch, outputs)."""
        return self.run(x, list(self.weights))

    def run(
        self, x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor] | None = None
    ) -> Tensor:
        """Evaluate with the given weights (stack, in, out), and biases, in place of our own."""
        biases = list(self.biases) if biases is None else biases
        return _Network.apply(x, len(weights), *weights, *biases)

    def hidden_values(self, x: Tensor, weights: Sequence[Tensor]) -> list[Tensor]:
        """Values after every layer, the output last; x (stack, batch, inputs)."""
        return _layers(x, weights, list(self.biases))

    def slopes(self, x: Tensor, weights: Sequence[Tensor]) -> Tensor:
        """Derivatives of the first output by the inputs, in closed form: (stack, batch, inputs)."""
        slope = weights[-1][..., :1].transpose(1, 2)
        hidden = self.hidden_values(x, weights)[:-1]
        for value, weight in zip(hidden[::-1], weights[-2::-1], strict=True):
            slope = ((1.0 - value * value) * slope) @ weight.transpose(1, 2)  # M_j W_j of `product`
        return slope


def _layers(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """Values after every layer, by ordinary differentiable operations."""
    values: list[Tensor] = []
    for layer, weight in enumerate(weights):
        x = _product(x, weight, biases[layer] if biases else None)
        x = tanh(x) if layer < len(weights) - 1 else x
        values.append(x)
    return values


def _product(x: Tensor, y: Tensor, shift: Tensor | None = None) -> Tensor:
    """Product of x and y, plus the shift; a narrow y costs several times less by transposes."""
    if y.shape[-1] < NARROW:
        x, y = y.transpose(1, 2), x.transpose(1, 2)
        shift = None if shift is None else shift.transpose(1, 2)
        return (torch.bmm(x, y) if shift is None else torch.baddbmm(shift, x, y)).transpose(1, 2)
    return torch.bmm(x, y) if shift is None else torch.baddbmm(shift, x, y)


class _Network(torch.autograd.Function):
    """The whole network as one node of the graph: small networks cost mostly bookkeeping."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, depth: int, *parameters: Tensor) -> Tensor:
        values = _layers(x, parameters[:depth], parameters[depth:])
        ctx.depth = depth
        ctx.save_for_backward(x, *parameters, *values[:-1])
        return values[-1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        depth = ctx.depth
        x, *saved = ctx.saved_tensors
        weights, biases = saved[:depth], saved[depth : -(depth - 1)]
        if torch.is_grad_enabled():  # a second derivative is wanted: back through plain operations
            inputs = [t for t in (x, *weights, *biases) if t.requires_grad]
            output = _layers(x, weights, biases)[-1]
            found = iter(torch.autograd.grad(output, inputs, gradients[0], create_graph=True))
            whole = [next(found) if t.requires_grad else None for t in (x, *weights, *biases)]
            return whole[0], None, *whole[1:]
        values, wanted = [x, *saved[len(weights) + len(biases) :]], ctx.needs_input_grad
        slope = gradients[0]
        to_weights: list[Tensor | None] = [None] * depth
        to_biases: list[Tensor | None] = [None] * len(biases)
        for layer in range(depth - 1, -1, -1):
            if wanted[2 + layer]:
                to_weights[layer] = _product(values[layer].transpose(1, 2), slope)
            if biases and wanted[2 + depth + layer]:
                to_biases[layer] = slope.sum(1, keepdim=True)
            if layer > 0 or wanted[0]:
                back = weights[layer].transpose(1, 2)
                # One output: an outer product, which costs less than a matrix product.
                slope = slope * back if slope.shape[-1] == 1 else torch.bmm(slope, back)
            if layer > 0:
                slope = torch.ops.aten.tanh_backward(slope, values[layer])
        return slope if wanted[0] else None, None, *to_weights, *to_biases


def _draw(
    seed: int, layer: int, shape: tuple[int, int, int], start: Start, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the weights (copies, in, out) and biases (copies, 1, out) of one seed's layer."""
    rng = np.random.default_rng([seed, layer])
    fan_in = shape[1]
    if start == "positive":
        weight = rng.uniform(0.0, 2.0, shape) / fan_in
    else:
        weight = rng.standard_normal(shape) / np.sqrt(fan_in)
    return factor * weight, rng.uniform(-1.0, 1.0, (shape[0], 1, shape[2]))


def to_stack(s: Tensor, seeds: int | None, n: int) -> Tensor:
    """Move s (..., n, 2), or (seeds, ..., n, 2), to (seeds * n, batch, 2).

    Raises:
        ValueError: if the last axes are not (n, 2) or the first is not the seeds.
    """
    if s.ndim < 2 or tuple(s.shape[-2:]) != (n, 2):
        raise ValueError(
            f"wanted s of shape (..., {n}, 2) holding (z, integral of z); got {tuple(s.shape)}"
        )
    if seeds is None:
        return s.reshape(-1, n, 2).transpose(0, 1)
    if s.ndim < 3 or s.shape[0] != seeds:
        raise ValueError(f"wanted a leading axis of {seeds} seeds; got shape {tuple(s.shape)}")
    return s.reshape(seeds, -1, n, 2).transpose(1, 2).reshape(seeds * n, -1, 2)


def from_stack(out: Tensor, like: Tensor, seeds: int | None) -> Tensor:
    """Move a stacked result (seeds * n, batch[, k]) back to (..., n[, k]), batched as `like`."""
    n, tail = like.shape[-2], out.shape[2:]
    if seeds is None:
        return out.transpose(0, 1).reshape(*like.shape[:-1], *tail)
    out = out.reshape(seeds, n, *out.shape[1:]).transpose(1, 2)
    return out.reshape(*like.shape[:-1], *tail)


class _Tanh(torch.autograd.Function):
    """Forward by numpy's vectorised tanh, backward by dtanh = 1 - tanh^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.empty_like(x)
        np.tanh(x.detach().numpy(), out=y.numpy())
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        if torch.is_grad_enabled():  # a second derivative is wanted
            return grad_outputs[0] * (1.0 - y * y)
        return torch.ops.aten.tanh_backward(grad_outputs[0], y)


def tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent equal to `torch.tanh` up to rounding, differentiable any number of times.

    On the CPU numpy computes the values (its vector code is several times faster than torch's);
    elsewhere, and for types that numpy lacks, this is `torch.tanh`.

    Args:
        x: any shape, real.
    """
    if x.device.type != "cpu" or x.dtype not in (torch.float32, torch.float64):
        return torch.tanh(x)
    if x.requires_grad and torch.is_grad_enabled():
        return _Tanh.apply(x)
    return torch.from_numpy(np.asarray(np.tanh(x.detach().numpy())))
