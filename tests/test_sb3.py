"""Stable-Baselines3 policy classes: the same promises, the same learning, save and load."""

from __future__ import annotations

import base64
import importlib
import json
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

pytest.importorskip("stable_baselines3")

from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3 import PPO as SB3PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from cmc import plants
from cmc.envs.auxiliary_space import AuxiliarySpaceWrapper
from cmc.envs.peg_touch import PegTouchEnv, PegTouchVectorEnv
from cmc.learning.ppo import PPO, PPOConfig
from cmc.policies import ModularPolicy, NegativeWeightError, PositiveNetwork
from cmc.sb3 import (
    BatchedVecEnv,
    ContractingPolicy,
    ContractingTD3Policy,
    ConvexGradientPolicy,
    IndependentPolicy,
)
from cmc.theory.certify import certify
from cmc.theory.exact import Region
from cmc.theory.slopes import action_of

UPDATES, CONFIG = 40, PPOConfig(critic_hidden=(32, 32))
KWARGS = {"log_std_init": CONFIG.log_std_start, "net_arch": {"pi": [16, 16], "vf": [32, 32]}}
ALIKE = {"n_steps": 50, "batch_size": 200, "n_epochs": 4, "learning_rate": CONFIG.learning_rate}


class WithoutPrivileged(PegTouchVectorEnv):
    """The critic sees the observation alone, as it does in Stable-Baselines3."""

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0], {}

    def step(self, actions):
        *result, info = super().step(actions)
        return *result, {"final_obs": info["final_obs"]} if "final_obs" in info else {}


