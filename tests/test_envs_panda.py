"""What holds for every Panda environment: interface, seeds, snapshots, limits, bad input."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cmc.envs.panda_task import CRITIC
from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze, PegMazeEnv, PegMazeVectorEnv
from cmc.envs.peg_push import PUSH, PegPush
from cmc.robot import panda

TASKS = {  # class, configuration, Gymnasium's name and keywords
    "stiff": (PegMaze, STIFF, "cmc/PegMaze-v0", {}),
    "soft": (PegMaze, SOFT, "cmc/PegMaze-v0", {"regime": "soft"}),
    "joint": (PegMaze, JOINT, "cmc/PegMazeJoint-v0", {}),
    "push": (PegPush, PUSH, "cmc/PegPush-v0", {}),
}
each_task = pytest.mark.parametrize("name", TASKS)


def build(name, num=1, seed=0):
    task, config, *_ = TASKS[name]
    return task(config, num, seed)


def make(name, **more):
    return gym.make(TASKS[name][2], **TASKS[name][3], **more).unwrapped


def drive(task, ticks, seed=0, start=0):
    """Random sub-goals and actions from their own stream; what came back."""
    c, rng = task.config, np.random.default_rng(seed)
    seen = []
    for k in range(start, start + ticks):
        if k % c.horizon == 0:
            task.set_subgoal(rng.uniform(c.subgoal_low, c.subgoal_high, (task.num, c.high_size)))
        seen.append(task.step(rng.uniform(-1, 1, (task.num, c.low_size))))
    return seen


@pytest.mark.parametrize("mode", ["two_level", "low", "high"])
@pytest.mark.parametrize("name", ["stiff", "joint", "push"])
def test_the_checkers_pass(name, mode):
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    env = make(name, action_mode=mode)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|infinity).*")
        check_env(env, skip_render_check=True)  # drawing needs graphics: a test of its own
        check_env_sb3(env)


@each_task
def test_one_world_and_many_worlds_are_the_same_environment(name):
    """World k of a batch seeded with s sees what the single environment seeded s + k sees."""
    many = gym.make_vec(TASKS[name][2], 3, "vector_entry_point", **TASKS[name][3])
    many.action_space.seed(0)
    singles = [make(name) for _ in range(3)]
    found, _ = many.reset(seed=5)
    single = [env.reset(seed=5 + k)[0] for k, env in enumerate(singles)]
    np.testing.assert_allclose(found, single, atol=1e-6)
    for _ in range(45):
        action = many.action_space.sample()
        found, reward, _, _, info = many.step(action)
        results = [env.step(action[k]) for k, env in enumerate(singles)]
        np.testing.assert_allclose(found, [r[0] for r in results], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(reward, [r[1] for r in results], rtol=1e-5, atol=1e-6)
        for key in ("contact_force", "contact_force_max"):
            wanted = [r[4][key] for r in results]
            np.testing.assert_allclose(info[key], wanted, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("num", [1, 2])
@each_task
def test_a_snapshot_continues_exactly(name, num):
    task, other = build(name, num), build(name, num, seed=99)
    drive(task, 25)
    kept = task.snapshot()
    first = drive(task, 15, seed=1, start=25)
    drive(task, 10, seed=2, start=40)
    task.restore(kept)
    again = drive(task, 15, seed=1, start=25)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one[0], two[0])
        np.testing.assert_array_equal(one[1], two[1])
        np.testing.assert_array_equal(one[4]["contact_force_max"], two[4]["contact_force_max"])
    other.restore(kept)
    np.testing.assert_array_equal(task.reset(), other.reset())  # the same next episode
    with pytest.raises(ValueError, match="other worlds"):
        build(name, num + 1).restore(kept)


@each_task
def test_seeds_decide_and_time_is_truncation(name):
    env = make(name, action_mode="high")
    first, second, other = (env.reset(seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 1e-5
    steps = env.task.config.ticks // env.task.config.horizon
    ends = [env.step(np.zeros(env.action_space.shape))[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(False, True)]


def test_a_picture_or_a_sentence_that_names_the_page():
    env = gym.make("cmc/PegMaze-v0", render_mode="rgb_array")
    env.reset(seed=0)
    try:
        picture = env.render()
    except RuntimeError:  # no graphics here
        with pytest.raises(RuntimeError, match="cmc.view.playback.record"):
            env.render()
    else:
        assert picture.shape == (480, 640, 3)
        assert np.ptp(picture) > 50
    env.close()
    with pytest.raises(ValueError, match="render_mode: wanted None or 'rgb_array', got 'human'"):
        PegMazeEnv(render_mode="human")
    with pytest.raises(TypeError, match="record makes a 3D page"):
        PegMazeVectorEnv(2, render_mode="rgb_array")


@pytest.mark.parametrize("name", ["stiff", "soft", "push"])
def test_latent_signal_and_integral_are_what_they_are_called(name):
    """y = K1 e + K2 e' from the observed error and velocity, and I_k = I_{k-1} + h y_k."""
    task, rng = build(name, 4), np.random.default_rng(0)
    c, latent = task.config, task.config.gains.latent
    for k in range(45):
        if k % 20 == 0:
            obs = task.set_subgoal(rng.uniform(c.subgoal_low, c.subgoal_high, (4, c.high_size)))
            integral = np.zeros((4, 6))
        field = {n: obs[:, part] for n, part in task.layout.items()}
        y = latent.K1 * field["error"] - latent.K2 * task.worlds.signals[:, 6:]
        np.testing.assert_allclose(field["latent"], y, atol=1e-12)
        integral = integral + 0.02 * y * [1, 1, 1, 0, 0, 0]
        np.testing.assert_allclose(field["integral"], integral, atol=1e-12)
        assert field["time_to_go"] == pytest.approx(0.4 - 0.02 * (k % 20))
        obs = task.step(rng.uniform(-1, 1, (4, 6)))[0]
    assert task.select(obs, CRITIC).shape == (4, 25)
    assert task.select(obs, task.high_level).shape == (4, 15 if name != "push" else 21)


