"""What holds for every Panda environment: interface, seeds, snapshots, limits, bad input."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import cmc.envs.peg_maze
from cmc.envs.panda_task import ACTOR, CRITIC
from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze
from cmc.envs.peg_push import PUSH, PegPush
from cmc.robot import panda

TASKS = {
    "stiff": (PegMaze, STIFF),
    "soft": (PegMaze, SOFT),
    "joint": (PegMaze, JOINT),
    "push": (PegPush, PUSH),
}
NAMES = ["cmc/PegMaze-v0", "cmc/PegMazeJoint-v0", "cmc/PegPush-v0"]
KWARGS = {
    "stiff": ("cmc/PegMaze-v0", {}),
    "soft": ("cmc/PegMaze-v0", {"regime": "soft"}),
    "joint": ("cmc/PegMazeJoint-v0", {}),
    "push": ("cmc/PegPush-v0", {}),
}
each_task = pytest.mark.parametrize("name", TASKS)


def build(name, num=1, seed=0):
    task, config = TASKS[name]
    return task(config, num, seed)


def drive(task, ticks, seed=0, start=0):
    """Random sub-goals and actions from their own stream; returns stacked observations."""
    c, rng = task.config, np.random.default_rng(seed)
    seen = []
    for k in range(start, start + ticks):
        if k % c.horizon == 0:
            task.set_subgoal(rng.uniform(c.subgoal_low, c.subgoal_high, (task.num, c.high_size)))
        seen.append(task.step(rng.uniform(-1, 1, (task.num, c.low_size))))
    return seen


@pytest.mark.parametrize("mode", ["two_level", "low", "high"])
@pytest.mark.parametrize("name", NAMES)
def test_the_checkers_pass(name, mode):
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    env = gym.make(name, action_mode=mode).unwrapped
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|infinity).*")
        check_env(env, skip_render_check=True)  # drawing needs graphics: a test of its own
        check_env_sb3(env)


@each_task
def test_one_world_and_many_worlds_are_the_same_environment(name):
    """World k of a batch seeded with s sees what the single environment seeded s + k sees."""
    gym_id, kwargs = KWARGS[name]
    many = gym.make_vec(gym_id, num_envs=3, vectorization_mode="vector_entry_point", **kwargs)
    many.action_space.seed(0)
    singles = [gym.make(gym_id, **kwargs).unwrapped for _ in range(3)]
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
            np.testing.assert_allclose(
                info[key], [r[4][key] for r in results], rtol=1e-3, atol=1e-3
            )


@pytest.mark.parametrize("num", [1, 2])
@each_task
def test_a_snapshot_continues_exactly(name, num):
    task = build(name, num)
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
    assert task.reset().tolist() == build_after(name, num, kept).tolist()
    with pytest.raises(ValueError, match="other worlds"):
        build(name, num + 1).restore(kept)


def build_after(name, num, kept):
    """A fresh task with the snapshot's random streams draws the same next episode."""
    task = build(name, num, seed=99)
    task.restore(kept)
    return task.reset()


