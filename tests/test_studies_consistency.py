"""How consistent a low level is: over starts, pushes and training; how distances are counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_studies_two_level import small

from cmc import store
from cmc.learning.low_level import Fixed
from cmc.studies import peg_maze, peg_push, two_level_evaluation, two_level_results
from cmc.studies.two_level_evaluation import Episodes, consistency, run_episodes, summary
from cmc.studies.two_level_training import train


class Linear(Fixed):
    """u = clip(gain y): one gain for each seed."""

    def __init__(self, *gains: float) -> None:
        super().__init__(None)
        self.gains = np.array(gains)[:, None, None]

    def act(self, observation, explore):
        return np.clip(self.gains * observation[..., :6], -1.0, 1.0)


@pytest.mark.parametrize("study", [peg_push.STUDY, peg_maze.STUDY], ids=lambda s: s.name)
def test_a_higher_gain_resists_pushes_and_starts(study) -> None:
    found = consistency(study, Linear(0.0, 20.0, 0.0), seeds=3, starts=8)
    for key in ("mean", "spread", "pushed", "mean_vector"):
        np.testing.assert_allclose(found[key][0], found[key][2], rtol=1e-9)  # the same worlds
    assert found["mean"][1] > found["mean"][0]
    assert found["pushed"][1] < found["pushed"][0]
    np.testing.assert_allclose(-found["mean_vector"][:, 0], found["mean"])


def test_a_step_is_five_millimeters_wherever_it_starts() -> None:
    """Near the edge of the maze's box a clamped step would be shorter; here the spread is small."""
    found = consistency(peg_maze.STUDY, Linear(50.0), seeds=1, starts=16)
    assert found["mean"][0] > 0.003
    assert found["spread"][0] < 0.001


def test_the_spread_without_action_is_what_the_push_does_to_the_gains_alone(monkeypatch) -> None:
    """Without action the loop is nearly linear, so that the effect scales with the force."""
    spreads = []
    for force in (0.0, 0.2, 0.4):
        monkeypatch.setattr(two_level_evaluation, "PUSH", force)
        spreads.append(consistency(peg_push.STUDY, Linear(0.0), seeds=1, starts=4)["pushed"][0])
    assert spreads[0] < 1e-12
    assert spreads[2] / spreads[1] == pytest.approx(2.0, rel=0.02)


def _test_of(step: int, vectors: list[list[float]]) -> dict:
    return {"step": step, "consistency_mm": {"mean_vector": vectors}}


def test_spread_over_training_counts_every_direction_by_seed() -> None:
    swing = [
        _test_of(k, [[3.0, 0.0, 0.0], [3.0 + (-1) ** k, 2.0 * (-1) ** k, 1.0]]) for k in (1, 2)
    ]
    still, moving = two_level_results._over_training(swing)
    assert still == 0.0
    assert moving == pytest.approx(np.sqrt(1.0 + 4.0))
    assert two_level_results._over_training(swing[:1]) is None


def test_an_episode_that_touches_and_leaves_has_passed_by() -> None:
    success = np.array([[True, False, False, False]])
    touched = np.array([[True, True, True, False]])
    distance = np.array([[0.0001, 0.0104, 0.0312344, 0.02]])
    nearest = np.minimum(distance, [[1.0, 0.0002, 0.0003, 0.015]])
    force = np.zeros((2, 1, 4))
    found = Episodes(success, touched, distance, nearest, distance, force, force, distance)
    figures = summary(found, every=True)
    assert figures["passed_by"] == [0.5]
    assert figures["final_mm_all"] == [[0.1, 10.4, 31.23, 20.0]]
    assert figures["nearest_mm_all"] == [[0.1, 0.2, 0.3, 15.0]]
    assert figures["final_mm"] == pytest.approx([15.2])
    assert not {"nearest_mm_all", "final_mm_all"} & set(summary(found))
    store.json.dumps(figures, allow_nan=False)


def test_every_kept_policy_has_the_figures_and_older_files_are_not_used(
    tmp_path: Path, monkeypatch
) -> None:
    study = small(peg_maze.STUDY)
    train(study, "hiro", [0, 1], steps=240, out=tmp_path)
    options = {"trajectories": 2, "folder": tmp_path / "tests", "checkpoints": tmp_path}
    monkeypatch.setattr(two_level_results, "FORMAT", two_level_results.FORMAT - 1)
    two_level_results.evaluate(study, **options)
    monkeypatch.undo()
    runs: list[int] = []
    monkeypatch.setattr(
        two_level_results, "run_episodes", lambda *given: runs.append(1) or run_episodes(*given)
    )
    found = [two_level_results.evaluate(study, **options)["methods"]["hiro"] for _ in range(2)]
    assert len(runs) == 2  # one for each of two policies, and none the second time
    assert found[0]["tests"] == found[1]["tests"]
    first, last = found[0]["tests"]
    assert "final_mm_all" not in first
    assert np.shape(last["final_mm_all"]) == np.shape(last["nearest_mm_all"]) == (2, 2)
    for test in (first, last):
        assert np.shape(test["consistency_mm"]["mean_vector"]) == (2, 3)
        assert (np.array(test["consistency_mm"]["pushed"]) > 0.0).all()
        assert len(test["passed_by"]) == 2
    change = [test["consistency_mm"]["mean_vector"] for test in (first, last)]
    expected = np.linalg.norm(np.subtract(*change), axis=-1) / 2
    np.testing.assert_allclose(found[0]["consistency_over_training_mm"], expected)
    np.testing.assert_allclose(found[0]["consistency_late_mm"], expected)
