"""A plant from a function: Jacobians, batches, what is refused, and the road to a certificate."""

import math

import numpy as np
import pytest

from cmc.plants import Plant
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.theory.certify import certify
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region
from cmc.theory.simulate import closed_loop

UNIT = {"y": ([-1.0, -1.0], [1.0, 1.0]), "u": (-1.0, 1.0)}


def tanks(y, u):
    """Two tanks in a row, levels in m, inflows in m/s."""
    h1, h2 = y
    return [u[0] - 0.1 * h1**0.5, 0.1 * h1**0.5 - 0.12 * h2**0.5 + u[1]]


def two_tanks():
    return Plant.from_function(tanks, y=([0.5, 0.5], [2.0, 2.0]), u=(0.0, 0.5), name="two tanks")


def twisted(y, u):
    y1, y2 = y
    return [y2 - y1**3 + u[0] * (1 + y2**2), -y1 + np.sin(y2) + u[1] + 0.1 * u[0] ** 3]


def twisted_jacobians(y, u):
    return (
        np.array([[-3 * y[0] ** 2, 1 + 2 * u[0] * y[1]], [-1, np.cos(y[1])]]),
        np.array([[1 + y[1] ** 2, 0], [0.3 * u[0] ** 2, 1]]),
    )


def test_jacobians_by_complex_step_are_exact():
    plant = Plant.from_function(twisted, **UNIT)
    assert plant.how == "complex step"
    assert not plant.constant
    y, u = np.random.default_rng(0).uniform(-1, 1, (2, 7, 3, 2))
    for k in np.ndindex(7, 3):
        wanted = twisted_jacobians(y[k], u[k])
        np.testing.assert_allclose(plant.f_y(y, u)[k], wanted[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(plant.f_u(y, u)[k], wanted[1], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(plant.f(0.3 * y, plant.hold(0.3 * y)), 0.0, atol=1e-9)


def test_functions_that_are_not_analytic_or_not_vectorised_fall_back():
    kink = Plant.from_function(lambda y, u: [np.abs(y[0]) * y[0] + u[0], u[1] - y[1]], **UNIT)
    assert kink.how == "central differences"
    np.testing.assert_allclose(kink.f_y([0.5, 0.0], [0.0, 0.0])[0, 0], 1.0, rtol=1e-6)
    single = Plant.from_function(lambda y, u: [math.sin(y[0]) + u[0], u[1] - y[1]], **UNIT)
    assert single.how == "central differences"
    assert single.f(np.zeros((4, 2)), np.zeros((4, 2))).shape == (4, 2)
    np.testing.assert_allclose(single.f_y([0.5, 0.0], [0, 0])[0, 0], math.cos(0.5), rtol=1e-6)


def test_affine_functions_have_constant_jacobians():
    A, B = np.array([[-1.0, 2.0], [0.0, -3.0]]), np.array([[1.0, 0.5], [0.0, 2.0]])
    plant = Plant.from_function(lambda y, u: A @ y + B @ u + np.array([[1.0], [2.0]]), **UNIT)
    assert plant.constant
    np.testing.assert_allclose(plant.space().eigenvalues, [-1.0, -3.0])
    limited = Plant.from_function(lambda y, u: np.clip(A @ y, -50, 50) + B @ u, **UNIT)
    assert not limited.constant
    timed = Plant.from_function(lambda y, u, t: A @ y + B @ u + np.sin(t), **UNIT)
    assert not timed.constant
    assert timed.f([0.0, 0.0], [0.0, 0.0], np.pi / 2) == pytest.approx([1.0, 1.0])


def test_what_is_refused_says_why():
    with pytest.raises(ValueError, match=r"3 signals and 1 command.*composite"):
        Plant.from_function(lambda y, u: y, y=([0] * 3, [1] * 3), u=([0], [1]))
    with pytest.raises(ValueError, match="return 2 rows"):
        Plant.from_function(lambda y, u: y[0], **UNIT)
    with pytest.raises(ValueError, match="f is not finite at y"):
        Plant.from_function(lambda y, u: [np.log(y[0]) + u[0], u[1]], **UNIT)
    with pytest.raises(ValueError, match=r"f_y\[0, 1\] is 3"):
        Plant.from_function(
            lambda y, u: [2 * y[1] + u[0], u[1]],
            f_y=lambda y, u: np.array([[0.0, 3.0], [0.0, 0.0]]),
            f_u=lambda y, u: np.eye(2),
            **UNIT,
        )
    with pytest.raises(ValueError, match="low < high"):
        Plant.from_function(lambda y, u: u, y=([1.0, 1.0], [0.0, 2.0]), u=(-1, 1))


def test_two_tanks_are_certified_in_reversed_order():
    """Their eigenvectors meet in the box, but the second tank never drives the first."""
    plant = two_tanks()
    network = PositiveNetwork(2, slope_min=0.5, slope_max=[1.0, 0.6])
    fits = {option.name: option for option in transforms_that_fit(plant)}
    assert not fits["eigenvectors at every state"].possible
    assert not fits["own order"].possible
    assert fits["reversed order"].possible
    box = Region([0.9, 0.9], [1.1, 1.1], integral=0.2)
    policy = ModularPolicy(network, u0=plant.hold([1.0, 1.0]))
    transforms = fits["reversed order"].transforms
    answer = certify(policy, plant, region=box, transforms=transforms, y_ref=[1.0, 1.0])
    assert answer, str(answer)
    path = closed_loop(
        plant, policy, [[1.05, 0.97]], [0, 40.0], transforms=transforms, y_ref=[1.0, 1.0]
    )
    np.testing.assert_allclose(path.y[-1], 1.0, atol=1e-3)
    refused = certify(policy, plant, region=Region([0.5, 0.5], [2.0, 2.0]), y_ref=[1.0, 1.0])
    assert not refused
    assert "reversed order" in refused.reason


def test_mixed_real_and_complex_modes_are_given_a_road():
    D = np.array([[-0.2, 3.0, 0.0], [-3.0, -0.2, 0.0], [0.0, 0.0, -1.0]])
    V = np.array([[1.0, 0.2, 0.3], [0.1, 1.0, 0.2], [0.3, 0.1, 1.0]])
    A = V @ D @ np.linalg.inv(V)
    box = {"y": (-np.ones(3), np.ones(3)), "u": (-5.0, 5.0)}
    plant = Plant.from_function(lambda y, u: A @ y + u, **box)
    fits = {option.name: option for option in transforms_that_fit(plant)}
    assert not fits["eigenvectors at every state"].possible
    policy = ModularPolicy(PositiveNetwork(3, slope_min=0.5, slope_max=[1.0, 0.7]))
    for name in ("feedback", "block schur"):
        assert fits[name].possible
        assert certify(policy, plant, transforms=fits[name].transforms)
        assert certify(policy, plant, transforms=fits[name].transforms, h=0.05)
