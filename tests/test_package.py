"""The shape of the package: importing it is light, and the wheel is whole."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


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
