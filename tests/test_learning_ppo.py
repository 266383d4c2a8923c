"""PPO: formulas against their definitions, independence of seeds, resumption exact to the bit."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from cmc import store
from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.learning.ppo import (
    PPO,
    PPOConfig,
    Rollout,
    _clip_gradients,
    _shuffle,
    collect,
    generalised_advantage,
    surrogate_gradient,
)
from cmc.policies import (
    DirectPolicy,
    IndependentNetwork,
    JointNetwork,
    ModularPolicy,
    PositiveNetwork,
)

SMALL = PPOConfig(steps=10, epochs=2, minibatches=2, critic_hidden=(8,))
RECORD = {"study": "test", "method": "cppo"}


def training(seeds=(0, 1), config=SMALL, trajectories=4, network=PositiveNetwork):
    env = PegTouchVectorEnv(num_envs=trajectories * len(seeds), horizon=config.steps)
    policy = ModularPolicy(network(2, seeds=seeds, hidden=(6, 6)))
    return PPO(env, policy, seeds, config)


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_surrogate_gradient_equals_autograd():
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    mean, action = draw(3, 50, 2).requires_grad_(), draw(3, 50, 2)
    log_std = (0.3 * draw(3, 1, 2)).requires_grad_()
    distribution = torch.distributions.Normal(mean, log_std.exp())
    log_probability = distribution.log_prob(action).sum(-1) + np.log(2 * np.pi)
    old, advantage = (log_probability + 0.3 * draw(3, 50)).detach(), draw(3, 50)
    ratio = (log_probability - old).exp()
    loss = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean(1).sum()
    expected = torch.autograd.grad(loss, [mean, log_std])
    with torch.no_grad():
        *found, found_ratio = surrogate_gradient(mean, log_std, action, old, advantage, 0.2)
    torch.testing.assert_close(found[0], expected[0])
    torch.testing.assert_close(found[1], expected[1])
    torch.testing.assert_close(found_ratio, ratio.detach())
    assert 0 < ((found_ratio - 1).abs() > 0.2).double().mean() < 1  # some are clipped, some not


def test_advantage_is_the_sum_of_discounted_errors_up_to_the_end():
    rng = np.random.default_rng(0)
    S, T, E, gamma, lam = 2, 12, 3, 0.9, 0.8
    reward, value, following = rng.standard_normal((3, S, T, E))
    terminated = rng.random((S, T, E)) < 0.15
    done = terminated | (rng.random((S, T, E)) < 0.15)
    empty = torch.empty(0)
    rollout = Rollout(empty, empty, empty, empty, empty, reward, terminated, done)
    found = generalised_advantage(rollout, value, following, gamma, lam)
    for s, t, e in np.ndindex(S, T, E):
        total, weight = 0.0, 1.0
        for k in range(t, T):
            next_value = 0.0 if terminated[s, k, e] else following[s, k, e]
            total += weight * (reward[s, k, e] + gamma * next_value - value[s, k, e])
            weight *= gamma * lam
            if done[s, k, e]:
                break
        assert found[s, t, e] == pytest.approx(total)


def test_rows_are_shuffled_a_seed_at_a_time():
    data = torch.arange(2 * 6).reshape(2, 6, 1).repeat(1, 1, 3)
    mixed = _shuffle(data, [np.random.default_rng(0), np.random.default_rng(1)])
    assert torch.equal(mixed[..., 0].sort(1).values, data[..., 0])
    assert torch.equal(mixed[..., 0], mixed[..., 2])
    assert not torch.equal(mixed, data)


def test_gradients_are_clipped_a_seed_at_a_time():
    small, large = torch.full((2, 3, 2), 0.01), torch.full((2, 5), 0.01)
    large[1] = 100.0
    before = torch.cat([small[1].flatten(), large[1]])
    _clip_gradients([small, None, large], 2, 0.5)
    assert torch.equal(small[0], torch.full((3, 2), 0.01))
    assert torch.equal(large[0], torch.full((5,), 0.01))
    after = torch.cat([small[1].flatten(), large[1]])
    assert float(after.norm()) == pytest.approx(0.5, rel=1e-4)
    torch.testing.assert_close(after / after.norm(), before / before.norm())


@pytest.mark.parametrize("network", [PositiveNetwork, IndependentNetwork, JointNetwork])
def test_a_seed_learns_the_same_alone_and_in_any_company(network):
    together, permuted, alone = (
        training(seeds, network=network) for seeds in ((3, 8, 5), (5, 3, 8), (8,))
    )
    for _ in range(3):
        returns = [t.update()["episode_return"] for t in (together, permuted, alone)]
    np.testing.assert_allclose(returns[0], returns[1][[1, 2, 0]], rtol=1e-4)
    np.testing.assert_allclose(returns[0][1], returns[2][0], rtol=1e-4)
    for name, weight in together.parameters.items():
        rows = [t.parameters[name].detach() for t in (permuted, alone)]
        rows = [row.reshape(-1, *weight.shape[1:]) for row in rows]
        copies = weight.shape[0] // 3
        first = weight.detach()
        torch.testing.assert_close(first[:copies], rows[0][copies : 2 * copies], rtol=0, atol=1e-4)
        torch.testing.assert_close(first[copies : 2 * copies], rows[1], rtol=0, atol=1e-4)
    moved = together.parameters["log_std"].detach() - SMALL.log_std_start
    assert moved.abs().min() > 1e-3  # they did learn


def test_learns_the_peg_task():
    returns = []
    config = PPOConfig(critic_hidden=(32, 32))
    env = PegTouchVectorEnv(num_envs=32)
    policy = ModularPolicy(PositiveNetwork(2, seeds=[0, 1], hidden=(16, 16)))
    ppo = PPO(env, policy, [0, 1], config)
    ppo.train(45, lambda row: returns.append(row["episode_return"]))
    assert np.shape(returns) == (45, 2)
    assert (np.mean(returns[-3:], 0) > 0.85 * np.mean(returns[:3], 0)).all()  # negative returns
    assert ppo.episodes == 45 * 16


def test_report():
    rows = []
    training().train(3, rows.append)
    assert [row["update"] for row in rows] == [1, 2, 3]
    assert (rows[-1]["episodes"], rows[-1]["steps"], rows[-1]["total_updates"]) == (12, 120, 3)
    assert rows[-1]["episode_return"].shape == (2,)
    assert rows[-1]["std"].shape == (2, 2)


def test_resumed_training_is_exactly_the_uninterrupted_one(tmp_path):
    path = tmp_path / "training.safetensors"
    whole, first, resumed = training(), training(), training()
    whole.train(5)
    first.train(3)
    first.save(path, RECORD)
    resumed.load(path, RECORD)
    resumed.train(5)
    assert same(whole.state()[0], resumed.state()[0])
    assert not same(whole.state()[0], training().state()[0])


def test_interrupt_returns_to_the_last_whole_update(monkeypatch):
    whole, stopped = training(), training()
    whole.train(4)
    ordinary, calls = stopped._minibatch, []

    def interrupted(batch):
        calls.append(1)
        if len(calls) == 4 * 2 + 3:  # within the third update
            raise KeyboardInterrupt
        return ordinary(batch)

    monkeypatch.setattr(stopped, "_minibatch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stopped.train(4)
    assert stopped.updates == 2
    stopped.train(4)
    assert same(whole.state()[0], stopped.state()[0])


SCRIPT = """
import sys
from tests.test_learning_ppo import RECORD, training
ppo = training()
while True:
    ppo.train(ppo.updates + 3)
    ppo.save(sys.argv[1], RECORD)
