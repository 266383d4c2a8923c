"""Caps: whatever the weights, the sampled loop of the worst plant of the design stays stable."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.studies.peg_touch_caps import VARIANTS, compare
from cmc.studies.peg_touch_training import PegTouchStudy, slope_limit, task_of
from cmc.theory.sampled import sampled_margin

CAPPED = [name for name in VARIANTS if not name.startswith("none")]


def worst_plant(scaled: bool):
    task = task_of("cppo_scaled" if scaled else "cppo_capped")
    stiffest = task.stiffness_reference if scaled else task.K_sur[1]
    return 0.5 * np.array([task.tau_x, task.tau_z]), np.array([1.0, 2.0 * stiffest]), task.h


@pytest.mark.parametrize("name", CAPPED)
def test_the_worst_sampled_loop_is_stable_for_any_weights(name):
    variant, study = VARIANTS[name], PegTouchStudy()
    limit = slope_limit("cppo_scaled" if variant.scaled else "cppo_capped", study)
    options = {"hidden": (8, 8), **variant.options(limit, study.task.h)}
    policy = ModularPolicy(PositiveNetwork(2, seeds=[0, 1], **options))
    tau, K, h = worst_plant(variant.scaled)
    for scale in (0.3, 3.0, 30.0):
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.copy_(scale * torch.randn(parameter.shape))
            s = torch.randn(2, 500, 2, 2) * torch.tensor([1.0, 0.1])
            s[:, 0] = 0.0
            slope = policy.jacobian(s).double().numpy()
        assert (sampled_margin(slope[..., 0], slope[..., 1], tau, K, h) >= 0).all()


def test_without_a_cap_some_weights_are_unstable():
    policy = ModularPolicy(PositiveNetwork(2, hidden=(8, 8)))
    tau, K, h = worst_plant(False)
    slope = policy.jacobian(torch.zeros(1, 2, 2)).detach().double().numpy()
    assert (sampled_margin(slope[..., 0], slope[..., 1], tau, K, h) < 0).any()


def test_comparison_reports_cost_and_shares():
    two = {"seeds": [0, 1], "shifts": ["nominal", "all, fast"]}
    found = compare(["none", "joint"], episodes=64, trajectories=20, **two)
    assert found["none"]["cost"] == 0.0
    own, free = (np.mean(found[name]["return"]) for name in ("joint", "none"))
    assert found["joint"]["cost"] == pytest.approx(own / free - 1, abs=1e-3)
    assert set(found["joint"]["oscillation"]) == set(found["joint"]["drift"])
    assert max(found["joint"]["oscillation"].values()) == 0.0
    with pytest.raises(ValueError, match="variants"):
        compare(["joint", "tight"])
