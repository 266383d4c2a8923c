"""Certificates: against brute force, against simulation, and what they refuse to say."""

import numpy as np
import pytest
from scipy.linalg import expm

from cmc.theory.certificates import (
    circle_criterion,
    common_metric,
    rates_in,
)
from cmc.theory.contraction import contraction_rate
from cmc.theory.metric_search import condition_metric, search_metric
from cmc.theory.slopes import compose_hierarchical

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
            assert (search_metric(corners)[0] is not None) == expected


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

    def loops(trace, q):
        return np.stack([[[-trace, -k], [1.0, 0.0]] for k in q])

    breathing = 1 + 0.5 * np.cos(np.linspace(0, 2 * np.pi, 50))
    J = loops(0.1, breathing)
    assert (np.linalg.eigvals(J).real < 0).all()
    assert not circle_criterion(0.1, 0.5, 1.5)
    answer = common_metric(J)
    assert not answer
    assert answer.violated is not None
    assert "no quadratic metric" in answer.reason
    # 10 tanh(0.02 I) + 0.8 tanh(I) under a bounded push: two oscillations attract
    I = np.linspace(-6, 6, 61)
    assert not common_metric(loops(0.1, 0.2 / np.cosh(0.02 * I) ** 2 + 0.8 / np.cosh(I) ** 2))
    assert common_metric(loops(0.65, breathing))  # more damping repairs it


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
    found = condition_metric(corners, search_metric(corners)[0])
    assert contraction_rate(corners, found).min() > 0
    assert np.linalg.cond(found) == pytest.approx(best, rel=0.02)
    with pytest.raises(ValueError, match="not a common metric"):
        condition_metric(corners, np.diag([1.0, 100.0]))


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
    assert answer.rate == pytest.approx(rates_in(vertices, answer.metric, h).min())
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
    assert search_metric(pair)[0] is None


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
        assert rates_in(J[None], metric, h)[0] >= rate - 1e-9
    assert rate >= 0.89 * min(p.rate for p in parts)
    with pytest.raises(ValueError, match="positive rate"):
        compose_hierarchical([np.eye(1)], [0.0], {})
    with pytest.raises(ValueError, match="i < j"):
        compose_hierarchical([np.eye(1)] * 2, [1.0, 1.0], {(1, 0): np.ones((1, 1, 1))})
