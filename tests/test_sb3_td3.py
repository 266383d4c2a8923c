"""The contracting actor of Stable-Baselines3's TD3, and certificates of what algorithms hold."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO as SB3PPO
from stable_baselines3 import TD3
from test_sb3 import saved_and_loaded_alike

from cmc import plants
from cmc.envs.peg_touch import PegTouchEnv
from cmc.sb3 import (
    ContractingPolicy,
    ContractingTD3Policy,
)
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certify import certify
from cmc.theory.exact import Region
from cmc.theory.slopes import action_of


class Slow(gymnasium.Env):
    """Two lags whose action space is neither centred nor of width two."""

    A, B, h = np.array([-1.0, -2.0]), np.array([1.0, -2.0]), 0.1
    observation_space = spaces.Box(-9, 9, (4,), np.float32)
    action_space = spaces.Box(np.float32([-1, -4]), np.float32([3, 4]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y, self.integral, self.k = self.np_random.uniform(-1, 1, 2), np.zeros(2), 0
        return self._seen(), {}

    def _seen(self):
        self.integral = self.integral + self.h * self.y
        return np.stack([self.y, self.integral], -1).ravel().astype(np.float32)

    def step(self, u):
        self.y = self.y + self.h * (self.A * self.y + self.B * u)
        self.k += 1
        return self._seen(), -float(np.square(self.y).sum()), False, self.k >= 40, {}


@pytest.fixture(scope="module")
def td3():
    kwargs = {"R": [1.0, -1.0], "network_kwargs": {"slope_max": [0.5, 0.3]}, "net_arch": [8, 8]}
    options = {"learning_starts": 40, "batch_size": 16, "buffer_size": 300, "device": "cpu"}
    model = TD3(ContractingTD3Policy, Slow(), policy_kwargs=kwargs, seed=0, **options)
    before = model.actor.mu.network.mlp.weights[0].detach().clone()
    model.learn(120)
    assert not torch.equal(before, model.actor.mu.network.mlp.weights[0])
    return model


def test_the_contracting_actor_of_td3_acts_is_saved_and_keeps_its_signs_and_caps(td3, tmp_path):
    s = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    taken = td3.predict(s, deterministic=True)[0]
    pi = action_of(td3.policy.on_signals(), 2)
    wanted = [1.0, 0.0] + pi(s.reshape(50, 2, 2).astype(float), np.array([1.0, -1.0]))
    np.testing.assert_allclose(taken, wanted, atol=1e-5)
    optimised = td3.actor.optimizer.param_groups[0]["params"]
    assert set(map(id, optimised)) == set(map(id, td3.actor.parameters()))
    saved_and_loaded_alike(td3, s, tmp_path)
    low, high = td3.policy.slope_bounds()
    assert (low == 0).all()  # tanh saturates
    assert (high <= np.array([[2.0 * 0.5, 2.0 * 0.3], [4.0 * 0.5, 4.0 * 0.3]]) + 1e-6).all()
    s = torch.randn(100, 4, requires_grad=True)
    action = td3.actor(s)
    for i, half in enumerate((2.0, 4.0)):
        slope = torch.autograd.grad(action[:, i].sum(), s, retain_graph=True)[0].numpy() * half
        own, other = slope[:, 2 * i : 2 * i + 2] * [-1.0, 1.0][i], slope[:, 2 - 2 * i : 4 - 2 * i]
        assert (own > 0).all()
        assert (own <= high[i] + 1e-6).all()
        assert (other == 0).all()


def test_what_the_algorithms_hold_can_be_certified_in_a_box(td3):
    kwargs = {"network_kwargs": {"slope_min": 0.2, "slope_max": [0.6, 0.6]}}
    ppo = SB3PPO(ContractingPolicy, PegTouchEnv(), policy_kwargs=kwargs, n_steps=64)
    region = Region([1.0, -8.0], [3.0, -1.0])
    answer = certify(ppo.policy, plants.get("peg"), region=region, y_ref=[2.0, -4.0])
    assert not answer.refused, str(answer)
    plant = plants.LinearPlant(np.diag(Slow.A), np.diag(Slow.B))
    own = AuxiliarySpace.identity(plant.f_y([0, 0], [0, 0]), plant.f_u([0, 0], [0, 0]))
    assert "no floor" in certify(td3.policy, plant, transforms=own).reason  # tanh is flat
    near = Region([-0.3] * 2, [0.3] * 2, integral=0.3)
    assert certify(td3.policy, plant, region=near, transforms=own)
    assert "wrong way" in certify(td3.policy, plant, region=near).reason  # decompose has R > 0
