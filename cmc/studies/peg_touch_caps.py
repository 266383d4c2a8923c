"""What a cap on the slopes costs: the same training under different caps, then the same tests.

`python -m cmc.studies.peg_touch_caps` writes `assets/results/peg_touch_caps.json`. Every capped
variant meets k1 + (h/2) k2 < coth(h/(2 tau))/K for half the lags and twice the stiffness, by
construction; they differ in how the room under that line is shared out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc import store
from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.learning.ppo import PPO
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.studies.peg_touch_evaluation import SHIFTS, run_test, shifted
from cmc.studies.peg_touch_methods import HIDDEN, SAFETY
from cmc.studies.peg_touch_training import PegTouchStudy, slope_limit, task_of

Options = Callable[[np.ndarray, float], dict[str, Any]]
RESULT = "peg_touch_caps.json"


@dataclass(frozen=True)
class Variant:
    """One way to keep, or not to keep, the sampled-data bound."""

    title: str
    """Name in tables."""
    options: Options
    """Arguments of `PositiveNetwork` from the limit (2,) of k1 + (h/2) k2, and h."""
    scaled: bool = False
    """Whether the nominal stiffness is divided out, so that the limit is one on the loop gain."""
    log_std: tuple[float, float] = (-1.0, -1.0)
    """First logarithm of the noise in each dimension."""


def _joint(limit: np.ndarray, h: float, **more: Any) -> dict[str, Any]:
    return {"joint_cap": ((1.0, h / 2), SAFETY * limit), **more}


def _separate(share: float) -> Options:
    """Give k1 a share of the room and (h/2) k2 the rest."""
    split = np.array([share, 1.0 - share])
    return lambda limit, h: {"slope_max": SAFETY * limit[:, None] * split / [1.0, h / 2]}


def _bypass(proportional: float, integral: float) -> Options:
    """Put these shares of the vertical room into the linear bypass; horizontally no cap binds."""
    split = np.array([[0.0, 0.0], [proportional, integral]])
    return lambda limit, h: _joint(limit, h, slope_min=limit[:, None] * split / [1.0, h / 2])


VARIANTS: dict[str, Variant] = {
    "none": Variant("no cap", lambda limit, h: {}),
    "separate": Variant("half the room to each slope", _separate(0.5)),
    "separate_p": Variant("nine tenths to k1", _separate(0.9)),
    "separate_i": Variant("nine tenths to k2", _separate(0.1)),
    "joint": Variant("joint cap on k1 + (h/2) k2", _joint),
    "joint_odd": Variant(
        "joint cap, no biases: the product bound is reached",
        lambda limit, h: _joint(limit, h, bias=False),
    ),
    "joint_shallow": Variant(
        "joint cap, one hidden layer", lambda limit, h: _joint(limit, h, hidden=(32,))
    ),
    "joint_bypass_i": Variant("joint cap, a quarter in a bypass of k2", _bypass(0.0, 0.25)),
    "joint_bypass_p": Variant("joint cap, a quarter in a bypass of k1", _bypass(0.25, 0.0)),
    "joint_bypass": Variant("joint cap, most of it in a bypass", _bypass(0.15, 0.6)),
    "scaled": Variant("joint cap on the loop gain", _joint, scaled=True),
    "scaled_quiet": Variant(
        "joint cap on the loop gain, little noise", _joint, scaled=True, log_std=(-1.0, -3.0)
    ),
    "scaled_bypass": Variant(
        "joint cap on the loop gain, most of it in a bypass, little noise",
        _bypass(0.2, 0.5),
        scaled=True,
        log_std=(-1.0, -3.0),
    ),
    "scaled_odd": Variant(
        "joint cap on the loop gain, little noise, no biases",
        lambda limit, h: _joint(limit, h, bias=False),
        scaled=True,
        log_std=(-1.0, -3.0),
    ),
    "joint_quiet": Variant("joint cap, little noise", _joint, log_std=(-1.0, -3.0)),
    "none_bypass": Variant(
        "no cap, the same bypass",
        lambda limit, h: {"slope_min": _bypass(0.15, 0.6)(limit, h)["slope_min"]},
    ),
    "none_quiet": Variant("no cap, little noise", lambda limit, h: {}, log_std=(-1.0, -3.0)),
}


def train(
    variant: Variant, seeds: Sequence[int], episodes: int, study: PegTouchStudy
) -> tuple[nn.Module, np.ndarray]:
    """Train one variant; returns the policy and the returns (updates, seeds)."""
    like = "cppo_scaled" if variant.scaled else "cppo_capped"
    options = {"hidden": HIDDEN, **variant.options(slope_limit(like, study), study.task.h)}
    policy = ModularPolicy(PositiveNetwork(2, seeds=seeds, **options))
    envs = PegTouchVectorEnv(len(seeds) * study.episodes_per_update, task_of(like, study))
    trainer = PPO(envs, policy, seeds, study.ppo)
    with torch.no_grad():
        trainer.log_std.copy_(torch.tensor(variant.log_std).expand_as(trainer.log_std))
    returns: list[np.ndarray] = []
    trainer.train(
        episodes // study.episodes_per_update, lambda row: returns.append(row["episode_return"])
    )
    return policy, np.array(returns)


def compare(
    names: Iterable[str] = VARIANTS,
    *,
    seeds: Sequence[int] = range(5),
    episodes: int = 5000,
    trajectories: int = 2000,
    shifts: Sequence[str] = tuple(SHIFTS),
    finished: Mapping[str, dict[str, Any]] | None = None,
    progress: Callable[[str, dict[str, dict[str, Any]]], object] | None = None,
) -> dict[str, Any]:
    """Train and test variants; one entry each, with the cost against "none" where it is there.

    Args:
        names: of `VARIANTS`.
        seeds: of each training.
        episodes: training episodes of each seed.
        trajectories: of each test and seed.
        shifts: of the plant in the tests, "nominal" among them.
        finished: entries of an earlier call with the same numbers, not to be repeated.
        progress: called with the name of each new entry and all entries so far.

    Raises:
        ValueError: for an unknown variant.
    """
    names = list(names)
    if unknown := set(names) - set(VARIANTS):
        raise ValueError(f"variants: wanted some of {sorted(VARIANTS)}, got {sorted(unknown)}")
    study = PegTouchStudy()
    answer: dict[str, dict[str, Any]] = dict(finished or {})
    for name in names:
        if name in answer:
            continue
        variant, start = VARIANTS[name], time.process_time()
        policy, returns = train(variant, list(seeds), episodes, study)
        answer[name] = _tested(policy, variant, len(seeds), trajectories, shifts, study)
        answer[name] |= {
            "title": variant.title,
            "training_return": _by_episode(returns, study.episodes_per_update),
            "cpu_seconds": round(time.process_time() - start, 1),
        }
        if "none" in answer:
            own, free = answer[name]["return"], answer["none"]["return"]
            answer[name]["cost"] = round(float(np.mean(own) / np.mean(free)) - 1.0, 4)
        if progress is not None:
            progress(name, answer)
    return answer


def _tested(
    policy: nn.Module,
    variant: Variant,
    seeds: int,
    trajectories: int,
    shifts: Sequence[str],
    study: PegTouchStudy,
) -> dict[str, Any]:
    """Return at the nominal plant by seed, shares of instability and force errors by shift."""
    task = task_of("cppo_scaled" if variant.scaled else "cppo_capped", study)
    test = replace(study.test, trajectories=trajectories)
    found = {shift: run_test(policy, shifted(task, shift), test, seeds) for shift in shifts}
    shares = {
        key: {shift: round(float(np.mean(row[key])), 6) for shift, row in found.items()}
        for key in ("oscillation", "drift", "error_f")
    }
    high = policy.slope_bounds()[1]  # type: ignore[operator]
    reach = high[..., 0] + task.h / 2 * high[..., 1]
    return {"return": found["nominal"]["return"], **shares, "reach": reach.round(5).tolist()}


def _by_episode(returns: np.ndarray, size: int, window: int = 20) -> dict[str, list[float]]:
    """Mean return of the last updates before some episodes, by seed."""
    marks = [mark for mark in (1000, 2500, 5000, 10_000) if mark // size <= len(returns)]
    return {
        str(mark): returns[mark // size - window : mark // size].mean(0).round(2).tolist()
        for mark in marks
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="What a cap on the slopes costs.")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=5000)
    parser.add_argument("--trajectories", type=int, default=2000)
    parser.add_argument("--out", type=Path, default=Path("assets/results") / RESULT)
    chosen = parser.parse_args()
    seeds = list(range(chosen.seeds))
    numbers = {"episodes": chosen.episodes, "trajectories": chosen.trajectories}
    command = (
        f"python -m cmc.studies.peg_touch_caps --seeds {chosen.seeds} "
        f"--episodes {chosen.episodes} --trajectories {chosen.trajectories}"
    )
    made = {**store.provenance(command, seeds), **numbers}
    finished: dict[str, Any] = {}
    if chosen.out.is_file():
        found = store.read_json(chosen.out)
        if found.get("command") == command:  # go on where an earlier run stopped
            finished = found["variants"]

    def show(name: str, rows: dict[str, dict[str, Any]]) -> None:
        row = rows[name]
        cost, worst = row.get("cost"), max(row["oscillation"].values())
        print(f"{name:16} return {np.mean(row['return']):7.2f} cost {cost} worst {worst}")
        store.write_json(chosen.out, {**made, "variants": rows})

    compare(chosen.variants, seeds=seeds, finished=finished, progress=show, **numbers)


if __name__ == "__main__":
    main()
