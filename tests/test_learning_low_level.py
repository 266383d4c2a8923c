"""Low levels: the slope they start from, and the sign of what they do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cmc import plants
from cmc.learning.low_level import evaluate, latent_policy, set_gain
from cmc.policies import IndependentNetwork, LinearNetwork, ModularPolicy, PositiveNetwork
from cmc.theory.certify import certify
from cmc.theory.slopes import action_of

SEEDS = [3, 8]
CAP = (np.array([1.0, 0.02]), np.full(6, 30.0))
NETWORKS = {
    "capped": lambda: PositiveNetwork(6, seeds=SEEDS, bias=False, joint_cap=CAP),
    "with biases": lambda: PositiveNetwork(6, seeds=SEEDS),
    "free": lambda: IndependentNetwork(6, seeds=SEEDS),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_can_start_from_the_same_slope(name):
    gain = np.array([0.3, 0.3, 5.0, 20.0, 0.3, 1.0])
    network = NETWORKS[name]()
    before = [weight.detach().clone() for weight in network.mlp.weights]
    set_gain(network, gain)
    slope = network.jacobian(torch.zeros(2, 1, 6, 2))[:, 0, :, 0].detach().numpy()
    np.testing.assert_allclose(slope, np.tile(gain, (2, 1)), rtol=1e-4)
    if name != "with biases":  # these start away from zero, where the last tanh is flatter
        seen = np.concatenate([1e-4 * np.ones((2, 1, 6)), np.zeros((2, 1, 6))], -1)
        u = evaluate(latent_policy(network), seen)
        np.testing.assert_allclose(u[:, 0] / 1e-4, np.tile(gain, (2, 1)), rtol=0.01)
    for old, new in zip(before[:-1], network.mlp.weights, strict=False):
        assert torch.equal(old, new)  # the last layer alone was moved


def test_free_networks_keep_most_of_their_start():
    network = NETWORKS["free"]()
    last = network.mlp.weights[-1].detach().clone()
    set_gain(network, 0.3)
    moved = network.mlp.weights[-1].detach() - last
    x = torch.tensor([[[1e-3, 0.0]]]).repeat(12, 1, 1)
    h = x
    for weight in network.mlp.weights[:-1]:
        h = torch.tanh(h @ weight)
    h = h / 1e-3
    # the smallest change that gives the slope lies along h
    along = (moved[..., 0] * h[:, 0]).sum(-1) / h[:, 0].norm(dim=-1)
    torch.testing.assert_close(along.abs(), moved[..., 0].norm(dim=-1), rtol=1e-3, atol=1e-5)


def test_positive_slopes_pull_towards_the_sub_goal_and_stay_within_one():
    actor = latent_policy(LinearNetwork(np.tile([2.0, 3.0], (6, 1))))
    y = np.random.default_rng(0).normal(size=(2, 5, 6))
    integral = np.random.default_rng(1).normal(size=(2, 5, 6))
    seen = np.concatenate([y, integral, np.ones((2, 5, 13))], -1)
    np.testing.assert_allclose(evaluate(actor, seen), np.tanh(2 * y + 3 * integral), atol=1e-6)


def test_a_tanh_at_the_end_leaves_no_floor():
    """Behind a tanh an unstable plant escapes from far away: nothing is certified everywhere."""
    plant = plants.LinearPlant([[0.5]], [[1.0]])
    network = PositiveNetwork(1, slope_min=[2.0, 0.5], slope_max=[3.0, 1.0])
    assert certify(ModularPolicy(network), plant)
    assert not certify(ModularPolicy(network, squash=True), plant)
    s = np.random.default_rng(0).normal(size=(9, 1, 2))
    policy = ModularPolicy(network, squash=True)
    with torch.no_grad():
        wanted = policy(torch.as_tensor(s.reshape(9, 2), dtype=torch.float32)).numpy()
    np.testing.assert_allclose(action_of(policy, 1)(s, np.ones(1)), wanted, atol=1e-5)
