"""Stacked networks: equal to their networks one by one, with derivatives of two orders."""

import pytest
import torch
from test_policies import f64, shake, signals

from cmc.policies import StackedMLP


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

    assert torch.autograd.gradgradcheck(run, (x, *weights), fast_mode=True)


@pytest.mark.parametrize("bias", [True, False])
def test_gradients_of_the_stacked_network_to_second_order(bias):
    network = StackedMLP(2, 3, (5, 4), copies=2, seeds=[0, 1], bias=bias, dtype=f64)
    shake(network, 0.3)
    x = signals(4, 3, 2).requires_grad_()

    def run(x, *weights):
        return network.run(x, weights)

    weights = [weight.detach().clone().requires_grad_() for weight in network.weights]
    assert torch.autograd.gradcheck(run, (x, *weights))
    assert torch.autograd.gradgradcheck(run, (x, *weights))
    plain = network.hidden_values(x, list(network.weights))[-1]
    torch.testing.assert_close(network(x), plain)
    ours, theirs = (
        torch.autograd.grad(out.square().sum(), list(network.parameters()))
        for out in (network(x), plain)
    )
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other)
