"""Peg touch: exact integration, one convention in batch and single form, honest shifts."""

import json
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy.integrate import solve_ivp

import cmc.envs  # noqa: F401  (registers)
from cmc.envs.peg_touch import INTERFACES, PegShift, PegTouchConfig, PegTouchVectorEnv
from cmc.plants import Peg

SHIFTED = PegShift(tau_x=1.5, tau_z=0.5, K_sur=2.0, surface=1.5)


def still(num_envs=1, **config):
    return PegTouchVectorEnv(num_envs, autoreset_mode=AutoresetMode.DISABLED, **config)


def drive(envs, seed, steps, rng_seed=0):
    """Random actions; the observations and rewards that came back."""
    rng = np.random.default_rng(rng_seed)
    rows = [envs.reset(seed=seed)[0]]
    rewards = []
    for _ in range(steps):
        obs, reward, *_ = envs.step(rng.normal(size=(envs.num_envs, 2)))
        rows.append(obs)
        rewards.append(reward)
    return np.array(rows), np.array(rewards)


@pytest.mark.parametrize("interface", INTERFACES)
def test_gymnasium_and_stable_baselines_accept_the_environment(interface, recwarn):
    env = gym.make("cmc.envs:cmc/PegTouch-v0", interface=interface)
    check_env(env.unwrapped)
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    sb3.check_env(env.unwrapped)
    unexpected = [w for w in recwarn if "symmetric and normalized" not in str(w.message)]
    assert not unexpected, [str(w.message) for w in unexpected]


@pytest.mark.parametrize("interface", INTERFACES)
def test_batch_and_single_environment_agree(interface):
    batch = still(4, interface=interface, shift=SHIFTED)
    obs, _ = batch.reset(seed=3)
    actions = np.random.default_rng(0).normal(size=(20, 4, 2))
    batched = [batch.step(a) for a in actions]
    for index in range(4):
        env = gym.make("cmc/PegTouch-v0", interface=interface, shift=SHIFTED)
        values = {name: drawn[index] for name, drawn in batch.sampled.items()}
        first, _ = env.reset(options={"parameters": values})
        np.testing.assert_array_equal(first, obs[index])
        for a, (o, r, *_, info) in zip(actions, batched, strict=True):
            single = env.step(a[index].astype(np.float64))
            np.testing.assert_array_equal(single[0], o[index])
            assert single[1] == r[index] == pytest.approx(sum(single[4]["reward_terms"].values()))
            np.testing.assert_array_equal(single[4]["privileged"], info["privileged"][index])


def test_a_step_is_the_exact_solution_of_the_lags():
    shift = PegShift(tau_x=1.5, tau_z=0.5)
    envs = still(5, h=0.023, shift=shift)
    envs.reset(seed=1)
    start = envs.position.copy()
    envs.step(np.random.default_rng(2).normal(size=(5, 2)))
    lag = np.array([0.0437 * 1.5, 0.01 * 0.5])
    for index in range(5):
        u = envs.command[index]
        path = solve_ivp(
            lambda t, p, u=u: (u - p) / lag, (0, 0.023), start[index], rtol=1e-10, atol=1e-12
        )
        np.testing.assert_allclose(envs.position[index], path.y[:, -1], atol=1e-8)


