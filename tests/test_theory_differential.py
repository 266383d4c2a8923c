"""Blocks of F against simulated closed loops, and the margins of both theorems."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.differential import (
    F1,
    F2,
    F,
    F_without_integral,
    Theta_M,
    blocks,
    regroup,
    subsystems,
)
from cmc.theory.margins import (
    frame_motion,
    module_eigenvalues,
    slope_floor,
    symmetric_bound,
    theorem1_margin,
    theorem2_margin,
    transient_factor,
)

RNG = np.random.default_rng(0)
SLOPES = np.array([[-1.5, -0.8], [-0.4, -2.0]])


def plant(y, u):
    """A nonlinear plant with full Jacobians."""
    return np.array([-2 * y[0] + np.sin(y[1]) + u[0] + 2 * u[1], np.tanh(y[0]) - y[1] + 3 * u[0]])


def plant_jacobians(y):
    f_y = np.array([[-2.0, np.cos(y[1])], [1.0 / np.cosh(y[0]) ** 2, -1.0]])
    return f_y, np.array([[1.0, 2.0], [3.0, 0.0]])


def frame(t):
    """A transform that moves for t < 2 and then stays; its derivative is worked out by hand."""
    phase = 0.25 * min(t, 2.0) * (4.0 - min(t, 2.0))
    rate = 0.25 * (4.0 - 2.0 * t) if t < 2.0 else 0.0
    c, s = np.cos(phase), np.sin(phase)
    T_y = np.array([[1.2 * c, -s], [s, c]])
    return T_y, rate * np.array([[-1.2 * s, -c], [c, -s]])


def test_F_predicts_how_two_simulated_trajectories_separate():
    """The reference integrates y and int z in the original coordinates."""
    T_a = np.array([[0.9, 0.3], [-0.2, 1.1]])
    p, q = SLOPES[:, 0], SLOPES[:, 1]

    def loop(t, state):
        y, integral = state[:2], state[2:4]
        z = frame(t)[0] @ y
        y_dot = plant(y, T_a @ (p * z + q * integral))
        # delta obeys F along this trajectory
        f_y, f_u = plant_jacobians(y)
        T_y, T_y_dot = frame(t)
        space = AuxiliarySpace.from_transforms(T_y, T_a, f_y, f_u)
        return np.concatenate([y_dot, z, F(space, SLOPES, T_y_dot) @ state[4:]])

    def z_and_a(t, state):
        z = frame(t)[0] @ state[:2]
        return np.concatenate([z, p * z + q * state[2:4]])

    start, nudge = np.array([1.0, -0.7, 0.2, 0.1]), 1e-5 * np.array([1.0, 2.0, -1.0, 0.5])
    delta = (z_and_a(0.0, start + nudge) - z_and_a(0.0, start - nudge)) / 2e-5

    def end(state):
        for span in ((0.0, 2.0), (2.0, 3.0)):  # the frame stops with a corner at t = 2
            state = solve_ivp(loop, span, state, method="DOP853", rtol=1e-9, atol=1e-12).y[:, -1]
        return state

    up, down = (end(np.concatenate([start + k * nudge, delta])) for k in (1, -1))
    measured = (z_and_a(3.0, up) - z_and_a(3.0, down)) / 2e-5
    predicted = (up[4:] + down[4:]) / 2.0
    np.testing.assert_allclose(measured, predicted, rtol=1e-6, atol=1e-8)
    assert np.abs(measured).max() > 1e-3


def random_space(number, n=2, seed=1):
    rng = np.random.default_rng(seed)
    T_y = np.eye(n) + 0.3 * rng.normal(size=(number, n, n))
    T_a, f_y, f_u = rng.normal(size=(3, number, n, n))
    return AuxiliarySpace.from_transforms(T_y, T_a, f_y, f_u), rng


def test_F_is_F1_plus_F2_and_its_rows_are_tied_by_the_policy():
    space, rng = random_space(50, n=3)
    slopes, T_y_dot = rng.normal(size=(50, 3, 2)), rng.normal(size=(50, 3, 3))
    total = F(space, slopes, T_y_dot)
    np.testing.assert_allclose(total, F1(space, slopes) + F2(space, slopes, T_y_dot), atol=1e-12)
    # da' = Pi_1 dz' + Pi_2 dz (v)
    d = rng.normal(size=(50, 6, 1))
    rate = total @ d
    upper = slopes[..., :1] * rate[:, :3] + slopes[..., 1:] * d[:, :3]
    np.testing.assert_allclose(rate[:, 3:], upper, atol=1e-12)
    assert np.abs(F2(space, slopes, 0.0 * T_y_dot)).max() == 0.0


def test_frozen_F_is_similar_to_the_closed_loop_in_the_original_coordinates():
    space, rng = random_space(200)
    slopes = rng.normal(size=(200, 2, 2))
    f_y, f_u = space.V @ space.Lambda @ space.T_y, space.V @ space.R @ np.linalg.inv(space.T_a)
    K_1, K_2 = (space.T_a @ (slopes[..., j, None] * space.T_y) for j in (0, 1))
    # y' = f_y y + f_u u, u' = K_1 y' + K_2 y
    original = np.block([[f_y, f_u], [K_1 @ f_y + K_2, K_1 @ f_u]])
    T = Theta_M(space)
    np.testing.assert_allclose(
        np.linalg.inv(T) @ F(space, slopes) @ T, original, rtol=1e-6, atol=1e-7
    )


def test_regrouping_only_reorders():
    space, rng = random_space(20, n=3)
    slopes = rng.normal(size=(20, 3, 2))
    whole = F(space, slopes)
    grouped, parts = regroup(whole), subsystems(whole)
    np.testing.assert_allclose(np.poly(grouped[0]), np.poly(whole[0]), rtol=1e-8, atol=1e-8)
    A_blk, B_blk, C_blk, D_blk = blocks(space, slopes)
    for i in range(3):
        for j in range(3):
            rows, columns = slice(2 * i, 2 * i + 2), slice(2 * j, 2 * j + 2)
            np.testing.assert_array_equal(grouped[:, rows, columns], parts[:, i, j])
            expected = [[A_blk[4, i, j], B_blk[4, i, j]], [C_blk[4, i, j], D_blk[4, i, j]]]
            np.testing.assert_array_equal(parts[4, i, j], expected)


def test_the_explicit_solution_is_block_triangular_with_self_blocks_as_in_the_appendix():
    rng = np.random.default_rng(3)
    V, f_u = rng.normal(size=(2, 300, 4, 4))
    f_y = V @ (-rng.uniform(0.1, 5.0, size=(300, 4, 1)) * np.linalg.inv(V))
    keep = np.linalg.cond(V) < 1e3
    space, slopes = decompose(f_y[keep], f_u[keep]), -rng.uniform(0.1, 3.0, size=(keep.sum(), 4, 2))
    parts = subsystems(F(space, slopes))
    below = np.tril_indices(4, -1)
    assert np.abs(parts[:, below[0], below[1]]).max() == 0.0
    # couplings act from z and a of later modules on earlier ones
    above = np.triu_indices(4, 1)
    assert np.abs(parts[:, above[0], above[1]]).max() > 0.1
    # a policy whose networks share inputs loses the structure
    shared = space.Lambda * slopes[..., :1] + rng.normal(size=(keep.sum(), 4, 4))
    full = np.block([[space.Lambda, space.R], [shared, slopes[..., :1] * space.R]])
    assert np.abs(subsystems(full)[:, below[0], below[1]]).max() > 0.1


def admissible(number, seed=5):
    rng = np.random.default_rng(seed)
    R = rng.choice([-1.0, 1.0], number) * rng.uniform(0.1, 3.0, number)
    Lambda = -rng.uniform(0.1, 3.0, number)
    slopes = -np.sign(R)[:, None, None] * rng.uniform(0.1, 3.0, (number, 1, 2))
    eye = np.ones((number, 1, 1))
    return AuxiliarySpace(eye, eye, Lambda[:, None, None], R[:, None, None]), slopes


def test_margins_of_theorem_2_are_trace_and_determinant_and_decide_decay():
    rng = np.random.default_rng(6)
    space = AuxiliarySpace(*np.ones((2, 3000, 1, 1)), *rng.normal(size=(2, 3000, 1, 1)))
    slopes = rng.normal(size=(3000, 1, 2))
    own = subsystems(F(space, slopes))[:, 0, 0]
    margin = theorem2_margin(space, slopes)[:, 0]
    np.testing.assert_allclose(margin[:, 0], -np.trace(own, axis1=-2, axis2=-1), atol=1e-12)
    np.testing.assert_allclose(margin[:, 1], np.linalg.det(own), atol=1e-12)
    decays = np.linalg.eigvals(own).real.max(axis=-1) < 0.0
    np.testing.assert_array_equal((margin > 0.0).all(axis=-1), decays)
    apart = np.abs(
        module_eigenvalues(space, slopes)[:, 0, :, None] - np.linalg.eigvals(own)[:, None]
    )
    assert apart.min(axis=-1).max() < 1e-6
    assert apart.min(axis=-2).max() < 1e-6


def test_admissible_modules_decay_but_many_oscillate():
    space, slopes = admissible(20_000)
    roots = module_eigenvalues(space, slopes)
    assert (roots.real < 0.0).all()
    share = float(np.mean(np.abs(roots[..., 0].imag) > 0.0))
    assert 0.05 < share < 0.5


def test_alpha_is_not_a_rate():
    space = AuxiliarySpace(np.eye(1), np.eye(1), [[-1.0]], [[1.0]])
    slopes = [[-9999.0, -1.0]]
    assert theorem2_margin(space, slopes).min() == 1.0
    assert module_eigenvalues(space, slopes)[0, 0].real == pytest.approx(-1e-4, rel=1e-6)


def test_theorem_1_is_far_stronger_than_theorem_2():
    rng = np.random.default_rng(7)
    R, Lambda = np.zeros((2, 20_000, 2, 2))
    R[:, [0, 1], [0, 1]], R[:, 0, 1] = (
        10.0 ** rng.uniform(-1, 1, (20_000, 2)),
        rng.normal(size=20_000),
    )
    Lambda[:, [0, 1], [0, 1]] = -(10.0 ** rng.uniform(-1, 1, (20_000, 2)))
    eye = np.broadcast_to(np.eye(2), R.shape)
    space = AuxiliarySpace(eye, eye, Lambda, R)
    slopes = -(10.0 ** rng.uniform(-1, 1, (20_000, 2, 2)))
    assert (theorem2_margin(space, slopes) > 0.0).all()
    assert np.mean(theorem1_margin(space, slopes) > 0.0) < 0.2
    # but every one of these frozen systems decays
    assert np.linalg.eigvals(F(space, slopes)).real.max() < 0.0


def test_theorem_1_margin_is_the_rate_and_the_printed_beta_is_twice_it():
    rng = np.random.default_rng(8)
    space = AuxiliarySpace(np.eye(1), np.eye(1), [[-2.0]], [[1.0]])
    slopes = [[-1.0, -3.0]]  # F = [[-2, 1], [-1, -1]]
    rate = float(theorem1_margin(space, slopes))
    assert rate == pytest.approx(1.0)
    total = F(space, slopes)
    printed = -np.linalg.eigvalsh(total + total.T).max()
    assert printed == pytest.approx(2.0 * rate)
    for t in (0.1, 0.5, 2.0):
        growth = np.linalg.norm(expm(t * total), ord=2)
        assert growth <= np.exp(-rate * t) + 1e-12
        assert growth > np.exp(-printed * t)
    # the moving frame costs max(lmax(F2), 0), and the sum bounds the whole of F
    for _ in range(50):
        dot = rng.normal(size=(1, 1))
        margin = float(theorem1_margin(space, slopes, dot))
        assert margin <= rate + 1e-12
        assert symmetric_bound(F(space, slopes, dot)) <= -margin + 1e-12


def test_slope_floor_is_where_an_unstable_mode_starts_to_decay():
    f_y = np.array([[1.0, 0.5], [0.2, -2.0]])
    space = decompose(f_y, [[1.0, 0.4], [-0.3, 0.8]])
    floor = slope_floor(space)
    assert floor[0] > 0.0
    assert floor[1] == 0.0
    for factor, decays in ((0.99, False), (1.01, True)):
        slopes = np.array([[-factor * floor[0], -0.1], [-0.1, -0.1]])
        assert (np.linalg.eigvals(F(space, slopes)).real.max() < 0.0) == decays
    with_margin = np.stack([-slope_floor(space, 0.3) - 1e-9, [-1.0, -1.0]], axis=-1)
    assert theorem2_margin(space, with_margin)[:, 0].min() == pytest.approx(0.3, abs=1e-6)
    with pytest.raises(ValueError, match="alpha"):
        slope_floor(space, -1.0)
    with pytest.raises(ValueError, match="zero on its diagonal"):
        slope_floor(AuxiliarySpace(np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))))


def test_without_the_integral_F_is_singular_but_z_alone_contracts():
    space = decompose([[-2.0, 1.0], [0.5, -1.0]], [[1.0, 2.0], [1.5, 1.0]])
    slopes = np.array([[-1.0, 0.0], [-0.5, 0.0]])
    roots = np.sort(np.linalg.eigvals(F(space, slopes)).real)
    np.testing.assert_allclose(roots[-2:], 0.0, atol=1e-12)
    alone = np.sort(np.linalg.eigvals(F_without_integral(space, slopes)).real)
    np.testing.assert_allclose(alone, roots[:2], atol=1e-9)
    np.testing.assert_allclose(
        np.sort(alone), np.sort(space.eigenvalues + space.gains * slopes[:, 0]), atol=1e-9
    )


def test_frame_motion_finds_when_the_frame_settles_and_bounds_its_stretch():
    t = np.linspace(0.0, 4.0, 2001)
    T_y = np.array([frame(time)[0] for time in t])
    motion = frame_motion(T_y, t, SLOPES)
    assert motion.settled == pytest.approx(2.0, abs=0.01)
    dots = np.array([frame(time)[1] for time in t])
    eye = np.broadcast_to(np.eye(2), T_y.shape)
    exact = F2(AuxiliarySpace(T_y, eye, eye, eye), SLOPES, dots)
    np.testing.assert_allclose(motion.norm, np.linalg.norm(exact, ord=2, axis=(-2, -1)), atol=5e-3)
    assert motion.bound == pytest.approx(motion.norm.max())
    # growth bounds what d' = F2 d does, by Coppel's inequality
    state = np.eye(4)
    for k in range(len(t) - 1):
        state = expm(exact[k] * (t[1] - t[0])) @ state
    assert 1.0 < np.linalg.norm(state, ord=2) <= motion.growth * 1.01

    still = frame_motion(np.tile(np.eye(2), (5, 1, 1)), np.arange(5.0), SLOPES)
    assert (still.settled, still.bound, still.growth) == (0.0, 0.0, 1.0)
    assert frame_motion(T_y[:900], t[:900], SLOPES).settled == np.inf


def test_distances_in_the_original_space_are_bounded_by_the_condition_of_Theta_M():
    space = decompose([[-1.0, 8.0], [0.0, -2.0]], np.eye(2))
    T = Theta_M(space)
    assert float(transient_factor(space)) == pytest.approx(np.linalg.cond(T))
    J = space.V @ space.Lambda @ space.T_y
    overshoot = max(np.linalg.norm(expm(J * t), ord=2) for t in np.linspace(0.0, 3.0, 50))
    assert 1.5 < overshoot <= float(transient_factor(space))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: F(s, np.ones(2)), r"\(\.\.\., 2, 2\)"),
        (lambda s: F(s, np.full((2, 2), np.nan)), "finite"),
        (lambda s: F(s, SLOPES, np.ones((3, 3))), "size of T_y"),
        (lambda s: F(s, SLOPES, np.full((2, 2), np.inf)), "finite"),
        (lambda s: regroup(np.eye(3)), "2n, 2n"),
        (lambda s: subsystems(np.ones((2, 4))), "n, n"),
        (lambda s: symmetric_bound(np.ones((2, 4))), "n, n"),
        (lambda s: frame_motion(np.ones((5, 2, 2)), np.arange(4.0), SLOPES), "time"),
        (
            lambda s: frame_motion(np.tile(np.eye(2), (3, 1, 1)), [0.0, 2.0, 1.0], SLOPES),
            "increase",
        ),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(ValueError, match=words):
        call(decompose(np.diag([-1.0, -2.0]), np.eye(2)))
