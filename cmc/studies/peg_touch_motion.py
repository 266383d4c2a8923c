"""Recorded peg-touch trajectories as arrays, for figures and for `python -m cmc play`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike
from torch import nn

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.envs.peg_touch_config import PegTouchConfig
from cmc.studies.peg_touch_methods import method
from cmc.studies.peg_touch_training import load, task_of


def simulate(
    policy: nn.Module,
    config: PegTouchConfig,
    *,
    num: int = 50,
    duration: float = 1.0,
    seed: int = 0,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Run a policy without exploration noise.

    Args:
        policy: maps (num, 4) to (num, 2); a leading axis of seeds is not wanted here.
        config: the task.
        num: trajectories.
        duration: length [s].
        seed: random stream of starts and targets.
        parameters: values to fix, see `PegTouchVectorEnv`.

    Returns:
        `t` (time,), and by time and trajectory `x`, `z`, `f`, `e_x`, `e_f`, `u_x`, `u_z`,
        `reward`; `return`, the sum of rewards over the first `horizon` steps, (num,); and
        `sampled`, the values drawn.
    """
    envs = PegTouchVectorEnv(num, config, AutoresetMode.DISABLED)
    obs, _ = envs.reset(seed=seed, options={"parameters": dict(parameters or {})})
    rows: list[list[np.ndarray]] = []
    for _ in range(round(duration / config.h)):
        now = [*envs.position.T, envs.force, *envs.error.T]
        with torch.no_grad():
            action = policy(torch.as_tensor(obs)).numpy()
        obs, reward, *_ = envs.step(action)
        rows.append([*now, *envs.command.T, reward])
    names = ("x", "z", "f", "e_x", "e_f", "u_x", "u_z", "reward")
    recorded: dict[str, Any] = {
        name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }
    recorded["t"] = config.h * np.arange(len(rows))
    recorded["return"] = recorded["reward"][: config.horizon].sum(axis=0)
    return {**recorded, "sampled": envs.sampled}


def motion(name: str, seed: int = 0) -> dict[str, Any]:
    """What `python -m cmc play peg_touch` draws: errors of 50 trajectories of a shipped policy."""
    policy = load(name, seed=seed if method(name).trained else None)
    run = simulate(policy, task_of(name))
    signals = [
        (r"$x - x_d$ (m)", run["e_x"], 0.0),
        (r"$f - f_d$ (N)", np.clip(run["e_f"], -10.0, 10.0), 0.0),
    ]
    text = f"{method(name).title}: tracking errors of 50 trajectories of the training set."
    return {"t": run["t"], "signals": signals, "text": text}
