"""Plants: Jacobians against differences, the lessons each was chosen for, exact discretisation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cmc import plants


def _sample(plant, rng, batch=(40,)):
    y = rng.uniform(plant.y_low, plant.y_high, (*batch, plant.n))
    u = rng.uniform(plant.u_low, plant.u_high, (*batch, plant.n))
    return y, u


def _difference(function, at, step=1e-6):
    columns = []
    for i in range(at.shape[-1]):
        shift = np.zeros(at.shape[-1])
        shift[i] = step * max(1.0, float(np.abs(at[..., i]).max()))
        columns.append((function(at + shift) - function(at - shift)) / (2 * shift[i]))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", plants.names())
def test_every_plant_is_batched_described_and_has_the_jacobians_of_its_f(name):
    plant, rng = plants.get(name), np.random.default_rng(1)
    y, u = _sample(plant, rng, (3, 4))
    assert plant.f(y, u).shape == (3, 4, plant.n)
    size = np.abs(plant.f_u(y, u)).max() + np.abs(plant.f_y(y, u)).max()
    for jacobian, f, x in (
        (plant.f_y, lambda at: plant.f(at, u), y),
        (plant.f_u, lambda at: plant.f(y, at), u),
    ):
        np.testing.assert_allclose(jacobian(y, u), _difference(f, x), atol=1e-6 * size)
        np.testing.assert_array_equal(jacobian(y, u)[1, 2], jacobian(y[1, 2], u[1, 2]))
        assert jacobian(y, u[0, 0]).shape == (3, 4, plant.n, plant.n)
    assert len(plant.state_names) == len(plant.units) == plant.n
    assert (plant.y_low < plant.y_high).all()
    assert (plant.u_low < plant.u_high).all()
    np.testing.assert_allclose(plant.f(y, plant.hold(y)), 0, atol=1e-9)
    assert plant.name == name


@pytest.mark.parametrize(
    ("call", "words"),
    [
        *(
            (lambda n=n: plants.get(n).f(np.zeros(3), np.zeros(2)), r"y needs shape \(\.\.\., 2\)")
            for n in plants.names()
        ),
        *(
            (lambda n=n: plants.get(n).f_y(np.zeros(2), 1.0), "u needs shape")
            for n in plants.names()
        ),
        (lambda: plants.get("boat"), "name needs one of .* got 'boat'"),
        (lambda: plants.get("peg", K_sur=[1.0, -1.0]), "K_sur needs positive"),
        (lambda: plants.get("pendulum", damping=np.nan), "damping needs finite"),
        (lambda: plants.LinearPlant(np.eye(2), np.eye(3)), r"B needs shape \(2, 2\)"),
        (lambda: plants.LinearPlant(np.eye(2), np.ones((2, 1))), "2 signals and 1 command; "),
        (lambda: plants.get("spiral", omega=0.0), "not be complex"),
        (lambda: plants.get("unstable_mode", growth=-3.0), "growth needs values above -2"),
        (lambda: plants.get("lags", tau=[1.0], gain=[1.0, 2.0]), r"gain needs shape \(1,\)"),
        (lambda: plants.get("peg").step(1.0, 0.0, np.zeros(2), 0.0), "h needs positive"),
        (lambda: plants.get("lags").space("a"), "y needs real numbers"),
    ],
)
def test_wrong_names_shapes_and_parameters_are_refused(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def _closed_loop(f_y, f_u, T_y, T_a, sign, k1, k2):
    """Jacobian in (y, int y) of u = -T_a diag(sign) (k1 T_y y + k2 int T_y y)."""
    P = -T_a @ (sign[:, None] * k1[..., :, None] * T_y)
    Q = -T_a @ (sign[:, None] * k2[..., :, None] * T_y)
    top = np.concatenate([f_y + f_u @ P, f_u @ Q], axis=-1)
    bottom = np.broadcast_to(np.hstack([np.eye(2), np.zeros((2, 2))]), top.shape)
    return np.concatenate([top, bottom], axis=-2)


def test_coupled_lags_need_the_transforms():
    """Identity transforms fail for EVERY positive slope; the paper's T_y and T_a for none."""
    plant, rng = plants.CoupledLags(), np.random.default_rng(2)
    f_y, f_u = plant.A, plant.B
    k1, k2 = 10 ** rng.uniform(-2, 1.5, (2, 2000, 2))
    identity = np.eye(2)
    sign = np.sign(np.diag(f_u))
    J = _closed_loop(f_y, f_u, identity, identity, sign, k1, k2)
    assert (np.linalg.eigvals(J).real.max(-1) > 0).all()

    # T_y = V^-1, and T_a = Q P from the QR of (T_y f_u)^T P: an independent route with numpy.
    eigenvalues, V = np.linalg.eig(f_y)
    T_y = np.linalg.inv(V)
    P = identity[::-1]
    Q, _ = np.linalg.qr((T_y @ f_u).T @ P)
    T_a = Q @ P
    R = T_y @ f_u @ T_a
    assert abs(R[1, 0]) < 1e-12
    assert (eigenvalues < 0).all()
    J = _closed_loop(f_y, f_u, T_y, T_a, np.sign(np.diag(R)), k1, k2)
    assert (np.linalg.eigvals(J).real.max(-1) < 0).all()


def test_the_other_linear_plants_have_the_spectra_they_promise():
    spiral = np.linalg.eigvals(plants.Spiral(sigma=-0.4, omega=2.0).A)
    np.testing.assert_allclose(np.sort_complex(spiral), [-0.4 - 2j, -0.4 + 2j])
    unstable = np.linalg.eigvals(plants.UnstableMode(growth=0.8).A)
    np.testing.assert_allclose(np.sort(unstable), [-2.0, 0.8])
    overdamped = plants.get("pendulum")
    angles = np.linspace(-np.pi, np.pi, 101)
    y = np.stack([angles, 0 * angles], axis=-1)
    assert (np.linalg.eigvals(overdamped.f_y(y, 0 * y)).imag == 0).all()


