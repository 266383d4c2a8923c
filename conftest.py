"""`pytest --nbmake` fails a notebook for errors that its cells do not raise.

An exception in a widget's callback stops no cell. After nbmake has run a notebook, its outputs
and the saved state of its widgets are searched for such errors, and for figures without a line of
text. The notebook runs once; nothing is written.
"""

from __future__ import annotations

import contextlib
from typing import Any

EXPECTED = "raises-exception"
WIDGETS = "application/vnd.jupyter.widget-state+json"


def hidden_errors(notebook: Any) -> list[str]:
    """Errors in widgets, tracebacks and warnings that were printed, undescribed figures, stubs."""
    found = []
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type != "code":
            continue
        outputs, expected = cell.get("outputs", []), EXPECTED in cell.metadata.get("tags", [])
        if expected and not any(o.output_type == "error" for o in outputs):
            found.append(f"cell {number} is tagged {EXPECTED} and raised nothing")
        for output in outputs:
            found += [f"cell {number}: {problem}" for problem in _problems(output)]
    state = notebook.metadata.get("widgets", {}).get(WIDGETS, {}).get("state", {})
    for model in state.values():
        values = model.get("state", {})
        if isinstance(values.get("error"), str) and values["error"]:
            found.append(f"a picture shows {values['error']}")
        for output in values.get("outputs", ()):
            if output.get("output_type") == "error":
                found.append(
                    f"an output widget shows {output.get('ename')}: {output.get('evalue')}"
                )
            elif "Traceback (most recent call last)" in str(output.get("text", "")):
                found.append("an output widget shows a traceback")
    return found


def _problems(output: Any) -> list[str]:
    if output.output_type == "stream":
        signs = {"Traceback (most recent call last)": "traceback", "Warning: ": "warning"}
        return [f"a {what} was printed" for sign, what in signs.items() if sign in output.text]
    data = output.get("data", {})
    described = str(data.get("text/plain", "")).startswith("Figure: ")
    return ["a figure without figures.describe"] if "image/png" in data and not described else []


def _search_after_execution() -> None:
    """Let nbmake's runs end with the search."""
    from nbmake.nb_result import NotebookError
    from nbmake.nb_run import NotebookRun

    execute = NotebookRun.execute

    def execute_and_search(self: Any) -> Any:
        result = execute(self)
        if result.error is None and (found := hidden_errors(result.nb)):
            text = f"{self.filename.name}: " + "; ".join(found)
            result.error = NotebookError(summary=text, trace=text, failing_cell_index=-1)
        return result

    NotebookRun.execute = execute_and_search


with contextlib.suppress(ImportError):  # without nbmake there is nothing to search
    _search_after_execution()
