"""How consistent a low level is: over starts, pushes and training; how distances are counted."""

from __future__ import annotations

import numpy as np
import pytest

from cmc.learning.low_level import Fixed
from cmc.studies import peg_maze, peg_push, two_level_tests
from cmc.studies.two_level_tests import consistency


class Linear(Fixed):
    """u = clip(gain y): one gain for each seed."""

    def __init__(self, *gains: float) -> None:
        super().__init__(None)
        self.gains = np.array(gains)[:, None, None]

    def act(self, observation, explore):
        return np.clip(self.gains * observation[..., :6], -1.0, 1.0)


@pytest.mark.parametrize("study", [peg_push.STUDY, peg_maze.STUDY], ids=lambda s: s.name)
def test_a_higher_gain_resists_pushes_and_starts(study) -> None:
    found = consistency(study.config, Linear(0.0, 20.0, 0.0), seeds=3, starts=8)
    for values in found.values():
        np.testing.assert_allclose(values[0], values[2], rtol=1e-9)  # the same worlds
    assert found["moved_mm"][1] > found["moved_mm"][0]
    assert found["push_mm"][1] < found["push_mm"][0]
    np.testing.assert_allclose(-found["moved_x_mm"], found["moved_mm"])


def test_a_step_is_five_millimeters_wherever_it_starts() -> None:
    """Near the edge of the maze's box a clamped step would be shorter; here the spread is small."""
    found = consistency(peg_maze.STUDY.config, Linear(50.0), seeds=1, starts=16)
    assert found["moved_mm"][0] > 0.003
    assert found["starts_mm"][0] < 0.001


def test_the_spread_without_action_is_what_the_push_does_to_the_gains_alone(monkeypatch) -> None:
    """Without action the loop is nearly linear, so that the effect scales with the force."""
    spreads = []
    for force in (0.0, 0.2, 0.4):
        monkeypatch.setattr(two_level_tests, "PUSH", force)
        spreads.append(consistency(peg_push.STUDY.config, Linear(0.0), 1, 4)["push_mm"][0])
    assert spreads[0] < 1e-12
    assert spreads[2] / spreads[1] == pytest.approx(2.0, rel=0.02)
