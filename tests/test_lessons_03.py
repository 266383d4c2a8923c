"""Lesson 03: what its text says is what its cells compute."""

import math

import numpy as np
import pytest
from lesson import run


@pytest.fixture(scope="module")
def whole():
    return run("03", solved=True)


@pytest.fixture(scope="module")
def space(whole):
    return whole.space


def largest(M):
    return np.linalg.eigvals(M).real.max()


def test_each_module_contracts_by_itself(space):
    for M in (space["F_11"], space["F_22"]):
        assert np.linalg.eigvalsh(M + M.T).max() < 0


def test_kinds_of_coupling_do_what_the_lesson_says(space):
    still = space["combined"](0.0, "both ways")
    assert largest(space["combined"](0.4, "both ways")["F"]) < 0  # a weak one is harmless
    assert largest(space["combined"](1.5, "both ways")["F"]) > 0
    for strength in (0.5, 4.0):
        one_way, skew = (space["combined"](strength, k) for k in ("one way", "feedback"))
        np.testing.assert_allclose(
            np.sort_complex(one_way["eig"]), np.sort_complex(still["eig"]), atol=1e-9
        )
        assert space["sym"](skew["F"]) == pytest.approx(float(space["sym"](still["F"])))


def test_energy_passes_in_feedback_though_none_is_made(space):
    run = space["combined"](4.0, "feedback")
    assert np.diff(run["one"]).max() > 0
    assert np.diff(run["two"]).max() > 0
    assert (np.diff(run["one"] ** 2 + run["two"] ** 2) < 0).all()


def test_feedback_of_stable_modules_may_grow(space, whole):
    """The counter-example: eigenvalues -1, an exactly skew coupling, and +0.25."""
    F = space["whole"]
    np.testing.assert_allclose(np.linalg.eigvals(F[:2, :2]), -1.0)
    np.testing.assert_array_equal(F[:2, 2:], -F[2:, :2].T)
    assert largest(F) == pytest.approx(0.25, abs=0.005)
    assert "+0.25 1/s" in whole.text
    assert 0.005 < space["grow"].mean() < 0.1
    assert not space["grow"][space["safe"]].any()  # what the theorem does promise
    # the modules drawn do meet theorem 2
    trace = np.trace(space["modules"], axis1=-2, axis2=-1)
    assert (trace < 0).all()
    assert (np.linalg.det(space["modules"]) > 0).all()


@pytest.mark.parametrize("modules", [2, 4, 6])
@pytest.mark.parametrize("strength", [0.0, 3.0, 4.0])
def test_cascade_against_its_closed_form(space, modules, strength):
    out = space["cascade"](strength, modules)
    t = out["t"]
    for k in range(modules):  # k levels above the free module: (strength t)^k e^-t / k!
        wanted = (strength * t) ** k * np.exp(-t) / math.factorial(k)
        np.testing.assert_allclose(out["sizes"][:, -1 - k], np.maximum(wanted, 1e-6), atol=1e-6)
        np.testing.assert_array_equal(out[f"dot_{k}"][:, 0, 1], k)
        np.testing.assert_array_equal(out[f"size_{k}"], out["sizes"][:, -1 - k])
    assert f"{out['sizes'][:, 0].max():.2f}" in out["text"]


def test_no_transform_decouples_the_spiral(space):
    assert space["bound"] == pytest.approx(-4.0)
    for product in space["products"].values():
        assert (product <= space["bound"] + 1e-9).all()


def test_the_block_form_is_skew_with_negative_symmetric_parts(space):
    F = space["F_of"](
        space["P"] @ space["half"] - space["Q"] + (space["Lambda"] - space["half"]) @ space["P"]
    )
    np.testing.assert_allclose(F[:2, 2:], -F[2:, :2].T, atol=1e-12)
    for M in (F[:2, :2], F[2:, 2:], F):
        assert np.linalg.eigvalsh(M + M.T).max() < 0


def test_linearized_is_the_derivative_of_the_rates(space):
    x, W = space["cases"][0]
    for moving in (True, False):
        J, d = space["linearized"](x, W, moving), np.array([1.0, -2.0, 0.5, 1.5])
        h = 1e-5
        ahead, behind = (space["rates"](x + s * h * d, W, moving) for s in (1, -1))
        np.testing.assert_allclose(J @ d, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6)
    # without the slopes the loop is z' = (Lambda + P) z + Q I, in closed form
    p, q = space["slopes_at"](W, np.stack([space["T_y"] @ x[:2], x[2:]], -1)).T
    wanted = np.block([[space["Lambda"] + np.diag(p), np.diag(q)], [np.eye(2), np.zeros((2, 2))]])
    T = np.block([[space["T_y"], np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]])
    np.testing.assert_allclose(T @ J @ np.linalg.inv(T), wanted, atol=1e-5)


def test_slopes_in_the_transform_make_the_frozen_verdict_wrong(space):
    found = {k: np.array(v) for k, v in space["found"].items()}
    assert (found["frozen"] < 0).all()
    assert (found["T_a without slopes"] < 1e-6).all()
    assert np.mean(found["slopes in T_a"] > 0) > 0.3


def test_energy_falls_where_a_part_of_it_does_not(space):
    assert (np.diff(space["V"]) < 0).all()
    assert np.diff(space["part"]).max() > 0


def test_without_the_integral(space):
    whole = np.sort(np.linalg.eigvals(space["F_z"]).real)
    alone = np.linalg.eigvals(space["Lambda"] + space["P"]).real
    np.testing.assert_allclose(whole, np.sort([*alone, 0.0, 0.0]), atol=1e-9)


def test_the_table_of_combinations(space):
    rows = {row[0]: dict(zip(space["head"], row[1:], strict=True)) for row in space["rows"]}
    names = ["hierarchical", "schur", "feedback (policies)", "feedback (constant slopes)"]
    wanted = {
        "spiral": ["no", "no", "yes", "yes"],
        "defective": ["no", "yes", "no", "no"],
        "unstable_mode": ["yes", "yes", "yes", "no"],
        "coupled_lags": ["yes", "yes", "yes", "yes"],
    }
    for plant, answers in wanted.items():
        assert [rows[plant][name] for name in names] == answers
