"""Certificates of whole loops: the exact Jacobian, against simulation, and what is refused."""

import re

import numpy as np
import pytest

from benchmarks.questions import Tanh
from cmc import plants
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certify import certify
from cmc.theory.combinations import feedback
from cmc.theory.exact import Region
from cmc.theory.identification import differences
from cmc.theory.sampled import largest_slope
from cmc.theory.simulate import Loop, closed_loop


def policy(bypass=(0.3, 0.2), room=(0.8, 0.3), n=2):
    """pi_i(s_i) = bypass . s_i + tanh(room . s_i), slopes in [bypass, bypass + room]."""
    return Tanh(np.tile(bypass, (n, 1)).astype(float), np.tile(room, (n, 1)).astype(float), 1.0)


def ratio(paths, metric):
    """Largest distance of two paths in a metric over that at the start, (time,)."""
    i, j = np.triu_indices(paths.shape[1], 1)
    gap = paths[:, i] - paths[:, j]
    distance = np.sqrt(np.einsum("tpi,ij,tpj->tp", gap, metric, gap))
    return (distance / distance[0]).max(axis=1)


# ---------------------------------------------------------------- exact Jacobian, certify


def test_the_loop_of_a_space_is_the_derivative_of_the_loop():
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
    found = AuxiliarySpace.identity(Lambda, R).loop(np.stack([p, q], axis=-1))
    np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "h"), [("coupled_lags", None), ("lags", None), ("coupled_lags", 0.05)]
)
def test_linear_plants_get_exact_certificates_that_simulations_obey(name, h):
    plant, pol, rng = plants.get(name), policy(), np.random.default_rng(6)
    answer = certify(pol, plant, h=h)
    assert answer
    assert (answer.kind, answer.region, answer.evidence) == ("exact", "everywhere", "proof")
    assert answer.domain == ("continuous" if h is None else "sampled")
    assert str(answer).startswith("contracting (exact")
    assert 1 <= answer.overshoot < 20
    # the metric is in (z, int z)
    space = decompose(plant.A, plant.B)
    start = rng.normal(size=(12, 4)) * 3
    if h is None:
        times = np.linspace(0, 25, 1000)
        path = closed_loop(plant, pol, start[:, :2], times, transforms=space, integral=start[:, 2:])
        paths = np.concatenate([path.z, path.integral], axis=-1)
    else:
        times, loop, paths = h * np.arange(401), Loop(plant, pol, space), [start]
        for _ in times[1:]:
            paths.append(loop.step(paths[-1], h))
        paths = np.stack(paths)
        paths = np.concatenate([paths[..., :2] @ space.T_y.T, paths[..., 2:]], axis=-1)
    assert (ratio(paths, answer.metric) <= np.exp(-answer.rate * times) + 1e-7).all()


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


def test_exact_sampled_certificate_of_the_peg_is_obeyed_by_the_peg_itself():
    """The certificate uses the contact model; the trajectories here use the plant's own step."""
    peg, h, goal = plants.get("peg", K_sur=31.0), 0.01, np.array([2.0, -1.5])
    caps = [largest_slope(peg.tau_x, 1.0, h, ratio=5.0), largest_slope(0.01, 31.0, h, ratio=5.0)]
    top = 0.5 * np.array(caps)[:, None] * [1.0, 5.0]
    pol = Tanh(0.3 * top, 0.7 * top, 1.0)
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
    bound = np.exp(-answer.rate * h * np.arange(len(path)))
    assert (ratio(path, answer.metric) <= bound * (1 + 1e-6)).all()


class Bounds:
    """A policy of which only the interval of its slopes is known."""

    def __init__(self, low, high):
        self.low, self.high = np.asarray(low, float), np.asarray(high, float)

    def slope_bounds(self):
        return self.low, self.high


def numbers(text):
    return [float(x) for x in re.findall(r"(?<![a-z])-?\d+\.?\d*(?:e[+-]?\d+)?", text)]


