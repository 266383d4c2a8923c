"""What was tried on the library from outside and failed: each kind of fault stays mended."""

import numpy as np
import pytest
import torch

from cmc import plants
from cmc.policies import ConvexGradientNetwork, LinearNetwork, ModularPolicy, PositiveNetwork
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import circle_criterion, common_metric
from cmc.theory.certify import certify
from cmc.theory.exact import Region
from cmc.theory.simulate import closed_loop

A3 = np.array([[0.0, 1.0, 0.0], [900.0, 0.0, -3.0], [0.0, 0.0, -100.0]])  # a levitated ball
B3 = np.array([[0.0], [0.0], [100.0]])
BOX = Region([-0.3, -0.3], [0.3, 0.3], integral=0.3)


def positive(n=2, R=1.0, **options):
    bounds = {"slope_min": 0.5, "slope_max": [1.5, 0.8], "dtype": torch.float64}
    kept = {k: options.pop(k) for k in ("normalise", "integral") if k in options}
    return ModularPolicy(PositiveNetwork(n, **{**bounds, **options}), R=R, **kept)


class Ball(plants.Plant):
    name, n, m, constant = "ball", 3, 1, True

    def __init__(self):
        self._box([1.0] * 3, [1.0] * 3)

    def f(self, y, u, t=0.0):
        return np.asarray(y) @ A3.T + np.asarray(u) @ B3.T

    def f_y(self, y, u, t=0.0):
        return np.broadcast_to(A3, (*np.shape(y)[:-1], 3, 3))

    def f_u(self, y, u, t=0.0):
        return np.broadcast_to(B3, (*np.shape(y)[:-1], 3, 1))


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: plants.LinearPlant(A3, B3),
        lambda: decompose(A3, B3),
        lambda: certify(positive(3), Ball()),
    ],
)
def test_fewer_commands_than_signals_are_led_to_a_composite_signal(attempt):
    with pytest.raises(ValueError, match=r"3 signals and 1 command;.*composite signal"):
        attempt()


@pytest.mark.parametrize("name", ["lags", "coupled_lags"])
@pytest.mark.parametrize("R", [[1.0, -1.0], [-1.0, 1.0], -1.0])
def test_a_policy_that_was_told_another_sign_is_not_certified(name, R):
    plant, policy = plants.get(name), positive(R=R)
    assert "wrong way" in certify(policy, plant).reason
    assert not certify(policy, plant, region=BOX)
    path = closed_loop(plant, policy, [[0.5, 0.5]], [0.0, 40.0])
    assert np.abs(path.y[-1]).max() > 10


def test_a_plant_with_negative_gains_wants_a_policy_that_knows_them():
    plant = plants.LinearPlant(-np.eye(2), -np.eye(2))
    eye = AuxiliarySpace.identity(plant.A, plant.B)
    policy = PositiveNetwork(2, slope_min=2.0, slope_max=2.5)
    assert not certify(ModularPolicy(policy), plant, transforms=eye)
    assert certify(ModularPolicy(policy, R=-1.0), plant, transforms=eye)
    assert certify(policy, plant, transforms=eye)  # no R was told: the rule reads the plant's


def test_a_normalised_policy_is_judged_with_the_magnitude_that_it_was_told():
    plant = plants.get("unstable_mode")
    right = positive(
        R=np.abs(plant.space().gains), normalise=True, slope_min=1.0, slope_max=[1.5, 1.2]
    )
    assert certify(right, plant)
    assert not certify(
        positive(R=100.0, normalise=True, slope_min=1.0, slope_max=[1.5, 1.2]), plant
    )


def test_coupled_policies_are_not_taken_for_modular_ones():
    network = ConvexGradientNetwork(2, hidden=1, mu=0.1, dtype=torch.float64)
    with torch.no_grad():
        network.W[:], network.a[:] = torch.tensor([[1.0], [0.9]]), 1.0
    plant = plants.LinearPlant(np.diag([-0.1, -0.2]), [[1.0, -10.0], [0.0, 1.0]])
    answer = certify(ModularPolicy(network), plant)
    assert answer.refused
    assert "coupled" in answer.reason
    assert not certify(ModularPolicy(network), plant, region=BOX)


