"""A lesson's own code, as its notebook defines it, for tests to call.

    demo = lesson("02")                        # what notebook 02 defines, as a dictionary
    demo["largest_real_part"](demo["plant"], 1.0)
    other = lesson("02", plant="plant = ...")  # the same, with another plant cell
    whole = run("02", plant="plant = ...")     # every cell; whole.text is what it printed
    done = run("02", solved=True)              # with the exercises solved

Cells tagged `plant` and `setup` run whole. Of all other cells `lesson` runs imports, functions,
classes and assignments of literals; `run` runs everything.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"
if str(NOTEBOOKS) not in sys.path:  # a kernel starts beside its notebook, and `exercises` is there
    sys.path.append(str(NOTEBOOKS))


def cells(number: str, plant: str | None = None) -> list[Any]:
    """Code cells of the notebook whose name starts with `number`, with another plant if given."""
    (path,) = NOTEBOOKS.glob(f"{number}_*.ipynb")
    found = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    marked = [c for c in found if "plant" in c.metadata.get("tags", [])]
    if plant is not None:
        assert len(marked) == 1, f"{path.name}: wanted one cell tagged 'plant', got {len(marked)}"
        marked[0].source = plant
    return found


def lesson(number: str, plant: str | None = None) -> dict[str, Any]:
    """Names that a notebook's imports, functions, literals and `plant` and `setup` cells define."""
    space: dict[str, Any] = {"__name__": f"lesson_{number}"}
    for cell in cells(number, plant):
        tree = ast.parse(cell.source)
        if not {"plant", "setup"} & set(cell.metadata.get("tags", [])):
            tree.body = [node for node in tree.body if _defines(node)]
        exec(compile(tree, f"lesson {number}", "exec"), space)
    return space


def run(
    number: str,
    plant: str | None = None,
    solved: bool = False,
    skip: str = "",
    drawn: bool = False,
) -> SimpleNamespace:
    """Run every cell in one process, in fast mode: `.space` holds the names, `.text` the output.

    Errors of a cell are raised as they are; figures are closed.

    Args:
        number: the lesson.
        plant: source that takes the place of the cell tagged `plant`.
        solved: let the functions and values of the solutions take the place of the stubs.
        skip: tag of cells to leave out.
        drawn: turn figures into pixels (half of the time of a run).
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    space: dict[str, Any] = {"__name__": f"lesson_{number}"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), _fast(drawn):
        for cell in cells(number, plant):
            if not skip or skip not in cell.metadata.get("tags", []):
                tree = ast.parse(cell.source)
                if solved and "exercises.check(" in cell.source:
                    tree.body = [node for node in tree.body if not _is_stub(node)]
                    space |= solutions(number)
                exec(compile(tree, f"lesson {number}", "exec"), space)
    plt.close("all")
    return SimpleNamespace(space=space, text=printed.getvalue())


@contextlib.contextmanager
def _fast(drawn: bool) -> Iterator[None]:
    """Fast mode, and figures that are built but, unless `drawn`, not turned into pixels."""
    from matplotlib.figure import Figure

    before, savefig = os.environ.get("CMC_FAST"), Figure.savefig
    os.environ["CMC_FAST"] = "1"
    if not drawn:
        Figure.savefig = lambda *_, **__: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        Figure.savefig = savefig  # type: ignore[method-assign]
        os.environ.pop("CMC_FAST")
        os.environ.update({} if before is None else {"CMC_FAST": before})


def solutions(number: str) -> dict[str, Any]:
    """What the lesson's solutions define."""
    (path,) = (NOTEBOOKS / "solutions").glob(f"{number}_*.py")
    return {k: v for k, v in runpy.run_path(str(path)).items() if not k.startswith("__")}


def _is_stub(node: ast.stmt) -> bool:
    text = ast.unparse(node)
    return text.endswith("= ...") or (
        isinstance(node, ast.FunctionDef) and "raise NotImplementedError" in text
    )


def _defines(node: ast.stmt) -> bool:
    if isinstance(node, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef):
        return True
    if not isinstance(node, ast.Assign) or not all(isinstance(x, ast.Name) for x in node.targets):
        return False
    try:
        ast.literal_eval(node.value)
    except ValueError:
        return False
    return True
