"""Physics of the worlds: the compiled tick against numpy, pushes, copies and pickles."""

import copy
from dataclasses import replace
from pickle import dumps, loads

import gymnasium as gym
import joblib
import mujoco
import numpy as np
import numpy_control
import pytest

import cmc.envs  # noqa: F401  (registers)
from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze
from cmc.envs.peg_push import PUSH, PegPush

FORCES = np.array([[2.0, 0, 0], [0, -1.0, 0.5], [0.3, 0.4, -1.2]])
each_number = pytest.mark.parametrize("num", [1, 3])


def _free(config, joints=3, **changes):
    """No obstacles, no spread of the start, and a workspace of 2 m (or rad)."""
    wide = {"workspace_low": (-1.0,) * joints, "workspace_high": (1.0,) * joints}
    plain = {"scene": "panda.xml", "start_joints": 0.0, "start_box": (0.0,) * 3}
    return replace(config, **plain, **wide, **changes)


LIMP = {n: getattr(JOINT, n) for n in ("command", "subgoal_low", "subgoal_high", "u_limit")}
LIMP |= {"joint_stiffness": 0.0, "hold": False}
"""Joint control with no stiffness: nothing but gravity is carried."""


@pytest.mark.parametrize("peg", [STIFF, SOFT, PUSH], ids=["stiff", "soft", "push"])
@each_number
def test_a_pushed_arm_moves_as_the_engine_says_for_a_generalized_force(num, peg):
    config = _free(peg, 7, **LIMP)
    task = PegMaze(config, num, seed=0)
    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    hand, site = model.body("hand").id, model.site("tip_nominal").id
    for _ in range(10):
        task.worlds.push(FORCES[:num])
        task.step(np.zeros((num, 7)))
    for k in range(num):
        mujoco.mj_resetData(model, data)
        data.qpos[:7] = task._q_start
        for _ in range(100):
            mujoco.mj_step1(model, data)
            data.ctrl[:], data.qfrc_applied[:] = data.qfrc_bias[:7], 0.0
            tip = data.site_xpos[site]
            mujoco.mj_applyFT(model, data, FORCES[k], np.zeros(3), tip, hand, data.qfrc_applied)
            mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
        moved = np.linalg.norm(data.site_xpos[site] - np.array(config.start))
        assert moved > 1e-3
        np.testing.assert_allclose(task.worlds.nominal[k], data.site_xpos[site], atol=1e-3 * moved)


@each_number
def test_a_held_arm_gives_way_by_the_force_over_stiffness_and_effective_mass(num):
    task = PegPush(_free(PUSH), num, seed=0)
    for _ in range(600):
        task.worlds.push(0.1 * FORCES[:num])
        task.step(np.zeros((num, 6)))
    worlds = task.worlds
    assert np.abs(worlds.signals[:, 6:]).max() < 1e-4
    data, jac, solved = mujoco.MjData(worlds.model), np.zeros((6, 7)), np.zeros((6, 7))
    for k in range(num):
        data.qpos[:] = worlds.qpos[k]
        mujoco.mj_forward(worlds.model, data)
        site = worlds.model.site("tip_nominal").id
        mujoco.mj_jacSite(worlds.model, data, jac[:3], jac[3:], site)
        mujoco.mj_solveM(worlds.model, data, solved, jac)
        # At rest K_p e + J M^-1 J^T F = 0: the acceleration that the force alone would cause.
        expected = -(solved @ jac.T)[:, :3] @ (0.1 * FORCES[k]) / PUSH.gains.kp
        np.testing.assert_allclose(worlds.signals[k, :6], expected, rtol=0.01, atol=2e-5)


@each_number
def test_a_push_ends_with_a_reset_and_travels_in_a_snapshot(num):
    task, quiet = (PegPush(_free(PUSH), num, seed=0) for _ in range(2))
    ends, still = [], np.zeros((num, 6))
    task.worlds.push(FORCES[:num])
    kept = task.snapshot()
    for _ in range(2):
        task.restore(kept)
        task.step(still)
        ends.append(task.worlds.qpos)
        task.worlds.push(np.zeros((num, 3)))
    quiet.step(still)
    np.testing.assert_array_equal(*ends)
    assert np.abs(ends[0] - quiet.worlds.qpos).max() > 1e-6
    task.worlds.push(FORCES[:num])
    for t in (task, quiet):
        t.seed(3)
        t.reset()
        t.step(still)
    np.testing.assert_array_equal(task.worlds.qpos, quiet.worlds.qpos)


CASES = {
    "stiff": (PegMaze, STIFF),
    "soft": (PegMaze, SOFT),
    "stiff, one block": (PegMaze, replace(STIFF, law=replace(STIFF.law, split=False, drift=True))),
    "push": (PegPush, PUSH),
    "stiff, every step": (PegMaze, replace(STIFF, hold=False)),
    "push, every step": (PegPush, replace(PUSH, hold=False)),
}