def test_learns_as_ours_does():
    torch.set_num_threads(1)
    returns = []

    class Returns(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            returns.append(np.mean([e["r"] for e in list(self.model.ep_info_buffer)[-16:]]))

    env = BatchedVecEnv(PegTouchVectorEnv(num_envs=16))
    model = SB3PPO(ContractingPolicy, env, policy_kwargs=KWARGS, seed=0, device="cpu", **ALIKE)
    model.learn(16 * 50 * UPDATES, callback=Returns())
    history, seeds = [], [0, 1, 2]
    policy = ModularPolicy(PositiveNetwork(2, seeds=seeds, hidden=(16, 16)))
    ppo = PPO(WithoutPrivileged(num_envs=16 * len(seeds)), policy, seeds, CONFIG)
    ppo.train(UPDATES, lambda row: history.append(row["episode_return"]))
    assert len(returns) == len(history) == UPDATES
    first, ours = np.mean(history[:5]), np.mean(history[-5:], axis=0)
    theirs = np.mean(returns[-5:])
    assert min(theirs, ours.min()) > first + 6.0  # all have learnt
    assert abs(theirs - ours.mean()) < 3.0 * max(ours.std(ddof=1), 3.0)


def saved_and_loaded_alike(model, observation, folder):
    """The whole model and its policy alone act as before after a round trip."""
    before = model.predict(observation, deterministic=True)[0]
    model.save(folder / "model.zip")
    again = type(model).load(folder / "model.zip", device="cpu")
    assert type(again.policy) is type(model.policy)
    model.policy.save(folder / "policy.pt")
    for other in (again, type(model.policy).load(folder / "policy.pt")):
        np.testing.assert_array_equal(other.predict(observation, deterministic=True)[0], before)


@pytest.mark.parametrize("kind", [ContractingPolicy, IndependentPolicy, ConvexGradientPolicy])
def test_save_and_load(tmp_path, kind):
    model = SB3PPO(kind, PegTouchEnv(), n_steps=64, policy_kwargs=KWARGS, device="cpu", seed=3)
    model.learn(128)
    observation = np.random.default_rng(0).standard_normal((9, 4)).astype(np.float32)
    saved_and_loaded_alike(model, observation, tmp_path)


def test_a_file_that_names_a_module_of_an_earlier_version_loads(tmp_path, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(ContractingPolicy, "__module__", "cmc.sb3.actor_critic")
        model = SB3PPO(ContractingPolicy, PegTouchEnv(), n_steps=64, device="cpu")
        model.save(tmp_path / "earlier.zip")
    data = json.loads(zipfile.ZipFile(tmp_path / "earlier.zip").read("data"))
    assert b"actor_critic" in base64.b64decode(data["policy_class"][":serialized:"])
    again = SB3PPO.load(tmp_path / "earlier.zip", device="cpu")
    assert type(again.policy) is importlib.import_module("cmc.sb3.td3").ContractingPolicy


def test_the_promised_slopes_hold_in_the_action_that_is_taken():
    caps = {"slope_min": 0.05, "slope_max": [[2.0, 1.0], [0.2, 0.1]]}
    kwargs = {"network_kwargs": caps, "R": [1.0, -1.0], "u0": [0.5, 0.0]}
    model = SB3PPO(ContractingPolicy, PegTouchEnv(), policy_kwargs=kwargs, device="cpu")
    observation = torch.randn(200, 4, requires_grad=True)
    mean = model.policy.get_distribution(observation).distribution.mean
    low, high = model.policy.slope_bounds()
    assert (low >= 0.05 - 1e-7).all()
    assert (high <= np.array(caps["slope_max"]) * (1 + 1e-6)).all()
    rows = [torch.autograd.grad(mean[:, i].sum(), observation, retain_graph=True) for i in (0, 1)]
    slope = torch.stack([row[0].reshape(200, 2, 2)[:, i] for i, row in enumerate(rows)], 1)
    own = slope * torch.tensor([-1.0, 1.0])[:, None]
    torch.testing.assert_close(own, model.policy.jacobian(observation.detach().view(200, 2, 2)))
    assert (own >= torch.as_tensor(low) - 1e-6).all()
    assert (own <= torch.as_tensor(high) + 1e-6).all()
    optimised = {id(p) for group in model.policy.optimizer.param_groups for p in group["params"]}
    assert optimised == {id(p) for p in model.policy.parameters()}
    state = model.policy.state_dict()
    state["action_net.network.mlp.weights.0"] -= 10.0
    with pytest.raises(NegativeWeightError, match="action_net"):
        model.policy.load_state_dict(state)


def test_batched_environment_reports_what_ended():
    env = BatchedVecEnv(PegTouchVectorEnv(num_envs=3, horizon=4))
    env.seed(5)
    env.reset()
    total = np.zeros(3)
    for step in range(4):
        observation, reward, done, infos = env.step(np.zeros((3, 2)))
        total += reward
        assert done.all() == (step == 3)
    for index, info in enumerate(infos):
        assert info["episode"]["r"] == pytest.approx(total[index], rel=1e-5)
        assert info["episode"]["l"] == 4
        assert info["TimeLimit.truncated"]
        assert not np.allclose(info["terminal_observation"], observation[index])
    assert env.get_attr("num_envs", [0, 2]) == [3, 3]


def lags(scales=None, clip_obs=10.0):
    """Two lags behind the wrapper, and behind VecNormalize with given standard deviations."""
    A, B, h = np.diag([-2.0, -5.0]), np.diag([2.0, 10.0]), 0.1

    class Lags(gymnasium.Env):
        observation_space = spaces.Box(-50, 50, (2,), np.float64)
        action_space = spaces.Box(-20, 20, (2,), np.float64)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.y = np.array([0.05, -0.05])
            return self.y.copy(), {}

        def step(self, u):
            phi = np.exp(np.diag(A) * h)
            self.y = phi * self.y + (1 - phi) * np.diag(B) / -np.diag(A) * u
            return self.y.copy(), 0.0, False, False, {}

    def wrapped():
        return AuxiliarySpaceWrapper(Lags(), error=lambda y: y, model=lambda y: (A, B), h=h)

    env = DummyVecEnv([wrapped])
    if scales is not None:
        env = VecNormalize(env, norm_reward=False, training=False, clip_obs=clip_obs)
        env.obs_rms.mean[:], env.obs_rms.var[:] = 0.0, np.square(scales)
    kwargs = {"network_kwargs": {"slope_min": [0.5, 0.5], "slope_max": [1.5, 1.0]}}
    return SB3PPO(ContractingPolicy, env, policy_kwargs=kwargs, n_steps=64, seed=0, device="cpu")


def test_a_certificate_sees_vec_normalize():
    plant, h = plants.LinearPlant(np.diag([-2.0, -5.0]), np.diag([2.0, 10.0])), 0.1
    plain = lags()
    assert certify(plain.policy, plant, h=h)
    scaled = lags([0.1, 0.01, 0.5, 0.05])
    assert not certify(scaled.policy, plant, h=h)
    box = Region([-0.02] * 2, [0.02] * 2, integral=0.02)
    assert not certify(scaled.policy, plant, h=h, region=box)
    unit = lags([1.0, 1.0, 1.0, 1.0])
    assert not certify(unit.policy, plant, h=h)  # VecNormalize clips somewhere
    assert certify(unit.policy, plant, h=h, region=box)


def test_what_the_theory_sees_is_what_the_model_does():
    model = lags([0.3, 0.1, 0.5, 0.2])
    action = action_of(model.policy.on_signals(), 2)
    s = np.random.default_rng(0).normal(size=(20, 2, 2))
    seen = model.get_vec_normalize_env().normalize_obs(s.reshape(20, 4))
    taken, _ = model.predict(seen.astype(np.float32), deterministic=True)
    wanted = np.clip(action(s, np.ones(2)), -1, 1)
    np.testing.assert_allclose(taken, wanted, atol=1e-5)


def test_edges_of_other_algorithms_spaces_and_layouts():
    rate, pendulum = lambda _: 1e-3, gymnasium.make("Pendulum-v1")
    action, seen, own = spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (5,)), spaces.Box(-1, 1, (4,))
    gaussian, there = "for PPO, A2C and their like", "for TD3 and DDPG.*there is ContractingPolicy"
    sync = gymnasium.make_vec("cmc.envs:cmc/PegTouch-v0", num_envs=2, vectorization_mode="sync")
    peg, no_layers = PegTouchEnv(), {"net_arch": {"pi": []}}
    wide = {"layout": {"s": slice(0, 9)}}
    for call, message in (
        (lambda: ContractingPolicy(seen, action, rate), r"shape \(4,\)"),
        (lambda: ContractingPolicy(seen, spaces.Discrete(3), rate), "Box of one axis"),
        (lambda: ContractingPolicy(own, action, rate, net_arch=[0]), "net_arch needs"),
        (lambda: ContractingPolicy(own, action, rate, net_arch={"qf": [3]}), "net_arch: wanted"),
        (lambda: ContractingPolicy(own, action, rate, R=np.nan), "R needs finite"),
        (lambda: ContractingPolicy(own, action, rate, integral=3), "integral: wanted True"),
        (lambda: SB3PPO(ContractingPolicy, peg, policy_kwargs=wide), "layout: 's' needs 4 numbers"),
        (lambda: ContractingPolicy(seen, action, rate, layout=[3]), "layout needs a mapping"),
        (
            lambda: ContractingPolicy(
                seen, action, rate, layout={"z": slice(2), "integral": slice(2, 5)}
            ),
            "layout: 'integral' needs 2 numbers for 2 actions, got slice",
        ),
        (lambda: SB3PPO(ConvexGradientPolicy, peg, policy_kwargs=no_layers), "hidden needs"),
        (lambda: TD3(ContractingPolicy, peg, buffer_size=9), "there is ContractingTD3Policy"),
        (
            lambda: TD3(ContractingTD3Policy, pendulum, buffer_size=9),
            r"of shape \(2,\).*got \(3,\)",
        ),
        (lambda: BatchedVecEnv(sync), "env: wanted a restart in the same step"),
        *((lambda a=a: a(ContractingPolicy, peg, buffer_size=9), gaussian) for a in (SAC, DDPG)),
        *((lambda a=a: a(ContractingTD3Policy, peg), there) for a in (SB3PPO, SAC)),
    ):
        with pytest.raises((ValueError, TypeError, AttributeError), match=message):
            call()
    assert ContractingPolicy(seen, action, rate, layout={"s": slice(1, 5)}).actor.n == 2
    model = SB3PPO(ContractingPolicy, peg, policy_kwargs={"net_arch": {"pi": [16]}}, n_steps=64)
    assert model.policy.net_arch["vf"] == []
