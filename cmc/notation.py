"""The notation of the course: symbol, name in code, where it is, shape, unit, equation.

`assets/notation.csv` holds it: `symbol` in LaTeX, `where` a dotted path (`path(argument)` for an
argument of a function), `shape` without batch axes, `unit` (`plant` where the plant's own units
count, `1` for a pure number), `equation` the label in the paper (empty for what it does not have).
The paper uses A, B, K_1, K_2 and f twice; here every name has one meaning. A test resolves every
`where` in the code and every label in the paper's list.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache

from cmc.store import asset


@dataclass(frozen=True)
class Symbol:
    """One row of the notation table."""

    section: str
    symbol: str
    name: str
    where: str
    shape: str
    unit: str
    equation: str
    meaning: str


@cache
def symbols() -> tuple[Symbol, ...]:
    """All symbols, in the order of the table."""
    with asset("notation.csv").open(encoding="utf-8", newline="") as file:
        return tuple(Symbol(**row) for row in csv.DictReader(file))


class Table(str):
    """Markdown text that a notebook renders."""

    __slots__ = ()

    def _repr_markdown_(self) -> str:
        return str(self)


def table(*sections: str) -> Table:
    """Return the notation, or some of its sections, as a Markdown table."""
    there = list(dict.fromkeys(s.section for s in symbols()))
    unknown = set(sections) - set(there)
    if unknown:
        raise ValueError(f"no section {sorted(unknown)}; there are: {there}")
    rows = ["| symbol | in code | shape | unit | equation | meaning |", "|---|---|---|---|---|---|"]
    for section in sections or there:
        rows.append(f"| **{section}** | | | | | |")
        for s in symbols():
            if s.section == section:
                label = f"`{s.equation}`" if s.equation else "ours"
                shape = "scalar" if s.shape == "1" else f"({s.shape})"
                cells = (f"${s.symbol}$", f"`{s.name}`", shape, s.unit, label, s.meaning)
                rows.append(f"| {' | '.join(cells)} |")
    return Table("\n".join(rows))
