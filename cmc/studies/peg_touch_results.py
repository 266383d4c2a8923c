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
KEYS = ("episode", "shift", "h", "trajectories")
SPARSE = (1000, 5000, 10_000, 15_000)
"""Kept policies at which every method is tested."""
SIDE = 2000
"""Trajectories for each seed where the paper makes no statement: side arms, control periods."""
SAMPLE_TIMES = (0.002, 0.005, 0.01, 0.02, 0.03)
"""Control periods of the test of the sampled-data bound [s]; training has 0.01."""
DENSE = (
    "cppo",
    "ppo",
    "cppo_capped",
    "cppo_bypass",
    "ppo_stress",
    "cppo_stress",
    "ppo_joint",
    "ppo_raw",
)
"""Methods tested at every kept policy; the others at `SPARSE`."""
TIMED = ("cppo", "ppo", "cppo_capped", "cppo_bypass", "cppo_bounded")
"""Methods tested with other control periods."""
EVERY_SHIFT = ("cppo_capped", "cppo_bypass")
"""Methods tested under every shift at every kept policy."""
FULL = ("cppo", "ppo", "cppo_capped", "cppo_bypass", "cppo_bounded")
"""Methods tested with all trajectories, the others with `SIDE`."""


def plan(name: str, test: TestConfig, checkpoints: Folder = None) -> list[dict[str, Any]]:
    """The tests of a method: `episode` (None for fixed gains), `shift`, `h`, `trajectories`."""
    h, few = PegTouchStudy().task.h, min(SIDE, test.trajectories)
    marks: list[int | None] = [None]
    dense = broad = timed = marks
    number = test.trajectories
    if method(name).trained:
        kept, _ = contents(name, _path(name, checkpoints))
        marks = [*kept]
        dense = [m for m in kept if name in DENSE or m in SPARSE or m == kept[-1]]
        broad = [*sorted({paper_mark(kept), kept[-1] if name in FULL else paper_mark(kept)})]
        broad = marks if name in EVERY_SHIFT else broad
        timed = [paper_mark(kept)] if name in TIMED else []
        number = test.trajectories if name in FULL else few
    tests = [(mark, "nominal", h, number) for mark in dense]
    tests += [(mark, shift, h, number) for mark in broad for shift in SHIFTS if shift != "nominal"]
    tests += [
        (mark, "nominal", other, few) for mark in timed for other in SAMPLE_TIMES if other != h
    ]
    return [dict(zip(KEYS, values, strict=True)) for values in tests]


def evaluate(
    names: Iterable[str] | None = None,
    *,
    trajectories: int | None = None,
    folder: str | Path = Path("runs") / NAME / "results",
    checkpoints: Folder = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Test the shipped policies and collect every figure; finished tests are not repeated.

    Args:
        names: methods; all that have a checkpoint, and the fixed ones, if None.
        trajectories: for each test and seed; the study's 8000 if None.
        folder: where each method's tests are kept, so that an interrupted evaluation goes on.
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
    total, done = sum(len(plan(name, test, checkpoints)) for name in wanted), 0
    methods: dict[str, Any] = {}
    for name in wanted:

        def step(count: int, what: str, before: int = done) -> None:
            if progress is not None:
                progress(before + count, total, what)

        file = Path(folder) / f"{name}.json"
        methods[name] = evaluate_method(name, test, file, step, checkpoints)
        done += len(methods[name]["tests"])
    if progress is not None:
        progress(done, total, "done")
    answer = {"study": NAME, "test": asdict(test), "methods": methods, "totals": totals(methods)}
    answer["claims"] = claims(methods) if {"ppo", "cppo"} <= set(methods) else {}
    seeds: list[int] = max((found["seeds"] for found in methods.values()), key=len, default=[])
    return answer | store.provenance(f"python -m cmc evaluate {NAME} --json", seeds)


def evaluate_method(
    name: str,
    test: TestConfig,
    file: Path,
    step: Callable[[int, str], object] | None = None,
    checkpoints: Folder = None,
) -> dict[str, Any]:
    """All tests of one method, its learning curve and its certificates.

    Args:
        name: the method.
        test: the test.
        file: where tests are kept one by one; those that are there are not repeated.
        step: called before each test with its number and what it is.
        checkpoints: folder of checkpoint files; the shipped ones if None.
    """
    arm, path = method(name), _path(name, checkpoints)
    mark = _fingerprint(name, test, checkpoints)
    earlier = store.read_json(file) if file.is_file() else {}
    ready = earlier.get("tests", []) if earlier.get("fingerprint") == mark else []
    seeds = contents(name, path)[1]["seeds"] if arm.trained else []
    tests: list[dict[str, Any]] = []
    for count, key in enumerate(plan(name, test, checkpoints)):
        if step is not None:
            step(count, f"{name}, episode {key['episode']}, {key['shift']}, {1000 * key['h']:g} ms")
        found = next((t for t in ready if all(t[k] == key[k] for k in KEYS)), None)
        if found is None:
            number = replace(test, trajectories=key["trajectories"])
            task = shifted(task_of(name), key["shift"], key["h"])
            policy = load(name, key["episode"], path=path)
            # fixed gains have no axis of seeds; a leading axis of one does not disturb them
            made = run_test(policy, task, number, max(1, len(seeds)), predict=_predict(name, key))
            found = key | made
        tests.append(found)
        later = [t for t in ready if all(t is not kept for kept in tests)]
        store.write_json(file, {"fingerprint": mark, "tests": tests + later})
    certified = certificates(name, path) if arm.contracting else []
    training = _training(name, path) if arm.trained else {}
    shown = paper_mark([test["episode"] for test in tests]) if arm.trained else None
    for test_of in tests:  # histograms are shown for one episode; the others only take room
        if test_of["episode"] != shown or test_of["h"] != PegTouchStudy().task.h:
            test_of.pop("histogram_f", None)
        test_of.pop("histogram_x", None)
    kept = {"tests": tests, "certificates": certified}
    return {"title": arm.title, "seeds": seeds, "training": training, **kept}


def _predict(name: str, key: dict[str, Any]) -> str | None:
    """How the oscillation of a test is predicted, if it is."""
    arm = method(name)
    if arm.interface == "raw" or (arm.capped and key["shift"] != "nominal"):
        return None  # no slopes in the signals; nothing to predict below a cap
    return "weights" if arm.contracting and name != "cppo_no_integral" else "visited"


def _training(name: str, path: Path | None) -> dict[str, Any]:
    """Learning curve, averaged over 240 episodes."""
    episodes, returns = learning_curve(name, path)
    size = min(240 // PegTouchStudy().episodes_per_update, len(returns))
    count = len(returns) // size
    smooth = returns[: count * size].reshape(count, size, -1).mean(axis=1)
    episode = episodes[size - 1 :: size][:count]
    return {"episode": episode.tolist(), "return": np.round(smooth, 3).tolist()}


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
    length = (test.duration, test.seed, test.detectors, test.sign_every)
    return hashlib.sha256(data + repr(length).encode()).hexdigest()[:16]
