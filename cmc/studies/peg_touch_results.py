"""Every figure of the peg-touch study, computed from the shipped policies."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from cmc import store
from cmc.studies.peg_touch_certificates import certificates
from cmc.studies.peg_touch_claims import claims, paper_mark
from cmc.studies.peg_touch_evaluation import SHIFTS, TestConfig, run_test, shifted
from cmc.studies.peg_touch_methods import METHODS, method
from cmc.studies.peg_touch_training import (
    NAME,
    PegTouchStudy,
    checkpoint_path,
    contents,
    learning_curve,
    load,
    task_of,
)

Progress = Callable[[int, int, str], object]
Folder = str | Path | None
Planned = tuple[int | None, str, float]
SPARSE = (1000, 5000, 10_000, 15_000)
"""Kept policies at which every method is tested."""
SIDE = 2000
"""Trajectories for each seed where the paper makes no statement: side arms, control periods."""
SAMPLE_TIMES = (0.002, 0.005, 0.01, 0.02, 0.03)
"""Control periods of the test of the sampled-data bound [s]; training has 0.01."""
DENSE = ("cppo", "ppo", "cppo_capped", "ppo_stress", "cppo_stress", "ppo_joint", "ppo_raw")
"""Methods tested at every kept policy; the others at `SPARSE`."""
TIMED = ("cppo", "ppo", "cppo_capped", "cppo_bounded")
"""Methods tested with other control periods."""
EVERY_SHIFT = ("cppo_capped",)
"""Methods tested under every shift at every kept policy."""
FULL = ("cppo", "ppo", "cppo_capped", "cppo_bounded")
"""Methods tested with all trajectories, the others with `SIDE`."""


def plan(name: str, checkpoints: Folder = None) -> list[Planned]:
    """The tests of a method: episode (None for fixed gains), shift, control period."""
    h = PegTouchStudy().task.h
    marks: list[int | None] = [None]
    dense = broad = timed = marks
    if method(name).trained:
        kept, _ = contents(name, _path(name, checkpoints))
        marks = [*kept]
        dense = [m for m in kept if name in DENSE or m in SPARSE or m == kept[-1]]
        broad = [*sorted({paper_mark(kept), kept[-1] if name in FULL else paper_mark(kept)})]
        broad = marks if name in EVERY_SHIFT else broad
        timed = [paper_mark(kept)] if name in TIMED else []
    tests: list[Planned] = [(mark, "nominal", h) for mark in dense]
    tests += [(mark, shift, h) for mark in broad for shift in SHIFTS if shift != "nominal"]
    tests += [(mark, "nominal", other) for mark in timed for other in SAMPLE_TIMES if other != h]
    return tests


def evaluate(
    names: Iterable[str] | None = None,
    *,
    trajectories: int | None = None,
    folder: str | Path = Path("runs") / NAME / "results",
    checkpoints: Folder = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Test the shipped policies and collect every figure; finished methods are not repeated.

    Args:
        names: methods; all that have a checkpoint, and the fixed ones, if None.
        trajectories: for each test and seed; the study's 8000 if None.
        folder: where each method's answer is kept, so that an interrupted evaluation goes on.
        checkpoints: folder of checkpoint files; the shipped ones if None.
        progress: called with (tests done, tests in all, what is next).

    Returns:
        `methods` (name to `evaluate_method`'s answer), `claims`, `totals`, provenance.

    Raises:
        ValueError: for an unknown method, or less than one trajectory.
    """
    wanted = [*names] if names is not None else [n for n in METHODS if _available(n, checkpoints)]
    if trajectories is not None and trajectories < 1:
        raise ValueError(f"trajectories: wanted at least 1, got {trajectories}")
    test = TestConfig() if trajectories is None else TestConfig(trajectories=trajectories)
    plans = {name: plan(name, checkpoints) for name in wanted}
    total, done = sum(map(len, plans.values())), 0
    methods: dict[str, Any] = {}
    for name in wanted:
        kept = Path(folder) / f"{name}.json"
        mark = _fingerprint(name, test, checkpoints)
        found = store.read_json(kept) if kept.is_file() else {}
        if found.get("fingerprint") != mark:

            def step(count: int, what: str, name: str = name, before: int = done) -> None:
                if progress is not None:
                    progress(before + count, total, f"{name}, {what}")

            found = {"fingerprint": mark, **evaluate_method(name, test, step, checkpoints)}
            store.write_json(kept, found)
        methods[name] = {key: value for key, value in found.items() if key != "fingerprint"}
        done += len(plans[name])
        if progress is not None:
            progress(done, total, name)
    answer = {"study": NAME, "test": asdict(test), "methods": methods, "totals": totals(methods)}
    answer["claims"] = claims(methods) if {"ppo", "cppo"} <= set(methods) else {}
    seeds: list[int] = max((found["seeds"] for found in methods.values()), key=len, default=[])
    return answer | store.provenance(f"python -m cmc evaluate {NAME} --json", seeds)


