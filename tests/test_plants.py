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
def test_jacobians_match_finite_differences(name):
    plant, rng = plants.get(name), np.random.default_rng(0)
    y, u = _sample(plant, rng)
    f_y = _difference(lambda at: plant.f(at, u), y)
    f_u = _difference(lambda at: plant.f(y, at), u)
    scale = np.abs(f_u).max() + np.abs(f_y).max()
    np.testing.assert_allclose(plant.f_y(y, u), f_y, atol=1e-6 * scale)
    np.testing.assert_allclose(plant.f_u(y, u), f_u, atol=1e-6 * scale)


@pytest.mark.parametrize("name", plants.names())
def test_every_plant_is_batched_and_described(name):
    plant, rng = plants.get(name), np.random.default_rng(1)
    y, u = _sample(plant, rng, (3, 4))
    assert plant.f(y, u).shape == (3, 4, plant.n)
    for jacobian in (plant.f_y, plant.f_u):
        assert jacobian(y, u).shape == (3, 4, plant.n, plant.n)
        np.testing.assert_array_equal(jacobian(y, u)[1, 2], jacobian(y[1, 2], u[1, 2]))
        assert jacobian(y, u[0, 0]).shape == (3, 4, plant.n, plant.n)
    assert len(plant.state_names) == len(plant.units) == plant.n
    assert (plant.y_low < plant.y_high).all()
    assert (plant.u_low < plant.u_high).all()
    np.testing.assert_allclose(plant.f(y, plant.hold(y)), 0, atol=1e-9)
    assert plant.name == name


@pytest.mark.parametrize("name", plants.names())
def test_wrong_shapes_are_refused(name):
    plant = plants.get(name)
    with pytest.raises(ValueError, match=r"y needs shape \(\.\.\., 2\), got \(3,\)"):
        plant.f(np.zeros(3), np.zeros(2))
    with pytest.raises(ValueError, match="u needs shape"):
        plant.f_y(np.zeros(2), 1.0)


def test_unknown_names_and_bad_parameters_are_refused():
    with pytest.raises(ValueError, match="no plant is called 'boat'"):
        plants.get("boat")
    with pytest.raises(ValueError, match="no loop is called"):
        plants.loop("boat")
    with pytest.raises(ValueError, match="K_sur needs positive"):
        plants.get("peg", K_sur=[1.0, -1.0])
    with pytest.raises(ValueError, match="mu needs finite"):
        plants.get("van_der_pol", mu=np.nan)
    with pytest.raises(ValueError, match="B needs a 2 x 2"):
        plants.LinearPlant(np.eye(2), np.eye(3))
    with pytest.raises(ValueError, match="not be complex"):
        plants.get("spiral", omega=0.0)
    with pytest.raises(ValueError, match="above -2"):
        plants.get("unstable_mode", growth=-3.0)
    with pytest.raises(ValueError, match="positive sample time"):
        plants.get("peg").step(1.0, 0.0, np.zeros(2), 0.0)
    with pytest.raises(ValueError, match="0 <= depth < 1"):
        plants.loop("floquet", depth=1.5)


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


@pytest.mark.parametrize("name", plants.loop_names())
def test_loop_jacobians_match_differences_and_meet_every_inequality(name):
    loop, rng = plants.loop(name), np.random.default_rng(7)
    s = rng.uniform(-6, 6, (30, 2))
    for t in np.linspace(0, loop.period, 7):
        J = loop.jacobian(t, s)
        np.testing.assert_allclose(J, _difference(lambda at, t=t: loop.rhs(t, at), s), atol=1e-7)
        assert (np.trace(J, axis1=-2, axis2=-1) < 0).all()
        assert (np.linalg.det(J) > 0).all()
        assert (np.linalg.eigvals(J).real < 0).all()


def test_floquet_multipliers():
    loop = plants.loop("floquet")
    monodromy = np.column_stack(
        [
            solve_ivp(loop.rhs, (0, loop.period), column, rtol=1e-11, atol=1e-12).y[:, -1]
            for column in np.eye(2)
        ]
    )
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(monodromy)), [-1.263, -0.579], atol=5e-4)


@pytest.mark.parametrize(("start", "amplitude"), [(0.0, 0.570), (6.0, 4.517)])
def test_two_attractors(start, amplitude):
    loop = plants.loop("two_attractors")
    end = 60 * loop.period
    times = np.linspace(end - loop.period, end, 400)
    path = solve_ivp(loop.rhs, (0, end), [0, start], t_eval=times, rtol=1e-7, atol=1e-9).y
    assert np.ptp(path[1]) / 2 == pytest.approx(amplitude, abs=2e-3)
