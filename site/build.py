"""Build the static site: executed notebooks, live pages, results and the API, all offline.

    python site/build.py [--jobs 2] [--only [NN ...]] [--out build/site]

Sources are laid out beside the site, notebooks are executed there, and Sphinx treats every warning
as an error. Nothing is fetched, and the pages load nothing from elsewhere.
"""

from __future__ import annotations

import argparse
import hashlib
import html
import importlib
import inspect
import json
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import cmc
from cmc import notation, studies
from cmc.results import tidy

ROOT = Path(__file__).resolve().parent.parent
SITE = ROOT / "site"


def main() -> int:
    """Lay out, execute, build, check; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2, help="notebooks side by side")
    parser.add_argument(
        "--only", nargs="*", metavar="NN", help="execute these lessons, keep others as they are"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "site")
    chosen = parser.parse_args()
    out, started = chosen.out.resolve(), time.monotonic()
    source = out.parent / "site-source"
    if fresh := lay_out(source, chosen.only):
        execute(fresh, chosen.jobs)
    shutil.rmtree(out, ignore_errors=True)
    if sphinx(source, out) != 0:
        return 1
    if (source / "notebooks" / "playback").is_dir():
        shutil.copytree(source / "notebooks" / "playback", out / "notebooks" / "playback")
        share(out / "notebooks" / "playback")
    shutil.copytree(ROOT / "assets" / "results", out / "results")
    prune(out)
    left_out = out / "notebooks" / "playback"  # by lessons that were never executed here
    faults = [f for f in broken(out) if chosen.only is None or left_out.name not in f]
    print("\n".join(faults))
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    print(f"{out / 'index.html'}: {size / 1e6:.0f} MB in {time.monotonic() - started:.0f} s")
    return 1 if faults else 0


def lay_out(source: Path, only: Sequence[str] | None) -> list[Path]:
    """Pages of the site beside the notebooks; returns the notebooks that are to be executed."""
    if only is None:
        shutil.rmtree(source, ignore_errors=True)
    folder, fresh = source / "notebooks", []
    folder.mkdir(parents=True, exist_ok=True)
    for lesson in sorted((ROOT / "notebooks").glob("*.ipynb")):
        copy = folder / lesson.name
        if only is None or lesson.name[:2] in only:
            fresh.append(copy)
        if copy in fresh or not copy.exists():
            text = lesson.read_text("utf-8")
            copy.write_text(text.replace("*all results*", "[all results](../results.md)"), "utf-8")
    for page in [*SITE.glob("*.md"), SITE / "conf.py"]:
        shutil.copy(page, source / page.name)
    shutil.copytree(SITE / "static", source / "static", dirs_exist_ok=True)
    shutil.copy(ROOT / "CHANGELOG.md", source / "changelog.md")
    lessons = "\n".join(f"notebooks/{p.stem}" for p in sorted(folder.glob("*.ipynb")))
    index = (SITE / "index.md").read_text("utf-8").replace("@@LESSONS@@", lessons)
    made = {"index": index, "notation": f"# Notation\n\n{notation.table()}\n"}
    made |= {"results": results(), "api": api(source / "api")}
    for name, text in made.items():
        (source / f"{name}.md").write_text(text, "utf-8")
    return fresh


def execute(notebooks: Sequence[Path], jobs: int) -> None:
    """Run notebooks in place, in fast mode, with sliders that live without a kernel."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "notebooks")])  # for the exercises
    settings = {"CMC_FAST": "1", "CMC_EXPORT": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--nbmake"]
    command += ["--overwrite", "-n", str(jobs), *map(str, notebooks)]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, **settings})


def results() -> str:
    """A table for each study: its last policies, test by test, and the files with all rows."""

    def words(values: Any) -> str:
        mean, low, high = (f"{v:.3g}" for v in (values.mean(), values.min(), values.max()))
        few = mean if low == high else f"{mean} [{low}, {high}]"
        return "" if values.isna().all() else few.replace("-", "\N{MINUS SIGN}")

    parts, files = [RESULTS], {}
    for file in sorted((ROOT / "assets" / "results").glob("*.csv")):
        whose = [name for name in studies.WHERE if file.stem.startswith(name)] or [file.stem]
        link = f'<a href="results/{file.name}">{file.name}</a>'
        files.setdefault(max(whose, key=len), []).append(link)
    for name in sorted(files, key=[*studies.WHERE, *files].index):
        data = tidy(name)
        last = data[data["last"]] if "last" in data else data
        shown = [key for key in MEASURES if key in last and last[key].notna().any()]
        keys = [key for key in ("title", "test") if key in last]
        table = (
            last.groupby(keys, sort=False)[shown]
            .agg(words)
            .reset_index()
            .rename(columns={"title": "method"})
        )
        rows = [table.columns, ["---"] * len(table.columns), *table.values]
        lines = "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)
        about = studies.get(name).about if name in studies.WHERE else "the low level alone"
        parts += [f"## {name}", f"{about}.", lines]
        parts += [f"All columns: {', '.join(files[name])}. `{data.attrs.get('command', '')}`"]
    return "\n\n".join(parts) + "\n"


