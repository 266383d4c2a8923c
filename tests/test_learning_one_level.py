"""Planning without a low level: what one step of `SegmentEnv` is, and PPO on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmc.envs.peg_maze import PegMaze
from cmc.learning.one_level import SegmentEnv
from cmc.studies import peg_maze

CONFIG = peg_maze.STUDY.config


def env_of(worlds: int) -> SegmentEnv:
    task = PegMaze(replace(CONFIG.task, ticks=60), num=worlds)
    return SegmentEnv(task, CONFIG.planning(), reward_scale=100.0)


def test_a_step_is_a_segment_of_ticks_without_action() -> None:
    env, alone = env_of(2), PegMaze(replace(CONFIG.task, ticks=60), num=2)
    alone.seed(9)
    first, _ = env.reset(seed=9)
    obs = alone.reset()
    np.testing.assert_allclose(first, CONFIG.planning().observe(alone, obs), atol=1e-5)
    action = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 2, 3)).astype(np.float32)
    for k in range(3):
        seen, reward, ended, limit, _ = env.step(action[k])
        low, high = np.array(CONFIG.task.subgoal_low), np.array(CONFIG.task.subgoal_high)
        middle, half = (low + high) / 2, (high - low) / 2
        obs = alone.set_subgoal(middle + half * np.clip(action[k], -1, 1))
        total = np.zeros(2)
        for _ in range(20):
            obs, gain, *_ = alone.step(np.zeros((2, 6)))
            total += gain
        np.testing.assert_allclose(reward, 100.0 * total / 20, rtol=1e-9)
        np.testing.assert_allclose(seen, CONFIG.planning().observe(alone, obs), atol=1e-5)
        assert not ended.any()
        assert limit.all() == (k == 2)


def test_every_seed_has_its_own_starts() -> None:
    env = env_of(4)
    both, _ = env.reset(seed=[3, 8])
    again, _ = env.reset(seed=[8, 3])
    np.testing.assert_array_equal(both[:2], again[2:])
    assert not np.allclose(both[:2], both[2:])
    with pytest.raises(ValueError, match="divide 4 worlds"):
        env.reset(seed=[1, 2, 3])
