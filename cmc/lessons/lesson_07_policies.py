"""Lesson 07, fourth part: trained policies whose commands arrive late."""

from __future__ import annotations

from collections import deque
from functools import cache
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.fast import budget
from cmc.studies import peg_touch
from cmc.studies.detectors import judge
from cmc.studies.peg_touch_evaluation import equilibrium
from cmc.theory.delay import LagLoop, spectral_radius

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SEEDS = 5
DELAYS = (0, 1, 2, 3, 4, 6)
"""Delays in samples of the control period."""
METHODS = ("cppo", "cppo_capped")


@cache
def under_delay() -> dict[str, dict[str, Any]]:
    """Share of oscillating trajectories against the delay of the command, per method.

    Only trajectories whose target the policy can hold are counted.

    Returns:
        For each method `title`, `delays` (samples), `measured` and `predicted` (seeds, delays), and
        `agreement`, the share of trajectories on which both say the same.
    """
    return {name: _method(name) for name in METHODS}


def _method(name: str) -> dict[str, Any]:
    policy = peg_touch.load(name)
    measured, predicted, same = [], [], []
    for late in DELAYS:
        found, envs = _run(policy, name, late)
        s, exists = equilibrium(policy, envs, SEEDS)
        counted: Flags = np.all(exists, axis=-1)
        wanted = _unstable(policy, s, envs, late)
        measured.append((found & counted).sum(axis=1) / counted.sum(axis=1))
        predicted.append((wanted & counted).sum(axis=1) / counted.sum(axis=1))
        same.append((found == wanted)[counted])
    return {
        "title": peg_touch.METHODS[name].title,
        "delays": np.array(DELAYS),
        "measured": np.array(measured).T,
        "predicted": np.array(predicted).T,
        "agreement": float(np.concatenate(same).mean()),
    }


def _run(policy: torch.nn.Module, name: str, late: int) -> tuple[Flags, PegTouchVectorEnv]:
    """Oscillation of each trajectory, (seeds, trajectories), and the environment."""
    config, number = peg_touch.task_of(name), budget(100, 25)
    envs = PegTouchVectorEnv(SEEDS * number, config, AutoresetMode.DISABLED)
    obs, _ = envs.reset(seed=[7] * SEEDS)
    waiting = deque([np.zeros((SEEDS * number, 2), np.float32)] * late)
    errors = []
    for _ in range(round(4.0 / config.h)):
        with torch.no_grad():
            action = policy(torch.as_tensor(obs).reshape(SEEDS, number, 4))
        waiting.append(action.reshape(-1, 2).numpy())
        obs, *_ = envs.step(waiting.popleft())
        errors.append(envs.error.copy())
    return judge(np.array(errors), config.h).oscillation.reshape(SEEDS, number), envs


def _unstable(
    policy: torch.nn.Module, s: torch.Tensor, envs: PegTouchVectorEnv, late: int
) -> Flags:
    """Whether the delayed loop of some dimension has a pole outside of the unit circle."""
    config = envs.config
    with torch.no_grad():
        slopes = policy.jacobian(s).double().numpy()  # type: ignore[operator]
    slopes = np.maximum(slopes, 1e-9).reshape(-1, 2, 2)
    outside = np.zeros(len(slopes), dtype=bool)
    for i, stiffness in enumerate(envs.true_peg.K_sur):
        for tau, gain, (k1, k2) in zip(
            (config.tau_x, config.tau_z), (1.0, float(stiffness)), slopes[i], strict=True
        ):
            loop = LagLoop(tau, gain, config.h, float(k1 / k2))
            outside[i] |= spectral_radius(loop, late * config.h, float(k1)) > 1.0
    return outside.reshape(s.shape[:2])
