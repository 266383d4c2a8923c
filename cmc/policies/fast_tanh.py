"""tanh on the CPU through numpy, several times faster than `torch.tanh`, with its own gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


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
