"""The notation table against the code and against the paper's labels."""

import importlib
import inspect

import pytest

from cmc import notation

# Labels of equations and appendices in the paper's source that the course refers to.
LABELS = {
    *("theta_m", "zu", "v", "e", "deconstruct_zv", "inverse_solution", "deconstruction_explicit"),
    *("two_sub", "coupling", "selffeedback", "eq_theorem2", "y_and_g", "constraint_sign"),
    *("product", "xi", "F1_theorem1", "F1", "F2", "delta_zv", "F", "delta_zv_F1", "zv", "zv_ii"),
    *("tau_task_space_control", "2nd_sys", "mapping_pos", "LTI", "lambda_b_1", "lambda_b_2"),
    *("inequal_1", "fd", "PPO"),
}
SYMBOLS = notation.symbols()
SECTIONS = {s.section for s in SYMBOLS}


def find(where: str):
    """Resolve `package.module.Class.attribute`, where a field of a dataclass counts as one."""
    parts = where.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
            break
        except ModuleNotFoundError as error:
            if not ".".join(parts[:k]).startswith(error.name or "?"):
                raise
    for name in parts[k:]:
        if not hasattr(found, name) and name in inspect.get_annotations(found):
            found = inspect.get_annotations(found)[name]
        else:
            found = getattr(found, name)
    return found


@pytest.mark.parametrize("symbol", SYMBOLS, ids=lambda s: s.where)
def test_every_row_is_complete_and_its_name_is_in_the_code(symbol):
    assert all((symbol.symbol, symbol.name, symbol.shape, symbol.unit, symbol.meaning))
    assert "|" not in symbol.symbol + symbol.meaning + symbol.unit
    assert symbol.symbol.count("{") == symbol.symbol.count("}")
    path, _, argument = symbol.where.removesuffix(")").partition("(")
    found = find(path)
    if argument:
        assert argument in inspect.signature(found).parameters
        assert symbol.name == argument
    else:
        assert path.rsplit(".", 1)[-1] in (symbol.name, f"to_{symbol.name}")


def test_one_name_has_one_meaning_and_every_equation_is_one_of_the_papers():
    assert {s.equation for s in SYMBOLS} - {""} <= LABELS
    names = [s.name for s in SYMBOLS]
    assert len(set(names)) == len(names)


def test_the_table_renders_every_row():
    table = notation.table()
    lines = table._repr_markdown_().splitlines()
    assert len(lines) == 2 + len(SYMBOLS) + len(SECTIONS)
    assert {line.count("|") for line in lines} == {7}
    assert len(notation.table("Peg").splitlines()) == 3 + sum(s.section == "Peg" for s in SYMBOLS)
    with pytest.raises(ValueError, match=r"no section \['peg'\]"):
        notation.table("peg")
