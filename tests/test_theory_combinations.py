"""Hierarchical and feedback combinations, constant slopes and neural policies."""

import numpy as np
import pytest
import torch

from cmc import plants
from cmc.policies import PositiveNetwork
from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.certificates import rates_in
from cmc.theory.certify import certify
from cmc.theory.combinations import (
    block_schur,
    feedback,
    possible_combinations,
    real_block_form,
    schur,
)
from cmc.theory.contraction import F, contraction_rate, slope_floor, subsystems, theorem2_margin
from cmc.theory.explicit import ComplexEigenvalueError, DefectiveMatrixError, SingularInputError
from cmc.theory.identification import differences
from cmc.theory.simulate import Loop


def random_spirals(number, seed=0, real=(-5.0, -0.05)):
    """Random 2x2 plants with a complex pair; near-singular ones (some per mille) are left out."""
    rng = np.random.default_rng(seed)
    s, w = rng.uniform(*real, number), rng.uniform(0.05, 10.0, number)
    V, f_u = rng.normal(size=(2, number, 2, 2))
    block = np.stack([np.stack([s, w], -1), np.stack([-w, s], -1)], -2)
    f_y = V @ block @ np.linalg.inv(V)
    keep = (np.linalg.cond(V) < 300.0) & (np.linalg.cond(f_u) < 1e4)
    return f_y[keep], f_u[keep], s[keep], w[keep]


def coupling_skewness(space, slopes):
    """Largest entry of F_ij + F_ji^T, i != j: zero where the coupling is skew."""
    parts, off = subsystems(F(space, slopes)), ~np.eye(space.n, dtype=bool)
    mirrored = np.moveaxis(parts, (-4, -3, -2, -1), (-3, -4, -1, -2))
    return np.abs((parts + mirrored)[..., off, :, :]).max(axis=(-3, -2, -1), initial=0.0)


def test_the_block_form_is_skew_and_contracting_on_twenty_thousand_plants():
    f_y, f_u, s, w = random_spirals(20_400)
    assert len(f_y) > 20_000
    slopes = -np.random.default_rng(1).uniform(0.05, 5.0, (len(f_y), 2, 2))
    built = feedback(f_y, f_u, slopes)
    # from the transforms alone, so that a wrong R or Lambda could not hide
    space = AuxiliarySpace.from_transforms(built.T_y, built.T_a, f_y, f_u)
    assert coupling_skewness(space, slopes).max() < 1e-9
    assert contraction_rate(F(space, slopes)).min() > 0.0
    np.testing.assert_allclose(space.R, built.R, atol=1e-8)
    np.testing.assert_allclose(space.Lambda, built.Lambda, atol=1e-8)
    np.testing.assert_allclose(built.eigenvalues, np.stack([s, s], axis=-1), atol=1e-7)
    p, q = slopes[..., 0], slopes[..., 1]
    wanted = (p * s[:, None] - q).prod(-1) + p.prod(-1) * w**2  # det B > 0
    np.testing.assert_allclose(np.linalg.det(space.R), wanted, rtol=1e-6)
    own = subsystems(F(space, slopes))[:, [0, 1], [0, 1]]
    symmetric = 0.5 * (own + np.swapaxes(own, -1, -2))
    np.testing.assert_allclose(
        np.linalg.det(symmetric), s[:, None] * p * np.abs(q), rtol=1e-5, atol=1e-8
    )


def test_policy_form_decays_for_every_admissible_constant_slope():
    f_y, f_u, _, _ = random_spirals(20_400, seed=2)
    slopes = -np.random.default_rng(3).uniform(0.05, 5.0, (len(f_y), 2, 2))
    space = feedback(f_y, f_u)
    back = AuxiliarySpace.from_transforms(space.T_y, space.T_a, f_y, f_u)
    np.testing.assert_allclose(back.R, np.broadcast_to(np.eye(2), back.R.shape), atol=1e-9)
    assert np.linalg.eigvals(F(back, slopes)).real.max() < 0.0
    # V = |dz|^2 - dI^T Pi_2 dI: its derivative along (z, int z) loses the rotation
    k = 17
    P, Q = np.diag(slopes[k, :, 0]), np.diag(slopes[k, :, 1])
    J = np.block([[space.Lambda[k] + P, Q], [np.eye(2), np.zeros((2, 2))]])
    M = np.block([[np.eye(2), np.zeros((2, 2))], [np.zeros((2, 2)), -Q]])
    derivative = M @ J + J.T @ M
    expected = np.zeros((4, 4))
    expected[:2, :2] = 2.0 * (np.diag(space.eigenvalues[k]) + P)
    np.testing.assert_allclose(derivative, expected, atol=1e-9)


