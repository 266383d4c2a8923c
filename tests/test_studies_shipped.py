"""What is shipped: policies, tables and episodes belong together and to the present code."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from cmc import results, store, studies
from cmc.studies import recorded
from cmc.studies.runner import find, load, marks_of, train
from cmc.studies.study import Test

FOLDER = store.asset("checkpoints")
SHIPPED = [
    (study, name)
    for study in studies.WHERE
    for name, method in studies.get(study).methods.items()
    if method.trained and (FOLDER / f"{study}_{name}.safetensors").is_file()
]


def test_every_shipped_file_belongs_to_a_study() -> None:
    known = {f"{study}_{name}" for study, name in SHIPPED}
    begun = {"peg_push_halfway"}  # a training that lesson 12 finishes
    assert {path.stem for path in FOLDER.glob("*.safetensors")} - begun == known
    assert {path.stem for path in FOLDER.glob("*.json")} - begun == known


@pytest.mark.parametrize(("study", "name"), SHIPPED)
def test_every_shipped_policy_loads_and_has_its_rows(study: str, name: str) -> None:
    path = find(studies.get(study), name)
    tensors, record = store.load_checkpoint(path, study=study, method=name)
    assert store.read_json(path.with_suffix(".json")) == record
    assert f"train {study} --method {name}" in record["command"]
    assert "+changes" not in record["commit"] or study == "peg_touch"  # an early run
    marks = marks_of(tensors)
    for mark in (marks[0], marks[-1]):
        assert load(studies.get(study), name, mark).seeds == record["seeds"]
    data = results.tidy(study)
    rows = data[data["method"] == name]
    assert list(rows["seed"].unique()) == record["seeds"]
    assert set(rows.loc[rows["last"], studies.get(study).unit]) == {marks[-1]}
    curve = results.tidy(study, "curves")
    gain = studies.get(study).gain
    mean = curve.loc[curve["method"] == name, gain].mean()
    assert mean == pytest.approx(tensors[f"{gain}s"].mean(), rel=0.1)


@pytest.mark.parametrize("name", ["cppo", "ppo", "cppo_bounded"])
def test_shipped_runs_begin_as_the_present_code_does(name: str, tmp_path: Path) -> None:
    """The first updates of one seed, trained again alone, are those of the shipped five."""
    study = studies.get("peg_touch")
    path = train(study, name, [0], length=32, out=tmp_path)
    found, wanted = (store.load_checkpoint(p)[0]["returns"] for p in (path, find(study, name)))
    np.testing.assert_allclose(found[:2, 0], wanted[:2, 0], rtol=1e-3)


@pytest.mark.parametrize(
    ("study", "name", "mark", "number", "keys"),
    [
        ("peg_touch", "cppo_capped", 5000, 8000, ["return", "oscillation", "error_f"]),
        ("peg_touch", "ppo_raw", 5000, 2000, ["return", "oscillation", "error_f"]),
    ],
)
def test_the_present_code_gives_the_shipped_figures(
    study: str, name: str, mark: int, number: int, keys: list[str]
) -> None:
    s = studies.get(study)
    policy = load(s, name, mark).policy
    rows = s.judge(s.config_of(name), policy, 5, Test("nominal", number))["tests"]
    data = results.at(results.tidy(study), mark)
    kept = data[data["method"] == name][keys]
    np.testing.assert_allclose(pd.DataFrame(rows)[keys], kept, rtol=1e-3, atol=1e-6)


def test_the_last_policies_of_the_maze_do_what_the_table_says() -> None:
    s = studies.get("peg_maze")
    rows = s.judge(s.config_of("ctd3"), load(s, "ctd3").policy, 5, Test("nominal", 2))["tests"]
    kept = results.at(results.tidy("peg_maze")).set_index("method").loc["ctd3"]
    found = pd.DataFrame(rows)
    assert found["success"].mean() >= kept["success"].mean() - 0.3
    np.testing.assert_allclose(found["return"], kept["return"], rtol=0.5)


def test_what_signs_and_caps_promise_is_measured() -> None:
    data = results.tidy("peg_touch")
    data = data[data["h"] == 0.01]
    capped = ["cppo_capped", "cppo_bypass", "cppo_scaled", "cppo_bounded", "pi_scaled"]
    assert data.loc[data["method"].isin(capped), "oscillation"].max() == 0.0
    signed = ["cppo", "cppo_capped", "cppo_bypass", "cppo_bounded", "pi"]
    assert data.loc[data["method"].isin(signed), "drift"].max() == 0.0
    every = data[data["method"].isin(["cppo_capped", "cppo_bypass"])]
    assert (every.groupby(["method", "test", "seed"])["episode"].nunique() == 15).all()
    from_weights = data[(data["prediction"] == "weights") & ~data["method"].isin(capped)]
    assert from_weights["agreement"].mean() >= 0.98


@pytest.mark.parametrize(
    "path", sorted(store.asset("episodes").glob("*.npz")), ids=lambda p: p.stem
)
def test_shipped_episodes_load_and_fit_their_scene(path: Path) -> None:
    found = recorded.load(path.stem)
    assert found["qpos"].shape == (len(found["t"]), found["model"].nq)
    data = mujoco.MjData(found["model"])
    data.qpos[:] = found["qpos"][-1]
    mujoco.mj_kinematics(found["model"], data)
    np.testing.assert_allclose(data.site("tip").xpos, found["tip"][-1], atol=1e-9)
    assert "+changes" not in found["record"]["commit"]


def test_the_assets_stay_small() -> None:
    files = [path for path in store.asset("checkpoints").parent.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 30 * 2**20
