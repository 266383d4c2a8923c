"""One closed loop, continuous or held, against an adaptive solver and against exact matrices."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cmc import plants
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.simulate import closed_loop, equilibrium, flow, linear_flow

SLOPES = np.array([[-1.5, -0.7], [-0.8, -0.3]])


def test_flow_agrees_with_scipy_over_a_batch():
    plant, t = plants.get("pendulum", damping=-0.2, stiffness=4.0), np.linspace(0, 6, 13)
    starts = np.array([[2.0, 0.0], [0.1, -1.0], [-3.0, 2.0]])
    path = flow(lambda at, y: plant.f(y, 0 * y, at), starts, t)
    for start, found in zip(starts, path.swapaxes(0, 1), strict=True):
        wanted = solve_ivp(
            lambda at, y: plant.f(y, 0 * y), (0, 6), start, t_eval=t, rtol=1e-11, atol=1e-13
        ).y.T
        np.testing.assert_allclose(found, wanted, atol=2e-6)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_flow_keeps_its_digits_in_any_unit(scale):
    A = np.array([[-1.0, 3.0], [-3.0, -1.0]])
    path = flow(lambda _, x: x @ A.T, scale * np.array([1.0, 0.0]), [0.0, 2.0])
    np.testing.assert_allclose(path[-1], scale * expm(2 * A)[:, 0], atol=1e-6 * scale)


def test_linear_flow_is_the_matrix_exponential_at_any_times():
    A, t = np.array([[-1.0, 2.0], [0.0, -0.3]]), np.array([1.0, 1.5, 4.0])
    start = np.random.default_rng(0).normal(size=(5, 2))
    maps = linear_flow(A, t)
    np.testing.assert_allclose(maps[2], expm(3 * A))
    np.testing.assert_allclose(linear_flow(A, t, start)[2], start @ expm(3 * A).T)


def test_linear_loop_is_its_jacobian():
    plant, t = plants.get("coupled_lags"), np.linspace(0, 5, 6)
    space, y0 = plant.space(), np.array([[1.0, -2.0], [0.5, 0.5]])
    slopes = space.signed([1.5, 0.8], [0.7, 0.3])
    np.testing.assert_array_equal(slopes, -np.sign(space.gains)[:, None] * np.abs(SLOPES))
    P, Q = np.diag(slopes[:, 0]), np.diag(slopes[:, 1])
    J = np.block([[space.Lambda + space.R @ P, space.R @ Q], [np.eye(2), np.zeros((2, 2))]])
    np.testing.assert_allclose(space.loop(slopes), J)
    exact = linear_flow(J, t, np.concatenate([space.to_z(y0), np.zeros((2, 2))], axis=-1))
    path = closed_loop(plant, slopes, y0, t)
    np.testing.assert_allclose(path.z, exact[..., :2], atol=1e-7)
    np.testing.assert_allclose(path.integral, exact[..., 2:], atol=1e-7)
    np.testing.assert_allclose(space.to_z(path.y), path.z, atol=1e-12)


def test_loop_of_a_nonlinear_plant_towards_a_moving_goal():
    plant, t = plants.get("pendulum"), np.linspace(0, 3, 4)
    eye = AuxiliarySpace.identity(np.zeros((2, 2)), np.eye(2))

    def goal(at):
        return np.array([np.sin(at), 0.0])

    def rhs(at, s):
        z = s[:2] - goal(at)
        return np.concatenate([plant.f(s[:2], SLOPES[:, 0] * z + SLOPES[:, 1] * s[2:]), z])

    wanted = solve_ivp(rhs, (0, 3), [0.5, 0.2, 0, 0], t_eval=t, rtol=1e-11, atol=1e-13).y.T
    path = closed_loop(plant, SLOPES, [0.5, 0.2], t, transforms=eye, y_ref=goal)
    np.testing.assert_allclose(np.concatenate([path.y, path.integral], -1), wanted, atol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 200.0])
def test_a_held_command_is_exact_on_a_lag_however_stiff(factor):
    plant, h = plants.Lags(tau=(0.5 / factor, 0.2), gain=(1.0, 2.0)), 0.1
    path = closed_loop(plant, SLOPES / 4, [1.0, -1.0], [0.0, 0.05, 0.1, 0.37], h=h)
    y, I = np.array([1.0, -1.0]), np.zeros(2)
    phi = np.exp(np.diag(plant.A) * h)
    for _ in range(4):
        I = I + h * plant.space().to_z(y)
        s = np.stack([plant.space().to_z(y), I], axis=-1)
        u = plant.space().to_u((SLOPES / 4 * s).sum(-1))
        before = y
        y = phi * y + (1 - phi) * np.diag(plant.B) / -np.diag(plant.A) * u
    part = np.exp(np.diag(plant.A) * 0.07)
    last = part * before + (1 - part) * np.diag(plant.B) / -np.diag(plant.A) * u
    np.testing.assert_allclose(path.y[-1], last, atol=1e-12)
    np.testing.assert_allclose(path.u[-1], u, atol=1e-12)


def test_a_held_nonlinear_plant_against_scipy():
    plant, h = plants.get("pendulum"), 0.2
    eye = AuxiliarySpace.identity(np.zeros((2, 2)), np.eye(2))
    path = closed_loop(plant, SLOPES, [1.0, 0.5], [0.0, 0.4], transforms=eye, h=h)
    y, I = np.array([1.0, 0.5]), np.zeros(2)
    for _ in range(2):
        I = I + h * y
        u = SLOPES[:, 0] * y + SLOPES[:, 1] * I
        held = solve_ivp(lambda _, x, u=u: plant.f(x, u), (0, h), y, rtol=1e-11, atol=1e-13)
        y = held.y[:, -1]
    np.testing.assert_allclose(path.y[-1], y, atol=1e-7)


def test_a_policy_keeps_the_sign_that_it_was_told():
    network = PositiveNetwork(2, slope_min=0.5, slope_max=[1.5, 0.8], dtype=torch.float64)
    policy, plant = ModularPolicy(network, R=[1.0, -1.0]), plants.get("lags")
    t, y0 = np.linspace(0, 3, 4), np.array([[0.5, 0.5]])

    path = closed_loop(plant, policy, y0, t)
    assert np.abs(path.y[-1]).max() > 5
    right = closed_loop(plant, ModularPolicy(network), y0, t)
    assert np.abs(right.y[-1]).max() < 0.5


def test_limits_act_where_asked():
    plant = plants.get("unstable_mode")
    path = closed_loop(plant, -4 * np.ones((2, 2)), [50.0, 50.0], [0.0, 0.5], h=0.1, clip=True)
    assert (np.abs(path.u) <= plant.u_high).all()


class Valve(plants.Plant):
    """y' = -y + u + u^3/3, one Newton step from 0 is far from the root."""

    n, name = 1, "valve"

    def __init__(self):
        self._box([3.0], [3.0])

    def f(self, y, u, t=0.0):
        return -np.asarray(y) + u + np.power(u, 3) / 3

    def f_y(self, y, u, t=0.0):
        return -np.ones((*np.shape(y), 1))

    def f_u(self, y, u, t=0.0):
        return (1 + np.square(u))[..., None]