def test_peg_step_is_exact_and_agrees_with_its_contact_model():
    peg, rng = plants.get("peg"), np.random.default_rng(3)
    for _ in range(5):
        x, z = rng.uniform(1, 3), rng.uniform(-1.5, -0.5)
        u = rng.uniform([1, -2.0], [3, -0.5])
        y = np.array([x, peg.contact_force(x, z)])
        path = solve_ivp(lambda t, s, u=u: peg.f(s, u), (0, 0.03), y, rtol=1e-10, atol=1e-12)
        x_new, z_new = peg.step(x, z, u, 0.03)
        np.testing.assert_allclose(
            path.y[:, -1], [x_new, peg.contact_force(x_new, z_new)], rtol=1e-7
        )
    halves = peg.step(*peg.step(1.2, 0.4, u, 0.01), u, 0.02)
    np.testing.assert_allclose(halves, peg.step(1.2, 0.4, u, 0.03), rtol=1e-13)


def test_peg_force_is_never_positive_and_vanishes_out_of_contact():
    peg, rng = plants.get("peg"), np.random.default_rng(4)
    x, z = rng.uniform(1, 3, 1000), rng.uniform(-3, 1, 1000)
    force = peg.contact_force(x, z)
    assert (force <= 0).all()
    assert (force[z > peg.surface(x)] == 0).all()
    touching = force < 0
    np.testing.assert_allclose(peg.height(x, force)[touching], z[touching], rtol=1e-12)


def test_peg_parameters_broadcast_over_the_batch():
    rng = np.random.default_rng(5)
    K = rng.uniform(1, 31, 50)
    batch = plants.get("peg", K_sur=K)
    y, u = _sample(batch, rng, (50,))
    for i in (0, 17, 49):
        single = plants.get("peg", K_sur=K[i])
        np.testing.assert_allclose(batch.f(y, u)[i], single.f(y[i], u[i]))
        np.testing.assert_allclose(batch.f_y(y, u)[i], single.f_y(y[i], u[i]))
        np.testing.assert_allclose(batch.f_u(y, u)[i], single.f_u(y[i], u[i]))
    assert batch.f_u(y[0], u[0]).shape == (50, 2, 2)


def test_papers_peg_jacobian_has_the_wrong_sign_in_most_samples():
    rng = np.random.default_rng(6)
    size = 20000
    peg = plants.get(
        "peg",
        K_sur=rng.uniform(1, 31, size),
        surface_sin=rng.uniform(-0.01, 0.01, size),
        surface_cos=rng.uniform(-0.01, 0.01, size),
    )
    y, u = _sample(peg, rng, (size,))
    exact, paper = peg.f_y(y, u)[..., 1, 0], peg.f_y_paper(y)[..., 1, 0]
    wrong = np.mean(np.sign(exact) != np.sign(paper))
    assert wrong == pytest.approx(0.63, abs=0.015)
    np.testing.assert_array_equal(np.diagonal(peg.f_y(y, u), 0, -2, -1)[:, 0], -1 / 0.0437)


TWO = {"x": [1.0, 2.0], "z": [0.0, -1.0], "u": [[1.0, 0.0], [2.0, -1.0]], "h": 0.01}


@pytest.mark.parametrize("bad", [None, "a", 1j, [], np.nan, [np.inf, 1.0], np.ones((2, 3))])
@pytest.mark.parametrize("name", TWO)
def test_peg_step_names_what_is_not_finite_or_does_not_fit(name, bad):
    peg = plants.Peg()
    assert np.isfinite(peg.step(**TWO)).all()
    with pytest.raises((TypeError, ValueError), match=rf"\b{name}\b"):
        peg.step(**TWO | {name: bad})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: plants.Peg().contact_force(np.ones(2), np.ones(3)), r"x \(2,\), z \(3,\)"),
        (lambda: plants.Peg().height(np.ones(2), [np.nan, 0.0]), "force needs finite"),
        (lambda: plants.Peg().surface([1.0, np.inf]), "x needs finite"),
        (lambda: plants.Peg(tau_x=[0.1, 0.2], K_sur=np.ones(3)), r"tau_x \(2,\).*K_sur \(3,\)"),
        (lambda: plants.Peg(K_sur=np.ones(3)).surface_slope(np.ones(2)), r"parameters \(3,\)"),
        (lambda: plants.Peg(K_sur=np.ones(3)).f(np.ones((2, 2)), np.ones(2)), r"y \(2,\), param"),
    ],
)
def test_pegs_and_arguments_that_do_not_fit_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("bad", [None, "x", 1j, object(), {}, ["a", "b"]])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("name", plants.get),
        ("tau", lambda x: plants.Lags(tau=x)),
        ("A", lambda x: plants.LinearPlant(x, np.eye(2))),
        *(("y", lambda x, n=n: plants.get(n).f(x, [0.1, 0.1])) for n in plants.names()),
        *(("u", lambda x, n=n: plants.get(n).f_u([1.5, -1.0], x)) for n in plants.names()),
        ("h", lambda x: plants.Peg().step(1.0, 0.0, [1.0, 0.0], x)),
        ("x", lambda x: plants.Peg().contact_force(x, 0.0)),
        ("force", lambda x: plants.Peg().height(1.0, x)),
        ("y", plants.Peg().f_y_paper),
    ],
)
def test_what_is_wrong_is_named(name, call, bad):
    with pytest.raises((TypeError, ValueError), match=rf"\b{name}\b"):
        call(bad)
