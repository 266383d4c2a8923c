"""A stack of tanh networks of equal shape, evaluated as one batched product a layer; fast tanh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from cmc.theory.arrays import count, number

Start = Literal["positive", "signed"]
NARROW = 16
"""Columns below which a product is computed from the transposes."""


def check_seeds(seeds: Sequence[int] | None) -> tuple[int, ...] | None:
    """The seeds as a tuple, or None for one network without a leading axis."""
    if seeds is None:
        return None
    found = seeds if isinstance(seeds, (Sequence, np.ndarray)) else ()
    if not len(found) or not all(isinstance(s, (int, np.integer)) and s >= 0 for s in found):
        raise ValueError(f"seeds needs whole numbers, at least one, from 0 on; got {seeds!r:.60}")
    return tuple(int(seed) for seed in found)


def check_tensor(name: str, value: Any, *tail: int) -> None:
    """Refuse what is no tensor of floats of shape (..., *tail)."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        raise TypeError(f"{name} needs a tensor of floats, got {value!r:.60}")
    if tail and tuple(value.shape[-len(tail) :]) != tail:
        wish = ", ".join(str(size) for size in tail)
        raise ValueError(f"{name} needs shape (..., {wish}), got {tuple(value.shape)}")


class StackedMLP(nn.Module):
    """Tanh networks x -> W_l tanh(... tanh(W_1 x + b_1)) + b_l, one for each index of a stack.

    The stack is the product of the seeds (if any) and `copies`, one `baddbmm` a layer. Each seed
    draws its own start: a network does not depend on which others are in the stack.

    Args:
        inputs, outputs, hidden: sizes; at least one hidden layer.
        copies: networks a seed (one per dimension), or 1.
        seeds: one integer for each leading index, or None for no leading axis (start from 0).
        bias: without biases the network is odd.
        start: "positive" draws weights from U(0, 2)/fan_in and hidden biases from U(-1, 1);
            "signed" draws weights from N(0, 1)/sqrt(fan_in), no biases.
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
        if not isinstance(hidden, (list, tuple)) or not hidden:
            raise ValueError(f"hidden needs a list of sizes, at least one; got {hidden!r:.60}")
        inner = [count("hidden", size) for size in hidden]
        sizes = [count("inputs", inputs), *inner, count("outputs", outputs)]
        copies, last = count("copies", copies), number("last", last)
        if not (isinstance(bias, bool) and isinstance(start, str) and start in get_args(Start)):
            raise ValueError(
                f"bias needs True or False, start one of {get_args(Start)}; "
                f"got bias = {bias!r:.60}, start = {start!r:.60}"
            )
        self.seeds = check_seeds(seeds)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for layer, (fan_in, fan_out) in enumerate(zip(sizes, sizes[1:], strict=False)):
            final = layer == len(sizes) - 2
            weight, shift = [], []
            for seed in self.seeds or (0,):
                rng, shape = np.random.default_rng([seed, layer]), (copies, fan_in, fan_out)
                if start == "positive":
                    drawn = rng.uniform(0.0, 2.0, shape) / fan_in
                else:
                    drawn = rng.standard_normal(shape) / np.sqrt(fan_in)
                weight.append((last if final else 1.0) * drawn)
                shift.append(rng.uniform(-1.0, 1.0, (copies, 1, fan_out)))
            self.weights.append(as_parameter(weight, dtype))
            if bias:
                still = final or start == "signed"
                self.biases.append(as_parameter(0.0 * np.array(shift) if still else shift, dtype))

    @property
    def stack(self) -> int:
        """Number of networks in the stack."""
        return len(self.weights[0])

    def forward(self, x: Tensor) -> Tensor:
        """Evaluate all networks: x (stack, batch, inputs) to (stack, batch, outputs)."""
        return self.run(x, list(self.weights))

    def run(
        self, x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor] | None = None
    ) -> Tensor:
        """Evaluate with the given weights (stack, in, out), and biases, in place of our own."""
        biases = list(self.biases) if biases is None else biases
        return _Network.apply(x, len(weights), *weights, *biases)

    def slopes(self, x: Tensor, weights: Sequence[Tensor]) -> Tensor:
        """Derivatives of the first output by the inputs, in closed form: (stack, batch, inputs)."""
        slope = weights[-1][..., :1].transpose(1, 2)
        hidden = _layers(x, weights, list(self.biases))[:-1]
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


def as_parameter(rows: Any, dtype: torch.dtype) -> nn.Parameter:
    """One parameter of arrays, seed after seed."""
    return nn.Parameter(torch.as_tensor(np.concatenate(rows), dtype=dtype))


def check_signals(s: Any, n: int, seeds: int | None) -> None:
    """Refuse signals that are not (..., n, 2), or (seeds, ..., n, 2) where there are seeds."""
    if not isinstance(s, np.ndarray):
        check_tensor("s", s)
    lead = "" if seeds is None else f"{seeds} seeds, "
    if tuple(s.shape[-2:]) != (n, 2) or (seeds is not None and (s.ndim < 3 or len(s) != seeds)):
        raise ValueError(
            f"s needs shape ({lead}..., {n}, 2), (z, integral of z); got {tuple(s.shape)}"
        )


class SignalNetwork(nn.Module):
    """Stacked networks on s (..., n, 2): by default `mlp` holds one for each of n dimensions.

    With seeds s is (seeds, ..., n, 2). What moves arrays about takes torch and numpy alike.
    """

    def __init__(self, n: int, mlp: StackedMLP) -> None:
        super().__init__()
        self.n, self.mlp = count("n", n), mlp
        self.seeds = None if mlp.seeds is None else len(mlp.seeds)

    def used_weights(self) -> list[Tensor]:
        """Weights (stack, in, out) as they are used."""
        return list(self.mlp.weights)

    def inputs_of(self, s: Any) -> Any:
        """What the stack sees of s, (seeds * n, batch, 2)."""
        check_signals(s, self.n, self.seeds)
        count = self.seeds or 1
        return s.reshape(count, -1, self.n, 2).swapaxes(1, 2).reshape(count * self.n, -1, 2)

    def outputs_of(self, out: Any, s: Any) -> Any:
        """What the stack answers, (seeds * n, batch, 1), to (..., n), batched as s."""
        return self._back(out[..., 0], s)

    def _back(self, out: Any, s: Any) -> Any:
        out = out.reshape(self.seeds or 1, self.n, *out.shape[1:]).swapaxes(1, 2)
        return out.reshape(*s.shape[:-1], *out.shape[3:])

    def forward(self, s: Tensor) -> Tensor:
        """Evaluate the networks: s (..., n, 2) to (..., n)."""
        check_tensor("s", s)
        return self.outputs_of(self.mlp.run(self.inputs_of(s), self.used_weights()), s)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes d pi_i / d s_ij in closed form (`product`): s (..., n, 2) to (..., n, 2)."""
        check_tensor("s", s)
        return self._back(self.mlp.slopes(self.inputs_of(s), self.used_weights()), s)


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
    """
    check_tensor("x", x)
    if x.device.type != "cpu" or x.dtype not in (torch.float32, torch.float64):
        return torch.tanh(x)
    if x.requires_grad and torch.is_grad_enabled():
        return _Tanh.apply(x)
    return torch.from_numpy(np.asarray(np.tanh(x.detach().numpy())))
