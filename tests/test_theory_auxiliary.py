"""The auxiliary decomposition: structure, invariances and errors."""

import numpy as np
import pytest

from cmc.theory.auxiliary import (
    AuxiliarySpace,
    ComplexEigenvalueError,
    DefectiveMatrixError,
    SingularInputError,
    decompose,
)

F_Y = np.array([[-2.0, 1.0], [0.5, -1.0]])
F_U = np.array([[1.0, 2.0], [1.5, 1.0]])


def random_systems(n, number, seed=0):
    """Random plants with real eigenvalues; near-singular ones (0.1 to 1 %) are left out."""
    rng = np.random.default_rng(seed)
    V, f_u = rng.normal(size=(2, number, n, n))
    eigenvalues = rng.uniform(-10.0, 2.0, size=(number, n))
    f_y = V @ (eigenvalues[..., None] * np.linalg.inv(V))
    keep = (np.linalg.cond(V) < 1e4) & (np.linalg.cond(f_u) < 1e6)
    return f_y[keep], f_u[keep], eigenvalues[keep]


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_structure_on_twenty_thousand_random_systems(n):
    f_y, f_u, eigenvalues = random_systems(n, 20_300)
    assert len(f_y) > 20_000
    space = decompose(f_y, f_u)
    R = space.T_y @ f_u @ space.T_a
    assert np.abs(np.tril(R, -1)).max() < 1e-10
    V = np.linalg.inv(space.T_y)
    Lambda = space.T_y @ f_y @ V
    scale = np.linalg.cond(V) * np.linalg.norm(f_y, axis=(-2, -1))
    off = np.abs(Lambda * (1.0 - np.eye(n))).max(axis=(-2, -1))
    assert (off <= 1e-12 * scale).all()
    # what is returned is what the transforms produce
    assert (np.abs(Lambda - space.Lambda).max(axis=(-2, -1)) <= 1e-12 * scale).all()
    np.testing.assert_allclose(R, space.R, atol=1e-10)
    # conventions
    assert (space.gains > 0.0).all()
    assert (np.diff(space.eigenvalues, axis=-1) <= 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(V, axis=-2), 1.0, rtol=1e-9)
    rows = np.abs(V).argmax(axis=-2)
    assert (np.take_along_axis(V, rows[:, None], axis=-2) > 0.0).all()
    orthogonal = np.swapaxes(space.T_a, -1, -2) @ space.T_a
    np.testing.assert_allclose(orthogonal, np.broadcast_to(np.eye(n), R.shape), atol=1e-12)
    expected = np.sort(eigenvalues, axis=-1)[:, ::-1]
    np.testing.assert_allclose(space.eigenvalues, expected, atol=1e-6)


def test_one_system_equals_its_row_in_a_batch():
    for n in (2, 4):
        f_y, f_u, _ = random_systems(n, 300, seed=3)
        batch = decompose(f_y, f_u)
        for k in range(len(f_y)):
            one = decompose(f_y[k], f_u[k])
            for name in ("T_y", "T_a", "Lambda", "R"):
                wanted = getattr(batch, name)[k]
                np.testing.assert_allclose(getattr(one, name), wanted, rtol=1e-8, atol=1e-9)


