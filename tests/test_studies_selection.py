"""Policies picked on validation episodes: the rule, and that every seed gets its own weights."""

from __future__ import annotations

import numpy as np
import pytest

from cmc import store
from cmc.learning.low_level import evaluate
from cmc.studies import peg_push
from cmc.studies.selection import load_picked, main, pick
from cmc.studies.two_level_training import load


def trained(name, folder):
    """Two kept policies that differ, in all that learns."""
    for steps in (160, 320):
        path = peg_push.train(name, range(4), steps=steps, out=folder)
    tensors, record = store.load_checkpoint(path)
    rng = np.random.default_rng(0)
    mixed = {
        k: v if name == "gain" and ".low." in k else v + 0.1 * rng.random(v.shape).astype(v.dtype)
        for k, v in tensors.items()
    }
    store.save_checkpoint(path, mixed, record)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained("ctd3", tmp_path_factory.mktemp("runs"))


def test_the_best_share_is_picked_and_the_later_one_of_equals():
    tests = [
        {"step": 10, "touched": [0.5, 0.9, 0.0]},
        {"step": 20, "touched": [0.7, 0.1, 0.0]},
        {"step": 30, "touched": [0.7, 0.3, 0.0]},
    ]
    assert pick(tests) == [30, 10, 30]
    with pytest.raises(ValueError, match="at least one"):
        pick([])


@pytest.mark.parametrize("name", ["ctd3", "gain"])
def test_every_seed_acts_as_the_policy_picked_for_it(run, name, tmp_path):
    run = run if name == "ctd3" else trained(name, tmp_path)
    steps = [320, 160, 320, 320]
    planner, low, _ = load_picked(peg_push.STUDY, name, steps, run)
    inputs = next(planner.parameters()).shape[-2:]
    rng = np.random.default_rng(1)
    size = peg_push.STUDY.planning().observe(task := _task(), task.reset()).shape[-1]
    assert size in inputs
    seen, signals = rng.normal(size=(4, 2, size)), rng.normal(size=(4, 2, 25))
    for seed, step in enumerate(steps):
        own, own_low, _ = load(peg_push.STUDY, name, step, run)
        np.testing.assert_array_equal(evaluate(planner, seen)[seed], evaluate(own, seen)[seed])
        np.testing.assert_array_equal(
            low.act(signals, explore=False)[seed], own_low.act(signals, explore=False)[seed]
        )
    other, _, _ = load(peg_push.STUDY, name, 160, run)
    assert not np.allclose(evaluate(planner, seen)[0], evaluate(other, seen)[0])
    with pytest.raises(ValueError, match="each of 4 seeds, got 2"):
        load_picked(peg_push.STUDY, name, [160, 320], run)


def _task():
    return peg_push.STUDY.task_class(peg_push.STUDY.task)


def test_the_command_judges_on_fresh_episodes(run, tmp_path, capsys):
    tests = [
        {"step": 160, "touched": [0.0, 0.5, 0.1, 0.0]},
        {"step": 320, "touched": [0.1, 0.2, 0.3, 0.4]},
    ]
    results = store.write_json(
        tmp_path / "results.json", {"methods": {"ctd3": {"title": "ours", "tests": tests}}}
    )
    out = tmp_path / "selected.json"
    request = ["--results", str(results), "--checkpoints", str(run.parent), "--episodes", "1"]
    main([*request, "--write", str(out)])
    assert "steps [320, 160, 320, 320]" in capsys.readouterr().out
    found = store.read_json(out)["methods"]["ctd3"]
    assert found["picked"] == [320, 160, 320, 320]
    assert found["episodes"] == 1
    assert all(0 <= share <= 1 for share in found["touched"])
    with pytest.raises(ValueError, match="unknown methods"):
        main([*request, "--method", "td4"])