def true_jacobian(network, T_y, T_a, f_y, f_u, state):
    """Jacobian of (y, int z) by automatic differentiation through the policy: independent of F."""
    T_y, T_a, f_y, f_u = (torch.as_tensor(np.array(m)) for m in (T_y, T_a, f_y, f_u))

    def rhs(x):
        z = T_y @ x[:2]
        a = -network(torch.stack([z, x[2:]], dim=-1))  # R = I > 0: slopes against its sign
        return torch.cat([f_y @ x[:2] + f_u @ (T_a @ a), z])

    return torch.autograd.functional.jacobian(rhs, torch.as_tensor(state)).numpy()


def test_no_certified_state_is_unstable_with_tanh_policies():
    f_y, f_u, s, _ = random_spirals(60, seed=4, real=(-2.0, 1.0))
    spaces, rng, certified = feedback(f_y, f_u), np.random.default_rng(5), 0
    for k in range(len(f_y)):
        torch.manual_seed(k)
        network = PositiveNetwork(2, hidden=(8, 8), dtype=torch.float64)
        space = AuxiliarySpace(*(getattr(spaces, m)[k] for m in ("T_y", "T_a", "Lambda", "R")))
        for _ in range(6):
            state = rng.normal(scale=2.0, size=4)
            z = space.T_y @ state[:2]
            seen = torch.as_tensor(np.stack([z, state[2:]], axis=-1))
            slopes = -network.jacobian(seen).detach().numpy()
            J = true_jacobian(network, space.T_y, space.T_a, f_y[k], f_u[k], state)
            if (theorem2_margin(space, slopes) > 1e-9).all():
                certified += 1
                assert np.linalg.eigvals(J).real.max() < 1e-12
    assert certified > 150
    assert (s > 0.0).any()  # some plants are open-loop unstable and some states refused
    assert certified < 6 * len(f_y)


def test_block_form_with_slopes_of_the_moment_misjudges_tanh_policies():
    """T_a depends on the slopes, hence on the state: the frozen verdict misses its derivative."""
    f_y, f_u, _, _ = random_spirals(40, seed=6, real=(-0.5, -0.05))
    rng, frozen_yes_true_no = np.random.default_rng(7), 0
    for k in range(len(f_y)):
        W = rng.uniform(0.5, 3.0, size=(2, 2))
        T_y = real_block_form(f_y[k])[0]

        def slopes_at(s, W=W):
            saturation = 1.0 - np.tanh((W * s).sum(-1)) ** 2
            return -W * saturation[:, None] - 0.05

        def rhs(x, W=W, T_y=T_y, k=k):
            s = np.stack([T_y @ x[:2], x[2:]], axis=-1)
            a = -np.tanh((W * s).sum(-1)) - 0.05 * s.sum(-1)
            T_a = feedback(f_y[k], f_u[k], slopes_at(s)).T_a
            return np.concatenate([f_y[k] @ x[:2] + f_u[k] @ T_a @ a, s[:, 0]])

        for _ in range(10):
            x = rng.normal(scale=2.0, size=4)
            J = np.stack([(rhs(x + d) - rhs(x - d)) / 2e-6 for d in 1e-6 * np.eye(4)], axis=-1)
            s = np.stack([T_y @ x[:2], x[2:]], axis=-1)
            space = feedback(f_y[k], f_u[k], slopes_at(s))
            assert contraction_rate(F(space, slopes_at(s))) > 0.0
            frozen_yes_true_no += np.linalg.eigvals(J).real.max() > 1e-3
    assert frozen_yes_true_no > 20


