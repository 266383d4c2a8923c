"""Runs are kept, resumed bit for bit, tested once, merged and shipped; shown on a toy training."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from cmc import results, store, studies
from cmc.studies.evaluation import evaluate, ship, summary
from cmc.studies.live import live_policies
from cmc.studies.runner import load, marks_of, train
from cmc.studies.study import Method, Study, Test, before_last, last
from cmc.studies.sweep import merge, sweep


@dataclass(frozen=True)
class Config:
    step: float = 0.1


class Walk:
    """A random walk of two weights a seed, ten steps a segment."""

    stride = 10

    def __init__(self, config: Config, seeds: Any) -> None:
        self.config, self.seeds, self.steps = config, list(seeds), 0
        self.net = nn.Linear(2, len(self.seeds), bias=False)
        nn.init.zeros_(self.net.weight)
        self.success = np.full(len(self.seeds), np.nan)

    def segment(self) -> np.ndarray:
        drawn = [np.random.default_rng([seed, self.steps]).normal(size=2) for seed in self.seeds]
        with torch.no_grad():
            self.net.weight += self.config.step * torch.tensor(np.array(drawn)).float()
        self.steps += self.stride
        return self.net.weight.detach().sum(1).numpy()

    def actors(self) -> Mapping[str, nn.Module]:
        return {"walker": self.net}

    def acting(self) -> np.ndarray:
        return self.net.weight.detach().numpy()

    def save(self, path: Any, record: Any) -> None:
        state = {"weight": self.acting(), "steps": np.array(self.steps)}
        store.save_checkpoint(path, state, {**record, "seeds": self.seeds})

    def load(self, path: Any, record: Any) -> None:
        state, _ = store.load_checkpoint(path)
        self.steps = state["steps"].item()
        with torch.no_grad():
            self.net.weight.copy_(torch.from_numpy(state["weight"]))


JUDGED: list[str] = []


def judge(config: Config, policy: np.ndarray, seeds: int, test: Test) -> dict[str, Any]:
    JUDGED.append(test.name)
    rows = [{"seed": k, "return": v, "number": test.number} for k, v in enumerate(policy[:, 0])]
    return {"tests": rows, "episodes": [{"seed": 0, "final_mm": 1.0}]}


TOY = Study(
    name="toy",
    about="a walk",
    config=Config(),
    methods={
        "walk": Method("Walk", Walk),
        "fast": Method("Fast", Walk, lambda c: replace(c, step=1.0)),
        "still": Method("Still", Walk, trained=False),
    },
    tests=(
        Test("nominal", 100, when=last),
        Test("nominal", 20, when=before_last),
        Test("twice", 50, lambda c: replace(c, step=2 * c.step), last, ("walk",)),
    ),
    length=100,
    every=30,
    judge=judge,
    motion=lambda config, policy, episode: {"text": ""},
)


def same_files(one: Path, other: Path) -> None:
    a, b = (store.load_checkpoint(path)[0] for path in (one, other))
    assert a.keys() == b.keys()
    for key, array in a.items():
        np.testing.assert_array_equal(array, b[key])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(TOY, "walk", [3, 5], out=tmp_path_factory.mktemp("whole"))


def test_policies_are_kept_at_every_mark_and_at_the_end(whole: Path) -> None:
    tensors, record = store.load_checkpoint(whole, study="toy", method="walk")
    assert marks_of(tensors) == [30, 60, 90, 100]
    assert tensors["rewards"].shape == (10, 2)
    assert record["seeds"] == [3, 5]
    assert "--steps 100" in record["command"]
    walk = Walk(Config(), [3, 5])
    for _ in range(6):
        walk.segment()
    np.testing.assert_array_equal(load(TOY, "walk", 60, path=whole).policy, walk.acting())
    one = load(TOY, "walk", 60, seed=1, path=whole)
    assert (one.seeds, one.mark) == ([5], 60)
    np.testing.assert_array_equal(one.policy, walk.acting()[1:])


@pytest.mark.parametrize("at", [1, 3, 4, 7, 10])
@pytest.mark.parametrize("how", ["interrupt", "signal", "crash"])
def test_a_stopped_run_goes_on_to_the_same_end(
    whole: Path, tmp_path: Path, at: int, how: str
) -> None:
    def stop(report: dict[str, Any]) -> None:
        if report["done"] == 10 * at:
            if how == "signal":
                os.kill(os.getpid(), signal.SIGINT)
            else:
                raise KeyboardInterrupt if how == "interrupt" else RuntimeError

    with pytest.raises(RuntimeError if how == "crash" else KeyboardInterrupt):
        train(TOY, "walk", [3, 5], out=tmp_path, callback=stop)
    if how != "crash":  # nothing that was done is lost
        assert store.load_checkpoint(tmp_path / "walk_state.safetensors")[0]["steps"] == 10 * at
    first: list[int] = []
    path = train(TOY, "walk", [3, 5], out=tmp_path, callback=lambda r: first.append(r["done"]))
    assert first[:1] == ([10 * at + 10] if how != "crash" and at < 10 else first[:1])
    same_files(path, whole)


def test_a_run_of_something_else_is_not_touched(tmp_path: Path) -> None:
    path = train(TOY, "walk", [3, 5], out=tmp_path)
    before = path.read_bytes()
    with pytest.raises(store.CheckpointError, match=r"is a run of seeds \[3, 5\], not \[3\]: use"):
        train(TOY, "walk", [3], out=tmp_path)
    with pytest.raises(store.CheckpointError, match=r"another configuration: use .* \(--out\)"):
        train(TOY.variant("toy", "", step=0.2), "walk", [3, 5], out=tmp_path)
    assert path.read_bytes() == before


def test_a_file_without_its_partner_never_mislabels_a_curve(whole: Path, tmp_path: Path) -> None:
    path = train(TOY, "walk", [3, 5], length=60, out=tmp_path)
    same_files(train(TOY, "walk", [3, 5], out=tmp_path), whole)  # made longer
    path.unlink()  # a state alone is begun anew
    same_files(train(TOY, "walk", [3, 5], out=tmp_path), whole)
    (tmp_path / "walk_state.safetensors").unlink()  # policies alone are not overwritten
    with pytest.raises(store.CheckpointError, match=r"lost its walk_state\.safetensors"):
        train(TOY, "walk", [3, 5], out=tmp_path)
    same_files(path, whole)


def test_wrong_requests_are_named(whole: Path, tmp_path: Path) -> None:
    for call, message in (
        (lambda: train(TOY, "run", out=tmp_path), "unknown method 'run'; wanted one of walk, fast"),
        (lambda: train(TOY, "walk", [], out=tmp_path), "seeds: wanted at least one"),
        (lambda: train(TOY, "walk", [0, 0], out=tmp_path), "seeds: .* all different"),
        (lambda: train(TOY, "walk", out=3), "out: wanted a path, got 3"),
        (lambda: train("toy", "walk"), "study: wanted a Study, as cmc.studies.get"),
        (lambda: evaluate(TOY, "walk"), "names: wanted a list of methods, got 'walk'"),
        (lambda: evaluate(TOY, [], folder=tmp_path), "names: wanted at least one"),
        (lambda: load(TOY, "still", path=whole), "path: 'still' has fixed gains"),
        (lambda: summary({}), "tables: wanted rows of `tests`"),
        (lambda: train(TOY, "still", out=tmp_path), "'still' has fixed gains"),
        (lambda: train(TOY, "walk", length=0, out=tmp_path), r"length \(steps\) needs .* got 0"),
        (
            lambda: load(TOY, "walk", 31, path=whole),
            r"mark \(step\): wanted one of \[30, 60, 90, 100\]",
        ),
        (lambda: load(TOY, "walk", seed=2, path=whole), "seed: wanted a position from 0 to 1"),
        (lambda: load(TOY, "fast", path=whole), "wanted a checkpoint of method 'fast'"),
        (lambda: evaluate(TOY, ["still"], trajectories=0), "trajectories needs"),
        (lambda: studies.get("toy"), "unknown study 'toy'; wanted one of peg_touch"),
        (lambda: sweep("peg_touch", ["cppo"], [0], jobs=0), "jobs needs"),
        (lambda: sweep("peg_touch", [], [0]), "names: wanted at least one method, got none"),
        (lambda: live_policies(studies.get("peg_maze"), []), "methods: wanted at least one method"),
        (lambda: sweep("peg_touch", ["cppo"], [0], backend="mpi"), "wanted 'loky' or 'dask'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    assert list(tmp_path.iterdir()) == []


def test_tests_are_made_once_and_carry_what_they_are_about(whole: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    JUDGED.clear()
    options: Any = {"checkpoints": whole.parent, "folder": tmp_path}
    tables = evaluate(TOY, progress=lambda d, t, _: seen.append((d, t)), **options)
    assert seen[-1] == (6, 6)  # walk: 4 policies and one shifted test; still: fixed, once
    assert len(JUDGED) == 6
    assert evaluate(TOY, **options) == tables
    assert len(JUDGED) == 6
    rows = [r for r in tables["tests"] if r["method"] == "walk"]
    nominal = [(r["step"], r["seed"], r["last"], r["number"]) for r in rows if r["test"] != "twice"]
    assert nominal[:2] == [(100, 3, True, 100), (100, 5, True, 100)]
    assert nominal[2:] == [(mark, seed, False, 20) for mark in (30, 60, 90) for seed in (3, 5)]
    assert {r["number"] for r in rows if r["test"] == "twice"} == {50}
    shown = [(r["step"], r["seed"]) for r in tables["episodes"] if r["method"] == "walk"]
    assert shown == [(100, 3)] * 2
    curve = store.load_checkpoint(whole)[0]["rewards"].astype(float).ravel()
    assert [r["reward"] for r in tables["curves"]] == list(curve)
    assert summary(tables)[0].startswith("Walk: return ")
    few = evaluate(TOY, ["walk"], trajectories=10, **options)["tests"]
    assert {r["number"] for r in few} == {10, 2, 5}


def test_what_is_shipped_is_the_last_policy_and_rows_of_others_stay(tmp_path: Path) -> None:
    run, assets = tmp_path / "run", tmp_path / "assets"
    train(TOY, "walk", [0, 1], out=run)
    train(TOY, "fast", [0, 1], out=run)
    ship(TOY, run, assets, complete=["fast"])
    marks = {
        name: marks_of(store.load_checkpoint(assets / "checkpoints" / f"toy_{name}.safetensors")[0])
        for name in ("walk", "fast")
    }
    assert marks == {"walk": [100], "fast": [30, 60, 90, 100]}
    table = assets / "results" / "toy.csv"
    before = results.read(table)
    assert list(before["method"].unique()) == ["walk", "fast", "still"]
    again = tmp_path / "again"
    train(TOY, "fast", [0, 1, 2], out=again)
    ship(TOY, again, assets)
    after = results.read(table)
    assert after[after["method"] == "walk"].equals(before[before["method"] == "walk"])
    assert set(after.loc[after["method"] == "fast", "seed"]) == {0, 1, 2}
    (tmp_path / "other").mkdir()
    store.save_checkpoint(tmp_path / "other" / "x.safetensors", {}, {"study": "x", "method": "y"})
    for folder, there in (("empty", "empty$"), ("other", "other, .* it holds x$")):
        for call in (lambda f: ship(TOY, f, assets), lambda f: evaluate(TOY, checkpoints=f)):
            with pytest.raises(store.CheckpointError, match=f"no checkpoint of toy in .*{there}"):
                call(tmp_path / folder)


def test_groups_of_seeds_put_together_are_the_whole(whole: Path, tmp_path: Path) -> None:
    parts = [train(TOY, "walk", [seed], out=tmp_path / str(seed)) for seed in (3, 5)]
    joined = merge(parts, tmp_path / whole.name)
    same_files(joined, whole)
    assert store.load_checkpoint(joined)[1]["seeds"] == [3, 5]
    other = train(TOY, "walk", [7], length=60, out=tmp_path / "7")
    with pytest.raises(store.CheckpointError, match="other policies are kept"):
        merge([parts[0], other], tmp_path / "x")
    with pytest.raises(store.CheckpointError, match="paths: wanted different seeds"):
        merge([parts[0], parts[0]], tmp_path / "x")