def test_small_entries_below_the_diagonal_are_not_dropped():
    f_u = np.array([[1e6, 1e6], [5e-4, 1e-6]])
    plant = plants.LinearPlant(-1e-3 * np.eye(2), f_u)
    policy = positive(slope_min=0.5, slope_max=[0.6, 0.6])
    assert not certify(policy, plant, transforms=AuxiliarySpace.identity(plant.A, f_u))


def test_a_policy_without_integral_is_judged_without_it():
    plant, policy = plants.get("pendulum"), positive(integral=False)
    answer = certify(policy, plant, region=BOX)
    assert answer
    assert answer.metric.shape == (2, 2)
    linear = certify(positive(integral=False, slope_min=0.0), plants.get("coupled_lags"))
    assert linear
    assert linear.metric.shape == (2, 2)


def test_stiff_plants_under_a_hold_are_judged_by_their_own_solution():
    class Stiff(plants.LinearPlant):
        constant = False

    slopes = -np.array([[324.0, 1.0]]) / 216
    for kind in (Stiff, plants.LinearPlant):
        answer = certify(324 * slopes, kind([[-216.0]], [[216.0]]), h=0.1)
        assert not answer
        assert certify(slopes / 10, kind([[-216.0]], [[216.0]]), h=0.1)


def test_a_region_is_looked_at_where_nothing_holds_everywhere():
    for name in ("lags", "coupled_lags"):
        policy, plant = ModularPolicy(PositiveNetwork(2)), plants.get(name)
        assert "bypass" in certify(policy, plant).reason
        answer = certify(policy, plant, region=BOX)
        assert answer, str(answer)
        assert answer.evidence == "points"
        assert "at the points tried" in str(answer)
        assert "0.3" in answer.region


def test_many_modes_need_no_grid():
    n = 12
    plant = plants.LinearPlant(-np.diag(np.linspace(0.5, 3.0, n)), np.eye(n))
    assert certify(positive(n, slope_max=[1.2, 0.6]), plant)


class Valve(plants.Plant):
    """y' = -y + arctan(u): the command acts less and less."""

    n, name = 1, "valve"
    slip = 1.0

    def __init__(self):
        self._box([0.5], [1.0])

    def f(self, y, u, t=0.0):
        return -np.asarray(y) + np.arctan(u)

    def f_y(self, y, u, t=0.0):
        return -np.ones((*np.shape(y), 1)) * self.slip

    def f_u(self, y, u, t=0.0):
        return (1 / (1 + np.square(u)))[..., None] + 0 * np.asarray(y)[..., None]


def test_own_jacobians_are_compared_with_f():
    policy, box = positive(1), Region([-0.3], [0.3], integral=0.3)
    assert certify(policy, Valve(), region=box)

    class Slip(Valve):
        slip = 2.0

    answer = certify(policy, Slip(), region=box)
    assert answer.refused
    assert "f_y[0, 0] is -2" in answer.reason

    class NotConstant(Valve):
        constant = True

    assert "not constant" in certify(policy, NotConstant()).reason

    class Empty(Valve):
        def f(self, y, u, t=0.0):
            return np.where(np.asarray(y) < -0.2, np.nan, super().f(y, u))

    answer = certify(policy, Empty(), region=box)
    assert answer.refused
    assert "f is not finite at y" in answer.reason


def test_slopes_outside_of_what_is_stated_are_noticed():
    class Boast:
        def pi(self, s):
            return 3 * s.sum(-1)

        def slope_bounds(self):
            return np.full((2, 2), 0.5), np.full((2, 2), 1.0)

    answer = certify(Boast(), plants.get("lags"))
    assert answer.refused
    assert "its slopes reach" in answer.reason


@pytest.mark.parametrize(
    "vertices",
    [
        [[[-1.0, 1e6], [0.0, -1.0]]],
        [[[-1e5, 1.0], [0.0, -1e-5]]],
        [[[-1e-2, 1e6], [-1e-6, -1e-2]]],
    ],
)
def test_badly_scaled_vertices_get_a_metric(vertices):
    answer = common_metric(vertices)
    assert answer
    assert 0 < answer.rate <= -np.linalg.eigvals(vertices[0]).real.max() * (1 + 1e-9)