@pytest.mark.parametrize("n", [1, 2, 3, 5, 6])
def test_real_and_complex_eigenvalues_may_be_mixed(n):
    rng = np.random.default_rng(n)
    for _ in range(100):
        f_y, f_u = rng.normal(size=(2, n, n))
        f_y -= (np.linalg.eigvals(f_y).real.max() + 0.2) * np.eye(n)
        slopes = -rng.uniform(0.1, 2.0, (n, 2))
        built = feedback(f_y, f_u, slopes)
        space = AuxiliarySpace.from_transforms(built.T_y, built.T_a, f_y, f_u)
        np.testing.assert_allclose(space.Lambda, built.Lambda, atol=1e-8)
        assert coupling_skewness(space, slopes) < 1e-7
        assert contraction_rate(F(space, slopes)) > 0.0
        assert (np.diff(built.eigenvalues) <= 1e-12).all()


def test_open_loop_unstable_pairs_need_the_slope_floor():
    f_y, f_u, s, _ = random_spirals(2_000, seed=8, real=(0.05, 2.0))
    with pytest.raises(ValueError, match="slope_floor"):
        feedback(f_y[0], f_u[0], -np.ones((2, 2)))
    space = feedback(f_y, f_u)
    np.testing.assert_allclose(slope_floor(space), np.stack([s, s], axis=-1), atol=1e-9)
    rng = np.random.default_rng(9)
    steep = -slope_floor(space) - rng.uniform(0.05, 1.0, (len(s), 2))
    slopes = np.stack([steep, -rng.uniform(0.1, 2.0, steep.shape)], axis=-1)
    assert np.linalg.eigvals(F(space, slopes)).real.max() < 0.0
    flat = np.stack([-0.9 * slope_floor(space), -np.ones_like(steep)], axis=-1)
    assert np.linalg.eigvals(F(space, flat)).real.max(axis=-1).min() > 0.0


def test_counting_unknowns_proves_nothing_for_a_complex_pair():
    """For every real T_y, A_12 A_21 <= -w^2: neither coupling can be made zero."""
    rng = np.random.default_rng(10)
    f_y, _, _, w = random_spirals(200, seed=10)
    for _ in range(50):
        T_y = rng.normal(size=(2, 2))
        A = T_y @ f_y @ np.linalg.inv(T_y)
        assert (A[:, 0, 1] * A[:, 1, 0] <= -(w**2) * (1.0 - 1e-6)).all()
    for build in (decompose, schur):
        with pytest.raises(ComplexEigenvalueError, match="feedback"):
            build(f_y[0], np.eye(2))


