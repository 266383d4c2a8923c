"""TD3 and its memory: independent seeds, exact resume, the options of the paper's tables."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cmc.learning.td3 import TD3, Replay, TD3Config
from cmc.policies import StackedMLP

SIZE, ACTION = 3, 2


class TanhActor(nn.Module):
    def __init__(self, seeds: list[int]) -> None:
        super().__init__()
        self.net = StackedMLP(SIZE, ACTION, (16,), seeds=seeds)

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(self.net(x))


def learner(seeds: list[int], **options) -> tuple[TD3, Replay]:
    config = TD3Config(critic_hidden=(16,), batch=32, target_period=3, **options)
    replay = Replay(seeds, SIZE, ACTION, capacity=200)
    for seed_count in (90, 70, 80):  # wraps around
        rows = [transitions(seed, seed_count) for seed in seeds]
        replay.add(*(np.stack(part) for part in zip(*rows, strict=True)))
    return TD3(TanhActor(seeds), seeds, SIZE, ACTION, config), replay


def transitions(seed: int, count: int):
    rng = np.random.default_rng([seed, count])
    observation, following = rng.normal(size=(2, count, SIZE))
    action = rng.uniform(-1, 1, (count, ACTION))
    reward = -np.square(action - 0.5 * np.tanh(observation[:, :ACTION])).sum(-1)
    return observation, action, reward, following, rng.random(count) < 0.9


def run(agent: TD3, replay: Replay, updates: int) -> None:
    for _ in range(updates):
        agent.update(replay.sample(agent.config.batch))


def test_a_seed_learns_the_same_alone_and_in_company() -> None:
    together, shared = learner([3, 8, 5], gradient_clip=0.1, action_gradient_clip=0.1)
    alone, own = learner([8], gradient_clip=0.1, action_gradient_clip=0.1)
    run(together, shared, 12)
    run(alone, own, 12)
    state_together, state_alone = together.state()[0], alone.state()[0]
    for name in ("actor.net.weights.0", "critics.weights.1", "target_critics.weights.0"):
        many, one = state_together[name], state_alone[name]
        np.testing.assert_allclose(many[len(one) : 2 * len(one)], one, atol=2e-6)
    assert not np.allclose(state_together["actor.net.weights.0"][0], one[0, 0, 0])


def test_an_averaged_actor_is_the_mean_of_all_that_were_and_changes_no_training() -> None:
    agent, replay = learner([1, 2], average=0.1)
    plain, memory = learner([1, 2])
    first = [p.detach().numpy().copy() for p in agent.actor.parameters()]
    past = []
    for _ in range(20):
        run(agent, replay, agent.config.actor_period)
        past.append([p.detach().numpy().copy() for p in agent.actor.parameters()])
    run(plain, memory, agent.updates)
    age = np.arange(20)[::-1]
    share = 0.1 * 0.9**age  # of an actor so many updates old; the first keeps the rest
    for k, mean in enumerate(agent.acting.parameters()):
        wanted = 0.9**20 * first[k] + sum(s * p[k] for s, p in zip(share, past, strict=True))
        np.testing.assert_allclose(mean.detach(), wanted, atol=1e-6)
        assert np.abs(mean.detach().numpy() - past[-1][k]).max() > 1e-4
    for one, other in zip(agent.actor.parameters(), plain.actor.parameters(), strict=True):
        np.testing.assert_array_equal(one.detach(), other.detach())
    assert plain.acting is plain.actor


@pytest.mark.parametrize("average", [0.0, 0.1])
def test_resume_continues_exactly(average: float) -> None:
    agent, replay = learner([1, 2], average=average)
    run(agent, replay, 7)
    saved = agent.state(), replay.state()
    run(agent, replay, 8)
    again = TD3(TanhActor([9, 9]), [1, 2], SIZE, ACTION, agent.config)
    memory = Replay([1, 2], SIZE, ACTION, capacity=200)
    again.restore(*saved[0])
    memory.restore(*saved[1])
    run(again, memory, 8)
    for name, value in agent.state()[0].items():
        np.testing.assert_array_equal(again.state()[0][name], value, err_msg=name)
    assert again.state()[1] == agent.state()[1]


def test_it_solves_a_problem_with_a_known_best_action() -> None:
    config = TD3Config(
        actor_rate=1e-3, critic_rate=3e-3, discount=0.0, critic_hidden=(64, 64), batch=64
    )
    agent = TD3(TanhActor([0, 1]), [0, 1], SIZE, ACTION, config)
    replay = Replay([0, 1], SIZE, ACTION, capacity=4000)
    replay.add(*(np.stack([part, part]) for part in transitions(0, 4000)))
    run(agent, replay, 1200)
    x = torch.randn(2, 500, SIZE, generator=torch.Generator().manual_seed(0))
    best = 0.5 * torch.tanh(x[..., :ACTION])
    with torch.no_grad():
        error = (agent.actor(x) - best).square().mean().sqrt()
    assert float(error) < 0.12
    assert float(best.square().mean().sqrt()) > 0.25  # doing nothing is no answer


def test_the_actor_climbs_the_first_critic_of_its_own_seed() -> None:
    agent, replay = learner([4, 9])
    batch = replay.sample(32)
    found = agent._action_gradient(batch.observation, batch.action)
    shifts = 1e-2 * torch.eye(ACTION)
    for k in range(ACTION):
        ends = [
            agent.values(agent.critics, batch.observation, batch.action + sign * shifts[k])[:, 0]
            for sign in (1.0, -1.0)
        ]
        expected = (ends[0] - ends[1]).detach() / 2e-2
        torch.testing.assert_close(found[..., k], expected, atol=2e-3, rtol=0.0)
    assert float(found.abs().mean()) > 0.05
    assert all(p.grad is None for p in agent.critics.parameters())


def test_clips_bound_the_actor_step_and_each_seed_by_itself() -> None:
    gradients = []
    for clip in (None, 1e-3):
        agent, replay = learner([4], action_gradient_clip=clip)
        agent._update_actor(replay.sample(32))
        gradients.append(max(float(p.grad.abs().max()) for p in agent.actor.parameters()))
    assert gradients[1] <= 1e-3 * 5  # |x|, |tanh'| and the mean over the batch
    assert gradients[0] > 3 * gradients[1]
    agent, replay = learner([4, 6], gradient_clip=0.01)
    agent._update_critics(replay.sample(32))
    for parameter in agent.critics.parameters():
        assert (parameter.grad.view(2, -1).norm(dim=1) <= 0.01 * (1 + 1e-5)).all()


def test_the_actor_waits_for_the_critics_head_start() -> None:
    agent, replay = learner([0], critic_head_start=10)
    before = agent.actor.net.weights[0].detach().clone()
    run(agent, replay, 10)
    assert torch.equal(agent.actor.net.weights[0], before)
    run(agent, replay, 2)
    assert not torch.equal(agent.actor.net.weights[0], before)


def test_memory_keeps_the_newest_and_names_bad_input() -> None:
    replay = Replay([0], 1, 1, capacity=5)
    with pytest.raises(ValueError, match="empty"):
        replay.sample(2)

    def rows(count, value=0.0, size=1):
        shape = (1, count)
        wide = np.full((*shape, size), value)
        return wide, np.zeros((*shape, 1)), np.zeros(shape), wide, np.ones(shape)

    for value in range(8):
        replay.add(*rows(1, value))
    assert sorted(replay.rows[0, :, 0]) == [3, 4, 5, 6, 7]
    with pytest.raises(ValueError, match="wanted rows of"):
        replay.add(*rows(2, size=3))
    with pytest.raises(ValueError, match="positive sizes"):
        Replay([], 1, 1, 5)
    with pytest.raises(ValueError, match="discount"):
        TD3Config(discount=1.5)
