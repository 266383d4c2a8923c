"""Training under changed contact: what is trained where, and what the result holds."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_studies_two_level import small

from cmc import store
from cmc.studies import contact_training, peg_push
from cmc.studies.contact_training import learn, variant
from cmc.studies.two_level_evaluation import run_episodes, summary
from cmc.studies.two_level_training import load

SHORT = {"seeds": [0, 4], "steps": 120, "episodes": 2, "study": small(peg_push.STUDY)}


def test_every_run_is_trained_and_tested_under_its_own_contact(tmp_path: Path) -> None:
    told: dict[str, list[int]] = {}

    def callback(what: str):
        return lambda row: told.setdefault(what, []).append(row["steps"])

    answer = learn(["control"], scales=(0.4, 4.0), out=tmp_path, callback=callback, **SHORT)
    assert [(run["method"], run["stiffness"]) for run in answer["runs"]] == [
        ("control", 6.25),
        ("control", 0.0625),
    ]
    assert list(told) == ["control, scale 0.4", "control, scale 4"]
    assert answer["seeds"] == [0, 4]
    for run, scale in zip(answer["runs"], (0.4, 4.0), strict=True):
        here = variant(scale, SHORT["study"])
        path = tmp_path / f"{scale:g}" / f"{here.name}_control.safetensors"
        planner, low, record = load(here, "control", path=path)
        assert record["configuration"]["task_class"] == "ScaledPush"
        task = here.task_class(here.task, num=1)
        solref = task.worlds.model.geom("peg").solref
        np.testing.assert_allclose(solref, [scale * 0.01, 1.0])
        final = summary(run_episodes(here, planner, low, 2, 2), every=True)
        assert {key: run["final"][key] for key in final} == final
    told.clear()
    again = learn(["control"], scales=(0.4, 4.0), out=tmp_path, callback=callback, **SHORT)
    assert not told  # nothing was trained again
    assert again["runs"] == answer["runs"]


def test_a_policy_of_another_contact_is_refused(tmp_path: Path) -> None:
    learn(["control"], scales=[0.4], out=tmp_path, **SHORT)
    file = tmp_path / "0.4" / "peg_push_contact_0.4_control.safetensors"
    with pytest.raises(store.CheckpointError, match=r"peg_push_contact_0\.4"):
        load(variant(4.0, SHORT["study"]), "control", path=file)


def test_bad_requests_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown method 'sac'"):
        learn(["sac"], out=tmp_path, **SHORT)
    with pytest.raises(ValueError, match="two physics steps, 4 ms"):
        learn(["control"], scales=[0.4, 0.1], out=tmp_path, **SHORT)
    with pytest.raises(ValueError, match="seed"):
        learn(["control"], out=tmp_path, **{**SHORT, "seeds": []})
    assert not list(tmp_path.rglob("*.safetensors"))


def test_the_command_writes_what_learning_answers(tmp_path: Path, monkeypatch, capsys) -> None:
    short = partial(learn, study=SHORT["study"], episodes=1)
    monkeypatch.setattr(contact_training, "learn", short)
    file = tmp_path / "result.json"
    words = ["--method", "control", "--scale", "2", "--seeds", "1", "--steps", "120"]
    contact_training.main([*words, "--out", str(tmp_path), "--write", str(file)])
    found = store.read_json(file)
    assert [(run["method"], run["scale"]) for run in found["runs"]] == [("control", 2.0)]
    assert found["command"].endswith("--method control --scale 2 --steps 120")
    assert "scale 2: TD3/Control" in capsys.readouterr().out
