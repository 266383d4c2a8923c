"""A policy that lies on another device is read where it can be."""

import copy

import numpy as np
import pytest
import torch

from cmc import plants
from cmc.policies import ModularPolicy, PositiveNetwork, as_numpy
from cmc.theory.certify import certify


def test_a_policy_on_another_device_is_brought_to_the_cpu():
    class Away(torch.Tensor):
        """On another device, from which it can be copied, and nothing else."""

        @staticmethod
        def __new__(cls, here):
            return cls._make_wrapper_subclass(cls, here.shape, dtype=here.dtype, device="meta")

        def __init__(self, here):
            self.here = here

        @classmethod
        def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
            if operation in (torch.ops.aten.detach.default, torch.ops.aten.clone.default):
                return cls(args[0].here.clone())
            if operation is torch.ops.aten._to_copy.default:
                made = args[0].here.to(kwargs.get("dtype", args[0].dtype), copy=True)
                return made if str(kwargs.get("device")) == "cpu" else cls(made)
            raise RuntimeError(f"{operation} on another device")

    here = ModularPolicy(PositiveNetwork(2, hidden=(8,), slope_min=0.5, slope_max=1.0))
    away = copy.deepcopy(here)
    for module in away.modules():
        for name, weight in [*module.named_parameters(recurse=False)]:
            setattr(module, name, torch.nn.Parameter(Away(weight.detach())))
        for name, buffer in [*module.named_buffers(recurse=False)]:
            setattr(module, name, Away(buffer))
    with pytest.raises((RuntimeError, TypeError)):
        away(torch.zeros(1, 4))
    assert certify(away, plants.get("coupled_lags"))
    seen = np.random.default_rng(0).normal(size=(5, 4))
    np.testing.assert_array_equal(as_numpy(away)(seen), as_numpy(here)(seen))
    assert {weight.device.type for weight in away.parameters()} == {"meta"}  # it stays there