@each_task
def test_two_level_actions_latch_the_sub_goal(name):
    """The flat action equals set_subgoal plus step, and sub-goals between are ignored."""
    env, task, rng = make(name), build(name, 1, seed=99), np.random.default_rng(0)
    env.reset(seed=3)
    task.seed(3)
    task.reset()
    c = task.config
    for k in range(42):
        u = rng.uniform(-1, 1, c.low_size)
        subgoal = rng.uniform(c.subgoal_low, c.subgoal_high)
        if k % c.horizon == 0:
            task.set_subgoal(subgoal[None])
        obs = env.step(np.concatenate([u, subgoal]))[0]
        np.testing.assert_allclose(obs, task.step(u[None])[0][0].astype(np.float32), atol=1e-7)


@each_task
def test_reward_is_the_sum_of_its_terms(name):
    task = build(name, 2)
    for obs, reward, terminated, _, info in drive(task, 5):
        np.testing.assert_allclose(reward, sum(info["reward_terms"].values()))
        assert not terminated.any()
        assert all((term <= 0).all() for term in info["tracking_terms"].values())
        goal, tip = (obs[:, task.layout[n]] for n in ("goal", "position"))
        distance = np.linalg.norm(goal - tip, axis=-1)
        expected = -np.tanh(50 * distance) if name == "push" else -distance
        np.testing.assert_allclose(next(iter(info["reward_terms"].values())), expected)


@each_task
def test_sub_goals_are_clamped(name):
    task = build(name, 2)
    c = task.config
    for sign in (1, -1):
        task.set_subgoal(sign * 1e6 * np.ones((2, c.high_size)))
        if name == "joint":
            assert (task.target_joints <= panda.UPPER).all()
            assert (task.target_joints >= panda.LOWER).all()
            assert np.abs(task.target_joints - task.worlds.qpos).max() <= 0.1 + 1e-9
        else:
            assert (task.target <= np.array(c.workspace_high) + 1e-12).all()
            assert (task.target >= np.array(c.workspace_low) - 1e-12).all()
            tilt = 2 * np.arccos(np.minimum(np.abs(task.worlds.quat @ panda.DOWN), 1.0))
            assert tilt.max() <= 0.5 + 1e-12


def test_tilted_sub_goals_cannot_random_walk():
    """Increments add to the current tilt, and stop at 0.5 rad."""
    task = build("push")
    for k in range(120):
        if k % 20 == 0:
            task.set_subgoal(np.array([[0, 0, 0.005, 0.5, 0, 0]]))
        task.step(np.zeros((1, 6)))
    assert 0.3 < np.linalg.norm(task.worlds.rotation) < 0.51


@each_task
def test_random_driving_stays_sane(name):
    """5000 ticks a task (`benchmarks` has 10^5): finite, inside the limits, near the workspace."""
    task = build(name, 25)
    c, start = task.config, task._q_start
    for block in range(10):
        for obs, *_ in drive(task, 20, seed=block):
            assert np.isfinite(obs).all()
        q = task.worlds.qpos[:, :7]
        assert (q > panda.LOWER).all()
        assert (q < panda.UPPER).all()
        assert np.abs(task.worlds.qvel).max() < 5.0
        if name == "joint":
            assert np.abs(q - start).max() < 0.8
        else:
            assert (task.worlds.tip > np.array(c.workspace_low) - 0.03).all()
            assert (task.worlds.tip < np.array(c.workspace_high) + 0.03).all()
        if block % 5 == 4:
            task.reset()


def test_a_low_level_policy_acts_inside_high_level_steps():
    seen, left = [], []

    def policy(y, integral):
        seen.append((y.copy(), integral.copy()))
        return np.clip(5.0 * (y + integral), -1, 1)

    subgoal = np.array(STIFF.start) + [0, -0.004, 0]
    for low_level in (policy, None):
        env = make("stiff", action_mode="high", low_level=low_level)
        env.reset(seed=0)
        _, reward, *_, info = env.step(subgoal)
        left.append(np.linalg.norm(env.task.worlds.tip[0] - subgoal))
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert len(seen) == 20
    assert left[0] < 0.25 * left[1]
