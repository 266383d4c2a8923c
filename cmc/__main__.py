"""Command line: `python -m cmc list | train | evaluate | ship | play`.

This is the only place where learning and pictures meet.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cmc import results, store, studies
from cmc.studies.study import Study


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (2 for a request that cannot be met)."""
    parser, rest = _parser(), "the same command goes on from what was saved last"
    chosen = parser.parse_args(arguments)
    try:
        chosen.run(chosen)
    except (ValueError, OSError) as error:
        full = isinstance(error, OSError) and error.errno == errno.ENOSPC
        more = f"; make room, and {rest}" if full else ""
        print(f"{parser.prog} {chosen.command}: {error}{more}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as reason:
        said = f"{reason}; {rest}" if str(reason) else rest
        print(f"{parser.prog} {chosen.command}: interrupted; {said}")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m cmc", description="Studies of the course.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], None], text: str) -> Any:
        made = commands.add_parser(name, help=text)
        made.set_defaults(run=run)
        if name != "list":
            made.add_argument("study", help="see `list`")
        if name in ("train", "evaluate", "play"):
            made.add_argument("--method", help="one method; all that fit if left out")
        return made.add_argument

    command("list", _list, "studies, their methods, and what is shipped")
    train = command("train", _train, "train a method; goes on with an interrupted run")
    train("--seeds", type=int, default=5, help="number of seeds (default 5)")
    train("--steps", type=int, help="environment steps of each seed")
    train("--episodes", type=int, help="training episodes of each seed (peg_touch)")
    train("--jobs", type=int, default=1, help="trainings side by side (default 1)")
    train("--group", type=int, help="seeds of one job; all if left out")
    train("--backend", choices=("loky", "dask"), default="loky")
    train("--address", help="of a running Dask scheduler")
    train("--out", type=Path, help="folder of the run (default runs/STUDY)")
    evaluate = command("evaluate", _evaluate, "test the shipped policies, or compute a table")
    evaluate("--trajectories", type=int, help="of the largest tests, fewer than usual")
    evaluate("--out", type=Path, help="folder that keeps finished tests, or the table")
    evaluate("--checkpoints", type=Path, help="folder; the shipped ones if left out")
    evaluate("--json", action="store_true", help="all rows as the last line")
    ship = command("ship", _ship, "test a run's policies; put them and their tables in the assets")
    ship("folder", type=Path, help="of the run")
    text = "methods of which all kept policies are shipped, not only the last"
    ship("--all", nargs="*", default=[], metavar="METHOD", dest="complete", help=text)
    ship("--assets", type=Path, default=Path("assets"))
    play = command("play", _play, "write a picture or a 3D page of one test episode")
    play("--seed", type=int, default=0, help="which trained seed (default 0)")
    play("--episode", type=int, default=0, help="number of the test start")
    play("--checkpoint", type=Path, help="file; the shipped one if left out")
    text = "file (default play.png, or play.html for 3D; .npz keeps arrays)"
    play("--out", type=Path, help=text)
    play("--live", action="store_true", help="a page in which the arm lives (3D)")
    play("--beside", metavar="METHOD", help="a second arm (--live); you set sub-goals")
    return parser


def _list(chosen: argparse.Namespace) -> None:
    from cmc.studies.runner import find

    for name in studies.WHERE:
        study = studies.get(name)
        print(f"{name}: {study.about}")
        for key, method in study.methods.items():
            there = "" if not method.trained or find(study, key).is_file() else "  (not shipped)"
            print(f"  {key:18} {method.title}{there}")
    print("tables without a training: " + ", ".join(studies.TABLES))


def _train(chosen: argparse.Namespace) -> None:
    from cmc.studies.runner import train
    from cmc.studies.sweep import sweep

    study = studies.get(chosen.study)
    other = "episodes" if study.unit == "step" else "steps"
    if getattr(chosen, other) is not None:
        raise ValueError(f"--{other}: {study.name} counts {study.unit}s, use --{study.unit}s")
    if chosen.address and chosen.backend != "dask":
        raise ValueError("--address: only with --backend dask")
    length, seeds = getattr(chosen, f"{study.unit}s"), range(chosen.seeds)
    methods = [key for key, method in study.methods.items() if method.trained]
    methods = methods if chosen.method is None else [chosen.method]
    if chosen.jobs != 1 or chosen.group is not None or chosen.backend != "loky":
        options = {key: getattr(chosen, key) for key in ("jobs", "backend", "group", "address")}
        made = sweep(study.name, methods, seeds, length=length, out=chosen.out, **options)
        print("\n".join(f"{method}: {path}" for method, path in zip(methods, made, strict=True)))
        return
    for method in methods:
        with _bar(method, study.unit) as show:

            def report(row: dict[str, Any], show: Any = show) -> None:
                words, success = f"{study.gain} {np.mean(row['gain']):.3g}", row["success"]
                if success is not None and np.isfinite(success).any():
                    words = f"success {100 * np.nanmean(success):.0f} %, {words}"
                show(row["done"], row["total"], words)

            path = train(study, method, seeds, length=length, out=chosen.out, callback=report)
        print(f"{method}: {path}")


@contextmanager
def _bar(title: str, unit: str) -> Iterator[Callable[[int, int, str], None]]:
    """A progress bar with the time that is left: a function of done, total and a word."""
    from tqdm import tqdm

    with tqdm(desc=title, unit=unit, dynamic_ncols=True) as bar:

        def show(done: int, total: int, text: str) -> None:
            if bar.total != total:  # what an earlier run did takes no time in this one
                bar.total = total
                bar.initial = bar.n = done
            bar.set_postfix_str(text, refresh=False)
            bar.update(done - bar.n)

        yield show


