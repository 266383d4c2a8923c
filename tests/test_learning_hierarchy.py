"""Planners: exploration, rates, what critics see; and PPO without a low level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cmc.envs.peg_maze import PegMaze
from cmc.learning.hierarchy import HierarchyConfig, play
from cmc.learning.planning import SegmentEnv
from cmc.studies import peg_maze, peg_push
from cmc.studies.two_level import frozen, latent, two_level

MAZE, PUSH = peg_maze.STUDY.config, peg_push.STUDY.config


def test_schedules_fall_linearly_and_stay():
    config = HierarchyConfig(
        high_noise=0.4, high_noise_end=0.1, redraw=(0.2, 0.1), burst=(0.1, 0.0), noise_steps=1000
    )
    found = np.array([config.exploration(k) for k in range(0, 2001, 100)])
    np.testing.assert_allclose(np.diff(found[:11], axis=0) - [-0.03, -0.01, -0.01], 0, atol=1e-12)
    np.testing.assert_allclose(found[10:] - [0.1, 0.1, 0.0], 0, atol=1e-12)
    assert HierarchyConfig(high_noise=0.4).exploration(10**6) == (0.4, 0.0, 0.0)
    rates = [HierarchyConfig(rate_steps=(100, 300)).rate(k) for k in (0, 100, 200, 300, 400)]
    assert rates == pytest.approx([1, 1, 0.55, 0.1, 0.1])


def test_the_low_level_learns_from_the_start_and_the_planner_after_the_warm_up():
    config = HierarchyConfig(
        samples=10, high_updates=5, low_updates=4, low_updates_late=1, low_late=200, warm_up=100
    )
    found = [config.updates(steps) for steps in (100, 200, 300)]
    assert found == [(0, 40), (50, 80), (100, 90)]


def planner(config, worlds=400):
    """A training whose planner asks for the middle of its range, and what it sees."""
    config = replace(config, hierarchy=replace(config.hierarchy, worlds=worlds))
    trainer = two_level(frozen)(config, [0])
    for parameter in trainer.planner.actor.parameters():
        torch.nn.init.zeros_(parameter)
    return trainer, config.planning().observe(trainer.task, trainer.task.reset())[None]


@pytest.mark.parametrize("steps", [10_000, 500_000])
def test_sub_goals_scatter_by_the_noise_of_the_moment(steps):
    calm = replace(PUSH.hierarchy, redraw=(0.0, 0.0), burst=(0.0, 0.0))
    trainer, seen = planner(replace(PUSH, hierarchy=calm))
    trainer.steps = steps
    action = trainer._choose(seen)
    assert np.std(action) == pytest.approx(calm.exploration(steps)[0], rel=0.1)


def test_redraws_and_bursts_come_as_often_as_asked_and_bursts_last():
    calm = {"high_noise": 0.0, "high_noise_end": 0.0}
    rates = replace(PUSH.hierarchy, **calm, redraw=(0.1, 0.1), burst=(0.05, 0.05))
    trainer, seen = planner(replace(PUSH, hierarchy=rates))
    trainer.steps = 10_000
    drawn = np.array([trainer._choose(seen)[0] != 0 for _ in range(60)])
    whole = drawn.all(-1)  # (60, worlds): in a burst, or by six redraws of one in ten
    share = 3 * 0.05 / (1 + 2 * 0.05)  # three segments each; none begins within another
    assert whole[3:].mean() == pytest.approx(share, rel=0.15)
    assert drawn[~whole].mean() == pytest.approx(0.1, rel=0.1)
    begins = np.argwhere(whole[1:-2] & ~whole[:-3])
    for k, world in begins:
        assert whole[k + 1 : k + 4, world].all()


@pytest.mark.parametrize("config", [PUSH, MAZE], ids=["push", "maze"])
def test_critics_see_tip_and_sub_goal_from_the_goal(config):
    trainer, _ = planner(config, worlds=3)
    task, planning = trainer.task, config.planning()
    action = np.random.default_rng(0).uniform(-0.3, 0.3, (3, len(planning.low)))
    obs = task.reset()
    seen = torch.as_tensor(planning.observe(task, obs), dtype=torch.float32)
    view = trainer.planner._view(seen, torch.as_tensor(action, dtype=torch.float32)).numpy()
    features = view[:, seen.shape[1] + action.shape[1] :]
    tip, goal = (task.select(obs, (name,)) for name in ("position", "goal"))
    task.set_subgoal(planning.subgoal(action))  # well inside the workspace: not clamped
    np.testing.assert_allclose(5 * features[:, :3], 1e3 * (task.target - goal), atol=2e-2)
    np.testing.assert_allclose(features[:, 9:12], np.tanh(1e3 * (tip - goal)), atol=2e-2)
    length = np.linalg.norm(1e3 * (task.target - goal), axis=-1)
    np.testing.assert_allclose(5 * features[:, 15], np.hypot(length, 0.1), atol=2e-2)


def test_play_keeps_what_a_loop_by_hand_sees():
    config = replace(MAZE, task=replace(MAZE.task, ticks=40))
    trainer = two_level(latent)(config, [0, 1])
    planner, planning = trainer.planner.actor, config.planning()
    names = ("reward", "tip", "success", "distance", "target")
    task, other = config.make(4, 5), config.make(4, 5)
    kept = play(task, planning, planner, trainer.low, 2, names)
    obs, rows = other.reset(), []
    for tick in range(40):
        if tick % 20 == 0:
            seen = torch.as_tensor(planning.observe(other, obs).reshape(2, 2, -1)).float()
            aim = planner(seen).detach().double().numpy().reshape(4, -1)
            obs = other.set_subgoal(planning.subgoal(aim))
        y, integral = (other.select(obs, (k,)).reshape(2, 2, 6) for k in ("latent", "integral"))
        s = torch.as_tensor(np.stack([y, integral], -1)).float()
        u = trainer.low.actor.network(s).tanh().detach()
        obs, reward, _, _, info = other.step(u.double().numpy().reshape(4, 6))
        rows.append((reward, other.worlds.tip.copy(), info["success"], other.target.copy()))
    reward, tip, success, target = (np.array(part) for part in zip(*rows, strict=True))
    np.testing.assert_allclose(kept["reward"].reshape(40, 4), reward, rtol=1e-5)
    np.testing.assert_allclose(kept["tip"].reshape(40, 4, 3), tip, atol=1e-7)
    np.testing.assert_allclose(kept["target"].reshape(40, 4, 3), target, atol=1e-7)
    np.testing.assert_array_equal(kept["success"].reshape(40, 4), success)
    np.testing.assert_allclose(kept["distance"].reshape(40, 4), -reward, rtol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [{"high_noise": -0.1}, {"noise_steps": 0}, {"redraw": (1.1, 0.0)}, {"rate_steps": (5, 5)}],
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="noise|redraw|rate_steps"):
        HierarchyConfig(**wrong)


# ---- PPO as a planner without a low level


def env_of(worlds: int) -> SegmentEnv:
    task = PegMaze(replace(MAZE.task, ticks=60), num=worlds)
    return SegmentEnv(task, MAZE.planning(), reward_scale=100.0)


def test_a_step_is_a_segment_of_ticks_without_action() -> None:
    env, alone = env_of(2), PegMaze(replace(MAZE.task, ticks=60), num=2)
    alone.seed(9)
    first, _ = env.reset(seed=9)
    obs = alone.reset()
    np.testing.assert_allclose(first, MAZE.planning().observe(alone, obs), atol=1e-5)
    action = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 2, 3)).astype(np.float32)
    for k in range(3):
        seen, reward, ended, limit, _ = env.step(action[k])
        low, high = np.array(MAZE.task.subgoal_low), np.array(MAZE.task.subgoal_high)
        middle, half = (low + high) / 2, (high - low) / 2
        obs = alone.set_subgoal(middle + half * np.clip(action[k], -1, 1))
        total = np.zeros(2)
        for _ in range(20):
            obs, gain, *_ = alone.step(np.zeros((2, 6)))
            total += gain
        np.testing.assert_allclose(reward, 100.0 * total / 20, rtol=1e-9)
        np.testing.assert_allclose(seen, MAZE.planning().observe(alone, obs), atol=1e-5)
        assert not ended.any()
        assert limit.all() == (k == 2)


def test_every_seed_has_its_own_starts() -> None:
    env = env_of(4)
    both, _ = env.reset(seed=[3, 8])
    again, _ = env.reset(seed=[8, 3])
    np.testing.assert_array_equal(both[:2], again[2:])
    assert not np.allclose(both[:2], both[2:])
    with pytest.raises(ValueError, match=r"divides 4, got \[1, 2, 3\]"):
        env.reset(seed=[1, 2, 3])
