"""What the exercises of the course are checked with.

They stand beside the notebooks because nobody imports them but the notebooks. Checks live in
`lessons_*.py` and are loaded when one of them is asked for. Most say what an answer is asked, what
is right, and which slips deserve a hint; others what has to hold:

    @compare("02-twice", "twice {0}")
    def twice(): ...                # yields (arguments, right[, {hint: wrong}])

    @check("02-sign-rule")
    def sign_rule(answer): ...      # raises AssertionError, by `expect`, with a helpful sentence

A notebook calls `exercises.check("02-sign-rule", my_function)`; `name` starts with the number of
the lesson.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Judge = Callable[[Any], None]

CHECKS: dict[str, Judge] = {}
"""Checks that have been loaded, by name."""
_FILES = {"00_05": range(6), "06_09": range(6, 10), "10_13": range(10, 14)}

__all__ = ["CHECKS", "Verdict", "check", "compare", "expect", "expect_close", "names", "numbers"]


@dataclass(frozen=True)
class Verdict:
    """What a check answers: true if the exercise is solved, and one calm line to show."""

    passed: bool
    line: str

    def __bool__(self) -> bool:
        return self.passed

    def __repr__(self) -> str:
        return self.line


def check(name: str, *answer: Any) -> Any:
    """Judge an answer, or, without one, register the decorated function as the judge of `name`.

    The name is `"NN-short-title"`; an answer is what the reader wrote, a function, an array or a
    number, and `...` is not written yet. A wrong or unwritten answer, or one that fails, is a
    `Verdict` too: a notebook runs on.

    Raises:
        KeyError: if there is no such exercise.
        ValueError: if the name does not start with a lesson's number, or is taken.
    """
    if not (name[:2].isdigit() and name[2:3] == "-" and name[3:]):
        raise ValueError(f"wanted a name like '02-sign-rule', got {name!r}")
    if not answer:
        return lambda judge: _register(name, judge)
    known = names(name[:2])
    if name not in known:
        raise KeyError(f"no exercise {name!r}; lesson {name[:2]} has: {', '.join(known) or 'none'}")
    said = "solved."
    try:
        if answer[0] is ...:
            raise NotImplementedError
        CHECKS[name](*answer)
    except NotImplementedError:
        said = "not written yet."
    except AssertionError as error:
        said = str(error)
    except Exception as error:
        said = f"your code stopped with {type(error).__name__}: {error}"
    return Verdict(said == "solved.", " ".join(f"{name}: {said}".split()))


def names(lesson: str) -> list[str]:
    """Names of the exercises of lesson `"NN"`."""
    files = [name for name, lessons in _FILES.items() if int(lesson) in lessons]
    if not files:
        raise KeyError(f"lesson {lesson!r} has no exercises")
    importlib.import_module(f"{__name__}.lessons_{files[0]}")
    return [name for name in CHECKS if name.startswith(f"{lesson}-")]


def expect(holds: Any, otherwise: str) -> None:
    """Raise AssertionError with the sentence `otherwise` unless `holds`."""
    if not bool(holds):
        raise AssertionError(f"Not yet: {otherwise}")


def compare(
    name: str, what: str, **tolerances: float
) -> Callable[[Callable[[], Iterator[Any]]], Judge]:
    """Register an exercise whose answer is a function, by its cases.

    The decorated generator yields a tuple of arguments, the right value, and, where there are
    likely slips, a mapping of hints to the wrong values that deserve them. `{0}` in `what` is the
    first argument.
    """

    def register(cases: Callable[[], Iterator[Any]]) -> Judge:
        def judge(answer: Any) -> None:
            for given, right, *slips in cases():
                found, said = answer(*copy.deepcopy(given)), what.format(*given)
                expect_close(found, right, said, slips[0] if slips else None, **tolerances)

        judge.__module__ = cases.__module__
        return _register(name, judge)

    return register


def numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """The reader's answer as an array of finite numbers of this shape, called `what` in messages.

    Raises:
        AssertionError: if it is none.
    """
    expect(value is not None, f"{what} is None; does your function return something?")
    try:
        found = np.asarray(value, dtype=complex if np.iscomplexobj(value) else float)
    except (TypeError, ValueError):
        raise AssertionError(
            f"Not yet: {what} should be numbers, got {type(value).__name__}"
        ) from None
    wanted = f"have shape {shape}" if shape else "be one number"
    expect(found.shape == shape, f"{what} should {wanted}, yours has {found.shape}")
    expect(not np.iscomplexobj(found), f"{what} should be real: take real parts")
    bad = np.argwhere(~np.isfinite(found))
    expect(not len(bad), f"{what}{_place(bad)} should be finite")
    return found


def expect_close(
    value: Any,
    wanted: ArrayLike,
    what: str,
    slips: Mapping[str, ArrayLike] | None = None,
    *,
    rtol: float = 1e-6,
    atol: float = 1e-9,
) -> np.ndarray:
    """Compare an answer with an array, say in words where they differ, and return it.

    `slips` are wrong answers by the hint that each deserves.

    Raises:
        AssertionError: if the answer is no array of numbers, or differs in shape or in value.
    """
    right = np.asarray(wanted)
    found = numbers(value, right.shape, what)
    bad = np.argwhere(~np.isclose(found, right, rtol=rtol, atol=atol))
    if len(bad):
        for hint, slip in (slips or {}).items():
            expect(not np.allclose(found, slip, rtol=1e-4), hint)
        where = tuple(bad[0])
        said = f"should be {right[where]:.6g}, yours is {found[where]:.6g}"
        expect(False, f"{what}{_place(bad)} {said}")
    return found


def _place(bad: np.ndarray) -> str:
    """Where the first of some entries is, " at (i, j)", or nothing for a single number."""
    return f" at {tuple(bad[0].tolist())}" if bad.size else ""


def _register(name: str, judge: Judge) -> Judge:
    known = CHECKS.setdefault(name, judge)
    if known.__module__ != judge.__module__:
        raise ValueError(f"exercise {name!r} is already judged by {known.__module__}")
    CHECKS[name] = judge
    return judge
