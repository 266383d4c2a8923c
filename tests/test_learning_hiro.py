"""HIRO: the sub-goal transition, the candidates, their likelihood, and what is relabelled."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cmc.envs.peg_maze import GOAL_HIGH, GOAL_LOW, JOINT, PegMaze
from cmc.learning.hiro import (
    CANDIDATES,
    JointLow,
    JointUnits,
    OffPolicyCorrection,
    PullActor,
    candidates,
    log_likelihood,
)
from cmc.learning.low_level import Segment, rollout
from cmc.learning.td3 import TD3, Batch, TD3Config
from cmc.studies import peg_maze

N, T = 2, 5
FREE = (torch.full((N,), -9.0), torch.full((N,), 9.0))


class Proportional(nn.Module):
    """u = gain * g: a low level whose actions tell the sub-goal."""

    def __init__(self, gain: float = 0.5) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(gain))

    def forward(self, seen: Tensor) -> Tensor:
        return self.gain * seen[..., -N:]


def segment_of(goal: Tensor, gain: float = 0.5, start: Tensor | None = None):
    """Joints that move by 0.3 u: states (..., T + 1, n) and actions (..., T, n)."""
    state = torch.zeros_like(goal) if start is None else start
    left, states, actions = goal, [state], []
    for _ in range(T):
        actions.append(gain * left)
        following = state + 0.3 * actions[-1]
        left = state + left - following
        state = following
        states.append(state)
    return torch.stack(states, -2), torch.stack(actions, -2)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_candidates_are_the_original_the_motion_and_draws_around_it() -> None:
    goal, moved = drawn(3, 4000, N).clamp(-2, 2), 0.05 * drawn(3, 4000, N, seed=1)
    found = candidates(goal, moved, drawn(3, 4000, 8, N, seed=2))
    assert found.shape == (3, 4000, CANDIDATES, N)
    torch.testing.assert_close(found[:, :, 0], goal)
    torch.testing.assert_close(found[:, :, 1], moved)
    around = found[:, :, 2:] - moved[:, :, None]
    assert abs(float(around.mean())) < 0.01
    # a normal of deviation 0.5, clipped at two deviations
    assert float(around.std()) == pytest.approx(0.48, abs=0.01)
    assert float(found[:, :, 1:].abs().max()) <= 1.0


def test_the_likeliest_sub_goal_is_the_one_that_was_pursued() -> None:
    goals = drawn(2, 50, 6, N)
    states, actions = segment_of(goals[:, :, 3], start=drawn(2, 50, N, seed=1))
    speeds = torch.zeros_like(actions)
    score = log_likelihood(Proportional(), states[..., :-1, :], speeds, actions, goals, FREE)
    assert score.shape == (2, 50, 6)
    assert (score.argmax(-1) == 3).all()
    torch.testing.assert_close(score[..., 3], torch.zeros(2, 50), atol=1e-10, rtol=0)


def test_likelihood_is_that_of_independent_gaussians() -> None:
    goals, states, actions = drawn(1, 4, 3, N), drawn(1, 4, T, N, seed=1), drawn(1, 4, T, N, seed=2)
    score = log_likelihood(Proportional(), states, torch.zeros_like(states), actions, goals, FREE)
    for b in range(4):
        for k in range(3):
            target = states[0, b, 0] + goals[0, b, k]
            mean = 0.5 * (target - states[0, b])
            gaussian = torch.distributions.Normal(mean, 1.0)
            best = torch.distributions.Normal(actions[0, b], 1.0).log_prob(actions[0, b])
            expected = (gaussian.log_prob(actions[0, b]) - best).sum()
            torch.testing.assert_close(score[0, b, k], expected.detach())


def joint_low(seeds: list[int], noise: float = 1.0) -> tuple[PegMaze, JointLow]:
    task = PegMaze(replace(JOINT, horizon=T, ticks=4 * T), num=2 * len(seeds), seed=0)
    start, reach = task._q_start, 0.1
    units = JointUnits(start, np.full(7, 0.1), start - reach, start + reach)
    config = TD3Config(critic_hidden=(16,), batch=16, discount=1.0)
    agent = TD3(PullActor(7, (16,), seeds), seeds, 21, 7, config, stream=2)
    return task, JointLow(agent, seeds, units, noise)


def run_segment(task: PegMaze, low: JointLow, seeds: int, scale: float = 0.05) -> Segment:
    task.reset()
    goal = np.random.default_rng(5).uniform(-scale, scale, (task.num, 7))
    obs = task.set_subgoal(goal)
    return rollout(task, low, obs, (seeds, task.num // seeds), explore=True)[0]


def test_what_is_stored_says_how_the_task_went_on() -> None:
    """The task's own error is s + g - s', clamped targets included, and actions have its sign."""
    task, low = joint_low([3, 4])
    correction = OffPolicyCorrection(low, [3, 4], T)
    segment = run_segment(task, low, 2, scale=0.2)  # beyond the range: clamped
    seen = low.units.normalise(segment.observation)
    q, error = seen[..., :7], seen[..., 14:]
    np.testing.assert_allclose(error, q[:1] + error[:1] - q, atol=1e-9)
    assert (segment.action * error[:-1] >= 0).all()
    packed = torch.from_numpy(correction.pack(segment))
    assert packed.shape == (2, 2, correction.size)
    rows = packed[..., :-7].unflatten(-1, (T, 21))
    np.testing.assert_array_equal(rows[1, 0, :, 14:], segment.action[:, 1, 0])
    np.testing.assert_array_equal(packed[0, 1, -7:], q[-1, 0, 1])
    # The goal that was asked for explains the actions as well as the clamped one it became.
    goals = torch.stack([torch.from_numpy(error[0]), torch.from_numpy(error[0]).clamp(-1, 1)], 2)
    states, speeds, actions = (part.float() for part in rows.chunk(3, dim=-1))
    score = log_likelihood(
        low.agent.actor, states, speeds, actions, goals.float(), correction._reach
    )
    torch.testing.assert_close(score[..., 0], score[..., 1], atol=1e-4, rtol=1e-4)


def batch_of(correction: OffPolicyCorrection, segment: Segment, action: Tensor) -> Batch:
    extra = torch.from_numpy(correction.pack(segment)).float()
    nothing = torch.zeros(*extra.shape[:2])
    return Batch(nothing[..., None], action, nothing, nothing[..., None], nothing, extra)


def test_relabelling_keeps_a_sub_goal_that_still_explains_the_actions() -> None:
    seeds = [0, 1]
    task, low = joint_low(seeds, noise=0.0)
    correction = OffPolicyCorrection(low, seeds, T)
    segment = run_segment(task, low, 2)
    truth = torch.from_numpy(low.units.normalise(segment.observation)[0, ..., 14:]).float()
    kept = correction.relabel(batch_of(correction, segment, truth)).action
    torch.testing.assert_close(kept, truth)
    with torch.no_grad():  # a low level that has changed: the same sub-goal explains less
        for weight in low.agent.actor.net.weights:
            weight.mul_(-3.0)
    wrong = batch_of(correction, segment, -truth)
    changed = correction.relabel(wrong)
    assert not torch.equal(changed.action, wrong.action)
    assert float(changed.action.abs().max()) <= 1.0
    assert changed.reward is wrong.reward


def test_relabelling_never_makes_the_actions_less_likely_and_resumes() -> None:
    seeds = [0, 1]
    task, low = joint_low(seeds)
    correction = OffPolicyCorrection(low, seeds, T)
    segment = run_segment(task, low, 2)
    drawn = torch.rand(2, 2, 7, generator=torch.Generator().manual_seed(3))
    batch = batch_of(correction, segment, drawn * 2 - 1)
    saved = correction.state()
    found = correction.relabel(batch)
    rows = batch.extra[..., :-7].unflatten(-1, (T, 21))
    parts = rows.chunk(3, dim=-1)
    both = torch.stack([batch.action, found.action], dim=2)
    score = log_likelihood(low.agent.actor, *parts, both, correction._reach)
    kept = (found.action == batch.action).all(-1)  # equal scores may differ by rounding
    assert ((score[..., 1] > score[..., 0]) | kept).all()
    correction.restore(*saved)
    torch.testing.assert_close(correction.relabel(batch).action, found.action)
    with pytest.raises(ValueError, match="stride: wanted 1 to 5"):
        OffPolicyCorrection(low, seeds, T, stride=6)


def test_the_first_random_sub_goals_lie_around_the_maze() -> None:
    """Their middle moves the joints to a pose with the tip among the goals."""
    config = peg_maze.STUDY.config_of("hiro")
    planning, task = config.planning(), PegMaze(config.task, num=3, seed=0)
    obs = task.reset()
    task.set_subgoal(planning.subgoal(planning.direction(task, obs)))
    np.testing.assert_allclose(task.target_joints, np.tile(planning.aim, (3, 1)), atol=1e-9)
    data = mujoco.MjData(task.worlds.model)
    data.qpos[:] = planning.aim
    mujoco.mj_kinematics(task.worlds.model, data)
    tip = data.site("tip").xpos
    assert (tip >= GOAL_LOW).all()
    assert (tip <= GOAL_HIGH).all()
    assert not peg_maze.STUDY.config.planning().direction(task, obs).any()