def test_equilibrium_is_a_root_or_an_error():
    plant, y = Valve(), np.linspace(-3, 3, 9)[:, None]
    np.testing.assert_allclose(plant.f(y, plant.hold(y)), 0, atol=1e-12)

    class Weak(Valve):
        def f(self, y, u, t=0.0):
            return -np.asarray(y) + np.arctan(u)

        def f_u(self, y, u, t=0.0):
            return (1 / (1 + np.square(u)))[..., None]

    np.testing.assert_allclose(Weak().f([1.4], equilibrium(Weak(), [1.4])), 0, atol=1e-9)
    with pytest.raises(ValueError, match="no u makes f"):
        equilibrium(Weak(), [2.0])


LAGS = plants.get("lags")


def loop_of(policy=SLOPES, y0=(1.0, 1.0), t=(0.0, 1.0), **options):
    return closed_loop(LAGS, policy, y0, t, **options)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: flow(lambda _, x: x**2, [1.0], [0.0, 2.0]), "explode or are too stiff"),
        (lambda: flow(lambda _, x: -x, [1.0], [0.0, 0.0]), "t needs at least 2 increasing"),
        (lambda: flow(lambda _, x: -x, [np.nan], [0.0, 1.0]), "start needs finite"),
        (lambda: flow(lambda _, x: -x[:1], [1.0, 2.0], [0, 1]), r"rhs\(t, start\) needs shape"),
        (lambda: flow(lambda _, x: x * np.nan, [1.0], [0, 1]), r"rhs\(t, start\) needs finite"),
        (lambda: flow(None, [1.0], [0, 1]), "rhs needs a function"),
        (lambda: flow(lambda _, x: -x, [1.0], [0, 1], tol=0.0), "tol needs positive"),
        (lambda: linear_flow(np.eye(3)[:2], [0, 1.0]), "A needs shape"),
        (lambda: linear_flow([[1e3]], [0, 1.0]), "A and t: too large"),
        (lambda: equilibrium(LAGS, [0.0, "a"]), "y needs real numbers"),
        (lambda: loop_of(y0=[1.0]), "y0 needs shape"),
        (lambda: loop_of(policy=SLOPES[:1]), "policy needs shape"),
        (lambda: loop_of(policy=lambda s: np.zeros(3)), "policy needs to return"),
        (lambda: loop_of(policy=3.0), "float is no policy"),
        (lambda: loop_of(t=[1.0, 0.0], h=0.1), "t needs at least 1 increasing"),
        (lambda: loop_of(h=-1.0), "h needs positive"),
        (lambda: loop_of(h=1e-9), "h = 1e-09 s needs more than 1,000,000 samples"),
        (lambda: loop_of(y_ref=[0.0] * 3), r"y_ref needs shape \(\.\.\., 2\)"),
        (lambda: loop_of(y0=np.ones((3, 2)), y_ref=np.ones((4, 2))), "fit together.*y_ref"),
        (lambda: loop_of(u0=np.inf), "u0 needs finite"),
    ],
)
def test_bad_arguments_are_named(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()
