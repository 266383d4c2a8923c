"""Lesson 04: what its text says is what its cells compute."""

import numpy as np
import pytest
from lesson import run


@pytest.fixture(scope="module")
def whole():
    return run("04", solved=True)


@pytest.fixture(scope="module")
def space(whole):
    return whole.space


def test_each_repair_mends_one_half_of_the_printed_formula(space):
    found = {k: space["as_printed"](*repair) for k, repair in space["repairs"].items()}
    diagonal = [abs(m[0] * (1 - np.eye(2))).max() == 0 for m in found.values()]
    triangular = [m[1][1, 0] == 0 for m in found.values()]
    assert diagonal == [False, True, False, True]
    assert triangular == [False, False, True, True]


def test_the_five_lines_solve_it(whole):
    """Residues are printed; the arrays are checked here for another plant and n = 3."""
    plant = (
        "plant = plants.LinearPlant([[-3, .5, -3], [.5, -2, -2.5], [-2.5, 1, -2]],"
        " [[1.5, -2.5, -.5], [2, -1, 3], [-2.5, -2, 0]])\ny_star = np.zeros(3)"
    )
    space = run("04", plant=plant).space
    Lambda = np.linalg.inv(space["V"]) @ space["f_y"] @ space["V"]
    np.testing.assert_allclose(Lambda, np.diag(np.diag(Lambda)), atol=1e-12)
    assert (np.diff(np.diag(Lambda)) < 0).all()
    np.testing.assert_allclose(np.tril(space["R"], -1), 0.0, atol=1e-12)


def test_more_damping_is_slower_beyond_two(space):
    damping, rate = space["damping"], np.array(space["rate"])
    beyond = damping > 2.1
    assert (np.diff(rate[beyond]) < 0).all()
    np.testing.assert_allclose(rate[damping < 1.9], damping[damping < 1.9] / 2, rtol=1e-6)
    assert rate[-1] == pytest.approx(1e-4, rel=1e-3)


def test_the_oscillating_share_by_eigenvalues(space):
    sizes = np.random.default_rng(1).uniform(0.1, 3.0, (4, 5000))
    L, R, p, q = sizes * np.array([-1, 1, -1, -1])[:, None]
    F = np.moveaxis(np.array([[L, R], [p * L + q, p * R]]), -1, 0)
    eig = np.linalg.eigvals(F)
    assert (eig.real < 0).all()
    assert np.mean(eig[:, 0].imag != 0) == pytest.approx(space["share"], abs=0.02)


def test_floor_is_where_the_loop_begins_to_decay(space):
    n, floor = space["n"], space["floor"]
    for factor, decays in ((0.98, False), (1.02, True)):
        worst = np.linalg.eigvals(space["loop"](factor * floor.max())).real.max()
        assert (worst < 0) == decays
    assert floor.shape == (n,)


@pytest.mark.parametrize("turns", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("crossing", [0.0, 1.5, 2.0])
def test_tracked_signals_never_jump(space, turns, crossing):
    out = space["tracking"](turns, crossing)
    assert np.abs(np.diff(out["z"], axis=0)).max() < 0.05
    assert np.abs(np.diff(out["rates"], n=2, axis=0)).max() < 1e-3
    jumps = (np.abs(np.diff(out["anew"], axis=0)).max(axis=-1) > 0.3).sum()
    assert f"{jumps} jumps" in out["text"]
    assert jumps > 0 or turns < 1.0


def test_half_a_turn_flips_the_sign(space):
    out = space["tracking"](1.0, 0.0)
    np.testing.assert_allclose(out["z"][-1], -out["z"][0], atol=1e-9)


def test_lapack_needs_tracking(space):
    assert 0.005 < space["swapped"].mean() < 0.2
    assert 0.005 < space["flipped"].mean() < 0.3


@pytest.mark.parametrize(
    ("entries", "kind"),
    [
        ((-2.0, 1.0, 0.5, -1.0), "decompose"),
        ((-2.0, 1.0, -1.5, -1.0), "feedback"),
        ((-1.0, 1.0, 0.0, -1.0), "schur"),
    ],
)
def test_the_matrices_are_never_empty(space, entries, kind):
    """Where there are no eigenvectors, no arrows are drawn and another form is shown."""
    out = space["matrices"](*entries)
    assert out["text"].startswith(kind)
    assert np.isfinite(out["Lambda"]).all()
    assert np.isfinite(out["R"]).all()
    J = np.array(entries).reshape(2, 2)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(out["Lambda"])),
        np.sort_complex(np.linalg.eigvals(J)),
        atol=1e-6,
    )
    for key, eig in (("slow", out["eig_1"]), ("fast", out["eig_2"])):
        v = out[key][1, 0]
        if kind == "decompose":
            np.testing.assert_allclose(J @ v, eig[0].real * v, atol=1e-9)
            assert np.linalg.norm(v) == pytest.approx(1.0)
        else:
            assert not v.any()


def test_schur_stays_well_conditioned(space):
    np.testing.assert_allclose(space["cond"]["Schur"], 1.0)
    assert max(space["cond"]["eigenvectors"]) > 1e5


def test_the_recipe_is_the_theorems(space):
    """T_y f_y T_y^-1 diagonal, R triangular, T_a orthogonal, both inequalities: everywhere."""
    for y in np.random.default_rng(5).uniform(-4, 4, (50, 2)):
        T_y, T_a = space["recipe"](y)
        f_y = np.array([[-1.0, 0.0], [2 * np.cos(2 * y[0]), -2.0]])
        np.testing.assert_allclose(T_y @ f_y @ np.linalg.inv(T_y), np.diag([-1, -2]), atol=1e-12)
        np.testing.assert_allclose(T_a.T @ T_a, np.eye(2), atol=1e-12)
        R = T_y @ T_a
        assert abs(R[1, 0]) < 1e-12
        assert (np.array([-1, -2]) + np.diag(R) * space["p_i"] < -0.5).all()
        assert (np.diag(R) * space["q_i"] < -0.5).all()


def test_the_recipe_is_of_that_plant(space):
    """f_y of the drift in the loop is the matrix that the recipe decomposes."""
    x, h = np.array([0.3, -1.0, 0.0, 0.0]), 1e-6
    space_rhs = space["rhs"]
    columns = []
    for d in np.eye(4)[:2]:
        sides = [space_rhs(0, x + s * h * d, frozen=space["goal"]) for s in (1, -1)]
        columns.append((sides[0] - sides[1])[:2] / (2 * h))
    T_y, T_a = space["recipe"](space["goal"])
    plant = np.array([[-1.0, 0.0], [2 * np.cos(2 * 0.3), -2.0]])
    np.testing.assert_allclose(np.array(columns).T, plant + space["p_i"] * T_a @ T_y, atol=1e-6)


def test_a_loop_that_meets_theorem_2_everywhere_oscillates_forever(space):
    turning, held = (space["runs"][k] for k in ("by the recipe", "held at the goal"))
    assert np.ptp(turning[-80:, :, 0], axis=0).min() > 1.0
    assert np.ptp(held[-80:, :, 0], axis=0).max() < 1e-3
    np.testing.assert_allclose(held[-1, :, :2], np.tile(space["goal"], (8, 1)), atol=1e-2)
