"""Command line: `python -m cmc list | train | evaluate | play`.

This is the only place where learning and pictures meet.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cmc import store, studies


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (2 for a wrong request)."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    try:
        chosen.run(chosen)
    except (ValueError, FileNotFoundError) as error:
        print(f"{parser.prog} {chosen.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{parser.prog} {chosen.command}: interrupted; the same command goes on from here")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m cmc", description="Studies of the course.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="studies, their methods, and what is shipped")
    listing.set_defaults(run=_list)
    train = commands.add_parser("train", help="train a method; goes on with an interrupted run")
    train.add_argument("study")
    train.add_argument("--method", help="one method; all of the study's if left out")
    train.add_argument("--seeds", type=int, default=5, help="number of seeds (default 5)")
    train.add_argument("--episodes", type=int, help="training episodes (peg_touch)")
    train.add_argument("--steps", type=int, help="environment steps of each seed (other studies)")
    train.add_argument("--jobs", type=int, default=1, help="trainings side by side (default 1)")
    train.add_argument("--group", type=int, help="seeds of one job; all if left out")
    train.add_argument("--backend", choices=("loky", "dask"), default="loky")
    train.add_argument("--address", help="of a running Dask scheduler")
    train.add_argument("--out", type=Path, help="folder of the run (default runs/STUDY)")
    train.set_defaults(run=_train)
    evaluate = commands.add_parser("evaluate", help="test the shipped policies")
    evaluate.add_argument("study")
    evaluate.add_argument("--method", help="one method; all if left out")
    evaluate.add_argument("--trajectories", type=int, help="for each test, instead of the study's")
    evaluate.add_argument("--out", type=Path, help="folder that keeps finished methods")
    evaluate.add_argument("--checkpoints", type=Path, help="folder; the shipped ones if left out")
    evaluate.add_argument("--write", type=Path, help="file that also gets all figures, as JSON")
    evaluate.add_argument("--json", action="store_true", help="all figures as the last line")
    evaluate.set_defaults(run=_evaluate)
    play = commands.add_parser("play", help="write a picture or a 3D page of one trajectory")
    play.add_argument("study")
    play.add_argument("--method", help="the study's first if left out")
    play.add_argument("--seed", type=int, default=0, help="which trained seed (default 0)")
    play.add_argument("--episode", type=int, default=0, help="number of the test start (3D)")
    play.add_argument(
        "--out", type=Path, help="file (default play.png, or play.html for 3D; .npz keeps arrays)"
    )
    play.add_argument("--checkpoint", type=Path, help="file; the shipped one if left out")
    play.set_defaults(run=_play)
    return parser


def _list(chosen: argparse.Namespace) -> None:
    for name in studies.STUDIES:
        study = studies.get(name)
        print(f"{name}: {(study.__doc__ or '').splitlines()[0]}")
        for method, arm in study.METHODS.items():
            print(f"  {method:18} {arm.title}")


def _methods(study: Any, name: str | None) -> list[str]:
    if name is None:
        return [key for key, arm in study.METHODS.items() if arm.trained]
    if name not in study.METHODS:
        raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(study.METHODS)}")
    return [name]


def _takes(function: Any, name: str) -> bool:
    """Whether a study's function takes an argument."""
    return name in inspect.signature(function).parameters


def _train(chosen: argparse.Namespace) -> None:
    study = studies.get(chosen.study)
    by_steps = _takes(study.train, "steps")
    unit, other = ("steps", "episodes") if by_steps else ("episodes", "steps")
    if getattr(chosen, other) is not None:
        raise ValueError(f"--{other}: {chosen.study} counts {unit}, use --{unit}")
    amount = {unit: getattr(chosen, unit)}
    for name, value in {"seeds": chosen.seeds, **amount}.items():
        if value is not None and value < 1:
            raise ValueError(f"--{name}: wanted at least 1, got {value}")
    methods = _methods(study, chosen.method)
    if chosen.jobs != 1 or chosen.group is not None or chosen.backend != "loky":
        _sweep(chosen, methods, amount)
        return
    from tqdm import tqdm

    counted = "step" if by_steps else "update"
    for method in methods:
        with tqdm(desc=method, unit=counted, dynamic_ncols=True) as bar:

            def show(report: dict[str, Any], bar: Any = bar) -> None:
                done, bar.total, text = _progress(report)
                bar.set_postfix_str(text, refresh=False)
                bar.update(done - bar.n)

            path = study.train(method, range(chosen.seeds), out=chosen.out, callback=show, **amount)
        print(f"{method}: {path}")


