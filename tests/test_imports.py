"""Imports go one way: rooms down the order, and no module in a circle."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "cmc"

# A room may import rooms further down; `view` stands apart, and leaves are open to all.
ORDER = [
    "__main__",
    "sb3",
    "studies",
    "results",
    "learning",
    "envs",
    "robot",
    "policies",
    "plants",
    "theory",
]
LEAVES = {"store", "fast"}
ALONE = {"view", "notation"}


def room(path: Path) -> str:
    """The room a source file belongs to: its folder in the package, or its own name."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path, text: str | None = None) -> set[str]:
    """What a file imports of cmc, at its top or inside its functions: names of modules or in them.

    Args:
        path: where it stands.
        text: its source, where it is not on the disk.
    """
    package = ["cmc", *path.relative_to(PACKAGE).parent.parts]
    found: set[str] = set()
    for node in ast.walk(ast.parse(text or path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{stem}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("cmc.")}


def rooms(names: set[str]) -> set[str]:
    """The rooms that these names lie in."""
    return {name.split(".")[1] for name in names}


SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.name != "__init__.py")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down_only(path: Path) -> None:
    here = room(path)
    others = rooms(imported(path)) - {here} - {"__version__"}
    if here in LEAVES:
        allowed: set[str] = set()
    elif here in ALONE:
        allowed = LEAVES
    else:
        assert here in ORDER, f"{here} is a new room: give it a place in the order"
        allowed = LEAVES | set(ORDER[ORDER.index(here) + 1 :])
        if here == "__main__":
            allowed |= ALONE
    assert others <= allowed, f"{here} must not import {sorted(others - allowed)}"


def test_the_import_check_sees_every_form_of_import() -> None:
    text = "import cmc.envs\nfrom cmc import plants\nfrom ..view import figures\nfrom . import x\n"
    assert rooms(imported(PACKAGE / "theory" / "_probe.py", text)) == {
        *("envs", "plants", "view", "theory")
    }


def test_no_import_goes_round_in_a_circle() -> None:
    """Inside of packages too, and imports inside of functions count."""
    names = {p: ".".join(["cmc", *p.relative_to(PACKAGE).with_suffix("").parts]) for p in SOURCES}
    names = {p: name.removesuffix(".__init__") for p, name in names.items()}
    modules = set(names.values())
    graph = {}
    for path, name in names.items():  # a name inside a module stands for the module
        found = {n if n in modules else n.rpartition(".")[0] for n in imported(path)}
        graph[name] = (found & modules) - {name}
    assert sum(map(len, graph.values())) > len(graph)  # arrows were found
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail("imports go round: " + " -> ".join(error.args[1]))
