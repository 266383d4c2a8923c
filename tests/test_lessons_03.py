"""Callbacks of lesson 03: what the prose claims is what they return."""

import numpy as np
import pytest

from cmc.lessons import lesson_03
from cmc.theory.margins import symmetric_bound


def test_each_module_contracts_by_itself():
    assert (symmetric_bound(lesson_03.SELF) < 0.0).all()


def test_kinds_of_coupling_do_what_the_lesson_says():
    still = lesson_03.two_modules(0.0, "general")
    assert lesson_03.two_modules(2.0, "general")["worst"] > 0.0
    for strength in (0.5, 4.0):
        one_way = lesson_03.two_modules(strength, "hierarchical")
        np.testing.assert_allclose(
            np.sort_complex(one_way["eig"]), np.sort_complex(still["eig"]), atol=1e-9
        )
        skew = lesson_03.two_modules(strength, "feedback")
        assert symmetric_bound(skew["M"]) == pytest.approx(float(symmetric_bound(still["M"])))
    with pytest.raises(ValueError, match="general"):
        lesson_03.two_modules(1.0, "other")


@pytest.mark.parametrize("modules", [2, 6])
@pytest.mark.parametrize("strength", [0.0, 4.0])
def test_cascade_settles_and_its_peak_grows_with_the_strength(modules, strength):
    out = lesson_03.cascade(strength, modules)
    assert out["sizes"].shape == (280, modules)
    assert out["bars"].shape == (280, modules, 1)
    # closed form: module n - k has (strength t)^k e^-t / k!
    t, k = out["t"], modules - 1
    wanted = (strength * t) ** k * np.exp(-t) / float(np.prod(np.arange(1, k + 1)))
    np.testing.assert_allclose(np.nan_to_num(out["sizes"][:, 0]), wanted, atol=1e-6)


def test_no_transform_decouples_the_spiral():
    angle, products, limit = lesson_03.coupling_products()
    assert products.shape == (len(lesson_03.SHEARS), len(angle))
    assert limit == pytest.approx(-4.0)
    assert (products <= limit + 1e-9).all()


def test_energy_falls_where_a_part_of_it_does_not():
    out = lesson_03.energy()
    assert (np.diff(out["V"]) < 0.0).all()
    assert np.diff(out["part"]).max() > 0.0


def test_verdicts_on_tanh_policies():
    out = lesson_03.tanh_verdicts(60)
    assert (out["frozen"] < 0.0).all()
    assert (out["true_policy"] < 1e-8).all()
    assert np.mean(out["true_block"] > 0.0) > 0.3


def test_tables():
    whole, alone = lesson_03.without_integral()
    np.testing.assert_allclose(whole, [*alone, 0.0, 0.0], atol=1e-9)
    table = lesson_03.answers_table().splitlines()
    assert len(table) == 6
    assert table[3].startswith("| spiral | no | no | yes | yes |")
