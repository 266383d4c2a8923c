"""A lesson's own code, as its notebook defines it, for tests to call.

    demo = lesson("02")                        # what notebook 02 defines, as a dictionary
    demo["largest_real_part"](demo["plant"], 1.0)
    other = lesson("02", plant="plant = ...")  # the same, with another plant cell
    whole = run("02", plant="plant = ...")     # every cell; whole.text is what it printed

Cells tagged `plant` and `setup` run whole. Of all other cells `lesson` runs imports, functions,
classes and assignments of literals; `run` runs everything.
"""

from __future__ import annotations

import ast
import contextlib
import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat

NOTEBOOKS = Path(__file__).resolve().parent.parent / "notebooks"


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


def run(number: str, plant: str | None = None) -> SimpleNamespace:
    """Run every cell in one process: `.space` holds the names, `.text` what was printed.

    Errors of a cell are raised as they are; figures are closed.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    space: dict[str, Any] = {"__name__": f"lesson_{number}"}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        for cell in cells(number, plant):
            exec(compile(cell.source, f"lesson {number}", "exec"), space)
    plt.close("all")
    return SimpleNamespace(space=space, text=printed.getvalue())


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
