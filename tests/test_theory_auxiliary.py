"""The auxiliary decomposition: structure, invariances and errors."""

import numpy as np
import pytest

from cmc.theory.auxiliary import AuxiliarySpace, decompose
from cmc.theory.explicit import ComplexEigenvalueError, DefectiveMatrixError, SingularInputError

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


@pytest.mark.parametrize("n", [2, 4])
def test_one_system_equals_its_row_in_a_batch(n):
    f_y, f_u, _ = random_systems(n, 300, seed=3)
    batch = decompose(f_y, f_u)
    for k in range(len(f_y)):
        one = decompose(f_y[k], f_u[k])
        for name in ("T_y", "T_a", "Lambda", "R"):
            wanted = getattr(batch, name)[k]
            np.testing.assert_allclose(getattr(one, name), wanted, rtol=1e-8, atol=1e-9)
    wide = decompose(np.broadcast_to(f_y[0], (4, 3, n, n)), f_u[0])  # batch axes broadcast
    assert wide.R.shape == (4, 3, n, n)
    np.testing.assert_allclose(wide.R[2, 1], batch.R[0], rtol=1e-8, atol=1e-9)


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


def test_scalar_systems_multiples_of_the_identity_and_integers():
    space = decompose([[-3.0]], [[-2.0]])
    assert space.eigenvalues.tolist() == [-3.0]
    assert space.gains.tolist() == [2.0]
    same = decompose(-2.0 * np.eye(2), F_U)
    np.testing.assert_allclose(same.T_y, np.eye(2))
    np.testing.assert_allclose(np.tril(F_U @ same.T_a, -1), 0.0, atol=1e-14)
    many = decompose(np.stack([-2.0 * np.eye(2), F_Y]), F_U)
    np.testing.assert_allclose(many.T_y[0], np.eye(2))
    whole = decompose(np.array([[-2, 1], [1, -3]]), np.eye(2, dtype=int))
    np.testing.assert_allclose(whole.Lambda, decompose([[-2.0, 1], [1, -3]], np.eye(2)).Lambda)


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
    still = AuxiliarySpace.identity(F_Y, F_U)
    np.testing.assert_array_equal([still.Lambda, still.R], [F_Y, F_U])


PAIR = np.array([[-0.4, 2.0], [-2.0, -0.4]])
PAIR_3 = np.array([[-0.4, 2.0, 0.0], [-2.0, -0.4, 0.0], [0.3, 0.1, -1.0]])
JORDAN_3 = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])
OUT = np.diag([1.0, 0.0])  # a peg out of contact: no command moves the force
COMPLEX = ComplexEigenvalueError, r"-0\.4 \+- 2j.*feedback combination"
DEFECTIVE = DefectiveMatrixError, "Schur"


@pytest.mark.parametrize(
    ("f_y", "f_u", "error", "words"),
    [
        (PAIR, np.eye(2), *COMPLEX),
        (PAIR_3, np.eye(3), *COMPLEX),
        (np.stack([F_Y, PAIR]), np.eye(2), *COMPLEX),
        (np.stack([F_Y, PAIR, F_Y]), F_U, ComplexEigenvalueError, r"at index 1 \(1 of 3\)"),
        (np.array([[-1.0, 1.0], [0.0, -1.0]]), np.eye(2), *DEFECTIVE),
        (JORDAN_3, np.eye(3), *DEFECTIVE),
        (np.array([[F_Y, [[-1, 0], [3, -1]]]]), np.eye(2), *DEFECTIVE),
        (F_Y, OUT, SingularInputError, "singular"),
        (F_Y[None], OUT, SingularInputError, "singular"),
        (np.diag([-1.0, -2, -3]), np.diag([1.0, 1, 0]), SingularInputError, "singular"),
        (F_Y, np.stack([F_U, F_U, OUT]), SingularInputError, r"at index 2 \(1 of 3\)"),
        (np.ones(4), np.eye(2), ValueError, r"\(\.\.\., n, n\), got shape \(4,\)"),
        (np.ones((2, 3)), np.eye(2), ValueError, "n, n"),
        (-np.eye(3), np.eye(2), ValueError, r"f_u needs shape \(\.\.\., 3, 3\)"),
        (F_Y, np.ones((2, 1)), ValueError, "2 signals and 1 command; .*composite"),
        (np.ones((0, 0)), np.ones((0, 0)), ValueError, "n, n"),
        (np.tile(F_Y, (2, 1, 1)), np.tile(F_U, (3, 1, 1)), ValueError, "broadcast"),
        (F_Y, 1e300 * F_U, ValueError, "f_y and f_u: too large"),
        (F_Y * 1j, F_U, TypeError, "real numbers"),
        ([["a", "b"], ["c", "d"]], F_U, TypeError, "real numbers"),
        ([[1.0], [2.0, 3.0]], F_U, TypeError, "f_y needs an array"),
        (None, F_U, TypeError, "f_y needs real numbers"),
    ],
)
def test_what_decompose_refuses(f_y, f_u, error, words):
    with pytest.raises(error, match=words):
        decompose(f_y, f_u)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n", [2, 3])
def test_not_finite(bad, n):
    good = (-np.diag(np.arange(1.0, n + 1)), np.eye(n))
    for which, name in enumerate(("f_y", "f_u")):
        for at in np.ndindex(n, n):
            broken = [matrix.copy() for matrix in good]
            broken[which][at] = bad
            with pytest.raises(ValueError, match=f"{name} needs finite"):
                decompose(*broken)


@pytest.mark.parametrize("n", [2, 3])
def test_defective_up_to_rounding(n):
    rng = np.random.default_rng(1)
    for _ in range(20):
        V = np.eye(n) + 0.3 * rng.normal(size=(n, n))
        jordan = -np.eye(n) + np.diag(np.ones(n - 1), 1)
        with pytest.raises(DefectiveMatrixError):
            decompose(V @ jordan @ np.linalg.inv(V), np.eye(n))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda eye: AuxiliarySpace(eye, eye, eye, np.eye(3)), "one shape"),
        (lambda eye: AuxiliarySpace(eye, eye, eye * np.nan, eye), "Lambda needs finite"),
        (lambda eye: AuxiliarySpace.from_transforms(eye, eye, F_Y, np.eye(3)), "f_u needs shape"),
        (lambda eye: AuxiliarySpace.from_transforms(0 * eye, eye, F_Y, F_U), "T_y .*invertible"),
        (lambda eye: AuxiliarySpace.identity(3.0, eye), "f_y needs shape"),
        (lambda eye: decompose(F_Y, F_U).to_z([1.0]), r"y needs shape \(\.\.\., 2\)"),
        (lambda eye: decompose(F_Y, F_U).to_u(["a", "b"]), "a needs real numbers"),
        (lambda eye: decompose(F_Y, F_U).signed([1.0, 2, 3], 1.0), "fit together"),
        (lambda eye: decompose(F_Y, F_U).loop(np.ones(2)), "slopes needs shape"),
    ],
)
def test_the_space_names_what_does_not_fit(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call(np.eye(2))
    with pytest.raises(AttributeError):
        decompose(F_Y, F_U).R = np.eye(2)


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
