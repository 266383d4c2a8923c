"""The wrapper: the peg's own form again, and a plant that identity transforms cannot hold."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from scipy.linalg import expm

from cmc import plants
from cmc.envs.auxiliary_space import AuxiliarySpaceWrapper
from cmc.envs.peg_touch import PegTouchEnv
from cmc.theory.combinations import feedback
from cmc.theory.explicit import ComplexEigenvalueError

H = 0.02


class Tanks(gym.Env):
    """Coupled lags under a held command, to be brought to zero."""

    def __init__(self):
        self.plant = plants.get("coupled_lags")
        zero = np.zeros(2)
        self.f_y, self.f_u = self.plant.f_y(zero, zero), self.plant.f_u(zero, zero)
        block = np.block([[self.f_y, self.f_u], [np.zeros((2, 4))]])
        self.step_matrix = expm(block * H)[:2]
        self.observation_space = spaces.Box(-1e3, 1e3, (2,), np.float64)
        self.action_space = spaces.Box(-20.0, 20.0, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.y = self.np_random.uniform(-1, 1, 2)
        return self.y.copy(), {}

    def step(self, action):
        self.y = np.clip(self.step_matrix @ np.concatenate([self.y, action]), -1e3, 1e3)
        return self.y.copy(), -float(np.abs(self.y).sum()), False, False, {}


def wrapped(transforms=True):
    env = Tanks()
    eye = np.eye(2)
    model = (
        (lambda y: (env.f_y, env.f_u)) if transforms else (lambda y: (-eye @ np.diag([1, 2]), eye))
    )
    return AuxiliarySpaceWrapper(env, error=lambda y: y, model=model, h=H, limit=20.0)


def final_error(env, k1=2.0, k2=1.0, steps=1500):
    s, _ = env.reset(seed=0)
    for _ in range(steps):
        pairs = s.reshape(2, 2).astype(float)
        s, *_ = env.step(-(k1 * pairs[:, 0] + k2 * pairs[:, 1]))
    return np.abs(env.unwrapped.y).max()


def test_one_controller_a_dimension_holds_what_it_cannot_hold_without_the_transforms():
    assert final_error(wrapped()) < 1e-3
    assert final_error(wrapped(transforms=False)) > 1.0


def test_it_passes_the_checker():
    check_env(wrapped(), skip_render_check=True)


def test_the_peg_in_its_own_form_is_the_same_up_to_scale():
    own = PegTouchEnv(interface="auxiliary", surface=(-0.02, 0.02))
    inner = PegTouchEnv(interface="identity", surface=(-0.02, 0.02))

    def model(s):
        batch = inner.batch
        x = batch.position[:, 0]
        y = np.stack([x, batch.force], axis=-1)
        peg = batch.nominal_peg
        u = np.stack([x, np.zeros_like(x)], axis=-1)
        return peg.f_y(y, u)[0], peg.f_u(y, u)[0]

    env = AuxiliarySpaceWrapper(
        inner, error=lambda s: s.reshape(2, 2)[:, 0], model=model, h=0.01, limit=3.0
    )
    wanted, _ = own.reset(seed=1)
    found, _ = env.reset(seed=1)
    for a in np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2)):
        scale = np.array([env.space.T_y[0, 0], 1.0])
        np.testing.assert_allclose(
            found.reshape(2, 2)[:, 0], scale * wanted.reshape(2, 2)[:, 0], atol=1e-3
        )
        wanted, *_ = own.step(a)
        found, *_ = env.step(a)


class Oscillator(Tanks):
    """x'' = -4 x + u as y = (x, x'), a complex pair that `decompose` refuses; two commands."""

    def __init__(self):
        super().__init__()
        self.f_y, self.f_u = np.array([[-0.1, 2.0], [-2.0, -0.1]]), np.eye(2)
        block = np.block([[self.f_y, self.f_u], [np.zeros((2, 4))]])
        self.step_matrix = expm(block * H)[:2]


@pytest.mark.parametrize("as_function", [False, True])
def test_a_lightly_damped_plant_works_through_transforms_of_ones_own(as_function):
    env = Oscillator()
    with pytest.raises(ComplexEigenvalueError):
        AuxiliarySpaceWrapper(
            env, error=lambda y: y, model=lambda y: (env.f_y, env.f_u), h=H
        ).reset(seed=0)
    space = feedback(env.f_y, env.f_u)
    given = (lambda y: space) if as_function else space
    wrapper = AuxiliarySpaceWrapper(env, error=lambda y: y, transforms=given, h=H, limit=20.0)
    assert final_error(wrapper) < 1e-3
    only = AuxiliarySpaceWrapper(env, error=lambda y: y, transforms=given, h=H, integral=False)
    s, _ = only.reset(seed=0)
    np.testing.assert_allclose(s, space.T_y @ env.y, atol=1e-6)
    check_env(only, skip_render_check=True)
    with pytest.raises(TypeError, match="either a model or transforms"):
        AuxiliarySpaceWrapper(env, error=lambda y: y, h=H)
    with pytest.raises(TypeError, match="AuxiliarySpace of 2, got 3"):
        AuxiliarySpaceWrapper(env, error=lambda y: y, transforms=lambda y: 3, h=H).reset()
