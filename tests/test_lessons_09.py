"""Callbacks and tables of lesson 09: what the prose claims is what they return."""

import numpy as np
import pytest

from cmc.lessons import lesson_09
from cmc.lessons import lesson_09_results as shipped
from cmc.studies import peg_touch


def test_live_training_reports_both_methods():
    seen = []
    out = lesson_09.live_training(lambda *row: seen.append(row), seeds=(0, 1), episodes=32)
    assert out["episode"].tolist() == [16, 32]
    assert out["ppo"].shape == out["cppo"].shape == (2, 2)
    assert seen[-1][0] == 32
    assert all(np.isfinite(row).all() for row in seen)


def test_the_difference_is_the_network_and_its_positive_weights():
    text = lesson_09.difference()
    assert "-     return TouchPolicy(IndependentNetwork(" in text
    assert "+     return TouchPolicy(PositiveNetwork(" in text
    assert "positive_weights()" in text
    assert ".abs()" in text
    assert '"""' not in text


@pytest.mark.parametrize("shift", ["nominal", "all, fast"])
@pytest.mark.parametrize("signal", ["force", "position"])
def test_press(shift, signal):
    out = lesson_09.press(4600, 1, 10.0, shift, signal, trajectories=30)
    for name, title in lesson_09.TITLES.items():
        assert out[name].shape == (100, 12)
        assert np.isfinite(out[name]).all()
        assert out[f"{name}_text"].startswith(f"{title}: ")
    assert "C-PPO, capped: 0% oscillate" in out["cppo_capped_text"]
    if shift == "all, fast":
        assert " 0% oscillate" not in out["cppo_text"]


@pytest.mark.parametrize("h", [2.0, 30.0])
def test_press_at_other_control_periods(h):
    out = lesson_09.press(h=h, trajectories=20)
    assert out["cppo_t"][-1] <= 1.0
    assert len(out["cppo"]) == len(out["cppo_t"]) <= 250
    assert (" 0% oscillate" in out["cppo_text"]) == (h == 2.0)


def test_capped_slopes_stay_below_the_bound_of_the_worst_plant():
    bounds = lesson_09.bounds()
    assert bounds["faster and stiffer"] < bounds["as trained"]
    capped = lesson_09.local_slopes("cppo_capped", 5000, 100)
    free = lesson_09.local_slopes("cppo", 5000, 100)
    assert capped.max() < bounds["faster and stiffer"] < free.max() < bounds["as trained"]


def test_gains_on_raw_inputs_creep_to_the_bound():
    out = lesson_09.raw_gains((5000, 15_000), trajectories=200)
    assert out["gain"].shape == out["beyond"].shape == (5, 2)
    assert out["beyond"][:, 1].mean() > out["beyond"][:, 0].mean()
    assert (out["gain"] < 1.1 * lesson_09.bounds()["as trained"]).all()


def test_a_turned_base_needs_the_transforms():
    out = lesson_09.turned_base((0, 120))
    aligned, turned = 0, 1
    assert out["cppo"][aligned] == pytest.approx(out["cppo"][turned], abs=0.02)
    assert out["cppo_identity"][aligned] < 0.5
    assert out["cppo_identity"][turned] > 0.9


def test_tables_have_a_row_for_every_method():
    answer = peg_touch.results()["methods"]
    table = shipped.method_table()
    for found in answer.values():
        assert f"| {found['title']} |" in table
    certified = shipped.certificate_table()
    assert certified.count("\n| ") == sum(bool(m["certificates"]) for m in answer.values())
    assert shipped.claims_table().count("**") == 12
    for sentence in (
        shipped.share_sentence(),
        shipped.agreement_sentence(),
        shipped.cap_sentence(),
        shipped.caps_table(),
    ):
        assert "nan" not in sentence


def test_arrays_of_the_figures_fit_together():
    episode, runs = shipped.training(("ppo", "cppo"))
    assert all(curve.shape == (5, episode.size) for curve in runs.values())
    for key in ("unstable", "wrong_sign_integral"):
        for marks, share in shipped.over_training(key, ("ppo", "cppo")).values():
            assert share.shape == (5, marks.size)
            assert ((share >= 0) & (share <= 1)).all()
    predicted, measured = shipped.predictions()
    assert predicted.shape == measured.shape
    assert np.abs(predicted - measured).mean() < 0.02
    errors = shipped.errors("cppo", "all, fast")
    test = peg_touch.at(shipped.methods()["cppo"], 5000, shift="all, fast")
    assert errors.size == 5 * test["trajectories"]
