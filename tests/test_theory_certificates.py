"""Certificates: against brute force, against simulation, and what they refuse to say."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.linalg import expm

from cmc import plants
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import (
    circle_criterion,
    common_metric,
    compose_hierarchical,
    loop_jacobian,
    rate_in,
)
from cmc.theory.certify import certify
from cmc.theory.combinations import feedback
from cmc.theory.contraction import contraction_rate, rate_from_cloud
from cmc.theory.exact import Region, closed_loop, total_jacobian
from cmc.theory.metric_search import condition_metric, search_metric
from cmc.theory.sampled import largest_slope
from cmc.theory.simulate import rk4


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


# ---------------------------------------------------------------- the circle criterion


def _brute_force_k2(c, k1):
    """Largest k2 that some M = [[1, b], [b, d]] allows, from the 2 x 2 conditions."""
    b = np.linspace(0, c, 1201)[1:-1, None]
    d = np.linspace(0, 4 * c**2 + 4 * k1, 3001)[None]

    def ok(k):
        # M J + J^T M = [[2 (b - c), d - b c - k], [., -2 b k]] negative definite
        return (4 * (c - b) * b * k > (d - b * c - k) ** 2) & (d > b**2)

    base = ok(k1)
    low, high = k1, (np.sqrt(k1) + 2 * c) ** 2
    for _ in range(22):
        middle = (low + high) / 2
        low, high = (middle, high) if (base & ok(middle)).any() else (low, middle)
    return low


@pytest.mark.parametrize(("c", "k1"), [(1.0, 1.0), (0.5, 2.0), (3.0, 0.4)])
def test_circle_criterion_agrees_with_brute_force(c, k1):
    edge = _brute_force_k2(c, k1)
    formula = (c + np.sqrt(k1)) ** 2
    assert edge == pytest.approx(formula, rel=1e-3)
    assert circle_criterion(c, k1, formula * (1 - 1e-3)).holds
    assert not circle_criterion(c, k1, formula * (1 + 1e-3)).holds


def test_metric_search_finds_the_same_edge():
    rng = np.random.default_rng(0)
    for c, k1 in rng.uniform(0.2, 3.0, (12, 2)):
        edge = (c + np.sqrt(k1)) ** 2
        for factor, expected in ((0.999, True), (1.001, False)):
            corners = [[[-c, -k], [1.0, 0.0]] for k in (k1, factor * edge)]
            assert (search_metric(corners).metric is not None) == expected


def test_circle_certificate_holds_for_every_stiffness_in_between():
    rng = np.random.default_rng(1)
    for _ in range(200):
        c, k1 = rng.uniform(0.1, 5.0, 2)
        k2 = (np.sqrt(k1) + rng.uniform(0, 0.999) * c) ** 2
        answer = circle_criterion(c, k1, k2)
        assert answer
        assert answer.rate > 0
        k = np.linspace(k1, k2, 50)
        J = np.zeros((50, 2, 2))
        J[:, 0, 0], J[:, 0, 1], J[:, 1, 0] = -c, -k, 1.0
        assert contraction_rate(J, answer.metric).min() >= answer.rate - 1e-9
        assert answer.rate <= -np.linalg.eigvals(J).real.max() + 1e-9


def test_circle_refusals():
    no_floor = circle_criterion(1.0, 0.0, 1.0)
    assert not no_floor
    assert "positive" in no_floor.reason
    too_wide = circle_criterion(0.1, 0.5, 1.5)
    assert not too_wide
    np.testing.assert_array_equal(too_wide.violated, [[-0.1, -1.5], [1.0, 0.0]])
    assert "not proved" in str(too_wide)
    with pytest.raises(ValueError, match="k1 <= k2"):
        circle_criterion(1.0, 2.0, 1.0)


def test_both_counter_examples_are_not_certified():
    """The Floquet loop really diverges; theorem 2's inequalities hold for it at every instant."""
    loop = plants.loop("floquet")
    J = np.stack([loop.jacobian(t, np.zeros(2)) for t in np.linspace(0, loop.period, 50)])
    assert not circle_criterion(0.1, 0.5, 1.5)
    answer = common_metric(J)
    assert not answer
    assert answer.violated is not None
    assert "no quadratic metric" in answer.reason
    two = plants.loop("two_attractors")
    s = np.stack([np.zeros(61), np.linspace(-6, 6, 61)], axis=-1)
    assert not common_metric(two.jacobian(0.0, s))
    # more damping repairs both
    heavy = plants.FloquetLoop(lag=-0.6)
    J = np.stack([heavy.jacobian(t, np.zeros(2)) for t in np.linspace(0, heavy.period, 50)])
    assert common_metric(J)


