"""What is shipped of the peg studies: policies, results and episodes belong together."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from cmc import store, studies
from cmc.studies import recorded
from cmc.studies.two_level_evaluation import run_episodes, summary
from cmc.studies.two_level_training import load, marks

SHIPPED = ("peg_maze", "peg_maze_stiff", "peg_push")


@cache
def results(study: str) -> dict:
    return store.read_json(store.asset("results", f"{study}.json"))


def cases() -> list[tuple[str, str]]:
    return [(study, name) for study in SHIPPED for name in results(study)["methods"]]


@pytest.mark.parametrize(("study", "name"), cases())
def test_every_result_has_its_policies_and_their_record(study, name):
    path = store.asset("checkpoints", f"{study}_{name}.safetensors")
    tensors, record = store.load_checkpoint(path, study=study, method=name)
    assert store.read_json(path.with_suffix(".json")) == record
    assert f"train {study} --method {name}" in record["command"]
    assert "+changes" not in record["commit"]
    found = results(study)["methods"][name]
    assert found["seeds"] == record["seeds"]
    steps = [test["step"] for test in found["tests"]]
    assert steps == sorted(steps)
    assert set(marks(studies.get(study).STUDY, name, path)) <= set(steps)
    assert found["final"]["step"] == steps[-1] == marks(studies.get(study).STUDY, name, path)[-1]
    assert found["final"]["episodes"] >= 100
    curve = np.array(found["training"]["reward"]).mean(0)
    np.testing.assert_allclose(curve, tensors["rewards"].mean(0), rtol=0.1)


@pytest.mark.parametrize(("study", "name"), cases())
def test_figures_keep_their_order(study, name):
    for test in results(study)["methods"][name]["tests"]:
        assert np.all(np.array(test["touched"]) >= np.array(test["success"]))
        assert np.all(np.array(test["nearest_mm"]) <= np.array(test["final_mm"]) + 1e-9)
        low, high = test["success_interval"]
        assert 0 <= low <= np.mean(test["success"]) <= high <= 1
        for force in test["force"].values():
            assert 0 <= force["zero"] <= force["below_1_N"] <= force["below_5_N"] <= 1
        if test.get("gains", {}).get("bounded"):
            slope, bound = np.array(test["gains"]["slope"]), np.array(test["gains"]["bound"])
            assert np.all((slope >= 0) & (slope <= bound * (1 + 1e-3)))


@pytest.mark.xfail(reason="the shipped runs are of an earlier scheme", strict=True)
@pytest.mark.parametrize(("study", "name"), [("peg_maze", "ctd3"), ("peg_push", "ctd3")])
def test_a_shipped_run_begins_as_the_present_code_does(study, name, tmp_path):
    path = studies.get(study).train(name, [0], steps=320, out=tmp_path)
    fresh = store.load_checkpoint(path)[0]["rewards"]
    kept = store.load_checkpoint(store.asset("checkpoints", path.name))[0]["rewards"]
    np.testing.assert_allclose(fresh[:2, 0], kept[:2, 0], rtol=1e-3)
    configuration = store.load_checkpoint(store.asset("checkpoints", path.name))[1]["configuration"]
    assert store.load_checkpoint(path)[1]["configuration"] == configuration


def test_the_last_policies_of_the_maze_do_what_the_results_say():
    study = studies.get("peg_maze").STUDY
    planner, low, record = load(study, "ctd3")
    fresh = summary(run_episodes(study, planner, low, len(record["seeds"]), 2))
    kept = results("peg_maze")["methods"]["ctd3"]["final"]
    assert np.mean(fresh["success"]) >= np.mean(kept["success"]) - 0.3
    np.testing.assert_allclose(fresh["return"], kept["return"], rtol=0.5)


@pytest.mark.parametrize(
    "path", sorted(store.asset("episodes").glob("*.npz")), ids=lambda p: p.stem
)
def test_shipped_episodes_load_and_fit_their_scene(path):
    import mujoco

    found = recorded.load(path.stem)
    assert found["qpos"].shape == (len(found["t"]), found["model"].nq)
    data = mujoco.MjData(found["model"])
    data.qpos[:] = found["qpos"][-1]
    mujoco.mj_kinematics(found["model"], data)
    np.testing.assert_allclose(data.site("tip").xpos, found["tip"][-1], atol=1e-9)
    assert "+changes" not in found["record"]["commit"]


def test_the_assets_of_the_peg_tasks_stay_small():
    files = [f for f in store.asset("checkpoints").parent.rglob("*peg_*") if f.is_file()]
    files = [f for f in files if "peg_touch" not in f.name and f.suffix != ".xml"]
    assert sum(f.stat().st_size for f in files) <= 25 * 2**20