@pytest.mark.parametrize("interface", ["auxiliary", "identity"])
def test_the_integral_includes_the_new_signal(interface):
    rows, _ = drive(still(6, interface=interface, h=0.02), seed=0, steps=12)
    s = rows.reshape(-1, 6, 2, 2).astype(float)
    np.testing.assert_allclose(s[..., 1], 0.02 * np.cumsum(s[..., 0], axis=0), atol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_transforms_diagonalise_the_model_and_triangulate_the_command(angle):
    envs = still(50, surface=(-0.3, 0.3), mount_angle=angle, shift=SHIFTED)
    envs.reset(seed=4)
    x = envs.position[:, 0]
    peg = Peg(**{n: envs.sampled[n] for n in ("K_sur", "surface_sin", "surface_cos")})
    y = np.stack([x, -np.ones(50)], axis=-1)
    u = np.stack([x, np.zeros(50)], axis=-1)
    cosine, sine = np.cos(angle), np.sin(angle)
    mount = np.array([[cosine, -sine], [sine, cosine]])
    T_y, T_a = envs.transforms()
    Lambda = T_y @ peg.f_y(y, u) @ np.linalg.inv(T_y)
    np.testing.assert_allclose(
        Lambda, np.broadcast_to(np.diag([-1 / 0.0437, -1 / 0.01]), Lambda.shape), atol=1e-9
    )
    R = T_y @ peg.f_u(y, u) @ mount @ T_a
    np.testing.assert_allclose(R[:, 1, 0], 0.0, atol=1e-9)
    assert (R[:, 0, 0] > 0).all()
    assert (R[:, 1, 1] > 0).all()
    np.testing.assert_allclose(
        T_a @ T_a.swapaxes(-1, -2), np.broadcast_to(np.eye(2), T_a.shape), atol=1e-12
    )
    np.testing.assert_allclose(envs.signal, (T_y @ envs.error[..., None])[..., 0], atol=1e-12)


def test_an_auxiliary_action_is_the_identity_action_seen_through_T_a():
    auxiliary = still(7, mount_angle=2.0)
    identity = still(7, mount_angle=2.0, interface="identity")
    auxiliary.reset(seed=5), identity.reset(seed=5)
    for a in np.random.default_rng(1).normal(size=(10, 7, 2)):
        _, T_a = auxiliary.transforms()
        auxiliary.step(a)
        identity.step((T_a @ a[..., None])[..., 0])
        np.testing.assert_allclose(auxiliary.position, identity.position, atol=1e-12)


def test_a_shift_changes_the_plant_and_not_the_nominal_model():
    nominal, shifted = still(20), still(20, shift=SHIFTED)
    nominal.reset(seed=6), shifted.reset(seed=6)
    np.testing.assert_array_equal(nominal.transforms()[0], shifted.transforms()[0])
    down = np.tile([0.0, -2.0], (20, 1))
    for _ in range(30):
        nominal.step(down), shifted.step(down)
    contact = nominal.force < -1e-3
    assert contact.any()
    ratio = shifted.force[contact] / nominal.force[contact]
    np.testing.assert_allclose(ratio, 2.0, rtol=0.05)


@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize("shift", [PegShift(), SHIFTED])
def test_observations_stay_in_the_declared_space(interface, shift):
    envs = still(200, interface=interface, shift=shift)
    rng = np.random.default_rng(0)
    obs, _ = envs.reset(seed=0)
    push = rng.choice([-9.0, 9.0], size=(200, 2))
    for _ in range(envs.config.horizon):
        assert envs.observation_space.contains(obs)
        obs, *_ = envs.step(push)
        assert (envs.force <= 0).all()  # it never pulls
    assert envs.observation_space.contains(obs)
    assert (envs.force < 0).any()
    assert (envs.force == 0).any()


def test_each_group_has_its_own_random_stream():
    together, _ = drive(still(6), seed=[11, 12, 13], steps=0)
    swapped, _ = drive(still(6), seed=[13, 11, 12], steps=0)
    alone, _ = drive(still(2), seed=[12], steps=0)
    np.testing.assert_array_equal(together[:, 2:4], alone)
    np.testing.assert_array_equal(together[:, [4, 5, 0, 1, 2, 3]], swapped)
    assert not np.array_equal(together[:, 0:2], together[:, 2:4])


def test_a_masked_reset_leaves_the_others_alone():
    envs = still(4)
    before, _ = drive(envs, seed=0, steps=3)
    mask = np.array([True, False, True, False])
    after, _ = envs.reset(options={"reset_mask": mask, "parameters": {"K_sur": 5.0}})
    np.testing.assert_array_equal(after[~mask], before[-1][~mask])
    assert (envs.steps == [0, 3, 0, 3]).all()
    assert (envs.sampled["K_sur"][mask] == 5.0).all()
    assert envs.sampled["K_sur"][1] != 5.0


def test_a_configuration_read_back_from_json_is_the_same():
    config = PegTouchConfig(K_sur=(2.0, 3.0))
    fields = json.loads(json.dumps(asdict(config)))
    shift = PegShift(**fields.pop("shift"))
    assert PegTouchConfig(**fields, shift=shift) == config
