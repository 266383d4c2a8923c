"""Eigenvectors followed along a path: no jump in order, sign or scale."""

import numpy as np
import pytest

from cmc.theory.auxiliary import decompose
from cmc.theory.tracking import Tracker, track

NAMES = ("T_y", "T_a", "Lambda", "R")


def turning_path(n, steps, seed=0, turns=3.0):
    """A smooth path whose eigenvectors turn right round and whose eigenvalues cross."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, steps)
    skew = rng.normal(size=(n, n))
    skew = skew - skew.T
    values, vectors = np.linalg.eig(skew / np.linalg.norm(skew, ord=2))
    phase = np.exp(2.0 * np.pi * turns * np.outer(t, values))
    rotation = ((vectors * phase[:, None, :]) @ np.linalg.inv(vectors)).real
    shear = np.eye(n) + 0.15 * np.sin(2.0 * np.pi * t)[:, None, None] * rng.normal(size=(n, n))
    speed = np.arange(1, n + 1)
    eigenvalues = -4.0 - speed + 2.0 * np.sin(2.0 * np.pi * np.outer(t, speed) + speed)
    V = rotation @ shear
    f_y = V @ (eigenvalues[..., None] * np.linalg.inv(V))
    f_u = np.eye(n) + 0.3 * np.cos(3.0 * t)[:, None, None] * rng.normal(size=(n, n)) / n
    return f_y, f_u


def jumps(array):
    """Largest change of any matrix from one step to the next, relative to its size."""
    step = np.linalg.norm(np.diff(array, axis=0), axis=(-2, -1))
    return float((step / np.linalg.norm(array, axis=(-2, -1)).max()).max())


@pytest.mark.parametrize(("n", "steps"), [(2, 50_000), (3, 30_000), (6, 20_000)])
def test_no_jump_on_a_hundred_thousand_steps(n, steps):
    f_y, f_u = turning_path(n, steps)
    space = track(f_y, f_u)
    for name in NAMES:
        assert jumps(getattr(space, name)) < 0.02, name
    # sorting anew at each step does jump: the path is a real test
    assert jumps(decompose(f_y, f_u).T_y) > 0.3
    # and the tracked space is a decomposition at every step
    Lambda = space.T_y @ f_y @ np.linalg.inv(space.T_y)
    np.testing.assert_allclose(Lambda, space.Lambda, atol=1e-9)
    np.testing.assert_allclose(space.T_y @ f_u @ space.T_a, space.R, atol=1e-10)
    assert np.abs(np.tril(space.R, -1)).max() == 0.0
    np.testing.assert_allclose(np.linalg.norm(np.linalg.inv(space.T_y), axis=-2), 1.0)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_online_tracker_gives_the_same_as_the_whole_path(n):
    f_y, f_u = turning_path(n, 800, seed=1) if n > 1 else (-np.ones((9, 1, 1)), np.ones((9, 1, 1)))
    whole, tracker = track(f_y, f_u), Tracker()
    for k in range(len(f_y)):
        step = tracker.update(f_y[k], f_u[k])
        for name in NAMES:
            np.testing.assert_allclose(getattr(step, name), getattr(whole, name)[k], atol=1e-7)


@pytest.mark.parametrize("n", [2, 4])
def test_modes_keep_their_place_through_an_exact_crossing(n):
    t = np.linspace(-1.0, 1.0, 201)
    V = np.eye(n) + 0.3 * np.random.default_rng(2).normal(size=(n, n))
    slopes = np.array([1.0, -1.0, -2.0, 0.0])[:n]
    eigenvalues = np.array([-3.0, -3.0, -3.0, -8.0])[:n] + np.outer(t, slopes)
    f_y = V @ (eigenvalues[..., None] * np.linalg.inv(V))
    space = track(f_y, np.eye(n))
    order = np.argsort(-eigenvalues[0])
    np.testing.assert_allclose(space.eigenvalues, eigenvalues[:, order], atol=1e-10)
    assert jumps(space.T_y) < 1e-6
    tracker = Tracker()
    for k in range(len(t)):
        np.testing.assert_allclose(tracker.update(f_y[k], np.eye(n)).T_y, space.T_y[k], atol=1e-9)


def test_the_start_has_the_default_order_and_a_constant_path_stays():
    f_y, f_u = turning_path(3, 5, seed=4)
    np.testing.assert_allclose(track(f_y, f_u).T_y[0], decompose(f_y[0], f_u[0]).T_y, atol=1e-12)
    still = track(np.tile(f_y[0], (4, 1, 1)), f_u[0])
    assert jumps(still.T_y) < 1e-12


def test_reset_forgets():
    tracker = Tracker()
    for f_y, wanted in ((np.diag([-1.0, -2.0]), [-1, -2]), (np.diag([-2.0, -1.0]), [-2, -1])):
        np.testing.assert_array_equal(tracker.update(f_y, np.eye(2)).eigenvalues, wanted)
    tracker.reset()
    np.testing.assert_array_equal(tracker.update(f_y, np.eye(2)).eigenvalues, [-1, -2])


def test_bad_input():
    with pytest.raises(ValueError, match=r"f_y_path needs shape \(time, n, n\)"):
        track(-np.eye(2), np.eye(2))
    tracker = Tracker()
    with pytest.raises(ValueError, match=r"f_y needs shape \(n, n\)"):
        tracker.update(np.stack([np.diag([-1.0, -2.0])] * 3), np.eye(2))
    tracker.update(np.diag([-1.0, -2.0]), np.eye(2))
    with pytest.raises(ValueError, match="reset"):
        tracker.update(np.diag([-1.0, -2.0, -3.0]), np.eye(3))
