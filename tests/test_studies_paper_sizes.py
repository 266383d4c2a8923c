"""The paper's network sizes: a run that was stopped, what is written, what a step costs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cmc import store
from cmc.learning.hierarchy import HierarchyConfig
from cmc.studies import paper_sizes, peg_maze
from cmc.studies.paper_sizes import STUDY, Meter, run, sizes
from cmc.studies.two_level_training import train

TINY = HierarchyConfig(worlds=2, samples=80, high_updates=4, warm_up=80)


def tiny(study, snapshot_every: int = 120):
    return replace(
        study,
        hierarchy=TINY,
        task=replace(study.task, ticks=60),
        planner=replace(study.planner, batch=8),
        latent=replace(study.latent, batch=4),
        snapshot_every=snapshot_every,
    )


def test_only_the_sizes_differ_from_the_comparison() -> None:
    assert sizes(STUDY) == {"planner": [400, 300], "critics": [400, 300], "low": [200, 200]}
    ours = replace(
        STUDY,
        name=peg_maze.NAME,
        planner=replace(STUDY.planner, critic_hidden=(128, 128)),
        planner_hidden=(128, 128),
        low_hidden=(32, 32),
    )
    assert ours == peg_maze.STUDY


def test_a_stopped_run_goes_on_and_is_measured_by_session(tmp_path: Path) -> None:
    def stop(row: dict) -> None:
        if row["steps"] == 160:
            raise KeyboardInterrupt

    study = tiny(STUDY)
    with pytest.raises(KeyboardInterrupt):
        train(study, "ctd3", [0], steps=240, out=tmp_path, callback=stop)
    options = {"steps": 240, "episodes": 5}
    answer = run(study, tiny(peg_maze.STUDY), out=tmp_path, **options)
    again = run(study, tiny(peg_maze.STUDY), out=tmp_path, **options)
    assert again == answer
    assert [test["step"] for test in answer["tests"]] == [120, 240]
    assert [test["episodes"] for test in answer["tests"]] == [1, 5]
    assert answer["seeds"] == [0]
    # Resumed at step 120, and the first segment of a session is left out.
    assert [session["steps"] for session in answer["sessions"]] == [80]
    assert [session["steps"] for session in answer["ours"]["sessions"]] == [160]
    assert min(answer["cpu_ms_per_step"], answer["ours"]["cpu_ms_per_step"]) > 0.0


def test_the_cost_of_a_step_is_that_of_all_sessions(tmp_path: Path, monkeypatch) -> None:
    clock = iter([5.0, 7.0, 8.0, 100.0, 101.5, 9.0])
    monkeypatch.setattr(paper_sizes.time, "process_time", lambda: next(clock))
    file, study = tmp_path / "cost.json", tiny(STUDY, snapshot_every=20)
    for steps in ((40, 80, 120), (120, 160), (240,)):
        meter = Meter(file, study)
        for step in steps:
            meter({"steps": step, "total_steps": 240})
    assert meter.sessions == [
        {"steps": 40, "cpu_seconds": 1.0},  # 40 to 80 is the warm-up
        {"steps": 40, "cpu_seconds": 1.5},
        {"steps": 0, "cpu_seconds": 0.0},
    ]
    assert meter.record()["cpu_ms_per_step"] == pytest.approx(2500.0 / 80)
    assert Meter(file, study).record() == meter.record()


def test_the_command_writes_result_and_provenance(tmp_path: Path, monkeypatch, capsys) -> None:
    def short(**options):
        return run(tiny(STUDY), tiny(peg_maze.STUDY), episodes=2, **options)

    monkeypatch.setattr(paper_sizes, "run", short)
    write = tmp_path / "result.json"
    words = ["paper_sizes", "--steps", "120", "--out", str(tmp_path / "run"), "--write", str(write)]
    monkeypatch.setattr("sys.argv", words)
    paper_sizes.main()
    found = store.read_json(write)
    assert found["command"] == "python -m cmc.studies.paper_sizes --steps 120"
    assert found["final"]["step"] == 120
    assert len(found["training"]["reward"][0]) == 1
    assert "ms of CPU a step" in capsys.readouterr().out
