"""Latent Jacobians from data: exact when linear, noisy as statistics says, poor data refused."""

import warnings

import numpy as np
import pytest
from scipy.linalg import expm

from cmc.theory.identification import PoorDataError, complex_step, differences, fit_latent


def transitions(f_y, f_u, f_0, dt, count, noise=0.0, seed=0):
    """Random (y, u, y_next) of a linear plant, from the matrix exponential."""
    rng = np.random.default_rng(seed)
    n, m = np.shape(f_u)
    generator = np.zeros((n + m + 1, n + m + 1))
    generator[:n] = np.column_stack([f_y, f_u, f_0])
    step = expm(generator * dt)
    y, u = rng.normal(size=(count, n)), rng.normal(size=(count, m))
    after = np.column_stack([y, u, np.ones(count)]) @ step[:n].T
    return y, u, after + noise * rng.normal(size=after.shape)


@pytest.mark.parametrize("dt", [1e-3, 0.02, 0.3])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_linear_plants_are_recovered_at_any_sample_time(dt, n):
    rng = np.random.default_rng(n)
    f_y, f_u, f_0 = (
        rng.normal(size=(n, n)) - 2 * np.eye(n),
        rng.normal(size=(n, n)),
        rng.normal(size=n),
    )
    fit = fit_latent(*transitions(f_y, f_u, f_0, dt, 50), dt)
    np.testing.assert_allclose(fit.f_y, f_y, atol=1e-8)
    np.testing.assert_allclose(fit.f_u, f_u, atol=1e-8)
    np.testing.assert_allclose(fit.f_0, f_0, atol=1e-8)
    assert fit.residual.max() < 1e-12


def test_error_falls_with_the_square_root_of_the_data_and_the_residual_shows_the_noise():
    truth = (np.array([[-3.0, 1.0], [0.5, -2.0]]), np.array([[1.0, 2.0], [1.5, 1.0]]), [0.1, 0.2])
    error = []
    for count in (200, 20_000):
        runs = [
            fit_latent(*transitions(*truth, 0.05, count, 0.01, seed), 0.05) for seed in range(8)
        ]
        error.append(np.mean([np.abs(r.f_u - truth[1]).mean() for r in runs]))
    assert error[0] / error[1] == pytest.approx(10, rel=0.35)
    assert runs[0].residual == pytest.approx([0.01, 0.01], rel=0.05)


def test_poor_data_are_refused():
    y, u, after = transitions(-np.eye(2), np.eye(2), [0, 0], 0.1, 50)
    for poor in ((y[:4], u[:4], after[:4]), (y, np.column_stack([u[:, 0]] * 2), after)):
        with pytest.raises(PoorDataError, match="tell 5 coefficients"):
            fit_latent(*poor, 0.1)
    with pytest.raises(PoorDataError, match="sample faster"):
        fit_latent(y, u, -0.5 * y + u, 0.1)


def test_a_sample_time_that_cannot_tell_a_turn_from_its_alias_is_warned_of():
    pair = np.array([[-0.2, 5.0], [-5.0, -0.2]])
    data = transitions(pair, np.eye(2), [0, 0], 0.63, 60)
    with pytest.warns(UserWarning, match=r"dt = 0\.63 s .* 3\.13 rad a sample, .* 3\.15 rad looks"):
        fit = fit_latent(*data, 0.63)
    assert fit.f_y[0, 1] == pytest.approx(5.0 - 2 * np.pi / 0.63)  # the alias, not the truth
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fit_latent(*transitions(pair, np.eye(2), [0, 0], 0.3, 60), 0.3)
    np.testing.assert_allclose(fit.f_y, pair, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda y, u, a: (y, u[:-1], a, 0.1), "u needs shape"),
        (lambda y, u, a: (y, u, a[:, :1], 0.1), "y_next needs shape"),
        (lambda y, u, a: (y[:, 0], u, a, 0.1), r"y needs shape \(N, n\)"),
        (lambda y, u, a: (y * np.nan, u, a, 0.1), "y needs finite"),
        (lambda y, u, a: (y, "u", a, 0.1), "u needs real numbers"),
        (lambda y, u, a: (y, u, a, 0.0), "dt needs positive"),
        (lambda y, u, a: (y, u, 0.9 * y + u, 1e-320), "dt: too large or too small"),
    ],
)
def test_bad_arguments_are_named(change, message):
    data = transitions(-np.eye(2), np.eye(2), [0, 0], 0.1, 20)
    with pytest.raises((ValueError, TypeError), match=message):
        fit_latent(*change(*data))


def test_jacobians_of_a_function_by_differences_and_by_a_complex_step():
    def f(x):
        return np.stack([np.sin(x[..., 0]) * x[..., 1], x[..., 0] ** 2, x[..., 1]], axis=-1)

    x = np.random.default_rng(0).normal(size=(5, 2))
    wanted = np.zeros((5, 3, 2))
    wanted[:, 0, 0], wanted[:, 0, 1] = np.cos(x[:, 0]) * x[:, 1], np.sin(x[:, 0])
    wanted[:, 1, 0], wanted[:, 2, 1] = 2 * x[:, 0], 1.0
    np.testing.assert_allclose(complex_step(f, x), wanted, rtol=1e-14)
    np.testing.assert_allclose(differences(f, x), wanted, atol=1e-8)
    np.testing.assert_allclose(differences(f, x, [1e-5, 1e-4]), wanted, atol=1e-7)
    with pytest.raises(ValueError, match="step needs"):
        differences(f, x, [1e-5] * 3)
    with pytest.raises(ValueError, match="step needs positive"):
        differences(f, x, 0.0)
