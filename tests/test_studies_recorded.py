"""Recorded episodes of a short training, and its tests under other contact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cmc import store
from cmc.__main__ import main
from cmc.studies import peg_push, recorded
from cmc.studies.evaluation import evaluate
from cmc.studies.peg_push import scaled
from cmc.studies.runner import load
from cmc.studies.two_level_tests import motion


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short training, and a recorded episode of it."""
    folder = tmp_path_factory.mktemp("runs")
    both = ["peg_push", "--method", "frozen"]
    assert main(["train", *both, "--seeds", "2", "--out", str(folder), "--steps", "160"]) == 0
    checkpoint, out = folder / "peg_push_frozen.safetensors", folder / "episode.npz"
    request = ["play", *both, "--seed", "1", "--episode", "3", "--checkpoint", str(checkpoint)]
    assert main([*request, "--out", str(out)]) == 0
    return folder


def test_a_recording_is_the_motion_it_was_made_of(run: Path) -> None:
    path = run / "peg_push_frozen.safetensors"
    policy = load(peg_push.STUDY, "frozen", seed=1, path=path).policy
    wanted = motion(peg_push.STUDY.config_of("frozen"), policy, 3)
    found = recorded.load(run / "episode.npz")
    for name in ("t", "qpos", "tip", "force", "distance"):
        np.testing.assert_array_equal(found[name], wanted[name])
    for name, value in wanted["markers"].items():
        np.testing.assert_array_equal(found["markers"][name], value)
    assert found["text"].endswith(wanted["text"])
    assert found["success"] <= found["touched"]
    assert found["record"]["seeds"] == [1]
    data = mujoco.MjData(found["model"])
    for k in (0, 500, 999):  # the tip is where the joints put it
        data.qpos[:] = found["qpos"][k]
        mujoco.mj_kinematics(found["model"], data)
        np.testing.assert_allclose(data.site("tip").xpos, found["tip"][k], atol=1e-9)


@pytest.mark.parametrize("kind", ["truncated", "foreign", "text", "scene"])
def test_bad_recordings_are_refused(kind: str, run: Path, tmp_path: Path) -> None:
    path, episode = tmp_path / "bad.npz", run / "episode.npz"
    if kind == "truncated":
        path.write_bytes(episode.read_bytes()[:-200])
    elif kind == "foreign":
        np.savez(path, a=np.zeros(3))
    elif kind == "text":
        path.write_text("hello")
    else:
        with np.load(episode) as found:
            arrays = dict(found)
        np.savez(path, **{**arrays, "qpos": arrays["qpos"][:, :-1]})
    with pytest.raises(store.CheckpointError, match=r"bad\.npz"):
        recorded.load(path)


def test_unknown_episodes_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="episodes/none"):
        recorded.load("none")
    with pytest.raises(ValueError, match="lacks"):
        recorded.save(tmp_path / "x.npz", {}, {"study": "peg_push"})


def test_tests_under_other_contact_are_made_under_it(run: Path, tmp_path: Path) -> None:
    tests = tuple(replace(test, methods=None) for test in peg_push.STUDY.tests[1:3])
    study = replace(peg_push.STUDY, tests=tests)
    options = {"checkpoints": run, "folder": tmp_path, "trajectories": 1}
    rows = evaluate(study, ["frozen"], **options)["tests"]
    assert [row["test"] for row in rows] == ["nominal"] * 2 + ["contact x 0.4"] * 2
    assert "moved_mm" in rows[0]
    assert "moved_mm" not in rows[2]
    assert tests[1].change(study.config).task_class is scaled(0.4)