# ---------------------------------------------------------------- several vertices


def test_common_metric_is_a_metric_for_the_whole_hull():
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(15):
        vertices = rng.normal(size=(6, 3, 3)) * 0.5 - 1.6 * np.eye(3)
        answer = common_metric(vertices)
        if not answer:
            continue
        found += 1
        weights = rng.dirichlet(np.ones(6) * 0.3, 200)
        inside = np.einsum("wv,vij->wij", weights, vertices)
        assert contraction_rate(inside, answer.metric).min() >= answer.rate - 1e-9 > -1e-9
        assert answer.overshoot >= 1
    assert found > 5


def test_the_metric_is_the_best_conditioned_one():
    """Against a grid over [[1, b], [b, d]] for slopes k in [1, 2] and c = 1."""
    corners = np.array([[[-1.0, -k], [1.0, 0.0]] for k in (1.0, 2.0)])
    b, d = np.meshgrid(np.linspace(0, 1, 400)[1:-1], np.linspace(0.05, 6, 1200))
    ok = d > b**2
    for k in (1.0, 2.0):
        ok &= 4 * (1 - b) * b * k > (d - b - k) ** 2
    b, d = b[ok], d[ok]
    root = np.sqrt((1 + d) ** 2 / 4 - (d - b**2))
    best = (((1 + d) / 2 + root) / ((1 + d) / 2 - root)).min()
    found = condition_metric(corners, search_metric(corners).metric)
    assert contraction_rate(corners, found).min() > 0
    assert np.linalg.cond(found) == pytest.approx(best, rel=0.02)
    with pytest.raises(ValueError, match="not a common metric"):
        condition_metric(corners, np.diag([1.0, 100.0]))


def test_the_whole_loop_gets_a_well_conditioned_metric():
    assert 1 <= certify(policy(), plants.get("coupled_lags")).overshoot < 20


def test_single_vertex_reaches_most_of_its_decay():
    J = np.array([[-1.0, 8.0], [0.0, -1.5]])
    answer = common_metric(J[None])
    assert 0.85 < answer.rate <= 1.0


def test_discrete_metrics_bound_the_products_of_any_order():
    rng = np.random.default_rng(3)
    c, h = 1.0, 0.2
    vertices = np.stack([expm(h * np.array([[-c, -k], [1.0, 0.0]])) for k in (0.5, 2.0)])
    answer = common_metric(vertices, h=h)
    assert answer
    assert answer.domain == "sampled"
    assert answer.rate == pytest.approx(rate_in(vertices, answer.metric, h))
    power = np.eye(2)
    for k in range(1, 200):
        power = vertices[rng.integers(2)] @ power
        bound = answer.overshoot * np.exp(-answer.rate * h * k)
        assert np.linalg.norm(power, 2) <= bound + 1e-12


