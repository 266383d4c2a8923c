"""Does soft contact make peg push easy to learn? The same training under other contact.

`python -m cmc.studies.contact_training` trains, tests every kept policy under the contact that it
was trained with, and writes `assets/results/peg_push_contact_training.json`; stopped, it goes on
where it was. `cmc.studies.contact_stiffness` says what a scale of the contact's time constant does
and tests policies that were trained at scale 1; these are in the result of `cmc.studies.peg_push`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cmc import store
from cmc.studies import peg_push
from cmc.studies.contact_stiffness import scaled
from cmc.studies.two_level import Callback, TwoLevelStudy
from cmc.studies.two_level_results import evaluate_method, verdict
from cmc.studies.two_level_training import train

METHODS = ("ctd3",)
SCALES = (0.4, 4.0)
"""Of the time constant: 6.25 times as stiff as the paper's contact, and a sixteenth."""
RESULT = "peg_push_contact_training.json"


def variant(scale: float, study: TwoLevelStudy = peg_push.STUDY) -> TwoLevelStudy:
    """Peg push with the time constant of all contact multiplied by `scale`, else the same.

    Raises:
        ValueError: if the time constant falls below two physics steps.
    """
    return replace(study, name=f"{study.name}_contact_{scale:g}", task_class=scaled(scale))


def learn(
    names: Iterable[str] = METHODS,
    *,
    scales: Iterable[float] = SCALES,
    seeds: Sequence[int] = range(5),
    steps: int | None = None,
    episodes: int | None = None,
    out: str | Path = "runs/peg_push_contact",
    study: TwoLevelStudy = peg_push.STUDY,
    callback: Callable[[str], Callback] | None = None,
    testing: Callable[[int, str], object] | None = None,
) -> dict[str, Any]:
    """Train and test methods at every scale; finished parts are not repeated.

    Args:
        names: methods.
        scales: of the contact's time constant.
        seeds: of the trainings.
        steps: environment steps of each seed; the study's if None.
        episodes: test episodes of each seed with the last policy; the study's if None.
        out: folder of the runs.
        study: peg push, perhaps in a smaller configuration.
        callback: told "METHOD, scale S" it gives what `train` calls after every segment.
        testing: called before each test with its number and what it is.

    Returns:
        `runs`, one for each method and scale: `method`, `scale`, `stiffness` relative to the
        nominal one, and what `evaluate_method` answers; provenance.

    Raises:
        ValueError: for an unknown method, no seed, or a scale that is too small.
        CheckpointError: if the folder holds a run of another configuration.
    """
    names, scales = list(names), [float(scale) for scale in scales]
    for name in names:
        study.method(name)
    variants = {scale: variant(scale, study) for scale in scales}
    count, runs = study.episodes if episodes is None else episodes, []
    for (scale, here), name in product(variants.items(), names):
        report = callback(f"{name}, scale {scale:g}") if callback is not None else None
        folder = Path(out) / f"{scale:g}"
        path = train(here, name, seeds, steps=steps, out=folder, callback=report)
        tests = evaluate_method(here, name, path, count, folder / f"{name}.json", testing)
        runs.append({"method": name, "scale": scale, "stiffness": round(scale**-2, 6), **tests})
    command = f"python -m cmc.studies.contact_training --method {' '.join(names)}"
    command += f" --scale {' '.join(f'{scale:g}' for scale in scales)}"
    command += f" --steps {study.steps if steps is None else steps}"
    return {"study": study.name, **store.provenance(command, list(seeds)), "runs": runs}


def _bar(what: str) -> Callback:
    """A progress bar for one training, shown once there is something to do."""
    bars: list[Any] = []

    def show(row: dict[str, Any]) -> None:
        if not bars:
            bars.append(tqdm(desc=what, unit="step", total=row["total_steps"], dynamic_ncols=True))
        bars[0].set_postfix_str(f"reward {row['reward'].mean():.4f}", refresh=False)
        bars[0].update(row["steps"] - bars[0].n)
        if row["steps"] >= row["total_steps"]:
            bars[0].close()

    return show


def main(words: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Peg push learned under stiffer, softer contact.")
    known = list(peg_push.STUDY.methods)
    parser.add_argument("--method", nargs="+", choices=known, metavar="NAME", default=METHODS)
    parser.add_argument("--scale", nargs="+", type=float, default=SCALES)
    parser.add_argument("--seeds", type=int, default=5, help="how many (default 5)")
    parser.add_argument("--steps", type=int, default=peg_push.STUDY.steps, help="of each seed")
    parser.add_argument("--out", type=Path, default=Path("runs/peg_push_contact"))
    parser.add_argument("--write", type=Path, default=Path("assets/results") / RESULT)
    chosen = parser.parse_args(words)

    answer = learn(
        chosen.method,
        scales=chosen.scale,
        seeds=range(chosen.seeds),
        steps=chosen.steps,
        out=chosen.out,
        callback=_bar,
        testing=lambda number, what: print(f"test {number + 1}: {what}", flush=True),
    )
    for run in answer["runs"]:
        print(f"scale {run['scale']:g}: {verdict(run)}")
    print(store.write_json(chosen.write, answer))


if __name__ == "__main__":
    main()