def _progress(report: dict[str, Any]) -> tuple[int, int, str]:
    """How much is done, of how much, and a word about it."""
    if "update" in report:
        text = f"return {report['episode_return'].mean():.1f}"
        return report["update"], report["total_updates"], text
    return report["steps"], report["total_steps"], f"reward {report['reward'].mean():.4f}"


def _sweep(chosen: argparse.Namespace, methods: list[str], amount: dict[str, Any]) -> None:
    from cmc.studies.sweep import sweep

    paths = sweep(
        chosen.study,
        methods,
        range(chosen.seeds),
        jobs=chosen.jobs,
        backend=chosen.backend,
        group=chosen.group,
        address=chosen.address,
        out=chosen.out,
        **amount,
    )
    for method, path in zip(methods, paths, strict=True):
        print(f"{method}: {path}")


def _evaluate(chosen: argparse.Namespace) -> None:
    from tqdm import tqdm

    study = studies.get(chosen.study)
    names = None if chosen.method is None else _methods(study, chosen.method)
    given = {"folder": chosen.out, "checkpoints": chosen.checkpoints}
    options = {name: value for name, value in given.items() if value is not None}
    with tqdm(desc=chosen.study, unit="test", dynamic_ncols=True) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_postfix_str(what, refresh=False)
            bar.update(done - bar.n)

        answer = study.evaluate(names, trajectories=chosen.trajectories, progress=show, **options)
    for name, claim in answer["claims"].items():
        print(f"{name}: {claim['verdict']}")
    if chosen.write is not None:
        store.write_json(chosen.write, answer)
    if chosen.json:
        print(json.dumps(answer, allow_nan=False))


def _play(chosen: argparse.Namespace) -> None:
    study = studies.get(chosen.study)
    method = _methods(study, chosen.method or next(iter(study.METHODS)))[0]
    in_space = _takes(study.motion, "path")
    wanted = (".html", ".npz") if in_space else (".png",)
    out = chosen.out or Path(f"play{wanted[0]}")
    if out.suffix not in wanted:
        raise ValueError(f"--out: wanted a {' or '.join(wanted)} file, got {out}")
    if chosen.checkpoint is not None and not in_space:
        raise ValueError(f"--checkpoint: {chosen.study} plays shipped policies only")
    if not in_space:
        print(_picture(study.motion(method, chosen.seed), out))
        return
    path = chosen.checkpoint
    motion = study.motion(method, chosen.seed, episode=chosen.episode, path=path)
    if out.suffix == ".html":
        print(_page(motion, out))
        return
    from cmc.studies import recorded

    command = f"python -m cmc play {chosen.study} --method {method} --seed {chosen.seed}"
    command += f" --episode {chosen.episode} --out {out.name}"
    made = store.provenance(command, motion["seeds"])
    print(recorded.save(out, motion, {"study": chosen.study, "method": method, **made}))


def _picture(motion: dict[str, Any], out: Path) -> Any:
    """Signals over time."""
    from cmc.view import figures

    fig, axes = figures.panels(1, len(motion["signals"]), width=9)
    for ax, (label, values, target) in zip(axes.flat, motion["signals"], strict=True):
        figures.trajectories(motion["t"], values, labels=("time (s)", label), target=target, ax=ax)
    return figures.save(fig, out, motion["text"])


def _page(motion: dict[str, Any], out: Path) -> Path:
    """The scene in 3D, with the path of the tip, the sub-goals and the contact force."""
    import numpy as np

    from cmc.view.playback import Arrow, record

    recording = record(
        motion["model"],
        motion["qpos"],
        motion["t"],
        title=motion["text"],
        trails=["tip"],
        markers=motion["markers"],
        arrows={"contact force": Arrow(motion["tip"], motion["force"])},
        readouts={
            "distance [mm]": 1e3 * motion["distance"],
            "force [N]": np.linalg.norm(motion["force"], axis=-1),
        },
    )
    views = dict(recording.cameras)
    near = {"task": views.pop("task")} if "task" in views else {}
    return replace(recording, cameras=near | views).save(out)


if __name__ == "__main__":
    sys.exit(main())
