"""Lesson 12, other contact: verdicts on made-up results, against what they were made to say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cmc import store
from cmc.lessons import lesson_12_contact as contact


def cells(success, title):
    """Cells of one method at three stiffnesses, in the order of the time constants."""
    made = [
        {
            "scale": 1.0 / np.sqrt(k),
            "stiffness": k,
            "time_constant_ms": 10.0 / np.sqrt(k),
            "success": [s, s + 0.02, s - 0.02],
            "success_interval": [0.0, 1.0],
            "return": [-100.0] * 3,
            "penetration_mm": [0.1 / k] * 3,
        }
        for k, s in zip((4.0, 1.0, 0.25), success, strict=True)
    ]
    return {"title": title, "step": 1_000_000, "seeds": [0, 1, 2], "cells": made}


def test_stiffness_is_judged_seed_by_seed(monkeypatch):
    found = {"ctd3": cells((0.5, 0.9, 0.9), "ours")}
    monkeypatch.setattr(contact, "stiffness", lambda: found)
    stiffer, softer = contact.stiffness_verdict().splitlines()
    assert "4 times as stiff: **fewer touches**" in stiffer
    assert "0.25 times as stiff: **no difference shown**" in softer
    x, share = contact.stiffness_curves()["ours"]
    assert x.tolist() == [0.25, 1.0, 4.0]
    assert share.shape == (3, 3)
    assert contact.stiffness_table().count("\n| ") == 3
    found.clear()
    assert contact.NO_SWEEP in contact.stiffness_table()
    assert contact.stiffness_verdict() == contact.NO_SWEEP


SPREAD = np.array([-0.05, -0.02, 0.0, 0.02, 0.05])


def run(touched, stiffness=1.0, last=400_000):
    """A training whose kept policies, one each 100,000 steps, touch in these shares."""
    tests = [
        {
            "step": step,
            "touched": (share + SPREAD).tolist(),
            "return": (-300 * (1 - share) + SPREAD).tolist(),
            "penetration_mm": [0.1] * 5,
        }
        for step, share in zip(range(100_000, last + 1, 100_000), touched, strict=False)
    ]
    return {"method": "ctd3", "title": "ours", "stiffness": stiffness, "tests": tests}


@pytest.fixture
def put(monkeypatch):
    """Put made-up trainings in place of the files; the nominal one is longer."""
    nominal = run([0.2, 0.4, 0.6, 0.8, 0.0], last=500_000)
    monkeypatch.setattr(contact, "methods", lambda: {"ctd3": nominal})

    def runs(*found):
        monkeypatch.setattr(contact, "trained", lambda: found)

    return runs


def test_learning_is_compared_over_the_steps_that_both_have(put):
    put(run([0.0, 0.1, 0.2, 0.3], 6.25), run([0.2, 0.4, 0.6, 0.8], 0.0625), run([0.8] * 4, 4.0))
    harder, same, easier = contact.trained_verdict().splitlines()
    assert "6.25 times as stiff: **harder to learn**, -35 [" in harder
    assert "0.0625 times as stiff: **no difference shown**, +0 [" in same
    assert "4 times as stiff: **easier to learn**, +30 [" in easier
    assert "over 4 kept policies up to 400,000 steps" in harder
    interval = stats.ttest_ind(SPREAD - 0.35, SPREAD, equal_var=False).confidence_interval()
    assert f"[{100 * interval.low:+.0f}, {100 * interval.high:+.0f}]" in harder


def test_table_and_curves_show_the_usual_contact_once(put):
    put(run([0.0, 0.1, 0.2, 0.3], 6.25), run([0.2, 0.4, 0.6, 0.8], 0.0625))
    rows = contact.trained_table().splitlines()[2:]
    assert [row.split(" | ")[1] for row in rows] == ["6.25", "1 (the paper's)", "0.0625"]
    assert "| 15 [10, 20] | 25 · 28 · 30 · 32 · 35 |" in rows[0]
    curves = contact.trained_curves()
    assert list(curves) == [
        "6.25 times as stiff",
        "the paper's",
        "0.0625 times as stiff",
    ]
    steps, shares = curves["the paper's"]
    assert steps.tolist() == [100e3, 200e3, 300e3, 400e3]
    assert shares.shape == (5, 4)


def test_missing_files_are_said(put, monkeypatch):
    put()
    assert contact.trained_table() == contact.trained_verdict() == contact.NOT_TRAINED
    assert not contact.trained_curves()
    put(run([0.5] * 4))
    monkeypatch.setattr(contact, "methods", dict)
    assert contact.trained_verdict() == contact.NOT_TRAINED


def test_files_are_read_from_the_shipped_results(monkeypatch, tmp_path):
    def asset(*parts):
        if (file := tmp_path / parts[-1]).is_file():
            return file
        raise FileNotFoundError(parts[-1])

    monkeypatch.setattr(store, "asset", asset)
    for read in (contact.trained, contact.stiffness):
        read.cache_clear()
    try:
        assert contact.trained() == ()
        assert contact.stiffness() == {}
        for read in (contact.trained, contact.stiffness):
            read.cache_clear()
        runs = [run([0.5] * 4, 6.25), run([0.5] * 4, 0.0625)]
        store.write_json(tmp_path / "peg_push_contact_training.json", {"runs": runs})
        assert [found["stiffness"] for found in contact.trained()] == [0.0625, 6.25]
    finally:
        for read in (contact.trained, contact.stiffness):
            read.cache_clear()
