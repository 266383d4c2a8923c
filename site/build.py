"""Build the static site: executed notebooks, live pages, results and the API, all offline.

    python site/build.py [--jobs 2] [--no-run] [--out build/site]

Sources are laid out in build/site-source, notebooks are executed there, and Sphinx treats every
warning as an error. Nothing is fetched, and the pages load nothing from elsewhere.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cmc

ROOT = Path(__file__).resolve().parent.parent
SITE = ROOT / "site"
HIDDEN = {"exercises", "__main__"}
"""Rooms that are not imported by readers."""
LIVE = {
    "two_arms": ["peg_push_half", "--live", "--method", "ctd3", "--beside", "td3"],
    "peg_maze": ["peg_maze", "--live"],
    "peg_push": ["peg_push", "--live"],
}
"""Live pages and the commands that write them."""


def main() -> int:
    """Lay out, execute, build; returns Sphinx's exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2, help="notebooks side by side")
    parser.add_argument("--no-run", action="store_true", help="keep notebooks executed before")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "site")
    chosen = parser.parse_args()
    source, started = ROOT / "build" / "site-source", time.monotonic()
    lay_out(source, keep=chosen.no_run)
    if not chosen.no_run:
        execute(source / "notebooks", chosen.jobs)
    live_pages(source / "live")
    status = sphinx(source, chosen.out)
    if status == 0:
        for folder in ("live", "notebooks/playback"):
            if (source / folder).is_dir():
                shutil.copytree(source / folder, chosen.out / folder, dirs_exist_ok=True)
        prune(chosen.out)
        size = sum(file.stat().st_size for file in chosen.out.rglob("*") if file.is_file())
        seconds = time.monotonic() - started
        print(f"{chosen.out / 'index.html'}: {size / 1e6:.0f} MB in {seconds:.0f} s")
    return status


def lay_out(source: Path, keep: bool) -> None:
    """Pages of the site beside the notebooks; `keep` leaves executed notebooks where they are."""
    kept = source / "notebooks"
    if not (keep and kept.is_dir()):
        shutil.rmtree(source, ignore_errors=True)
        shutil.copytree(ROOT / "notebooks", kept, ignore=shutil.ignore_patterns("playback", ".*"))
    for page in [*SITE.glob("*.md"), SITE / "conf.py"]:
        shutil.copy(page, source / page.name)
    shutil.copytree(SITE / "static", source / "static", dirs_exist_ok=True)
    shutil.copy(ROOT / "CHANGELOG.md", source / "changelog.md")
    lessons = "\n".join(f"notebooks/{p.stem}" for p in sorted(kept.glob("*.ipynb")))
    index = (SITE / "index.md").read_text("utf-8").replace("@@LESSONS@@", lessons)
    (source / "index.md").write_text(index, "utf-8")
    (source / "notation.md").write_text(notation(), "utf-8")
    (source / "results.md").write_text(results(), "utf-8")
    (source / "api.md").write_text(api(source / "api"), "utf-8")


def execute(folder: Path, jobs: int) -> None:
    """Run all notebooks in place, in fast mode, with sliders that live without a kernel."""
    settings = {"CMC_FAST": "1", "CMC_EXPORT": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--nbmake"]
    command += ["--overwrite", "-n", str(jobs), str(folder)]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, **settings})


def live_pages(folder: Path) -> None:
    """The pages in which MuJoCo runs."""
    from cmc.__main__ import main as command

    folder.mkdir(exist_ok=True)
    for name, arguments in LIVE.items():
        if command(["play", *arguments, "--out", str(folder / f"{name}.html")]) != 0:
            raise SystemExit(f"the live page {name} could not be written")


def notation() -> str:
    """The table of symbols as a page."""
    from cmc.notation import table

    return f"# Notation\n\n{table()}\n"


def results() -> str:
    """Last policies of every study, test by test, as a page of tables."""
    from cmc.results import tidy
    from cmc.studies import registry

    parts = ["# All results", "", RESULTS, ""]
    for name in registry.WHERE:
        try:
            data = tidy(name)
        except (FileNotFoundError, ValueError):
            continue  # a study without shipped tests
        last = data[data["last"]] if "last" in data else data
        numbers = last.select_dtypes("number").columns.difference(["seed", "step", "episode"])
        keys = [key for key in ("title", "test") if key in last]
        means = last.groupby(keys, sort=False)[list(numbers)].agg(["mean", "min", "max"])
        parts += [f"## {name}", "", registry.get(name).about, ""]
        for key in numbers:
            table = means[key].dropna().reset_index()
            parts += [f"### {name}: {key}", "", markdown(table), ""]
        parts += [f"`{data.attrs.get('command', '')}`", ""]
    return "\n".join(parts)


RESULTS = """Every figure that is shipped, as means over seeds of the last policies, with the least
and the largest seed. `cmc.results` documents columns and units; `tidy(study)` gives the rows."""


def markdown(table: Any) -> str:
    """A data frame as a Markdown table, numbers with four digits."""
    rows = [list(table.columns), ["---"] * len(table.columns)]
    rows += [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row] for row in table.values]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def api(folder: Path) -> str:
    """One page a room, made from its docstrings; returns the page that lists them."""
    folder.mkdir(exist_ok=True)
    rooms: dict[str, list[str]] = {}
    for module in pkgutil.walk_packages(cmc.__path__, "cmc."):
        parts = module.name.split(".")
        if parts[1] not in HIDDEN and not parts[-1].startswith("_"):
            rooms.setdefault(parts[1], []).append(module.name)
    for room, modules in rooms.items():
        text = [f"# cmc.{room}\n"]
        for name in modules:
            pages = markdown_pages(name)
            left_out = f"   :exclude-members: {', '.join(pages)}\n" if pages else ""
            text.append(f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n{left_out}```\n")
            text += [f"### {title}\n\n{page}\n" for title, page in pages.items()]
        (folder / f"{room}.md").write_text("\n".join(text), "utf-8")
    listed = "\n".join(f"api/{room}" for room in rooms)
    return f"# Library\n\n```{{toctree}}\n:maxdepth: 2\n\n{listed}\n```\n"


def markdown_pages(module: str) -> dict[str, str]:
    """Classes of a module that document themselves in Markdown, as environments do."""
    space = vars(importlib.import_module(module))
    found = {
        name: inspect.getdoc(value) or ""
        for name, value in space.items()
        if inspect.isclass(value) and value.__module__ == module
    }
    return {
        name: re.sub(r"^##", "####", text, flags=re.MULTILINE)
        for name, text in found.items()
        if "\n## " in text
    }


def sphinx(source: Path, out: Path) -> int:
    """Build with warnings as errors."""
    from sphinx.cmd.build import build_main

    return build_main(["-q", "-W", "--keep-going", "-b", "html", str(source), str(out)])


def prune(out: Path) -> None:
    """Drop what no page uses: MathJax's other input and output formats, Sphinx's own leavings."""
    for leaving in (".buildinfo", ".doctrees", "objects.inv"):
        target = out / leaving
        shutil.rmtree(target, ignore_errors=True) if target.is_dir() else target.unlink(True)
    used = re.compile(r"tex-(mml-)?chtml\.js|/output/chtml/fonts/|/input/tex/extensions/")
    for file in out.rglob("*mathjax*/**/*"):
        if file.is_file() and not used.search(file.as_posix()):
            file.unlink()


if __name__ == "__main__":
    sys.exit(main())
