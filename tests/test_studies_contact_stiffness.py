"""Contact of changed stiffness: what the engine then does, and the sweep over methods."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_studies_two_level import small

from cmc import store
from cmc.envs.peg_push import BOX_TOP, PUSH, PegPush
from cmc.robot import panda
from cmc.studies import contact_stiffness, peg_push
from cmc.studies.contact_stiffness import SCALES, TIME_CONSTANT, scaled, sweep
from cmc.studies.two_level_evaluation import run_episodes, summary
from cmc.studies.two_level_training import load, train


@pytest.mark.parametrize("scale", SCALES)
def test_only_the_time_constant_of_what_touches_changes(scale: float) -> None:
    nominal, changed = (kind(PUSH, 1).worlds.model for kind in (PegPush, scaled(scale)))
    for name in ("peg", "lid", "obstacle", "base", "side_left", "stop"):
        np.testing.assert_array_equal(nominal.geom(name).solref, [TIME_CONSTANT, 1.0])
        np.testing.assert_allclose(changed.geom(name).solref, [scale * TIME_CONSTANT, 1.0])
    np.testing.assert_array_equal(nominal.jnt_solref, changed.jnt_solref)
    assert (changed.geom_solref[0] == nominal.geom_solref[0]).all()  # the floor touches nothing
    changed.geom_solref[:] = nominal.geom_solref
    buffers = [np.zeros(mujoco.mj_sizeModel(model), np.uint8) for model in (nominal, changed)]
    for model, buffer in zip((nominal, changed), buffers, strict=True):
        mujoco.mj_saveModel(model, None, buffer)
    np.testing.assert_array_equal(*buffers)


def _engine_constants(task: PegPush) -> np.ndarray:
    """Stiffness and damping that MuJoCo uses when the peg is 0.05 mm inside the box's top."""
    model = task.worlds.model
    data, tip = mujoco.MjData(model), BOX_TOP + [0.012, 0.0135, -5e-5]
    data.qpos[:7] = panda.inverse_kinematics(tip, tool=panda.FINGERTIP + PUSH.peg.length)
    mujoco.mj_forward(model, data)
    touching = data.efc_type == mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL
    assert touching.any()
    return data.efc_KBIP[touching][0, :2]


@pytest.mark.parametrize("scale", SCALES)
def test_the_engine_uses_the_stiffness_and_damping_that_are_reported(scale: float) -> None:
    nominal, changed = (_engine_constants(kind(PUSH, 1)) for kind in (PegPush, scaled(scale)))
    np.testing.assert_allclose(changed / nominal, [scale**-2, 1 / scale], rtol=1e-9)


@pytest.mark.parametrize("scale", [0.39, 0.0, -1.0, np.nan])
def test_a_time_constant_that_the_engine_would_raise_is_refused(scale: float) -> None:
    with pytest.raises(ValueError, match="two physics steps, 4 ms"):
        scaled(scale)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("push")
    for name in ("frozen", "control"):
        train(small(peg_push.STUDY), name, [0, 4], steps=120, out=folder)
    return folder


def test_cells_are_kept_and_the_nominal_one_is_the_ordinary_test(
    trained: Path, tmp_path: Path, monkeypatch
) -> None:
    study, seen = small(peg_push.STUDY), []

    def stop(name: str, cell: dict) -> None:
        seen.append((name, cell["scale"]))
        if len(seen) == 2:
            raise KeyboardInterrupt

    options = {"study": study, "episodes": 2, "checkpoints": trained, "folder": tmp_path}
    with pytest.raises(KeyboardInterrupt):
        sweep(scales=(0.4, 1.0, 4.0), progress=stop, **options)
    assert seen == [("frozen", 0.4), ("frozen", 1.0)]
    kept = store.read_json(tmp_path / "frozen.json")
    runs: list[object] = []
    monkeypatch.setattr(
        contact_stiffness,
        "run_episodes",
        lambda *given: runs.append(given[0].task_class) or run_episodes(*given),
    )
    answer = sweep(scales=(0.4, 1.0, 4.0), **options)
    assert len(runs) == 1  # the one that was missing
    cells = answer["methods"]["frozen"]["cells"]
    assert [cell["stiffness"] for cell in cells] == [6.25, 1.0, 0.0625]
    assert [cell["time_constant_ms"] for cell in cells] == [4.0, 10.0, 40.0]
    assert cells[:2] == list(kept.values())
    planner, low, _ = load(study, "frozen", path=trained / "peg_push_frozen.safetensors")
    plain = summary(run_episodes(study, planner, low, 2, 2))
    assert {key: cells[1][key] for key in plain} == plain
    assert cells[0]["return"] == pytest.approx(plain["return"], rel=0.5)
    share = np.mean(cells[1]["force_by_seed"]["below_5_N"])
    assert share == pytest.approx(plain["force"]["largest"]["below_5_N"])
    assert answer["seeds"] == [0, 4]
    assert answer["commit"]


def test_other_episodes_scales_or_weights_are_other_cells(trained: Path, tmp_path: Path) -> None:
    study, kept = small(peg_push.STUDY), tmp_path / "cells"
    options = {"study": study, "checkpoints": trained, "folder": kept}
    sweep(["control"], scales=[1.0], episodes=1, **options)
    sweep(["control"], scales=[2.0], episodes=1, **options)
    sweep(["control"], scales=[1.0], episodes=2, **options)
    train(study, "control", [7], steps=120, out=tmp_path / "other")
    other = {**options, "checkpoints": tmp_path / "other"}
    answer = sweep(["control"], scales=[1.0], episodes=1, **other)
    assert len(store.read_json(kept / "control.json")) == 4
    assert answer["seeds"] == [7]


def test_bad_requests_are_named(trained: Path, tmp_path: Path) -> None:
    options = {"study": small(peg_push.STUDY), "checkpoints": trained, "folder": tmp_path}
    with pytest.raises(ValueError, match="unknown method 'sac'"):
        sweep(["sac"], **options)
    with pytest.raises(ValueError, match="episodes: wanted at least 1, got 0"):
        sweep(episodes=0, **options)
    with pytest.raises(store.CheckpointError, match="no checkpoint at"):
        sweep(["td3"], **options)
    with pytest.raises(store.CheckpointError, match="no checkpoint of any of ctd3, frozen, td3"):
        sweep(**{**options, "checkpoints": tmp_path})


def test_the_command_writes_what_the_sweep_answers(
    trained: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(contact_stiffness, "sweep", partial(sweep, study=small(peg_push.STUDY)))
    file = tmp_path / "result.json"
    words = ["--method", "control", "--scale", "1", "--episodes", "1", "--out", str(tmp_path)]
    contact_stiffness.main([*words, "--checkpoints", str(trained), "--write", str(file)])
    found = store.read_json(file)
    assert list(found["methods"]) == ["control"]
    assert found["command"].endswith("--method control --scale 1 --episodes 1")
    assert "scale   1  success" in capsys.readouterr().out
