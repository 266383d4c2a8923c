"""Certificates of whole loops: the exact Jacobian, against simulation, and what is refused."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import expm

from cmc import plants
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import (
    loop_jacobian,
    rate_in,
)
from cmc.theory.certify import certify
from cmc.theory.combinations import feedback
from cmc.theory.contraction import contraction_rate, rate_from_cloud
from cmc.theory.exact import Region
from cmc.theory.jacobians import differences
from cmc.theory.sampled import largest_slope
from cmc.theory.simulate import Loop, closed_loop


@dataclass
class Policy:
    """pi_i(s_i) = bypass . s_i + tanh(room . s_i), slopes in [bypass, bypass + room]."""

    bypass: np.ndarray
    room: np.ndarray
    u0: float = 0.0

    def pi(self, s):
        return (self.bypass * s).sum(-1) + np.tanh((self.room * s).sum(-1))

    def slope_bounds(self):
        return np.array(self.bypass, float), np.array(self.bypass, float) + np.array(self.room)


def policy(bypass=(0.3, 0.2), room=(0.8, 0.3), n=2):
    return Policy(np.tile(bypass, (n, 1)).astype(float), np.tile(room, (n, 1)).astype(float))


# ---------------------------------------------------------------- exact Jacobian, certify


def test_loop_jacobian_is_the_derivative_of_the_loop():
    rng = np.random.default_rng(5)
    Lambda, R = rng.normal(size=(2, 3, 3))
    pol = policy(n=3)

    def field(s):
        z, I = s[..., :3], s[..., 3:]
        a = -pol.pi(np.stack([z, I], axis=-1))
        return np.concatenate([z @ Lambda.T + a @ R.T, z], axis=-1)

    s = rng.normal(size=(20, 6))
    slope = 1 / np.cosh((pol.room * np.stack([s[:, :3], s[:, 3:]], -1)).sum(-1)) ** 2
    p = -(pol.bypass[:, 0] + pol.room[:, 0] * slope)
    q = -(pol.bypass[:, 1] + pol.room[:, 1] * slope)
    expected = differences(field, s)
    np.testing.assert_allclose(loop_jacobian(Lambda, R, p, q), expected, atol=1e-8)
    with pytest.raises(ValueError, match="slopes"):
        loop_jacobian(Lambda, R, p[:, :2], q)


@pytest.mark.parametrize("name", ["coupled_lags", "lags"])
def test_linear_plants_get_exact_certificates_that_simulations_obey(name):
    plant, pol = plants.get(name), policy()
    answer = certify(pol, plant)
    assert answer
    assert (answer.kind, answer.domain, answer.region) == ("exact", "continuous", "everywhere")
    # the metric is in (z, int z)
    f_y, f_u = plant.A, plant.B
    space = decompose(f_y, f_u)
    times, rng = np.linspace(0, 25, 1000), np.random.default_rng(6)
    start = rng.normal(size=(12, 4)) * 3
    path = closed_loop(plant, pol, start[:, :2], times, transforms=space, integral=start[:, 2:])
    paths = np.concatenate([path.z, path.integral], axis=-1)
    measured = rate_from_cloud(times, paths, answer.metric)
    assert measured.ratio.max() <= 1 + 1e-9
    assert (measured.ratio <= np.exp(-answer.rate * times) + 1e-7).all()


def test_identity_transforms_are_not_certified_where_the_paper_needs_its_own():
    plant = plants.get("coupled_lags")
    answer = certify(policy(), plant, transforms=AuxiliarySpace.identity(plant.A, plant.B))
    assert not answer
    assert "unstable" in answer.reason
    assert np.linalg.eigvals(answer.violated).real.max() > 0.1


def test_the_whole_loop_gets_a_well_conditioned_metric():
    assert 1 <= certify(policy(), plants.get("coupled_lags")).overshoot < 20


def test_what_stands_in_the_way_is_named():
    complex_pair = certify(policy(), plants.get("spiral"))
    assert complex_pair.refused
    assert "feedback" in complex_pair.reason
    growing = certify(policy(), plants.get("unstable_mode"))
    assert not growing
    assert "slope floor above 0.79" in growing.reason
    assert certify(policy(bypass=(1.2, 0.3)), plants.get("unstable_mode"))
    saturating = certify(policy(bypass=(0.0, 0.0)), plants.get("lags"))
    assert not saturating
    assert "bypass" in saturating.reason
    with pytest.raises(TypeError, match="slope_bounds"):
        certify(object(), plants.get("lags"))
    with pytest.raises(ValueError, match="kind"):
        certify(policy(), plants.get("lags"), kind="rough")


def test_sampled_certificates_follow_the_sampled_bound():
    lag = plants.Lags(tau=(0.01, 0.01), gain=(31.0, 31.0))
    tight, loose = policy((0.02, 0.05), (0.01, 0.05)), policy((0.02, 0.05), (0.1, 0.05))
    assert certify(loose, lag)
    inside = certify(tight, lag, h=0.01)
    assert inside
    assert inside.domain == "sampled"
    outside = certify(loose, lag, h=0.01)
    assert not outside
    assert "spectral radius" in outside.reason
    coupled = certify(policy(), plants.get("coupled_lags"), h=0.05)
    assert coupled
    assert coupled.kind == "exact"


def test_sampled_certificate_bounds_the_simulated_step():
    plant, pol, h = plants.get("coupled_lags"), policy(), 0.05
    answer = certify(pol, plant, h=h)
    space = decompose(plant.A, plant.B)
    loop = Loop(plant, pol, space)
    s = np.random.default_rng(7).normal(size=(10, 4)) * 3
    path = [s]
    for _ in range(400):
        path.append(loop.step(path[-1], h))
    path = np.stack(path)
    path = np.concatenate([path[..., :2] @ space.T_y.T, path[..., 2:]], axis=-1)
    measured = rate_from_cloud(h * np.arange(401), path, answer.metric)
    assert (measured.ratio <= np.exp(-answer.rate * measured.times) + 1e-6).all()


def test_peg_is_certified_in_contact():
    peg = plants.get("peg")
    slow = policy((0.5, 2.0), (0.5, 4.0))
    box = Region([1.5, -2.5], [2.5, -0.5], integral=0.1)
    answer = certify(slow, peg, region=box, y_ref=[2.0, -1.5])
    assert answer, str(answer)
    assert answer.kind == "exact"
    assert not certify(slow, peg, region=box, h=0.01, y_ref=[2.0, -1.5])


def test_torch_policies_are_understood():
    torch = pytest.importorskip("torch")
    from cmc.policies import ModularPolicy, PositiveNetwork

    network = PositiveNetwork(
        2, hidden=(8,), slope_min=[0.5, 0.3], slope_max=[1.5, 0.6], dtype=torch.float32
    )
    assert certify(ModularPolicy(network), plants.get("coupled_lags"))
    region = Region([-0.2, -0.2], [0.2, 0.2], integral=0.2, points=3)
    answer = certify(ModularPolicy(network), plants.get("pendulum"), region=region, kind="exact")
    assert answer.kind == "exact"
    assert not answer.refused
    plain = PositiveNetwork(2, hidden=(8,), seeds=(0, 1))
    assert "bypass" in certify(ModularPolicy(plain), plants.get("lags")).reason


def test_complex_pairs_are_certified_with_the_feedback_transform():
    """T_a = (T_y f_u)^-1 needs no slopes: what is certified is stable at every random state."""
    plant, rng, held = plants.get("spiral"), np.random.default_rng(9), 0
    space = feedback(plant.A, plant.B)
    for _ in range(8):
        bypass = 10 ** rng.uniform(-1, 0.5, (2, 2))
        pol = Policy(bypass, bypass * rng.uniform(0.1, 1.5, (2, 2)))
        answer = certify(pol, plant, transforms=space)
        held += answer.holds
        loop = Loop(plant, pol, space)
        J = differences(lambda s, loop=loop: loop.field(0.0, s), rng.normal(size=(300, 4)) * 3)
        if answer:
            assert np.linalg.eigvals(J).real.max() < 0
            to_aux = np.block([[space.T_y, np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]])
            J = to_aux @ J @ np.linalg.inv(to_aux)
            assert contraction_rate(J, answer.metric).min() >= answer.rate - 1e-6
    assert held >= 3


def test_exact_sampled_certificate_of_the_peg_is_obeyed_by_the_peg_itself():
    """The certificate uses the contact model; the trajectories here use the plant's own step."""
    peg, h, goal = plants.get("peg", K_sur=31.0), 0.01, np.array([2.0, -1.5])
    caps = [largest_slope(peg.tau_x, 1.0, h, ratio=5.0), largest_slope(0.01, 31.0, h, ratio=5.0)]
    top = 0.5 * np.array(caps)[:, None] * [1.0, 5.0]
    pol = Policy(0.3 * top, 0.7 * top)
    pol.u0 = np.array([2.0, -0.05])
    box = Region([1.5, -2.5], [2.5, -0.5], integral=0.2, points=4)
    answer = certify(pol, peg, kind="exact", region=box, h=h, y_ref=goal)
    assert answer, str(answer)
    assert (answer.kind, answer.domain) == ("exact", "sampled")
    x, force = np.array([1.9, 2.1, 2.0]), np.array([-1.4, -1.6, -1.5])
    z, I, path = peg.height(x, force), np.zeros((3, 2)), []
    for _ in range(120):
        y = np.stack([x, peg.contact_force(x, z)], axis=-1)
        path.append(np.concatenate([y, I], axis=-1))
        held = peg.hold(y)
        space = decompose(peg.f_y(y, held), peg.f_u(y, held))
        signal = space.to_z(y - goal)
        I = I + h * signal
        u = pol.u0 + space.to_u(-pol.pi(np.stack([signal, I], axis=-1)))
        x, z = peg.step(x, z, u, h)
    path = np.stack(path)
    assert (path[..., 1] < -0.5).all()
    assert (np.abs(path[..., 2:]) < 0.2).all()
    measured = rate_from_cloud(h * np.arange(len(path)), path, answer.metric)
    assert (measured.ratio <= np.exp(-answer.rate * measured.times) * (1 + 1e-6)).all()


