"""Every notebook has the course's skeleton, and its exercise a stub that fails and a solution."""

from __future__ import annotations

import ast
import importlib.util
import re
import runpy
from pathlib import Path

import nbformat
import pytest
from lesson import lesson

import exercises

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FIRST = ["What you will learn", "See it fail", "The equations"]
LAST = ["Questions", "Exercises", "What to remember", "Links"]
LONGEST = 20


def by_notebook(test):
    return pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)(test)


def read(path):
    return nbformat.read(path, as_version=4)


def code(path):
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def prose(path):
    text = "\n\n".join(cell.source for cell in read(path).cells if cell.cell_type == "markdown")
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def section(path, name):
    return re.split(r"^## ", prose(path).split(f"\n## {name}\n")[1], flags=re.MULTILINE)[0]


def calls(tree, name):
    """Calls of `name(...)` or `anything.name(...)`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = node.func
            if (getattr(called, "attr", None) or getattr(called, "id", None)) == name:
                yield node


def test_the_course_has_lessons():
    numbers = [int(path.name[:2]) for path in NOTEBOOKS]
    assert numbers == list(range(len(numbers)))


@by_notebook
def test_the_file_is_clean(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)
    for cell in code(path):
        assert cell.outputs == []
        assert cell.execution_count is None
        assert set(cell.metadata) <= {"tags"}


@by_notebook
def test_the_skeleton(path):
    text = prose(path)
    assert re.match(rf"# {path.name[:2]} · \S", text), "the title should read '# NN · Title'"
    headings = re.findall(r"^## (.+)$", text, flags=re.MULTILINE)
    assert headings[: len(FIRST)] == FIRST
    assert headings[-len(LAST) :] == LAST
    assert len(re.findall(r"^# ", text, flags=re.MULTILINE)) == 1
    learn = section(path, "What you will learn")
    assert re.search(r"\*\*Time\*\* .*\d+ min.*\*\*Prerequisites\*\* .*\*\*Paper\*\* ", learn)
    assert 3 <= section(path, "What to remember").count("\n- ") <= 6


@by_notebook
def test_two_questions_with_folded_answers(path):
    assert section(path, "Questions").count("<details><summary>Answer</summary>") == 2
    text = prose(path)
    assert text.count("<details>") == text.count("</details>") == text.count("<summary>")


@by_notebook
def test_code_cells_are_short(path):
    for cell in code(path):
        length = len(cell.source.splitlines())
        assert length <= LONGEST, f"{length} lines: {cell.source[:60]!r} ..."


DRAWING = {"figures", "ui", "fig", "ax", "axes"}


def statements(body):
    """(statement, its lines) of a cell, functions and loops opened, imports left out."""
    for node in body:
        inner = [*getattr(node, "body", []), *getattr(node, "orelse", [])]
        lines = node.end_lineno - node.lineno + 1
        if inner:
            found = list(statements(inner))
            yield node, lines - sum(length for _, length in found)
            yield from found
        elif not isinstance(node, ast.Import | ast.ImportFrom):
            yield node, lines


def draws(node):
    """Whether a statement is about the picture: it names figures, sliders or axes."""
    head = [node.iter, node.target] if isinstance(node, ast.For) else [node]
    if hasattr(node, "body") and not isinstance(node, ast.For):
        return False
    names = {x.id for part in head for x in ast.walk(part) if isinstance(x, ast.Name)}
    return bool(names & DRAWING)


def by_opened_notebook(test):
    opened = [path for path in NOTEBOOKS if path.name[:2] not in ("11", "12")]
    return pytest.mark.parametrize("path", opened, ids=lambda p: p.stem)(test)


@by_opened_notebook
def test_at_most_a_third_of_the_lines_draws(path):
    found = [s for cell in code(path) for s in statements(ast.parse(cell.source).body)]
    drawn = sum(lines for node, lines in found if draws(node))
    total = sum(lines for _, lines in found)
    assert 3 * drawn <= total, f"{drawn} of {total} lines"


def openness(cell):
    """How much of a cell's idea stands in it: "visible", "library" (a call to edit), "opaque".

    Visible: a function is defined, or at least three arithmetic operations or numpy calls stand
    outside of what draws. Library: a call with arguments. None for cells that only import, draw,
    or ask for an exercise.
    """
    tree = ast.parse(cell.source)
    kept = [n for n in tree.body if not isinstance(n, ast.Import | ast.ImportFrom) and not draws(n)]
    inside = [x for node in kept for x in ast.walk(node)]
    if not any(isinstance(x, ast.Call | ast.BinOp) for x in inside) or list(calls(tree, "check")):
        return None
    if any(isinstance(x, ast.FunctionDef) for x in inside):
        return "visible"
    called = [x for x in inside if isinstance(x, ast.Call)]
    worked = [x for x in called if ast.unparse(x.func).startswith("np.")]
    if len(worked) + sum(isinstance(x, ast.BinOp) for x in inside) >= 3:
        return "visible"
    asked = [x for x in called if ast.unparse(x.func) not in ("print", "Markdown")]
    return "library" if any(x.args or x.keywords for x in asked) else "opaque"


@by_opened_notebook
def test_the_idea_stands_in_the_cells(path):
    kinds = [kind for cell in code(path) if (kind := openness(cell))]
    count = {kind: kinds.count(kind) for kind in ("visible", "library", "opaque")}
    assert 2 * count["visible"] >= len(kinds), count
    assert 5 * count["opaque"] <= len(kinds), count


@by_notebook
def test_a_described_figure_comes_before_the_first_slider(path):
    sources = [cell.source for cell in code(path)]
    figures = [k for k, source in enumerate(sources) if list(calls(ast.parse(source), "describe"))]
    sliders = [k for k, source in enumerate(sources) if list(calls(ast.parse(source), "explore"))]
    assert figures, "no figure is described"
    if sliders:
        assert figures[0] < sliders[0]


@by_notebook
def test_every_slider_is_shown(path):
    """Its call ends the cell, or is displayed: in a branch or before other lines it is not seen."""
    for cell in code(path):
        tree = ast.parse(cell.source)
        shown = {id(argument) for call in calls(tree, "display") for argument in call.args}
        shown |= {id(node.value) for node in tree.body[-1:] if isinstance(node, ast.Expr)}
        assert all(id(call) in shown for call in calls(tree, "explore")), cell.source


@by_notebook
def test_links_lead_to_files(path):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", prose(path)):
        if "://" not in target:
            assert (path.parent / target).is_file(), target


def test_the_first_notebook_links_to_all_others():
    text = prose(NOTEBOOKS[0])
    assert [path.name for path in NOTEBOOKS[1:] if f"({path.name})" not in text] == []


@by_notebook
def test_solutions_pass_where_stubs_fail(path):
    """Each check of a lesson is used, answers a stub calmly, and accepts the solution."""
    solution = runpy.run_path(str(path.parent / "solutions" / f"{path.stem}.py"))
    space, checked = lesson(path.name[:2]), set()
    for cell in code(path):
        for call in calls(ast.parse(cell.source), "check"):
            name, answer = ast.literal_eval(call.args[0]), call.args[1].id
            assert not exercises.check(name, space[answer])
            verdict = exercises.check(name, solution[answer])
            assert verdict, verdict
            checked.add(name)
    assert checked == set(exercises.names(path.name[:2])) != set()


# ---- the search of executed notebooks that the root conftest.py adds to nbmake


@pytest.fixture(scope="module")
def search():
    specification = importlib.util.spec_from_file_location("root_conftest", ROOT / "conftest.py")
    module = importlib.util.module_from_spec(specification)
    from nbmake.nb_run import NotebookRun

    wrapped = NotebookRun.execute
    specification.loader.exec_module(module)
    NotebookRun.execute = wrapped  # loading it again would wrap it twice
    return module


PICTURE = {"output_type": "display_data", "metadata": {}, "data": {"image/png": "aa"}}


def executed(*outputs, tags=(), state=None):
    cell = nbformat.v4.new_code_cell("pass", outputs=list(map(nbformat.from_dict, outputs)))
    cell.metadata["tags"] = list(tags)
    notebook = nbformat.v4.new_notebook(cells=[cell])
    if state is not None:
        notebook.metadata["widgets"] = {
            "application/vnd.jupyter.widget-state+json": {"state": {"id": {"state": state}}}
        }
    return notebook


ERROR = {"output_type": "error", "ename": "ZeroDivisionError", "evalue": "zero", "traceback": []}
WARNED = {"name": "stderr", "text": "cell.py:4: UserWarning: will be reindexed"}
PRINTED = {"name": "stderr", "text": "Traceback (most recent call last): a"}


@pytest.mark.parametrize(
    ("notebook", "message"),
    [
        (executed(tags=["raises-exception"]), "raised nothing"),
        (executed(PICTURE), "a figure without figures.describe"),
        (executed({"output_type": "stream", **PRINTED}), "a traceback was printed"),
        (executed({"output_type": "stream", **WARNED}), "a warning was printed"),
        (executed(state={"error": "ValueError: no"}), "a picture shows ValueError: no"),
        (executed(state={"outputs": [ERROR]}), "shows ZeroDivisionError: zero"),
        (executed(state={"outputs": [PRINTED]}), "an output widget shows a traceback"),
    ],
)
def test_hidden_errors_are_found(search, notebook, message):
    (found,) = search.hidden_errors(notebook)
    assert message in found


def test_a_healthy_notebook_has_none(search):
    described = {**PICTURE, "data": {"image/png": "aa", "text/plain": "Figure: A line."}}
    assert search.hidden_errors(executed(described, state={"error": "", "outputs": []})) == []
    assert search.hidden_errors(executed(ERROR, tags=["raises-exception"])) == []


def test_nbmake_fails_a_notebook_for_an_error_in_a_callback(tmp_path):
    """End to end: the callback fails after its cell has passed."""
    from nbmake.nb_run import NotebookRun

    source = """
from cmc.view import sliders as ui

def callback(k):
    return {"t": [0.0, 1.0], "y": [k, 1 / (k - 3)]}

picture = ui.panel(ui.lines("t", "y"), x="t", y="y")
live = ui.explore(callback, picture, k=ui.slider(0, 5), describe="d")
"""
    cells = [nbformat.v4.new_code_cell(source), nbformat.v4.new_code_cell("import asyncio")]
    move = 'live.controls["k"].value = VALUE\nawait asyncio.sleep(0.05)'
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    verdicts = {}
    for value in (4, 3):
        last = nbformat.v4.new_code_cell(move.replace("VALUE", str(value)))
        notebook = nbformat.v4.new_notebook(cells=[*cells, last], metadata={"kernelspec": kernel})
        nbformat.write(notebook, tmp_path / "moved.ipynb")
        verdicts[value] = NotebookRun(tmp_path / "moved.ipynb", 60).execute().error
    assert verdicts[4] is None
    assert "ZeroDivisionError: division by zero (at k = 3)" in verdicts[3].summary