def test_schur_is_a_hierarchy_without_eigenvectors():
    rng = np.random.default_rng(11)
    jordan = -np.eye(3) + np.diag([1.0, 1.0], 1)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for f_y in (jordan, Q @ np.diag([-1.0, -2.0, -5.0]) @ Q.T + 0.0):
        f_u = rng.normal(size=(3, 3))
        built = schur(f_y, f_u)
        space = AuxiliarySpace.from_transforms(built.T_y, built.T_a, f_y, f_u)
        np.testing.assert_allclose(built.T_y @ built.T_y.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(space.Lambda, built.Lambda, atol=1e-12)
        slopes = -rng.uniform(0.1, 2.0, (3, 2))
        parts = subsystems(F(space, slopes))
        assert np.abs(parts[np.tril_indices(3, -1)]).max() < 1e-12
        assert np.linalg.eigvals(F(space, slopes)).real.max() < 0.0
        assert (built.gains > 0.0).all()


F_U = np.array([[1.0, 0.3], [-0.5, 1.2]])
REAL, PAIR = np.array([[-2.0, 1.0], [0.5, -1.0]]), np.array([[-0.4, 2.0], [-2.0, -0.4]])
JORDAN = np.array([[-1.0, 1.0], [0.0, -1.0]])


@pytest.mark.parametrize(
    ("f_y", "f_u", "flags", "name", "words"),
    [
        (REAL, F_U, "yyyyy", "hierarchical", "one way"),
        (PAIR, F_U, "nnyyy", "hierarchical", "complex pair"),
        (JORDAN, F_U, "nynny", "hierarchical", "Schur"),
        (PAIR + np.eye(2), F_U, "nnyny", "feedback (policies)", "0.6"),
        (REAL, np.ones((2, 2)), "nnnnn", "schur", "singular"),
    ],
)
def test_possible_combinations(f_y, f_u, flags, name, words):
    found = possible_combinations(f_y, f_u)
    assert "".join("ny"[option.possible] for option in found) == flags
    assert words in {option.name: option.reason for option in found}[name]
    assert all(option.reason for option in found)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: feedback(JORDAN, np.eye(2)), DefectiveMatrixError, "Schur"),
        (lambda: feedback(PAIR, np.ones((2, 2))), SingularInputError, "singular"),
        (lambda: feedback(PAIR, np.eye(2), [[-1.0, -1.0], [-1.0, 0.5]]), ValueError, "negative"),
        (lambda: feedback(PAIR * np.nan, np.eye(2)), ValueError, "f_y needs finite"),
        (lambda: feedback(PAIR, np.eye(2), np.ones(2)), ValueError, "slopes needs shape"),
        (lambda: feedback(PAIR, np.eye(2), -np.ones((3, 2))), ValueError, r"\(\.\.\., 2, 2\)"),
        (lambda: real_block_form("a"), TypeError, "f_y needs real numbers"),
        (lambda: schur([REAL, REAL], F_U), ValueError, r"f_y needs shape \(n, n\)"),
        (lambda: block_schur(REAL, [F_U, F_U]), ValueError, r"f_u needs shape \(2, 2\)"),
        (lambda: possible_combinations([REAL, REAL], F_U), ValueError, r"shape \(n, n\)"),
    ],
)
def test_errors(call, error, words):
    with pytest.raises(error, match=words):
        call()


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_block_schur_is_a_hierarchy_of_modes_and_rotations(n):
    rng = np.random.default_rng(n)
    for _ in range(50):
        f_y, f_u = rng.normal(size=(2, n, n))
        built = block_schur(f_y, f_u)
        space = AuxiliarySpace.from_transforms(built.T_y, built.T_a, f_y, f_u)
        np.testing.assert_allclose(space.Lambda, built.Lambda, atol=1e-7)
        np.testing.assert_allclose(space.R, np.eye(n), atol=1e-7)
        below = np.diagonal(built.Lambda, -1)
        assert (np.abs(np.tril(built.Lambda, -2)) < 1e-9).all()
        for k in np.flatnonzero(np.abs(below) > 1e-9):  # a rotation, w > 0
            block = built.Lambda[k : k + 2, k : k + 2]
            np.testing.assert_allclose(block[0, 1], -block[1, 0], rtol=1e-6)
            np.testing.assert_allclose(block[0, 0], block[1, 1], rtol=1e-6, atol=1e-9)
            assert block[0, 1] > 0


@pytest.mark.parametrize("h", [None, 0.05])
def test_a_defective_complex_pair_is_certified_as_a_hierarchy_of_rotations(h):
    from test_theory_certify import policy

    pair = np.array([[-1.5, 1.0], [-1.0, -1.5]])
    A = np.block([[pair, np.eye(2)], [np.zeros((2, 2)), pair]])
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0]
    plant = plants.LinearPlant(Q @ A @ Q.T, np.eye(4) + 0.3 * Q)
    space = block_schur(plant.A, plant.B)
    with pytest.raises(DefectiveMatrixError):
        feedback(plant.A, plant.B)
    pol = policy((0.8, 0.5), (0.2, 0.1), n=4)
    answer = certify(pol, plant, transforms=space, h=h)
    assert answer, str(answer)
    s = np.random.default_rng(1).normal(size=(200, 8)) * 3
    loop = Loop(plant, pol, space)
    move = (lambda x: loop.field(0.0, x)) if h is None else (lambda x: loop.step(x, h))
    to_aux = np.block([[space.T_y, np.zeros((4, 4))], [np.zeros((4, 4)), np.eye(4)]])
    J = to_aux @ differences(move, s) @ np.linalg.inv(to_aux)
    assert rates_in(J, answer.metric, h).min() >= answer.rate - 1e-6
