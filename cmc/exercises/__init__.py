"""What the exercises of the course are checked with.

A lesson's checks live in `cmc/exercises/lesson_NN.py` and are loaded when one of them is asked for:

    @check("02-sign-rule")
    def sign_rule(answer): ...      # raises AssertionError, by `expect`, with a helpful sentence

A notebook calls `exercises.check("02-sign-rule", my_function)`; `name` starts with the number of
the lesson.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

Judge = Callable[[Any], None]

CHECKS: dict[str, Judge] = {}
"""Checks that have been loaded, by name."""

__all__ = ["CHECKS", "Verdict", "check", "expect", "expect_close", "judge", "names"]


@dataclass(frozen=True)
class Verdict:
    """What a check answers: true if the exercise is solved, and one calm line to show."""

    passed: bool
    line: str

    def __bool__(self) -> bool:
        return self.passed

    def __repr__(self) -> str:
        return self.line


@overload
def check(name: str) -> Callable[[Judge], Judge]: ...
@overload
def check(name: str, answer: Any, /) -> Verdict: ...


def check(name: str, *answer: Any) -> Any:
    """Judge an answer, or, without one, register the decorated function as the judge of `name`.

    Args:
        name: the exercise, `"NN-short-title"`.
        answer: what the reader wrote: a function, an array or a number; `...` is not written yet.

    Returns:
        A `Verdict`, or the decorator. A wrong or unwritten answer, or one that fails, is a verdict
        too: a notebook runs on.

    Raises:
        KeyError: if there is no such exercise.
        ValueError: if the name does not start with a lesson's number, or is taken.
    """
    if not (name[:2].isdigit() and name[2:3] == "-" and name[3:]):
        raise ValueError(f"wanted a name like '02-sign-rule', got {name!r}")
    if not answer:
        return lambda judge: _register(name, judge)
    _find(name)
    if answer[0] is ...:
        return Verdict(False, f"{name}: not written yet.")
    try:
        judge(name, *answer)
    except NotImplementedError:
        return Verdict(False, f"{name}: not written yet.")
    except AssertionError as error:
        return Verdict(False, f"{name}: {error}")
    except Exception as error:
        kind = type(error).__name__
        return Verdict(False, f"{name}: your code stopped with {kind}: {error}")
    return Verdict(True, f"{name}: solved.")


def judge(name: str, answer: Any) -> None:
    """Judge an answer by raising: nothing if it is right.

    Raises:
        AssertionError: if the answer is wrong, with a sentence that says what was wanted.
        NotImplementedError: if the answer is a stub that was not written yet.
        KeyError: if there is no such exercise.
    """
    _find(name)(answer)


def names(lesson: str) -> list[str]:
    """Names of the exercises of lesson `"NN"`."""
    _load(lesson)
    return [name for name in CHECKS if name.startswith(f"{lesson}-")]


def expect(holds: Any, otherwise: str) -> None:
    """Raise AssertionError with the sentence `otherwise` unless `holds`."""
    if not bool(holds):
        raise AssertionError(f"Not yet: {otherwise}")


def expect_close(
    value: ArrayLike, wanted: ArrayLike, what: str, *, rtol: float = 1e-6, atol: float = 1e-9
) -> None:
    """Compare an answer with an array and say in words where they differ.

    Args:
        value: the reader's array.
        wanted: the right one.
        what: what it is called in the message.
        rtol: relative tolerance.
        atol: absolute tolerance.

    Raises:
        AssertionError: if the answer is no array of numbers, or differs in shape or in value.
    """
    right = np.asarray(wanted)
    expect(value is not None, f"{what} is None; does your function return something?")
    try:
        found = np.asarray(value, dtype=complex if np.iscomplexobj(value) else float)
    except (TypeError, ValueError):
        raise AssertionError(
            f"Not yet: {what} should be numbers, got {type(value).__name__}"
        ) from None
    expect(
        found.shape == right.shape,
        f"{what} should have shape {right.shape}, yours has {found.shape}",
    )
    near = np.isclose(found, right, rtol=rtol, atol=atol)
    if not near.all():
        where = tuple(int(i) for i in np.argwhere(~near)[0])
        place = f" at {where}" if where else ""
        expect(False, f"{what}{place} should be {right[where]:.6g}, yours is {found[where]:.6g}")


def _find(name: str) -> Judge:
    _load(name[:2])
    if name not in CHECKS:
        known = ", ".join(n for n in CHECKS if n[:2] == name[:2]) or "none"
        raise KeyError(f"no exercise {name!r}; lesson {name[:2]} has: {known}")
    return CHECKS[name]


def _register(name: str, judge: Judge) -> Judge:
    known = CHECKS.get(name)
    if known is not None and known.__module__ != judge.__module__:
        raise ValueError(f"exercise {name!r} is already judged by {known.__module__}")
    CHECKS[name] = judge
    return judge


def _load(lesson: str) -> None:
    module = f"{__name__}.lesson_{lesson}"
    if importlib.util.find_spec(module) is None:
        raise KeyError(f"lesson {lesson!r} has no exercises")
    importlib.import_module(module)