@pytest.mark.parametrize("R", [1.0, -3.0])
def test_a_refusal_says_which_slope_to_change_and_to_what(R):
    plant = plants.LinearPlant([[-0.1]], [[R]])
    own = AuxiliarySpace.identity(plant.A, plant.B)
    low, high = np.array([[0.3, 0.5]]), np.array([[0.3, 20.0]])
    reason = certify(Bounds(low, high), plant, transforms=own).reason
    assert "lower the cap of the slope in int z" in reason
    cap, floor = (numbers(reason.split(word)[1])[0] for word in ("to below", "to above"))
    for factor, holds in ((0.999, True), (1.001, False)):
        changed = Bounds(low, [[0.3, factor * cap]])
        assert bool(certify(changed, plant, transforms=own)) == holds
    for factor, holds in ((1.001, True), (0.999, False)):
        steep = np.array([factor * floor, 1.0])
        changed = Bounds([[steep[0], 0.5]], [[steep[0], 20.0]])
        assert bool(certify(changed, plant, transforms=own)) == holds
    growing = plants.LinearPlant([[0.8]], [[R]])
    own = AuxiliarySpace.identity(growing.A, growing.B)
    reason = certify(Bounds([[0.01, 0.1]], [[9.0, 0.2]]), growing, transforms=own).reason
    assert f"slope floor above {0.8 / abs(R):.4g} in z, it is 0.01" in reason


def test_a_sampled_refusal_says_how_much_lower_the_slopes_have_to_be():
    lag, h = plants.Lags(tau=(0.01, 0.01), gain=(31.0, 31.0)), 0.01
    low, high = np.tile([0.02, 0.05], (2, 1)), np.tile([0.12, 0.1], (2, 1))
    reason = certify(Bounds(low, high), lag, h=h).reason
    assert "lower both to" in reason
    share = numbers(reason.split("lower both to")[1])[0]
    assert not certify(Bounds(low, high * 1.02 * share), lag, h=h)
    assert certify(Bounds(low, high * 0.9 * share), lag, h=h)


@pytest.mark.parametrize("h", [None, 0.2])
def test_a_refused_complex_pair_hears_of_caps_that_hold(h):
    A = np.array([[-0.3, 3.0], [-3.0, -0.3]])
    plant, low = plants.LinearPlant(A, np.eye(2)), np.full((2, 2), 0.5)
    answer = certify(Bounds(low, 20 * low), plant, transforms=feedback(A, np.eye(2)), h=h)
    assert "Dimensions 1 and 2" in answer.reason
    caps = np.array(numbers(answer.reason.split("int z to")[1])).reshape(2, 2)
    assert (caps > low).all()
    assert certify(Bounds(low, 0.99 * caps), plant, transforms=feedback(A, np.eye(2)), h=h)
    assert not certify(Bounds(low, 1.5 * caps), plant, transforms=feedback(A, np.eye(2)), h=h)


def test_a_box_that_is_refused_says_where_and_how_far_it_would_hold():
    class Hill(plants.Plant):
        """y' = y^3 - y + u: it decays in the middle alone."""

        n, name = 1, "hill"

        def __init__(self):
            self._box([1.0], [9.0])

        def f(self, y, u, t=0.0):
            return np.asarray(y) ** 3 - np.asarray(y) + u

        def f_y(self, y, u, t=0.0):
            return (3 * np.square(y) - 1)[..., None] + 0 * np.asarray(u)[..., None]

        def f_u(self, y, u, t=0.0):
            return np.ones((*np.shape(y), 1))

    weak, lines = policy((0.1, 0.1), (0.05, 0.05), n=1), []
    answer = certify(weak, Hill(), region=Region([-1.0], [1.0]), progress=lines.append)
    assert not answer
    assert abs(numbers(answer.reason.split("y = [")[1])[0]) > 0.5
    assert "within 1/2 of the box one metric fits" in answer.reason
    assert certify(weak, Hill(), region=Region([-0.45], [0.45], integral=0.5))
    assert lines[0].startswith("box, round 1")


def test_long_questions_report_their_progress():
    plant, lines = plants.LinearPlant(-np.diag([1.0, 2.0, 3.0]), np.eye(3)), []
    assert certify(policy(n=3), plant, progress=lines.append)
    assert lines[0] == "round 1: one metric for 40 of 64 vertices"
    with pytest.raises(TypeError, match="progress"):
        certify(policy(n=3), plant, progress="yes")
