"""The shape of the package: imports go one way, importing it is light, and the wheel is whole."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "cmc"

# A room may import rooms further down; `view` stands apart, and leaves are open to all.
ORDER = [
    "__main__",
    "exercises",
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


def imported_rooms(path: Path) -> set[str]:
    """Rooms of cmc that a file imports, at its top or inside its functions."""
    rooms: set[str] = set()
    package = ["cmc", *path.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{stem}.{alias.name}" for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("cmc.")}
    return rooms


SOURCES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE or p.name != "__init__.py")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down_only(path: Path) -> None:
    here = room(path)
    others = imported_rooms(path) - {here} - {"__version__"}
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


def test_the_import_check_sees_every_form_of_import(tmp_path: Path) -> None:
    source = PACKAGE / "theory" / "_probe.py"
    text = "import cmc.envs\nfrom cmc import plants\nfrom ..view import figures\nfrom . import x\n"
    node_rooms = imported_rooms_of(text, source)
    assert {"envs", "plants", "view", "theory"} <= node_rooms


def imported_modules(path: Path, modules: set[str]) -> set[str]:
    """Modules of cmc that a file imports, at its top or inside its functions."""
    here = ["cmc", *path.relative_to(PACKAGE).with_suffix("").parts]
    package = here[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            names = {f"{stem}.{alias.name}" for alias in node.names}
            found |= names & modules or {stem}
            found |= {stem} if names - modules else set()
    return (found & modules) - {".".join(here)}


def test_no_import_goes_round_in_a_circle() -> None:
    """Inside of packages too, and imports inside of functions count."""
    names = {p: ".".join(["cmc", *p.relative_to(PACKAGE).with_suffix("").parts]) for p in SOURCES}
    names = {p: name.removesuffix(".__init__") for p, name in names.items()}
    modules = set(names.values())
    graph = {name: imported_modules(path, modules) for path, name in names.items()}
    assert sum(map(len, graph.values())) > len(graph)  # arrows were found
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail("imports go round: " + " -> ".join(error.args[1]))


def imported_rooms_of(text: str, pretended: Path) -> set[str]:
    """`imported_rooms` of a text that pretends to stand at a path."""

    class Pretended(type(pretended)):  # type: ignore[misc]
        def read_text(self, encoding: str | None = None, **_: object) -> str:
            return text

    return imported_rooms(Pretended(pretended))


def python(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout


def test_importing_cmc_loads_nothing_heavy() -> None:
    heavy = python(
        "import sys, cmc; print([m for m in ('torch', 'mujoco', 'control', 'matplotlib', "
        "'scipy', 'gymnasium', 'meshcat', 'jupyterlab') if m in sys.modules])"
    )
    assert heavy.strip() == "[]"


def test_theory_needs_numpy_and_scipy_only() -> None:
    loaded = python(
        "import sys, pkgutil, importlib, cmc.theory\n"
        "for m in pkgutil.iter_modules(cmc.theory.__path__):\n"
        "    importlib.import_module('cmc.theory.' + m.name)\n"
        "print([m for m in ('torch', 'mujoco', 'control', 'matplotlib', 'gymnasium') "
        "if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_subpackages_load_on_first_use() -> None:
    import cmc

    assert cmc.fast.budget(2, 1) in (1, 2)
    assert set(cmc.__all__) <= set(dir(cmc))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        cmc.nothing  # noqa: B018


def test_the_wheel_holds_code_data_and_assets(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, ROOT],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    tracked = subprocess.run(
        ["git", "ls-files", "assets", "cmc"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    wanted = {f"cmc/{name}" if name.startswith("assets/") else name for name in tracked}
    assert wanted <= names
    code = f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); import cmc, cmc.store; "
    assert str(tmp_path) in python(code + "print(cmc.__file__, cmc.store.asset('results'))")


def test_no_pickle_and_no_open_listening() -> None:
    banned = ("pickle.load", "allow_pickle" + "=True", "weights_only" + "=False", "0.0." + "0.0")
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for folder in ("cmc", "tests", "benchmarks", "notebooks")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".js", ".ipynb") and path != Path(__file__)
        for word in banned
        if word in path.read_text(encoding="utf-8")
    ]
    assert found == []