def evaluate_method(
    name: str,
    test: TestConfig,
    step: Callable[[int, str], object] | None = None,
    checkpoints: Folder = None,
) -> dict[str, Any]:
    """All tests of one method, its learning curve and its certificates."""
    arm, study, path = method(name), PegTouchStudy(), _path(name, checkpoints)
    answer: dict[str, Any] = {"title": arm.title, "seeds": [], "tests": [], "training": {}}
    if arm.trained:
        episodes, returns = learning_curve(name, path)
        size = min(240 // study.episodes_per_update, len(returns))
        count = len(returns) // size
        smooth = returns[: count * size].reshape(count, size, -1).mean(axis=1)
        answer["training"] = {
            "episode": episodes[size - 1 :: size][:count].tolist(),
            "return": np.round(smooth, 3).tolist(),
        }
        answer["seeds"] = contents(name, path)[1]["seeds"]
    predict = None
    if arm.interface != "raw":
        predict = "weights" if arm.contracting and "no_integral" not in name else "visited"
    for count, (mark, shift, h) in enumerate(plan(name, checkpoints)):
        if step is not None:
            step(count, f"episode {mark}, {shift}, {1000 * h:g} ms")
        policy = load(name, mark, path=path)
        seeds = max(1, len(answer["seeds"]))
        side = h != study.task.h or (name not in FULL and arm.trained)
        number = min(test.trajectories, SIDE) if side else test.trajectories
        task = shifted(task_of(name, study), shift, h)
        # fixed gains have no axis of seeds; a leading axis of one does not disturb them
        asked = None if arm.capped and shift != "nominal" else predict  # nothing to predict there
        found = run_test(policy, task, replace(test, trajectories=number), seeds, predict=asked)
        key = {"episode": mark, "shift": shift, "h": h, "trajectories": number}
        answer["tests"].append(key | found)
    answer["certificates"] = certificates(name, path) if arm.contracting else []
    return answer


def results() -> dict[str, Any]:
    """The shipped figures (assets/results/peg_touch.json)."""
    return store.read_json(store.asset("results", f"{NAME}.json"))


def totals(methods: dict[str, Any]) -> dict[str, Any]:
    """Over all tests: agreement with the prediction, and the worst of each contracting method."""
    pairs: list[tuple[float, bool]] = []
    worst: dict[str, Any] = {}
    for name, answer in methods.items():
        arm = method(name)
        for test in answer["tests"]:
            if test.get("prediction") == "weights" and not arm.capped:
                shares = zip(test["predicted_oscillation"], test["oscillation"], strict=True)
                moves = [max(pair) > 0.01 for pair in shares]
                pairs += zip(test["agreement"], moves, strict=True)
        if arm.contracting and answer["tests"]:
            tests = [t for t in answer["tests"] if t["h"] == 0.01]
            worst[name] = {
                "tests": len(tests),
                "largest_oscillation": max(max(t["oscillation"]) for t in tests),
                "largest_drift": max(max(t["drift"]) for t in tests),
            }
    moving = [share for share, moves in pairs if moves]
    return {
        "agreement": float(np.mean([share for share, _ in pairs])) if pairs else None,
        "policies": len(pairs),
        "agreement_where_some_oscillate": float(np.mean(moving)) if moving else None,
        "policies_where_some_oscillate": len(moving),
        "worst": worst,
    }


def _path(name: str, checkpoints: Folder) -> Path | None:
    return None if checkpoints is None else Path(checkpoints) / f"{NAME}_{name}.safetensors"


def _available(name: str, checkpoints: Folder) -> bool:
    if not method(name).trained:
        return True
    try:
        return (_path(name, checkpoints) or checkpoint_path(name)).is_file()
    except FileNotFoundError:
        return False


def _fingerprint(name: str, test: TestConfig, checkpoints: Folder) -> str:
    """Changes with the checkpoint and with the test, so that old answers are not taken for new."""
    path = _path(name, checkpoints) or (checkpoint_path(name) if method(name).trained else None)
    data = path.read_bytes() if path is not None and path.is_file() else b""
    return hashlib.sha256(data + repr((test, plan(name, checkpoints))).encode()).hexdigest()[:16]
