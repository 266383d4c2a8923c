"""Command line: `python -m cmc list | train | evaluate | play`.

This is the only place where learning and pictures meet.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cmc import studies


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
    train.add_argument("--episodes", type=int, help="training episodes, instead of the study's")
    train.add_argument("--out", type=Path, help="folder of the run (default runs/STUDY)")
    train.set_defaults(run=_train)
    evaluate = commands.add_parser("evaluate", help="test the shipped policies")
    evaluate.add_argument("study")
    evaluate.add_argument("--method", help="one method; all if left out")
    evaluate.add_argument("--trajectories", type=int, help="for each test, instead of the study's")
    evaluate.add_argument("--out", type=Path, help="folder that keeps finished methods")
    evaluate.add_argument("--json", action="store_true", help="all figures as the last line")
    evaluate.set_defaults(run=_evaluate)
    play = commands.add_parser("play", help="write a picture of one trajectory")
    play.add_argument("study")
    play.add_argument("--method", help="the study's first if left out")
    play.add_argument("--seed", type=int, default=0, help="which trained seed (default 0)")
    play.add_argument("--out", type=Path, default=Path("play.png"), help="file (default play.png)")
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


def _train(chosen: argparse.Namespace) -> None:
    from tqdm import tqdm

    study = studies.get(chosen.study)
    if chosen.seeds < 1:
        raise ValueError(f"--seeds: wanted at least 1, got {chosen.seeds}")
    if chosen.episodes is not None and chosen.episodes < 1:
        raise ValueError(f"--episodes: wanted at least 1, got {chosen.episodes}")
    for method in _methods(study, chosen.method):
        with tqdm(desc=method, unit="update", dynamic_ncols=True) as bar:

            def show(report: dict[str, Any], bar: Any = bar) -> None:
                bar.total = report["total_updates"]
                bar.set_postfix_str(f"return {report['episode_return'].mean():.1f}", refresh=False)
                bar.update(report["update"] - bar.n)

            path = study.train(
                method,
                range(chosen.seeds),
                out=chosen.out,
                episodes=chosen.episodes,
                callback=show,
            )
        print(f"{method}: {path}")


def _evaluate(chosen: argparse.Namespace) -> None:
    from tqdm import tqdm

    study = studies.get(chosen.study)
    names = None if chosen.method is None else _methods(study, chosen.method)
    options = {} if chosen.out is None else {"folder": chosen.out}
    with tqdm(desc=chosen.study, unit="test", dynamic_ncols=True) as bar:

        def show(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_postfix_str(what, refresh=False)
            bar.update(done - bar.n)

        answer = study.evaluate(names, trajectories=chosen.trajectories, progress=show, **options)
    for name, claim in answer["claims"].items():
        print(f"{name}: {claim['verdict']}")
    if chosen.json:
        print(json.dumps(answer, allow_nan=False))


def _play(chosen: argparse.Namespace) -> None:
    study = studies.get(chosen.study)
    method = _methods(study, chosen.method or next(iter(study.METHODS)))[0]
    if chosen.out.suffix != ".png":
        raise ValueError(f"--out: wanted a .png file, got {chosen.out}")
    motion = study.motion(method, chosen.seed)
    from cmc.view import plots

    fig, axes = plots.panels(1, len(motion["signals"]), width=9)
    for ax, (label, values, target) in zip(axes.flat, motion["signals"], strict=True):
        plots.trajectories(motion["t"], values, labels=("time (s)", label), target=target, ax=ax)
    print(plots.save(fig, chosen.out, motion["text"]))


if __name__ == "__main__":
    sys.exit(main())