def test_closed_form_agrees_with_lapack_where_two_by_two_sits_in_three_by_three():
    f_y, f_u, _ = random_systems(2, 200, seed=4)
    padded_y, padded_u = np.zeros((2, len(f_y), 3, 3))
    padded_y[:, :2, :2], padded_y[:, 2, 2] = f_y, -50.0  # the last mode in the descending order
    padded_u[:, :2, :2], padded_u[:, 2, 2] = f_u, 1.0
    small, large = decompose(f_y, f_u), decompose(padded_y, padded_u)
    np.testing.assert_allclose(large.T_y[:, :2, :2], small.T_y, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(large.R[:, :2, :2], small.R, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("n", [2, 5])
def test_a_change_of_latent_coordinates_changes_neither_eigenvalues_nor_the_loop(n):
    f_y, f_u, _ = random_systems(n, 400, seed=5)
    S = np.eye(n) + 0.2 * np.random.default_rng(6).normal(size=(n, n))
    before = decompose(f_y, f_u)
    after = decompose(S @ f_y @ np.linalg.inv(S), S @ f_u)
    np.testing.assert_allclose(after.eigenvalues, before.eigenvalues, atol=1e-7)
    # the new rows of T_y are the old ones seen through S, up to the unit-norm convention
    ratio = (after.T_y @ S) / before.T_y
    spread = np.abs(ratio / ratio[..., :1] - 1.0).max(axis=(-2, -1))
    assert np.median(spread) < 1e-9
    assert np.quantile(spread, 0.95) < 1e-5
    # gains scale with the rows, so that signs and ratios R_ij / R_ii of one row stay
    np.testing.assert_allclose(np.abs(ratio[..., 0]), after.gains / before.gains, rtol=1e-4)


def test_batch_axes_broadcast():
    space = decompose(np.broadcast_to(F_Y, (4, 3, 2, 2)), F_U)
    assert space.R.shape == (4, 3, 2, 2)
    np.testing.assert_allclose(space.R[2, 1], decompose(F_Y, F_U).R)


def test_scalar_systems_and_multiples_of_the_identity():
    space = decompose([[-3.0]], [[-2.0]])
    assert space.eigenvalues.tolist() == [-3.0]
    assert space.gains.tolist() == [2.0]
    same = decompose(-2.0 * np.eye(2), F_U)
    np.testing.assert_allclose(same.T_y, np.eye(2))
    np.testing.assert_allclose(np.tril(F_U @ same.T_a, -1), 0.0, atol=1e-14)
    many = decompose(np.stack([-2.0 * np.eye(2), F_Y]), F_U)
    np.testing.assert_allclose(many.T_y[0], np.eye(2))


def test_repeated_eigenvalues_with_enough_eigenvectors_are_no_error():
    rng = np.random.default_rng(8)
    for _ in range(50):
        V = np.eye(4) + 0.3 * rng.normal(size=(4, 4))
        f_y = V @ np.diag([-1.0, -1.0, -3.0, -3.0]) @ np.linalg.inv(V)
        space = decompose(f_y, np.eye(4))
        found = space.T_y @ f_y @ np.linalg.inv(space.T_y)
        np.testing.assert_allclose(found, np.diag([-1.0, -1.0, -3.0, -3.0]), atol=1e-10)


def test_signals_map_there_and_back():
    space = decompose(F_Y, F_U)
    y, a = np.random.default_rng(0).normal(size=(2, 7, 2))
    np.testing.assert_allclose(space.V @ space.to_z(y)[3], y[3])
    np.testing.assert_allclose(space.T_a.T @ space.to_u(a)[3], a[3])
    # y' = f_y y + f_u u becomes z' = Lambda z + R a
    z_dot = space.to_z(y @ F_Y.T + space.to_u(a) @ F_U.T)
    np.testing.assert_allclose(z_dot, space.to_z(y) @ space.Lambda.T + a @ space.R.T)


def test_identity_transforms_leave_the_jacobians():
    space = AuxiliarySpace.identity(F_Y, F_U)
    np.testing.assert_array_equal(space.Lambda, F_Y)
    np.testing.assert_array_equal(space.R, F_U)


COMPLEX_2 = np.array([[-0.4, 2.0], [-2.0, -0.4]])
COMPLEX_3 = np.array([[-0.4, 2.0, 0.0], [-2.0, -0.4, 0.0], [0.3, 0.1, -1.0]])
JORDAN_3 = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("f_y", [COMPLEX_2, COMPLEX_3, np.stack([F_Y, COMPLEX_2])])
def test_a_complex_pair_names_the_feedback_combination(f_y):
    with pytest.raises(ComplexEigenvalueError, match=r"-0\.4 \+- 2j.*feedback combination"):
        decompose(f_y, np.eye(f_y.shape[-1]))


def test_a_batch_says_where():
    with pytest.raises(ComplexEigenvalueError, match=r"at index 1 \(1 of 3\)"):
        decompose(np.stack([F_Y, COMPLEX_2, F_Y]), F_U)
    with pytest.raises(SingularInputError, match=r"at index 2 \(1 of 3\)"):
        decompose(F_Y, np.stack([F_U, F_U, np.ones((2, 2))]))


@pytest.mark.parametrize(
    "f_y", [np.array([[-1.0, 1.0], [0.0, -1.0]]), JORDAN_3, np.array([[F_Y, [[-1, 0], [3, -1]]]])]
)
def test_defective_matrices(f_y):
    with pytest.raises(DefectiveMatrixError, match="Schur"):
        decompose(f_y, np.eye(f_y.shape[-1]))


def test_defective_up_to_rounding():
    rng = np.random.default_rng(1)
    for n in (2, 3):
        for _ in range(20):
            V = np.eye(n) + 0.3 * rng.normal(size=(n, n))
            jordan = -np.eye(n) + np.diag(np.ones(n - 1), 1)
            with pytest.raises(DefectiveMatrixError):
                decompose(V @ jordan @ np.linalg.inv(V), np.eye(n))


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("batch", [False, True])
def test_singular_input(n, batch):
    f_u = np.eye(n)
    f_u[-1] = 0.0  # a peg out of contact: no command moves the force
    f_y = -np.diag(np.arange(1.0, n + 1))
    with pytest.raises(SingularInputError, match="singular"):
        decompose(f_y[None] if batch else f_y, f_u)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n", [2, 3])
def test_not_finite(bad, n):
    f_y, f_u = -np.diag(np.arange(1.0, n + 1)), np.eye(n)
    for i in range(n):
        for j in range(n):
            broken = f_y.copy()
            broken[i, j] = bad
            with pytest.raises(ValueError, match="f_y must be finite"):
                decompose(broken, f_u)
            broken = f_u.copy()
            broken[i, j] = bad
            with pytest.raises(ValueError, match="f_u must be finite"):
                decompose(f_y, broken)


@pytest.mark.parametrize(
    ("f_y", "f_u", "error", "words"),
    [
        (np.ones(4), np.eye(2), ValueError, r"\(\.\.\., n, n\), got \(4,\)"),
        (np.ones((2, 3)), np.eye(2), ValueError, "n, n"),
        (-np.eye(3), np.eye(2), ValueError, "one size"),
        (np.ones((0, 0)), np.ones((0, 0)), ValueError, "n, n"),
        (np.tile(F_Y, (2, 1, 1)), np.tile(F_U, (3, 1, 1)), ValueError, "broadcast"),
        (F_Y * 1j, F_U, TypeError, "real numbers"),
        ([["a", "b"], ["c", "d"]], F_U, TypeError, "real numbers"),
    ],
)
def test_wrong_shapes_and_types(f_y, f_u, error, words):
    with pytest.raises(error, match=words):
        decompose(f_y, f_u)


def test_integer_matrices_are_welcome():
    np.testing.assert_allclose(
        decompose(np.array([[-2, 1], [1, -3]]), np.eye(2, dtype=int)).Lambda,
        decompose([[-2.0, 1.0], [1.0, -3.0]], np.eye(2)).Lambda,
    )


def test_the_constructor_refuses_what_does_not_fit():
    eye = np.eye(2)
    with pytest.raises(ValueError, match="one shape"):
        AuxiliarySpace(eye, eye, eye, np.eye(3))
    with pytest.raises(ValueError, match="finite"):
        AuxiliarySpace(eye, eye, eye * np.nan, eye)
    with pytest.raises(ValueError, match="fit together"):
        AuxiliarySpace.from_transforms(eye, eye, F_Y, np.eye(3))
    with pytest.raises(AttributeError):
        decompose(F_Y, F_U).R = eye


@pytest.mark.parametrize(
    ("f_y", "f_u", "wanted"),
    [
        ([[-1, 1e-17], [-1e-17, -1]], np.eye(2), [-1, -1]),
        ([[-1, 1e8], [0, -2]], np.eye(2), [-1, -2]),
        (np.diag([-1.0, -2.0]), np.diag([1, 1e-13]), [-1, -2]),
        (1e160 * np.array([[-1, 0.0], [0.0, -2]]), np.eye(2), [-1e160, -2e160]),
    ],
)
def test_units_make_nothing_complex_defective_or_singular(f_y, f_u, wanted):
    np.testing.assert_allclose(decompose(f_y, f_u).eigenvalues, wanted, rtol=1e-9)
