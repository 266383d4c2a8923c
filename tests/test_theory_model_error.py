import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from cmc import plants
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certificates import common_metric, loop_jacobian
from cmc.theory.contraction import contraction_rate
from cmc.theory.differential import F1
from cmc.theory.model_error import (
    error_size,
    model_error_metric_test,
    model_error_paper_test,
    nominal_metric,
    tolerated_error,
)

COUNT = 20_000
EYE = np.eye(2)


def stable(rng, count, n=4):
    J = rng.normal(size=(count, n, n))
    shift = np.linalg.eigvals(J).real.max(axis=-1) + rng.uniform(0.2, 1.0, count)
    return J - shift[:, None, None] * np.eye(n)


def peg_loops(rng, count):
    """F1 and J of the nominal peg and of one shifted as in the paper, under the same policy."""
    surface = {
        "K_sur": rng.uniform(1, 31, count),
        "surface_sin": rng.uniform(-0.01, 0.01, count),
        "surface_cos": rng.uniform(-0.01, 0.01, count),
    }
    sign = rng.choice([-1.0, 1.0], (3, count))
    shifted = {
        "tau_x": 0.0437 * (1 + 0.5 * sign[0]),
        "tau_z": 0.01 * (1 + 0.5 * sign[1]),
        "K_sur": 2 * surface["K_sur"],
        "surface_sin": surface["surface_sin"] * (1 + 0.5 * sign[2]),
        "surface_cos": surface["surface_cos"] * (1 + 0.5 * sign[2]),
    }
    y = np.stack([rng.uniform(1, 3, count), rng.uniform(-2.5, -0.5, count)], -1)
    u = np.stack([rng.uniform(1, 3, count), rng.uniform(-3, 1, count)], -1)
    slopes = -rng.uniform(0.02, 1.0, (count, 2, 2)) * np.array([1.0, 5.0])
    loops = []
    for parameters in (surface, shifted):
        peg = plants.Peg(**parameters)
        space = AuxiliarySpace.from_transforms(EYE, EYE, peg.f_y(y, u), peg.f_u(y, u))
        p, q = slopes[..., 0], slopes[..., 1]
        loops.append((F1(space, slopes), loop_jacobian(space.Lambda, space.R, p, q)))
    return loops


def test_paper_inequality_never_holds_at_the_paper_shift_although_every_loop_is_stable():
    (F1_hat, nominal), (F1_real, real) = peg_loops(np.random.default_rng(0), COUNT)
    assert (np.linalg.eigvals(real).real.max(axis=-1) < 0).all()
    verdict = model_error_paper_test(F1_hat, F1_real)
    assert verdict.order.sum() == 0
    assert verdict.premise.mean() < 1e-3
    # even without any error the right-hand half fails
    assert model_error_paper_test(F1_hat, F1_hat).order.all()
    found = model_error_metric_test(nominal, real)
    assert found.nominal_rate.min() > 0
    assert found.holds.mean() > 0.7


def test_passing_the_metric_test_implies_stability_and_its_rate_bounds_the_decay():
    rng = np.random.default_rng(1)
    nominal = stable(rng, 3000)
    real = nominal + rng.normal(size=nominal.shape) * rng.uniform(0, 0.5, (3000, 1, 1))
    found = model_error_metric_test(nominal, real)
    abscissa = np.linalg.eigvals(real).real.max(axis=-1)
    assert 0.1 < found.holds.mean() < 0.9
    assert (abscissa[found.holds] < 0).all()
    assert (found.real_rate <= -abscissa + 1e-9).all()
    same = model_error_metric_test(nominal, nominal)
    assert same.holds.all()
    np.testing.assert_allclose(same.real_rate, same.nominal_rate)


def test_order_holds_exactly_for_errors_that_obey_the_matrix_equation():
    rng = np.random.default_rng(2)
    n, count = 2, 500
    P = rng.normal(size=(count, n, n))
    root = rng.normal(size=(count, n, n))
    D_A = -root @ np.swapaxes(root, -1, -2)
    D_B = D_A @ np.swapaxes(P, -1, -2)
    stack = np.concatenate([np.broadcast_to(np.eye(n), P.shape), P], axis=-2)

    def order(first, second):
        error = stack @ np.concatenate([first, second], axis=-1)
        hat = rng.normal(size=error.shape)
        return model_error_paper_test(hat, hat + error).order

    assert order(D_A, D_B).all()
    assert not order(-D_A, -D_B).any()
    assert not order(D_A, D_B + 1e-4 * rng.normal(size=D_B.shape)).any()
    assert not order(rng.normal(size=P.shape), rng.normal(size=P.shape)).any()


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_nominal_metric_solves_the_lyapunov_equation_of_scipy(share):
    J = stable(np.random.default_rng(3), 20)
    for loop, metric in zip(J, nominal_metric(J, share=share), strict=True):
        b = share * -np.linalg.eigvals(loop).real.max()
        expected = solve_continuous_lyapunov((loop + b * np.eye(4)).T, -np.eye(4))
        np.testing.assert_allclose(metric, expected, rtol=1e-7, atol=1e-9)
        assert contraction_rate(loop, metric) >= b


def test_any_error_smaller_than_the_tolerated_one_is_survived():
    rng = np.random.default_rng(4)
    nominal = stable(rng, 200)
    metric = nominal_metric(nominal)
    error = rng.normal(size=nominal.shape)
    size = error_size(nominal, nominal + error, metric)
    error *= (0.999 * tolerated_error(nominal, metric) / size)[:, None, None]
    assert (error_size(nominal, nominal + error, metric) < tolerated_error(nominal, metric)).all()
    assert (contraction_rate(nominal + error, metric) > 0).all()


def test_a_metric_made_for_all_models_passes_all_of_them():
    # lag with tau in [0.5, 1.5] and gain in [1, 2] times the nominal: four corners, one metric
    corners = [
        loop_jacobian(np.array([[-1 / tau]]), np.array([[gain / tau]]), [-0.5], [-2.0])
        for tau in (0.5, 1.5)
        for gain in (1.0, 2.0)
    ]
    found = common_metric(corners)
    assert found.holds
    verdict = model_error_metric_test(corners[0], corners, metric=found.metric)
    assert verdict.holds.all()
    assert verdict.real_rate.min() == pytest.approx(found.rate)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="largest real part"):
        nominal_metric(np.eye(2))
    with pytest.raises(ValueError, match="share"):
        nominal_metric(-np.eye(2), share=1.0)
    with pytest.raises(ValueError, match="shape"):
        model_error_paper_test(np.ones((2, 3)), np.ones((2, 3)))
    with pytest.raises(ValueError, match="finite"):
        model_error_metric_test(-np.eye(2), np.full((2, 2), np.nan))