"""


def test_killed_training_resumes_exactly(tmp_path):
    path = tmp_path / "training.safetensors"
    root = store.Path(__file__).resolve().parents[1]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(path)], env=environment, cwd=root)
    try:
        for _ in range(2400):
            if path.exists() or process.poll() is not None:
                break
            time.sleep(0.05)
        time.sleep(random.uniform(0.0, 0.2))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL
    resumed, whole = training(), training()
    resumed.load(path, RECORD)
    assert resumed.updates > 0
    goal = resumed.updates + 2
    resumed.train(goal)
    whole.train(goal)
    assert same(whole.state()[0], resumed.state()[0])


def test_foreign_checkpoints_are_refused(tmp_path):
    path = tmp_path / "training.safetensors"
    training().save(path, RECORD)
    for other, record, match in (
        (training(seeds=(0, 2)), RECORD, "seeds"),
        (training(config=PPOConfig(steps=10, clip=0.3)), RECORD, "settings"),
        (training(), {**RECORD, "method": "ppo"}, "method"),
        (training(network=JointNetwork), RECORD, "shape"),
    ):
        with pytest.raises(store.CheckpointError, match=match):
            other.load(path, record)
    store.save_checkpoint(path, {"a": np.zeros(2)}, RECORD)
    with pytest.raises(store.CheckpointError, match="no training state"):
        training().load(path, RECORD)
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(store.CheckpointError, match="not a complete"):
        training().load(path, RECORD)


def test_a_general_vector_environment_is_bootstrapped_at_its_time_limits():
    def make():
        return gym.wrappers.TimeLimit(gym.make("Pendulum-v1").unwrapped, 4)

    env = gym.vector.SyncVectorEnv([make] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    torch.manual_seed(0)
    policy = torch.nn.Linear(3, 1)
    rollout = collect(env, policy, torch.zeros(1, 1, 1), 0, [np.random.default_rng(0)], 10)
    assert rollout.done[0, :, 0].tolist() == [False, False, False, True] * 2 + [False] * 2
    assert not rollout.terminated.any()
    seen, reached = rollout.observation[0], rollout.following[0]
    cosine, sine, rate = seen.unbind(-1)
    push = rollout.action[0, ..., 0].clamp(-2, 2)
    rate = (rate + 0.05 * (15 * sine + 3 * push)).clamp(-8, 8)  # Pendulum-v1, its documentation
    angle = torch.atan2(sine, cosine) + 0.05 * rate
    expected = torch.stack([angle.cos(), angle.sin(), rate], -1)
    torch.testing.assert_close(reached, expected, atol=1e-5, rtol=1e-5)  # also at the time limits
    inner = ~torch.as_tensor(rollout.done[0, :-1, 0])
    assert torch.equal(seen[1:][inner], reached[:-1][inner])
    assert ((seen[1:][~inner] - reached[:-1][~inner]).norm(dim=-1) > 1e-3).all()  # restarted


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"steps": 0}, "steps"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"gamma": 1.1}, "gamma"),
        ({"clip": 0.0}, "clip"),
    ],
)
def test_bad_hyperparameters(options, match):
    with pytest.raises(ValueError, match=match):
        PPOConfig(**options)


def test_minibatches_of_one_step_whose_advantage_has_no_spread_are_refused():
    few = training(config=PPOConfig(steps=1, minibatches=3, critic_hidden=(8,)))
    with pytest.raises(ValueError, match="2 steps for each of 3 minibatches, got 4"):
        few.train(1)
    enough = training(config=PPOConfig(steps=1, minibatches=2, critic_hidden=(8,)))
    enough.train(1)
    assert all(weight.isfinite().all() for weight in enough.parameters.values())


def test_bad_seeds():
    env = PegTouchVectorEnv(num_envs=5)
    policy = ModularPolicy(PositiveNetwork(2, seeds=[0, 1]))
    with pytest.raises(ValueError, match="seeds: wanted at least one"):
        PPO(env, policy, [])
    with pytest.raises(ValueError, match="divides 5"):
        PPO(env, policy, [0, 1])
    with pytest.raises(ValueError, match="2 seeds"):
        PPO(env, policy, [0])
    with pytest.raises(ValueError, match="outputs"):
        PPO(env, DirectPolicy(JointNetwork(3, inputs=4), part=slice(0, 4)), [0])
