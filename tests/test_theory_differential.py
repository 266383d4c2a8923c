"""Blocks of F against simulated closed loops, and the margins of both theorems."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.contraction import (
    F2,
    F,
    Theta_M,
    blocks,
    subsystems,
    theorem1_margin,
    theorem2_margin,
)

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


def test_F_is_the_frozen_one_plus_F2_and_its_rows_are_tied_by_the_policy():
    space, rng = random_space(50, n=3)
    slopes, T_y_dot = rng.normal(size=(50, 3, 2)), rng.normal(size=(50, 3, 3))
    total = F(space, slopes, T_y_dot)
    still, moving = F(space, slopes), F2(space, slopes, T_y_dot)
    np.testing.assert_allclose(total, still + moving, atol=1e-12)
    # da' = Pi_1 dz' + Pi_2 dz (v)
    d = rng.normal(size=(50, 6, 1))
    rate = total @ d
    upper = slopes[..., :1] * rate[:, :3] + slopes[..., 1:] * d[:, :3]
    np.testing.assert_allclose(rate[:, 3:], upper, atol=1e-12)
    assert np.abs(F2(space, slopes, 0.0 * T_y_dot)).max() == 0.0


def test_theorem_1_bounds_how_fast_distances_grow_and_is_met_where_the_frame_is_still():
    space, rng = random_space(50)
    slopes, T_y_dot = rng.normal(size=(50, 2, 2)), rng.normal(size=(50, 2, 2))
    for moving in (None, T_y_dot):
        margin = theorem1_margin(space, slopes, moving)
        for t in (0.01, 0.3):
            grown = np.linalg.norm(expm(t * F(space, slopes, moving)), 2, axis=(-2, -1))
            assert (grown <= np.exp(-margin * t) * (1 + 1e-9)).all()
    soon = np.linalg.norm(expm(1e-6 * F(space, slopes)), 2, axis=(-2, -1))
    np.testing.assert_allclose(np.log(soon) / 1e-6, -theorem1_margin(space, slopes), rtol=1e-3)


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


def test_subsystems_only_reorder():
    space, rng = random_space(20, n=3)
    slopes = rng.normal(size=(20, 3, 2))
    whole, order = F(space, slopes), [0, 3, 1, 4, 2, 5]
    parts, four = subsystems(whole), blocks(space, slopes)
    grouped = np.block([[parts[:, i, j] for j in range(3)] for i in range(3)])
    np.testing.assert_array_equal(grouped, whole[:, order][:, :, order])
    for i, j in np.ndindex(3, 3):
        expected = np.reshape([block[4, i, j] for block in four], (2, 2))
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
