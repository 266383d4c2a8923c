"""Two levels: the planner's exploration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cmc.learning.hierarchy import HierarchyConfig
from cmc.studies import peg_push
from cmc.studies.two_level_parts import build


def test_noise_falls_linearly_and_stays():
    config = HierarchyConfig(high_noise=0.4, high_noise_end=0.1, noise_steps=1000)
    noise = np.array([config.noise(k) for k in range(0, 2001, 100)])
    np.testing.assert_allclose(np.diff(noise[:11]), -0.03)
    np.testing.assert_allclose(noise[10:], 0.1)
    assert HierarchyConfig(high_noise=0.4).noise(10**6) == 0.4


@pytest.mark.parametrize("steps", [10_000, 500_000])
def test_sub_goals_scatter_by_the_noise_of_the_moment(steps):
    study = replace(peg_push.STUDY, hierarchy=replace(peg_push.STUDY.hierarchy, worlds=400))
    trainer = build(study, "frozen", [0])
    for parameter in trainer.planner.actor.parameters():
        torch.nn.init.zeros_(parameter)  # sub-goals at 0, far from the ends of their range
    trainer.steps = steps
    seen = study.planning().observe(trainer.task, trainer.task.reset())[None]
    action = trainer._choose(seen, np.zeros(()))
    wanted = study.hierarchy.noise(steps)
    assert np.std(action) == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("wrong", [{"high_noise": -0.1}, {"noise_steps": 0}])
def test_impossible_noise_is_refused(wrong):
    with pytest.raises(ValueError, match="noise"):
        HierarchyConfig(**wrong)