@pytest.mark.parametrize("h", [None, 0.03])
def test_random_plants_of_three_dimensions_keep_their_promise(h):
    """Any slopes inside the bounds, against a loop that is written down afresh."""
    rng, held = np.random.default_rng(10), 0
    for _ in range(6):
        V = rng.normal(size=(3, 3)) + 2 * np.eye(3)
        A = V @ np.diag(-rng.uniform(0.5, 3, 3)) @ np.linalg.inv(V)
        plant = plants.LinearPlant(A, rng.normal(size=(3, 3)))
        bypass = rng.uniform(0.2, 1.0, (3, 2))
        pol = Policy(bypass, bypass * 0.3)
        answer = certify(pol, plant, h=h)
        held += answer.holds
        if not answer:
            continue
        space = decompose(A, plant.B)
        slopes = bypass * rng.uniform(1, 1.3, (200, 3, 2))
        K1, K2 = (slopes[:, None, :, m] * np.eye(3) for m in (0, 1))
        if h is None:
            top = np.concatenate([space.Lambda - space.R @ K1, -space.R @ K2], axis=-1)
            below = np.broadcast_to(np.eye(3, 6), top.shape)
        else:
            phi = expm(h * space.Lambda)
            G = np.linalg.solve(space.Lambda, (phi - np.eye(3)) @ space.R)
            top = np.concatenate([phi - G @ (K1 + h * K2), -G @ K2], axis=-1)
            below = np.broadcast_to(np.hstack([h * np.eye(3), np.eye(3)]), top.shape)
        loops = np.concatenate([top, below], axis=-2)
        assert rate_in(loops, answer.metric, h) >= answer.rate - 1e-7
    assert held >= 3


def test_a_certificate_says_whether_it_is_a_proof_or_looked_at_points():
    from cmc.policies import PositiveNetwork

    policy = PositiveNetwork(2, slope_min=0.5, slope_max=2.0)
    proof = certify(policy, plants.get("coupled_lags"))
    box = Region([-0.3, -0.3], [0.3, 0.3], integral=0.3)
    points = certify(policy, plants.get("pendulum"), region=box)
    assert proof.evidence == "proof"
    assert str(proof).startswith("contracting (exact")
    assert points.evidence == "points"
    assert "at the points tried" in str(points)


def test_frozen_answers_never_hold_where_the_transforms_move():
    from cmc.policies import PositiveNetwork

    policy = PositiveNetwork(2, slope_min=0.5, slope_max=2.0)
    box = Region([-0.3, -0.3], [0.3, 0.3], integral=0.3)
    answer = certify(policy, plants.get("pendulum"), kind="frozen", region=box)
    assert not answer
    assert "proves nothing" in answer.reason
    assert answer.rate > 0
