"""Native vector environments: how they end, and plants as environments."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy.linalg import expm

import cmc.envs  # noqa: F401  (registers)
from cmc import plants
from cmc.envs.plant_env import PlantEnv, PlantVectorEnv

SHORT = {
    "cmc/PegTouch-v0": {"horizon": 3},
    "cmc/PegMaze-v0": {"changes": {"ticks": 3}},
    "cmc/PegPush-v0": {"changes": {"ticks": 3}},
    "cmc/Plant-v0": {"horizon": 3},
}


def make(name, mode, num=2):
    return gym.make_vec(name, num, "vector_entry_point", autoreset_mode=mode, **SHORT[name])


@pytest.mark.parametrize("name", SHORT)
def test_next_step_resets_one_step_later_as_gymnasiums_own_vector_does(name):
    native = make(name, "next_step")
    assert native.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    envs = gym.wrappers.vector.RecordEpisodeStatistics(native)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    action, ends = envs.action_space.sample(), []
    for k in range(8):
        obs, reward, _, truncated, info = envs.step(action)
        ends.append(bool(truncated.all()))
        if k == 3:  # the step that begins the second episode
            np.testing.assert_array_equal(reward, 0.0)
            for terms in info.get("reward_terms", {}).values():
                np.testing.assert_array_equal(terms, 0.0)
            again = native.reset(options={"reset_mask": np.zeros(2, bool)})[0]
            np.testing.assert_array_equal(obs, again)
    assert ends == [False, False, True, False, False, False, True, False]
    assert info["episode"]["l"].shape == (2,) if "episode" in info else True
    gym.wrappers.vector.NormalizeObservation(make(name, AutoresetMode.NEXT_STEP)).reset(seed=0)


@pytest.mark.parametrize("name", SHORT)
def test_same_step_hands_out_the_last_observation_and_disabled_waits_for_the_mask(name):
    same, still = make(name, "SameStep"), make(name, AutoresetMode.DISABLED)
    first, _ = same.reset(seed=0)
    still.reset(seed=0)
    same.action_space.seed(0)
    action = same.action_space.sample()
    for _ in range(3):
        obs, *_, info = same.step(action)
        last, *_ = still.step(action)
    assert info["_final_obs"].all()
    np.testing.assert_array_equal(np.stack(info["final_obs"]), last)
    assert np.abs(obs - last).max() > 0
    assert obs.shape == first.shape
    anew, _ = still.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(anew, np.stack([obs[0], last[1]]))


# -- plants --------------------------------------------------------------------------------------


def test_a_linear_plant_moves_by_its_matrix_exponential():
    plant = plants.get("coupled_lags")
    env = PlantVectorEnv(3, plant, 0.05, autoreset_mode="Disabled")
    y, _ = env.reset(seed=0)
    u = np.random.default_rng(0).uniform(plant.u_low, plant.u_high, (3, 2)) / 4
    zero = np.zeros(2)
    block = np.block([[plant.f_y(zero, zero), plant.f_u(zero, zero)], [np.zeros((2, 4))]])
    step = expm(0.05 * block)[:2]
    for _ in range(5):
        wanted = np.concatenate([env.y, u], axis=1) @ step.T
        _, reward, *_ = env.step(u)
        np.testing.assert_allclose(env.y, wanted, rtol=1e-6, atol=1e-8)
        half = (plant.y_high - plant.y_low) / 2
        np.testing.assert_allclose(reward, -np.mean((env.y / half) ** 2, axis=-1))


@pytest.mark.parametrize("name", plants.names())
def test_every_plant_is_an_environment(name):
    from stable_baselines3.common.env_checker import check_env as check_env_sb3

    env = gym.make("cmc/Plant-v0", plant=name).unwrapped
    check_env(env, skip_render_check=True)
    check_env_sb3(env, warn=False)
    twin = copy.deepcopy(env)
    np.testing.assert_array_equal(env.reset(seed=1)[0], twin.reset(seed=1)[0])
    np.testing.assert_array_equal(env.step(env.plant.u_high)[0], twin.step(env.plant.u_high)[0])


def test_who_leaves_the_room_has_ended():
    env = PlantVectorEnv(2, "unstable_mode", 0.05, room=1.0, autoreset_mode="Disabled")
    plant = env.plant
    env.reset(seed=0, options={"y": plant.y_high * 0.999})
    ended = np.zeros(2, bool)
    for _ in range(500):
        _, _, terminated, _, _ = env.step(np.tile(plant.u_high, (2, 1)))
        ended |= terminated
    assert ended.all()
    assert np.isfinite(env.y).all()


def test_reward_and_target_are_ones_own():
    env = PlantEnv("coupled_lags", target=[0.5, 0.0], reward=lambda y, u: u[:, 0] - y[:, 1])
    env.reset(seed=0)
    obs, reward, *_ = env.step(np.array([1.0, 0.0]))
    assert reward == pytest.approx(1.0 - obs[1], abs=1e-6)
    np.testing.assert_array_equal(env.batch.target, [0.5, 0.0])