@each_task
def test_seeds_decide_and_time_is_truncation(name):
    gym_id, kwargs = KWARGS[name]
    env = gym.make(gym_id, action_mode="high", **kwargs)
    first, second, other = (env.reset(seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 1e-5
    horizon = env.unwrapped.task.config.horizon
    steps = env.unwrapped.task.config.ticks // horizon
    subgoal = np.zeros(env.action_space.shape)
    ends = [env.step(subgoal)[2:4] for _ in range(steps)]
    assert not any(terminated for terminated, _ in ends)
    assert [truncated for _, truncated in ends] == [False] * (steps - 1) + [True]


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
        cmc.envs.peg_maze.PegMazeEnv(render_mode="human")
    with pytest.raises(ValueError, match="record makes a 3D page"):
        cmc.envs.peg_maze.PegMazeVectorEnv(2, render_mode="rgb_array")


def test_autoreset_and_masked_reset():
    short = {"ticks": 3}
    env = cmc.envs.peg_maze.PegMazeVectorEnv(2, changes=short)
    env.reset(seed=0)
    action = env.action_space.sample()
    for _ in range(3):
        obs, _, _, truncated, info = env.step(action)
    assert truncated.all()
    assert set(info["final_obs"][0]) != set(obs[0])
    position = env.task.layout["position"]
    np.testing.assert_allclose(obs[:, position], [STIFF.start] * 2, atol=2e-3)
    still = cmc.envs.peg_maze.PegMazeVectorEnv(
        2, changes=short, autoreset_mode=AutoresetMode.DISABLED
    )
    before, _ = still.reset(seed=0)
    still.step(action)
    after, _ = still.reset(options={"reset_mask": np.array([True, False])})
    goal = still.task.layout["goal"]
    assert np.abs(after[0, goal] - before[0, goal]).max() > 1e-6
    np.testing.assert_array_equal(after[1, goal], before[1, goal])
    with pytest.raises(ValueError, match="autoreset_mode"):
        cmc.envs.peg_maze.PegMazeVectorEnv(2, autoreset_mode="now and then")


@pytest.mark.parametrize("name", ["stiff", "soft", "push"])
def test_latent_signal_and_integral_are_what_they_are_called(name):
    """y = K1 e + K2 e' from the observed error and velocity, and I_k = I_{k-1} + h y_k."""
    task = build(name, 4)
    c, latent = task.config, task.config.gains.latent
    rng = np.random.default_rng(0)
    previous = None
    for k in range(45):
        if k % 20 == 0:
            high = rng.uniform(c.subgoal_low, c.subgoal_high, (4, c.high_size))
            obs = task.set_subgoal(high)
            previous = np.zeros((4, 6))
        field = {n: obs[:, part] for n, part in task.layout.items()}
        y = latent.K1 * field["error"] - latent.K2 * task.worlds.signals[:, 6:]
        np.testing.assert_allclose(field["latent"], y, atol=1e-12)
        previous = previous + 0.02 * y * [1, 1, 1, 0, 0, 0]
        np.testing.assert_allclose(field["integral"], previous, atol=1e-12)
        assert field["time_to_go"] == pytest.approx(0.4 - 0.02 * (k % 20))
        obs = task.step(rng.uniform(-1, 1, (4, 6)))[0]
    assert task.select(obs, ACTOR).shape == (4, 12)
    assert task.select(obs, CRITIC).shape == (4, 25)
    assert task.select(obs, task.high_level).shape == (4, 15 if name != "push" else 21)


@each_task
def test_two_level_actions_latch_the_sub_goal(name):
    """The flat action equals set_subgoal plus step, and sub-goals between are ignored."""
    gym_id, kwargs = KWARGS[name]
    env = gym.make(gym_id, **kwargs).unwrapped
    env.reset(seed=3)
    task = build(name, 1, seed=3)
    task.reset()
    task.seed(3)
    task.reset()
    rng = np.random.default_rng(0)
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
    seen = drive(task, 5)
    for _, reward, terminated, _, info in seen:
        np.testing.assert_allclose(reward, sum(info["reward_terms"].values()))
        assert not terminated.any()
        assert all((term <= 0).all() for term in info["tracking_terms"].values())
    obs, info = seen[-1][0], seen[-1][4]
    goal, tip = (obs[:, task.layout[n]] for n in ("goal", "position"))
    distance = np.linalg.norm(goal - tip, axis=-1)
    expected = -np.tanh(50 * distance) if name == "push" else -distance
    found = next(iter(info["reward_terms"].values()))
    np.testing.assert_allclose(found, expected)


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
            assert np.linalg.norm(task.target_rotation, axis=-1).max() <= 0.5 + 1e-12


def test_tilted_sub_goals_cannot_random_walk():
    """Increments add to the current tilt, and stop at 0.5 rad."""
    task = build("push")
    for _ in range(6):
        task.set_subgoal(np.array([[0, 0, 0.005, 0.5, 0, 0]]))
        for _ in range(20):
            task.step(np.zeros((1, 6)))
    tilt = np.linalg.norm(task.worlds.rotation())
    assert 0.3 < tilt < 0.51


@each_task
def test_actions_beyond_the_bounds_are_clipped(name):
    far, edge = build(name, seed=0), build(name, seed=0)
    size = far.config.low_size
    np.testing.assert_array_equal(
        far.step(np.full((1, size), 1e9))[0],
        edge.step(np.ones((1, size)))[0],
    )


@each_task
def test_bad_actions_are_refused_and_leave_the_world_alone(name):
    task = build(name, 2)
    low, high = task.config.low_size, task.config.high_size
    before = task.snapshot()["physics"]
    for bad in (np.zeros(low), np.zeros((2, low + 1)), np.full((2, low), np.nan)):
        with pytest.raises(ValueError, match="low-level action: wanted"):
            task.step(bad)
    for bad in (np.zeros((1, high)), np.full((2, high), np.inf)):
        with pytest.raises(ValueError, match="high-level action: wanted"):
            task.set_subgoal(bad)
    with pytest.raises(ValueError, match="mask"):
        task.reset(np.array([True]))
    with pytest.raises(ValueError, match="seed"):
        task.seed([1])
    np.testing.assert_array_equal(task.snapshot()["physics"], before)
    env = gym.make(KWARGS[name][0], **KWARGS[name][1])
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action: wanted finite"):
        env.step(np.full(env.action_space.shape, np.nan, dtype=np.float32))


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="regime"):
        gym.make("cmc/PegMaze-v0", regime="hard")
    with pytest.raises(ValueError, match="action_mode"):
        gym.make("cmc/PegPush-v0", action_mode="fast")
    with pytest.raises(ValueError, match="low_level"):
        gym.make("cmc/PegPush-v0", low_level=lambda y, i: y)
    with pytest.raises(ValueError, match="multiple"):
        gym.make("cmc/PegPush-v0", changes={"timestep": 0.003})
    with pytest.raises(ValueError, match="u_limit"):
        gym.make("cmc/PegPush-v0", changes={"u_limit": (1.0,)})
    with pytest.raises(panda.SceneError, match="neither"):
        gym.make("cmc/PegPush-v0", changes={"scene": "nowhere.xml"})
    with pytest.raises(panda.UnreachableError):
        gym.make("cmc/PegPush-v0", changes={"start": (2.0, 0.0, 0.0)})
    with pytest.raises(ValueError, match="worlds"):
        PegPush(PUSH, 0)


@each_task
def test_random_driving_stays_sane(name):
    """5000 ticks a task (`benchmarks` has 10^5): finite, inside the limits, near the workspace."""
    task = build(name, 25)
    c, start = task.config, task._q_start
    sides = np.array([c.workspace_low, c.workspace_high])
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
            assert (task.worlds.tip > sides[0] - 0.03).all()
            assert (task.worlds.tip < sides[1] + 0.03).all()
        if block % 5 == 4:
            task.reset()


def test_a_low_level_policy_acts_inside_high_level_steps():
    seen = []

    def policy(y, integral):
        seen.append((y.copy(), integral.copy()))
        return np.clip(5.0 * (y + integral), -1, 1)

    env = gym.make("cmc/PegMaze-v0", action_mode="high", low_level=policy).unwrapped
    plain = gym.make("cmc/PegMaze-v0", action_mode="high").unwrapped
    subgoal = np.array(STIFF.start) + [0, -0.004, 0]
    left = []
    for e in (env, plain):
        e.reset(seed=0)
        _, reward, *_, info = e.step(subgoal)
        left.append(np.linalg.norm(e.task.worlds.tip[0] - subgoal))
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
    assert len(seen) == 20
    assert left[0] < 0.25 * left[1]


@pytest.mark.parametrize("num", [1, 2])
def test_control_at_every_physics_step_is_another_mode_of_the_same_task(num):
    held = PegMaze(STIFF, num, 0)
    config = cmc.envs.peg_maze.regime_config("stiff", {"hold": False})
    dense = PegMaze(config, num, 0)
    for task in (held, dense):
        task.set_subgoal(np.tile(np.array(STIFF.start) + [0, -0.004, 0], (num, 1)))
        for _ in range(20):
            task.step(np.zeros((num, 6)))
    np.testing.assert_allclose(held.worlds.tip, dense.worlds.tip, atol=1e-4)
    assert np.abs(held.worlds.tip - dense.worlds.tip).max() > 1e-9