@pytest.mark.parametrize("name", CASES)
def test_an_episode_in_contact_is_that_of_the_numpy_version(name):
    """Two worlds, 30 ticks, random actions and sub-goals, against MuJoCo's own Python calls."""
    kind, config = CASES[name]
    task, rng = kind(config, 2, seed=0), np.random.default_rng(0)
    model, law = task.worlds.model, replace(config.law, posture=tuple(task._q_start))
    states, largest = task.worlds.get_state(), 0.0
    worlds = [mujoco.MjData(model) for _ in range(2)]
    for data, state in zip(worlds, states, strict=True):
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step1(model, data)
    for k in range(30):
        if k % 10 == 0:
            high = rng.uniform(config.subgoal_low, config.subgoal_high, (2, config.high_size))
            task.set_subgoal(high)
        action = rng.uniform(-1.2, 1.2, (2, 6))
        _, _, _, _, info = task.step(action)
        for i, data in enumerate(worlds):
            u = np.clip(action[i], -1, 1) * np.array(config.u_limit)
            goal = (task.target[i], u, task.worlds.quat[i])
            peak, depth = numpy_control.tick(model, data, config, law, *goal)
            np.testing.assert_allclose(task.worlds.qpos[i], data.qpos, atol=1e-9)
            np.testing.assert_allclose(task.worlds.qvel[i], data.qvel, atol=1e-8)
            found = info["contact_force_max"][i], info["penetration"][i]
            np.testing.assert_allclose(found, (peak, depth), rtol=1e-6, atol=1e-9)
            push = -data.sensor("peg_force").data
            np.testing.assert_allclose(task.worlds.force[i], push, rtol=1e-6, atol=1e-9)
            largest = max(largest, peak)
    assert largest > 0.1


def test_joint_control_is_a_spring_an_action_towards_the_goal_and_gravity():
    task, rng = PegMaze(replace(JOINT, hold=False), 1, seed=0), np.random.default_rng(0)
    model, data = task.worlds.model, mujoco.MjData(task.worlds.model)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_setState(model, data, task.worlds.get_state()[0], kind)
    mujoco.mj_step1(model, data)
    task.set_subgoal(rng.uniform(-0.1, 0.1, (1, 7)))
    for _ in range(20):
        action = rng.uniform(-1.3, 1.3, (1, 7))
        pull = 0.3 * np.minimum(np.abs(action[0]), 1) * np.sign(task.target_joints[0] - data.qpos)
        task.step(action)
        for _ in range(10):
            data.ctrl[:] = 1.0 * (task.target_joints[0] - data.qpos) + pull + data.qfrc_bias
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
        np.testing.assert_allclose(task.worlds.qpos[0], data.qpos, atol=1e-9)


def test_threads_change_nothing():
    alone, shared = PegPush(PUSH, 5, seed=0), PegPush(PUSH, 5, seed=0, threads=3)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1, 1, (5, 6))
        np.testing.assert_array_equal(alone.step(action)[0], shared.step(action)[0])
    with pytest.raises(ValueError, match="finite"):
        shared.step(np.full((5, 6), np.nan))


# -- copies --------------------------------------------------------------------------------------

NAMES = ["cmc/PegMaze-v0", "cmc/PegMazeJoint-v0", "cmc/PegPush-v0", "cmc/PegTouch-v0"]
WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: loads(dumps(env))}


def _drive(env, seed, ticks=4):
    env.action_space.seed(seed)
    return [env.step(env.action_space.sample())[:2] for _ in range(ticks)]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("num", [None, 2])
@pytest.mark.parametrize("name", NAMES)
def test_a_copy_goes_on_as_the_original_would(name, num, started, way):
    env = gym.make(name) if num is None else gym.make_vec(name, num, "vector_entry_point")
    if started:
        env.reset(seed=3)
        _drive(env, 0)
    twin = WAYS[way](env)
    if not started:
        env.reset(seed=3)
        twin.reset(seed=3)
    for (one, reward), (other, same) in zip(_drive(env, 1), _drive(twin, 1), strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(reward, same)
    np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])


def _play(env):
    env.reset(seed=3)
    return [obs for obs, _ in _drive(env, 1)]


def test_other_processes_play_the_same_episode():
    """joblib's workers and Stable-Baselines3's SubprocVecEnv, over an environment made here."""
    from stable_baselines3.common.vec_env import SubprocVecEnv

    env = gym.make("cmc/PegMaze-v0")
    found = joblib.Parallel(n_jobs=2)(joblib.delayed(_play)(env) for _ in range(2))
    wanted = _play(env)
    np.testing.assert_array_equal(found, [wanted, wanted])
    venv = SubprocVecEnv([lambda: copy.deepcopy(env)] * 2)
    venv.seed(3)
    first = venv.reset()
    env.reset(seed=3)
    np.testing.assert_array_equal(first[0], env.reset(seed=3)[0])
    venv.close()