def test_a_deadbeat_step_contracts():
    assert common_metric([[[0.0, 1.0], [0.0, 0.0]]], h=0.1)
    with pytest.raises(ValueError, match="h needs positive"):
        common_metric([0.5 * np.eye(2)], h=-1.0)


def test_what_holds_at_the_edge_of_the_circle_criterion_has_a_rate():
    rng = np.random.default_rng(0)
    for c, k1 in rng.uniform(0.1, 3.0, (200, 2)):
        k2 = (np.sqrt(k1) + c) ** 2 * (1 - 10 ** rng.uniform(-16, -8))
        answer = circle_criterion(c, k1, max(k1, k2))
        assert not answer.holds or answer.rate > 0


@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e9])
def test_units_of_time_and_of_signals_do_not_matter(factor):
    plant = plants.get("coupled_lags")
    rate = certify(positive(), plant).rate
    units = np.diag([1.0, factor])
    A = units @ plant.A @ np.linalg.inv(units)
    other = plants.LinearPlant(A, units @ plant.B)
    space = AuxiliarySpace.from_transforms(
        plant.space().T_y @ np.linalg.inv(units), plant.space().T_a, A, other.B
    )
    answer = certify(positive(), other, transforms=space)
    assert answer, str(answer)
    assert answer.rate == pytest.approx(rate, rel=0.2)


def test_the_ball_keeps_trajectories_and_commands_inside():
    plant = plants.get("unstable_mode")
    answer = certify(positive(slope_min=[1.0, 0.5]), plant)
    theta = np.linalg.cholesky(answer.metric).T
    rng = np.random.default_rng(1)
    x = rng.normal(size=(40, 4))
    x = answer.rest + answer.ball * x / np.linalg.norm(x @ theta.T, axis=1, keepdims=True)
    t = np.linspace(0, 6, 60)
    y0 = x[:, :2] @ plant.space().V.T
    path = closed_loop(plant, positive(slope_min=[1.0, 0.5]), y0, t, integral=x[:, 2:])
    assert (np.abs(path.u) <= plant.u_high * (1 + 1e-9)).all()
    far = np.linalg.norm(
        (np.concatenate([path.z, path.integral], -1) - answer.rest) @ theta.T, axis=-1
    )
    assert (far <= answer.ball * np.exp(-answer.rate * t)[:, None] * (1 + 1e-6)).all()


def test_slopes_are_probed_in_the_units_in_which_they_vary():
    """tanh is flat but within 1e-5 of int z = 0: what was stated is too little there."""

    class Narrow:
        def pi(self, s):
            x = s / [1e-2, 1e-7]
            return (
                0.15 * x[..., 0] + 0.03 * x[..., 1] + np.tanh(0.05 * x[..., 0] + 0.02 * x[..., 1])
            )

        def slope_bounds(self):
            return np.array([[15.0, 3e5]]), 0.9 * np.array([[20.0, 5e5]])

    answer = certify(Narrow(), plants.LinearPlant([[-1.5e5]], [[474.0]]))
    assert answer.refused
    assert "its slopes reach" in answer.reason


@pytest.mark.parametrize("offset", np.arange(0.1, 4.0, 0.5))
def test_the_point_of_rest_is_found_where_the_loop_starts_on_it(offset):
    """y' = -2 y + 3 u + c, held at y = 0 by u0: the residual there is rounding alone."""
    plant = plants.Plant.from_function(
        lambda y, u: [-2 * y[0] + 3 * u[0] + offset], y=([-1.0], [1.0]), u=(-5.0, 5.0)
    )
    net = PositiveNetwork(1, hidden=(4,), bias=False, slope_min=0.5, slope_max=1.0)
    answer = certify(ModularPolicy(net, u0=plant.hold([0.0])), plant)
    assert answer
    np.testing.assert_allclose(answer.rest, 0.0, atol=1e-6)  # the network is in float32
    assert 0.0 < answer.ball < np.inf


def test_fixed_gains_are_certified():
    fixed = ModularPolicy(LinearNetwork([[1.0, 0.5], [1.0, 0.5]]))
    assert certify(fixed, plants.get("coupled_lags"))
