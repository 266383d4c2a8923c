"""What a study is: methods that can be trained, and tests. Studies describe, `runner` runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import reduce
from operator import index
from pathlib import Path
from typing import Any, Literal, Protocol

from torch import nn

from cmc.theory.arrays import Array

Rows = list[dict[str, Any]]
Change = Callable[[Any], Any]
"""A configuration to another one."""


class Training(Protocol):
    """A method's training of several seeds side by side.

    `steps`: environment steps, or episodes, of each seed so far; `segment` adds `stride` and
    answers the mean reward or return by seed. `actors` are the networks that act, by the name under
    which their weights are kept; `acting` is what acts now, without exploration, as the study's
    tests take it. `save` writes everything that decides what follows, `load` continues from it.
    """

    @property
    def steps(self) -> int: ...  # noqa: D102
    @property
    def stride(self) -> int: ...  # noqa: D102
    def segment(self) -> Array: ...  # noqa: D102
    def actors(self) -> Mapping[str, nn.Module]: ...  # noqa: D102
    def acting(self) -> Any: ...  # noqa: D102
    def save(self, path: str | Path, record: Mapping[str, Any]) -> None: ...  # noqa: D102
    def load(self, path: str | Path, record: Mapping[str, Any]) -> None: ...  # noqa: D102


def same(config: Any) -> Any:
    """No change of a configuration."""
    return config


def changed(**changes: Any) -> Change:
    """With some fields changed; of a configuration among them, only the fields that are named."""

    def adapt(config: Any) -> Any:
        new: dict[str, Any] = {}
        for name, value in changes.items():
            old: Any = getattr(config, name, None)  # `replace` refuses a field that is not there
            partial = is_dataclass(old) and isinstance(value, Mapping)
            new[name] = replace(old, **value) if partial else value
        return replace(config, **new)

    return adapt


def both(*steps: Change) -> Change:
    """One change after another."""
    return lambda config: reduce(lambda changed, step: step(changed), steps, config)


@dataclass(frozen=True)
class Method:
    """One arm of a study."""

    title: str  # in figures and tables
    build: Callable[[Any, Sequence[int]], Training]  # from its configuration and the seeds
    adapt: Change = same  # the study's configuration to the method's own
    trained: bool = True  # False for fixed gains


@dataclass(frozen=True)
class Test:
    """One condition under which kept policies are tested."""

    __test__ = False  # not a pytest class

    name: str  # in tables; several tests of other policies may share it
    number: int  # episodes of each seed
    change: Change = same  # the method's configuration to that of the test
    when: Callable[[Sequence[int]], Iterable[int]] = same  # which of the kept policies' steps
    methods: tuple[str, ...] | None = None  # names; all if None


def last(marks: Sequence[int]) -> Sequence[int]:
    """The last kept policy."""
    return marks[-1:]


def before_last(marks: Sequence[int]) -> Sequence[int]:
    """All kept policies but the last."""
    return marks[:-1]


@dataclass(frozen=True)
class Study:
    """Methods, the configuration that they share, and how they are tested.

    `judge` makes one test of one policy: (config, policy, seeds, test) to rows by table, in which
    `seed` is a position. `motion` records one episode for `play`: (config, policy of one seed,
    number of the start) to `text` and what the picture needs.
    """

    name: str  # of the study, its files and its folder
    about: str  # one line
    config: Any  # a frozen dataclass that everything in a run depends on
    methods: Mapping[str, Method]
    tests: tuple[Test, ...]
    length: int  # of a training, of each seed
    every: int  # how far apart policies are kept
    judge: Callable[[Any, Any, int, Test], dict[str, Rows]]
    motion: Callable[[Any, Any, int], dict[str, Any]]
    light: Change = same  # a configuration that builds faster and acts the same, for loading
    shown: Callable[[Sequence[int]], Iterable[int]] = last  # whose tables but `tests` are kept
    unit: Literal["step", "episode"] = "step"  # what `length` counts, and its column in tables
    gain: Literal["reward", "return"] = "reward"  # what a training's curve shows, and its column

    def method(self, name: str) -> Method:
        """The method of this name; a ValueError names the others if there is none."""
        if not isinstance(name, str) or name not in self.methods:
            raise ValueError(f"unknown method {name!r}; wanted one of {', '.join(self.methods)}")
        return self.methods[name]

    def config_of(self, name: str) -> Any:
        """The configuration as a method runs it."""
        return self.method(name).adapt(self.config)

    def build(self, name: str, seeds: Sequence[int]) -> Training:
        """A method's training, not yet begun."""
        return self.method(name).build(self.config_of(name), checked_seeds(seeds))

    def variant(self, name: str, about: str, **changes: Any) -> Study:
        """This study under another name, with its configuration `changed`."""
        return replace(self, name=name, about=about, config=changed(**changes)(self.config))


def checked_study(study: Any) -> Study:
    """A study, or a ValueError that says how to get one."""
    if not isinstance(study, Study):
        raise ValueError(f"study: wanted a Study, as cmc.studies.get(name) is, got {study!r}")
    return study


def checked_methods(name: str, study: Study, methods: Any, least: int = 0) -> list[str]:
    """Names of a study's methods, or a ValueError."""
    if isinstance(methods, str) or not isinstance(methods, Iterable):
        raise ValueError(f"{name}: wanted a list of methods, got {methods!r}")
    found = list(methods)
    if len(found) < least:
        raise ValueError(f"{name}: wanted at least one method, got none")
    for method in found:
        checked_study(study).method(method)
    return found


def checked_seeds(seeds: Any) -> list[int]:
    """Different integers from 0, at least one, or a ValueError."""
    try:
        given = list(seeds)
        found = [index(seed) for seed in given if not isinstance(seed, bool)]
    except TypeError:
        found = given = []
    if not found or min(found) < 0 or len(set(found)) < len(given):
        raise ValueError(f"seeds: wanted at least one integer from 0, all different, got {seeds!r}")
    return found