RESULTS = """# All results

Means over seeds of the last policies, with the least and the largest seed. Shares are of 1, forces
in N; `cmc.results` documents all columns of the files, and `tidy(study)` gives their rows. The
[claims](claims.md) are judged by the same tables."""
MEASURES = (
    "success",
    "touched",
    "return",
    "cost",
    "final_mm",
    "below_1_N",
    "largest_N",
    "oscillation",
)
MEASURES += ("drift", "error_f", "slope_x", "slope_z")


def api(folder: Path) -> str:
    """One page a room, made from its docstrings; returns the page that lists them."""
    folder.mkdir(exist_ok=True)
    rooms: dict[str, list[str]] = {}
    for name in [module.name for module in pkgutil.walk_packages(cmc.__path__, "cmc.")]:
        room, last = name.split(".")[1], name.split(".")[-1]
        if room == "__main__" or last.startswith("_"):
            continue
        # environments document themselves in Markdown: their classes are sections of their own
        space = vars(importlib.import_module(name))
        own = {k: v for k, v in space.items() if inspect.isclass(v) and v.__module__ == name}
        own = {k: doc for k, v in own.items() if "\n## " in (doc := inspect.getdoc(v) or "")}
        page = f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n"
        page += f"   :exclude-members: {', '.join(own)}\n```\n\n"
        for title, doc in own.items():
            page += f"### {title}\n\n" + doc.replace("\n## ", "\n#### ") + "\n\n"
        rooms.setdefault(room, [f"# cmc.{room}\n\n"]).append(page)
    for room, pages in rooms.items():
        (folder / f"{room}.md").write_text("".join(pages), "utf-8")
    listed = "\n".join(f"api/{room}" for room in rooms)
    return f"# Library\n\n```{{toctree}}\n:maxdepth: 2\n\n{listed}\n```\n"


def sphinx(source: Path, out: Path) -> int:
    """Build with warnings as errors."""
    from sphinx.cmd.build import build_main

    return build_main(["-q", "-W", "--keep-going", "-b", "html", str(source), str(out)])


def share(folder: Path) -> None:
    """What all 3D pages hold (viewer, MuJoCo) becomes one file each beside them."""
    block = re.compile(r"<script(?: type=\"text/plain\" id=\"(\w+)\")?>(.*?)</script>", re.S)

    def moved(match: re.Match[str]) -> str:
        kind, text = match.groups()
        if len(text) < 100_000 or text.startswith("const "):  # a page's own data stay in it
            return match[0]
        name = hashlib.sha256(text.encode()).hexdigest()[:12] + ".js"
        made = json.dumps({"type": "text/plain", "id": kind, "textContent": text})
        element = f'document.head.append(Object.assign(document.createElement("script"), {made}));'
        (folder / name).write_text(element if kind else text, "utf-8")
        return f'<script src="{name}"></script>'

    for page in folder.glob("*.html"):
        text = page.read_text("utf-8")
        text = text.replace("script-src 'unsafe-inline'", "script-src 'self' file: 'unsafe-inline'")
        page.write_text(block.sub(moved, text), "utf-8")


def prune(out: Path) -> None:
    """Drop what no page uses: MathJax's other input and output formats, Sphinx's own leavings."""
    for leaving in (".buildinfo", ".doctrees", "objects.inv", "_static/webpack-macros.html"):
        target = out / leaving
        shutil.rmtree(target, ignore_errors=True) if target.is_dir() else target.unlink(True)
    used = re.compile(r"tex-(mml-)?chtml\.js|/output/chtml/fonts/|/input/tex/extensions/")
    for file in out.rglob("*mathjax*/**/*"):
        if file.is_file() and not used.search(file.as_posix()):
            file.unlink()


def broken(out: Path) -> list[str]:
    """Links and sources that lead nowhere in the site, or that a page would load from elsewhere."""
    wanted = re.compile(r"<(\w+)\s[^<>]*?\b(href|src)=\"([^\"]*)\"")
    pages = {page: page.read_text("utf-8") for page in out.rglob("*.html")}
    names = {page: set(re.findall(r"\bid=\"([^\"]*)\"", text)) for page, text in pages.items()}
    faults = set()
    for page, text in pages.items():
        for tag, _, value in wanted.findall(
            re.sub(r"<script[^<>]*>.*?</script>", "", text, flags=re.S)
        ):
            link = urlsplit(html.unescape(value))
            target = (page.parent / unquote(link.path)).resolve() if link.path else page
            if link.scheme in ("http", "https") and tag != "a":
                faults.add(f"{page.relative_to(out)} loads {value}")
            elif not link.scheme and not target.exists():
                faults.add(f"{page.relative_to(out)}: no {value}")
            elif not link.scheme and link.fragment and link.fragment not in names.get(target, ()):
                faults.add(f"{page.relative_to(out)}: no place {value}")
    return sorted(faults)


if __name__ == "__main__":
    sys.exit(main())