def _evaluate(chosen: argparse.Namespace) -> None:
    from cmc.studies.evaluation import evaluate, summary

    if chosen.study in studies.TABLES:
        _refuse(chosen, ("method", "trajectories", "checkpoints", "json"), "not for a table")
        data = importlib.import_module(f"cmc.studies.{chosen.study}").table()
        seeds = sorted({int(seed) for seed in data["seed"]})
        record = store.provenance(f"python -m cmc evaluate {chosen.study}", seeds)
        folder = chosen.out or Path("runs") / chosen.study
        print(data.to_string())
        print(results.write(folder, "tests", data, {"study": chosen.study, **record}))
        return
    study = studies.get(chosen.study)
    names = None if chosen.method is None else [chosen.method]
    asked: Any = {"trajectories": chosen.trajectories, "checkpoints": chosen.checkpoints}
    with _bar(study.name, "test") as show:
        tables = evaluate(study, names, folder=chosen.out, progress=show, **asked)
    print("\n".join(summary(tables)))
    if chosen.json:
        print(json.dumps(tables, allow_nan=False))


def _ship(chosen: argparse.Namespace) -> None:
    from cmc.studies.evaluation import ship

    study = studies.get(chosen.study)
    with _bar(study.name, "test") as show:
        made = ship(study, chosen.folder, chosen.assets, complete=chosen.complete, progress=show)
    for path in made:
        print(path)


def _play(chosen: argparse.Namespace) -> None:
    from cmc.studies import recorded
    from cmc.studies.runner import load

    study = studies.get(chosen.study)
    method = next(iter(study.methods)) if chosen.method is None else chosen.method
    if chosen.live or chosen.beside is not None:
        _refuse(
            chosen, ("checkpoint", "episode"), "not with a live page, which has shipped policies"
        )
        _live(study, method, chosen)
        return
    if chosen.episode < 0:
        raise ValueError(f"--episode: wanted at least 0, got {chosen.episode}")
    seed = chosen.seed if study.method(method).trained else None
    found = load(study, method, seed=seed, path=chosen.checkpoint)
    motion = study.motion(study.config_of(method), found.policy, chosen.episode)
    out = _out(chosen.out, *((".html", ".npz") if "model" in motion else (".png",)))
    about = f"{study.name}, {study.method(method).title}, seed {found.seeds[0]}"
    motion |= {"text": f"{about}: {motion['text']}"}
    if out.suffix != ".npz":
        (_page if out.suffix == ".html" else _picture)(motion, out)
    else:
        command = f"python -m cmc play {study.name} --method {method} --seed {chosen.seed}"
        command += f" --episode {chosen.episode} --out {out.name}"
        record = {"study": study.name, "method": method}
        recorded.save(out, motion, record | store.provenance(command, found.seeds))
    print(f"{motion['text']}\n{out}")


def _refuse(chosen: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Raise where an option was given that would not count."""
    for name in names:
        if getattr(chosen, name):
            raise ValueError(f"--{name}: {why}")


def _out(path: Path | None, *kinds: str) -> Path:
    """The file that was asked for, or `play` of the first kind."""
    path = path or Path(f"play{kinds[0]}")
    if path.suffix not in kinds:
        raise ValueError(f"--out: wanted a {' or '.join(kinds)} file, got {path}")
    return path


def _live(study: Study, method: str, chosen: argparse.Namespace) -> None:
    """A page with MuJoCo in it: one arm under its planner, or two that take the same sub-goals."""
    from cmc.studies import live
    from cmc.view.simulator import live_page

    first = [method] if chosen.beside is None else [method, chosen.beside]
    policies = live.live_policies(study, live.playable(study, first))
    title = f"{study.name}: " + " beside ".join(study.method(name).title for name in first)
    task, out = live.live_task(study), _out(chosen.out or Path("live.html"), ".html")
    page = live_page(task, policies, title=title, arms=len(first), seed=chosen.seed).encode()
    store.write_atomic(out, lambda file: file.write(page))
    print(f"{title}\n{out}")


def _picture(motion: dict[str, Any], out: Path) -> None:
    """Signals over time."""
    from cmc.view import figures

    fig, axes = figures.panels(1, len(motion["signals"]), width=9)
    for ax, (label, values, target) in zip(axes.flat, motion["signals"], strict=True):
        figures.trajectories(motion["t"], values, labels=("time (s)", label), target=target, ax=ax)
    figures.save(fig, out, motion["text"])


def _page(motion: dict[str, Any], out: Path) -> None:
    """The scene in 3D, with the path of the tip, the sub-goals and the contact force."""
    from dataclasses import replace

    from cmc.view.playback import Arrow, record

    force = np.linalg.norm(motion["force"], axis=-1)
    shown: dict[str, Any] = {"title": motion["text"], "trails": ["tip"]}
    shown["markers"] = motion["markers"]
    shown["arrows"] = {"contact force": Arrow(motion["tip"], motion["force"])}
    shown["readouts"] = {"distance [mm]": 1e3 * motion["distance"], "force [N]": force}
    recording = record(motion["model"], motion["qpos"], motion["t"], **shown)
    views = sorted(recording.cameras.items(), key=lambda view: view[0] != "task")  # the task first
    replace(recording, cameras=dict(views)).save(out)


if __name__ == "__main__":
    sys.exit(main())
