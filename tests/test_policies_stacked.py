"""What runs fast: stacked networks, their tanh, and policies as numpy functions."""

import numpy as np
import pytest
import torch
from test_policies import APART, f64, shake, signals

from cmc.policies import (
    ConvexGradientNetwork,
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    ModularPolicy,
    PositiveNetwork,
    StackedMLP,
    as_numpy,
    tanh,
)


def test_tanh_is_tanh_to_second_order():
    x = torch.cat([torch.linspace(-12, 12, 200_001, dtype=f64), torch.tensor([0.0, 1e-6, 50.0])])
    for dtype, error in ((torch.float32, 2e-7), (f64, 1e-15)):
        assert (tanh(x.to(dtype)).double() - torch.tanh(x.to(dtype).double())).abs().max() < error
    x = torch.tensor([-np.inf, np.inf, np.nan])
    assert torch.equal(tanh(x)[:2], torch.tensor([-1.0, 1.0]))
    assert torch.isnan(tanh(x)[2])
    x = torch.linspace(-3, 3, 41, dtype=f64, requires_grad=True)
    assert torch.autograd.gradcheck(tanh, x)
    assert torch.autograd.gradgradcheck(tanh, x)
    strided = torch.randn(6, 5, requires_grad=True).T[::2]
    torch.testing.assert_close(tanh(strided), torch.tanh(strided))


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("hidden", [(5, 4), (20,), (20, 3, 17)])  # narrow, wide, both
@pytest.mark.parametrize("outputs", [1, 18])
def test_the_stack_is_its_networks_one_by_one(hidden, outputs, bias):
    sizes = {"copies": 2, "seeds": [0, 1], "bias": bias, "dtype": f64}
    network = shake(StackedMLP(2, outputs, hidden, **sizes), 0.3)
    x = signals(4, 6, 2).requires_grad_()

    def alone(i):
        value = x[i]
        for layer, weight in enumerate(network.weights):
            value = value @ weight[i] + (network.biases[layer][i] if bias else 0.0)
            value = torch.tanh(value) if layer < len(hidden) else value
        return value

    ours, theirs = network(x), torch.stack([alone(i) for i in range(4)])
    torch.testing.assert_close(ours, theirs)
    wanted = [x, *network.parameters()]
    for mine, other in zip(
        *(torch.autograd.grad(out.square().sum(), wanted) for out in (ours, theirs)), strict=True
    ):
        torch.testing.assert_close(mine, other)
    weights = [weight.detach().clone().requires_grad_() for weight in network.weights]

    def run(x, *weights):
        return network.run(x, weights)

    assert torch.autograd.gradcheck(run, (x, *weights), fast_mode=True)
    assert torch.autograd.gradgradcheck(run, (x, *weights), fast_mode=True)


@pytest.mark.parametrize("seeds", [None, [3], [0, 1]])
@pytest.mark.parametrize(
    "make",
    [
        lambda **o: ModularPolicy(PositiveNetwork(2, slope_min=0.1, slope_max=2, **o), u0=[1, 2]),
        lambda **o: ModularPolicy(PositiveNetwork(2, bias=False, **o), R=[-1.0, 2.0]),
        lambda **o: ModularPolicy(IndependentNetwork(2, **o), R=[-4.0, 2.0], normalise=True),
        lambda **o: ModularPolicy(IndependentNetwork(2, **o), integral=False),
        lambda **o: ModularPolicy(JointNetwork(2, **o), R=[-1.0, 2.0]),
        lambda **o: ModularPolicy(ConvexGradientNetwork(2, **o)),
        lambda **o: DirectPolicy(JointNetwork(2, inputs=3, **o), part=slice(1, 4), u0=[1, 2]),
        lambda **o: DirectPolicy(JointNetwork(2, inputs=4, **o), squash=True),
        lambda **o: ModularPolicy(PositiveNetwork(2, **o), layout=APART, R=-1.0, squash=True),
    ],
)
def test_the_numpy_function_equals_the_module(make, seeds):
    policy = make(seeds=seeds, dtype=f64)
    observation = signals(*([len(seeds)] if seeds else []), 7, 4)
    expected = policy(observation).detach().numpy()
    np.testing.assert_allclose(as_numpy(policy)(observation.numpy()), expected, rtol=1e-12)
    if seeds:
        with pytest.raises(ValueError, match="seeds"):
            as_numpy(policy)(np.zeros((3, 2, 4)))
