"""Pick a kept policy for each seed on validation episodes, and test it on fresh ones.

Planners go up and down between kept policies. The rule, fixed before it was used: for each seed the
policy with the largest share of strict touches among those that `evaluate` tested, the later one if
equal. Those episodes decide, so others judge: the picked policies are tested from starts that no
other test uses. `python -m cmc.studies.selection` writes `assets/results/peg_push_selected.json`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from cmc import store
from cmc.learning.low_level import LowLevel
from cmc.learning.state import single_thread
from cmc.studies.peg_push import STUDY
from cmc.studies.two_level import TwoLevelStudy
from cmc.studies.two_level_evaluation import TEST_SEED, run_episodes, summary
from cmc.studies.two_level_results import find_checkpoint
from cmc.studies.two_level_training import load

FRESH = TEST_SEED + 50_000
"""First of the starts that judge picked policies."""


def pick(tests: Sequence[dict[str, Any]]) -> list[int]:
    """Step of the picked policy of each seed.

    Args:
        tests: of one method, as `evaluate` gives them: `step` and `touched`, a share by seed.
    """
    if not tests:
        raise ValueError("tests: wanted at least one, got none")
    shares = np.array([test["touched"] for test in tests])
    last_best = len(tests) - 1 - np.argmax(shares[::-1], axis=0)
    return [int(tests[k]["step"]) for k in last_best]


def load_picked(
    study: TwoLevelStudy, name: str, steps: Sequence[int], path: str | Path
) -> tuple[nn.Module, LowLevel, dict[str, Any]]:
    """Planner and low level with another kept policy for each seed.

    Raises:
        ValueError: if the number of steps is not that of the seeds, or one was not kept.
    """
    planner, low, record = load(study, name, None, path)
    seeds = len(record["seeds"])
    if len(steps) != seeds:
        raise ValueError(f"steps: wanted one for each of {seeds} seeds, got {len(steps)}")
    for step in set(steps):
        mask = torch.tensor([own == step for own in steps])
        other, other_low, _ = load(study, name, step, path)
        for to, source in ((planner, other), (low.actor, other_low.actor)):
            if to is not None and source is not None:
                _copy_seeds(to, source, mask)
    return planner, low, record


def _copy_seeds(to: nn.Module, source: nn.Module, mask: torch.Tensor) -> None:
    """Copy the masked seeds' weights; the first axis of what learned holds the seeds, in order."""
    new = source.state_dict()
    mixed = {}
    for key, value in to.state_dict().items():
        if torch.equal(value, new[key]):  # did not learn, and may be one for all seeds
            mixed[key] = value
            continue
        parts = value.reshape(len(mask), -1).clone()
        parts[mask] = new[key].reshape(len(mask), -1)[mask]
        mixed[key] = parts.reshape(value.shape)
    to.load_state_dict(mixed)


def select(
    methods: dict[str, Any],
    episodes: int = 100,
    checkpoints: str | Path | None = None,
    progress: Callable[[str, dict[str, Any] | None], object] | None = None,
) -> dict[str, Any]:
    """Pick and test policies of peg push.

    Args:
        methods: of a result file of `evaluate`; those without several kept policies are left out.
        episodes: fresh test episodes of each seed.
        checkpoints: folder of checkpoint files; the shipped ones if None. Those hold all kept
            policies of the study's first method only.
        progress: called with each method and its answer, None before it is tested.

    Returns:
        By method `title`, `seeds`, `picked` (steps, one for each seed) and what `summary` holds.
    """
    if episodes < 1:
        raise ValueError(f"episodes: wanted at least 1, got {episodes}")
    report = progress or (lambda name, found: None)
    answer: dict[str, Any] = {}
    for name, method in methods.items():
        report(name, None)
        if len(method["tests"]) < 2:
            continue
        picked = pick(method["tests"])
        path = find_checkpoint(STUDY, name, checkpoints)
        planner, low, record = load_picked(STUDY, name, picked, path)
        with single_thread():
            found = run_episodes(STUDY, planner, low, len(record["seeds"]), episodes, FRESH)
        named = {"title": method["title"], "seeds": record["seeds"], "picked": picked}
        answer[name] = named | summary(found)
        report(name, answer[name])
    return answer


def main(arguments: Iterable[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--results", type=Path, help="result file; the shipped one if left out")
    parser.add_argument("--checkpoints", type=Path, help="folder; the shipped ones if left out")
    parser.add_argument("--episodes", type=int, default=100, help="of each seed (default 100)")
    parser.add_argument("--method", nargs="*", help="all if left out")
    parser.add_argument("--write", type=Path)
    chosen = parser.parse_args(None if arguments is None else [*arguments])
    methods = store.read_json(chosen.results or store.asset("results", "peg_push.json"))["methods"]
    names = chosen.method or [*methods]
    unknown = sorted(set(names) - set(methods))
    if unknown:
        raise ValueError(f"unknown methods {unknown}; wanted some of {', '.join(methods)}")
    wanted = {name: methods[name] for name in names}
    with tqdm(total=len(names), unit="method", dynamic_ncols=True) as bar:

        def show(name: str, method: dict[str, Any] | None) -> None:
            bar.set_postfix_str(name)
            if method is not None:
                shares = ", ".join(f"{100 * share:.0f}" for share in method["touched"])
                steps = method["picked"]
                bar.write(f"{method['title']}: steps {steps}, strict touch in {shares} %")
                bar.update()

        found = select(wanted, chosen.episodes, chosen.checkpoints, show)
    command = f"python -m cmc.studies.selection --method {' '.join(found)}"
    made = store.provenance(command, max((m["seeds"] for m in found.values()), key=len, default=[]))
    content = {"study": STUDY.name, "episodes": chosen.episodes, "methods": found, **made}
    store.write_json(chosen.write or Path("assets/results/peg_push_selected.json"), content)


if __name__ == "__main__":
    main()