def test_unstable_and_malformed_vertices():
    unstable = common_metric([np.diag([-1.0, -1.0]), np.diag([-1.0, 0.2])])
    assert not unstable
    np.testing.assert_array_equal(unstable.violated, np.diag([-1.0, 0.2]))
    assert "0.2" in unstable.reason
    growing = common_metric([1.1 * np.eye(2)], h=0.1)
    assert "spectral radius 1.1" in growing.reason
    for bad, message in (
        (np.eye(2), r"shape \(V, m, m\)"),
        (np.full((1, 2, 2), np.nan), "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            common_metric(bad)
    # each decays, their mean does not: no common metric can exist
    pair = [np.array([[-0.1, 5.0], [0.0, -0.1]]), np.array([[-0.1, 0.0], [5.0, -0.1]])]
    assert search_metric(pair).metric is None


@pytest.mark.parametrize("h", [None, 0.05])
def test_hierarchical_composition(h):
    rng = np.random.default_rng(4)
    sizes = (2, 1, 2)
    blocks = [rng.normal(size=(1, m, m)) * 0.4 - np.eye(m) for m in sizes]
    if h is not None:
        blocks = [expm(h * block[0])[None] for block in blocks]
    parts = [common_metric(block, h=h) for block in blocks]
    couplings = {
        (i, j): rng.normal(size=(4, sizes[i], sizes[j])) * (5 if h is None else 0.5)
        for i in range(3)
        for j in range(i + 1, 3)
    }
    metric, rate = compose_hierarchical(
        [p.metric for p in parts], [p.rate for p in parts], couplings, h=h
    )
    edges = np.concatenate([[0], np.cumsum(sizes)])
    for pick in rng.integers(4, size=(30, 3)):
        J = np.zeros((5, 5))
        for i in range(3):
            J[edges[i] : edges[i + 1], edges[i] : edges[i + 1]] = blocks[i][0]
        for ((i, j), block), which in zip(couplings.items(), pick, strict=True):
            J[edges[i] : edges[i + 1], edges[j] : edges[j + 1]] = block[which]
        assert rate_in(J[None], metric, h) >= rate - 1e-9
    assert rate >= 0.89 * min(p.rate for p in parts)
    with pytest.raises(ValueError, match="positive rate"):
        compose_hierarchical([np.eye(1)], [0.0], {})
    with pytest.raises(ValueError, match="i < j"):
        compose_hierarchical([np.eye(1)] * 2, [1.0, 1.0], {(1, 0): np.ones((1, 1, 1))})


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
    expected = total_jacobian(field, s)
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
    field = closed_loop(pol, plant, lambda y: space)
    times, rng = np.linspace(0, 25, 1000), np.random.default_rng(6)
    paths = rk4(lambda t, s: field(s), rng.normal(size=(12, 4)) * 3, times)
    paths = np.concatenate([paths[..., :2] @ space.T_y.T, paths[..., 2:]], axis=-1)
    measured = rate_from_cloud(times, paths, answer.metric)
    assert measured.ratio.max() <= 1 + 1e-9
    assert (measured.ratio <= np.exp(-answer.rate * times) + 1e-9).all()


def test_identity_transforms_are_not_certified_where_the_paper_needs_its_own():
    plant = plants.get("coupled_lags")
    answer = certify(policy(), plant, transforms=AuxiliarySpace.identity(plant.A, plant.B))
    assert not answer
    assert "unstable" in answer.reason
    assert np.linalg.eigvals(answer.violated).real.max() > 0.1


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
    step = closed_loop(pol, plant, lambda y: space, h=h)
    s = np.random.default_rng(7).normal(size=(10, 4)) * 3
    path = [s]
    for _ in range(400):
        path.append(step(path[-1]))
    path = np.stack(path)
    path = np.concatenate([path[..., :2] @ space.T_y.T, path[..., 2:]], axis=-1)
    measured = rate_from_cloud(h * np.arange(401), path, answer.metric)
    assert (measured.ratio <= np.exp(-answer.rate * measured.times) + 1e-6).all()


class Turning:
    """T_a = Rot(3 y1) on two plain lags: what the frozen view takes for a constant."""

    u0 = 0.0

    def slope_bounds(self):
        bounds = np.tile([0.5, 0.1], (2, 1))
        return bounds, bounds

    def pi(self, s):
        return 0.5 * s[..., 0] + 0.1 * s[..., 1] - np.array([0.0, -5.0])

    @staticmethod
    def spaces(y):
        angle = 3 * y[..., 0]
        rot = np.stack(
            [
                np.stack([np.cos(angle), -np.sin(angle)], -1),
                np.stack([np.sin(angle), np.cos(angle)], -1),
            ],
            -2,
        )
        eye = np.broadcast_to(np.eye(2), rot.shape)
        return AuxiliarySpace(eye, rot, -eye, rot)


def test_frozen_passes_and_exact_fails_where_the_transform_turns():
    plant = plants.Lags(tau=(1.0, 1.0), gain=(1.0, 1.0))
    region = Region([-0.35, -0.5], [0.35, 0.5])
    turning = Turning()
    frozen = certify(turning, plant, region=region, kind="frozen", transforms=Turning.spaces)
    assert frozen
    assert "frozen" in str(frozen)
    exact = certify(turning, plant, region=region, kind="exact", transforms=Turning.spaces)
    assert not exact
    assert not exact.refused
    # by hand, with the slopes at zero: -1 + 15 cos(0.9) = 8.32 at y1 = 0.3
    field = closed_loop(turning, plant, Turning.spaces)
    hand = total_jacobian(lambda s: field(s) + _without_feedback(s), np.array([0.3, 0, 0, 0.0]))
    assert np.linalg.eigvals(hand).real.max() == pytest.approx(8.32, abs=0.01)


def _without_feedback(s):
    y, I = s[..., :2], s[..., 2:]
    a = (0.5 * y + 0.1 * I)[..., None]
    push = (Turning.spaces(y).T_a @ a)[..., 0]
    return np.concatenate([push, np.zeros_like(push)], axis=-1)


def test_exact_certificate_of_a_nonlinear_plant_is_obeyed():
    plant = plants.get("pendulum")
    region = Region([-0.3, -0.3], [0.3, 0.3], integral=0.3, points=5)
    pol = policy((0.8, 0.3), (0.2, 0.1))
    answer = certify(pol, plant, region=region, kind="exact")
    assert answer, str(answer)
    assert answer.kind == "exact"
    assert "in it" in answer.reason

    def spaces(y):
        u = plant.hold(y)
        return decompose(plant.f_y(y, u), plant.f_u(y, u))

    field = closed_loop(pol, plant, spaces)
    times, rng = np.linspace(0, 4, 200), np.random.default_rng(8)
    paths = rk4(lambda t, s: field(s), rng.uniform(-0.05, 0.05, (8, 4)), times)
    assert np.abs(paths).max() < 0.3
    measured = rate_from_cloud(times, paths, answer.metric)
    assert (measured.ratio <= np.exp(-answer.rate * times) * (1 + 1e-6)).all()
    sampled = certify(pol, plant, region=region, kind="exact", h=0.02)
    assert sampled
    assert (sampled.kind, sampled.domain) == ("exact", "sampled")


def test_exact_is_refused_where_it_cannot_be_had():
    class BoundsOnly:
        def slope_bounds(self):
            return np.full((2, 2), 0.2), np.full((2, 2), 0.5)

    blind = certify(BoundsOnly(), plants.get("pendulum"), kind="exact")
    assert blind.refused
    assert "neither pi(s) nor a network" in blind.reason

    def flipping(y):
        space = AuxiliarySpace.identity(np.diag([-1.0, -2.0]), np.eye(2))
        sign = np.where(y[..., :1, None] > 0.1, -1.0, 1.0)
        eye = np.broadcast_to(np.eye(2), (*y.shape[:-1], 2, 2))
        return AuxiliarySpace(eye * sign, eye, eye * 0 + space.Lambda, eye)

    lags = plants.get("lags")
    assert "track" in certify(policy(), lags, kind="exact", transforms=flipping).reason


def test_peg_is_certified_in_contact():
    peg = plants.get("peg")
    slow = policy((0.5, 2.0), (0.5, 4.0))
    answer = certify(slow, peg)
    assert answer
    assert answer.kind == "frozen"
    assert not certify(slow, peg, h=0.01)


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
        field = closed_loop(pol, plant, lambda y: space)
        J = total_jacobian(field, rng.normal(size=(300, 4)) * 3)
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
    points = certify(policy, plants.get("pendulum"), kind="frozen")
    assert proof.evidence == "proof"
    assert str(proof).startswith("contracting (exact")
    assert points.evidence == "points"
    assert "grid points" in points.region
