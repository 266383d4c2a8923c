"""Recorded episodes and shipped policies: what is kept, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from cmc import store, studies
from cmc.__main__ import main
from cmc.studies import recorded
from cmc.studies.peg_push import STUDY
from cmc.studies.shipping import main as shipping
from cmc.studies.two_level_training import marks


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    request = ["train", "peg_push", "--method", "frozen", "--seeds", "2", "--out", str(folder)]
    assert main([*request, "--steps", "160"]) == 0
    assert main([*request, "--steps", "320"]) == 0
    return folder


@pytest.fixture(scope="module")
def episode(run):
    path = run / "episode.npz"
    request = ["play", "peg_push", "--method", "frozen", "--seed", "1", "--episode", "3"]
    checkpoint = str(run / "peg_push_frozen.safetensors")
    assert main([*request, "--checkpoint", checkpoint, "--out", str(path)]) == 0
    return path


def test_a_recording_is_the_motion_it_was_made_of(run, episode):
    path = run / "peg_push_frozen.safetensors"
    wanted = studies.get("peg_push").motion("frozen", 1, episode=3, path=path)
    found = recorded.load(episode)
    for name in ("t", "qpos", "tip", "force", "distance"):
        np.testing.assert_array_equal(found[name], wanted[name])
    assert found["markers"].keys() == wanted["markers"].keys()
    for name, value in wanted["markers"].items():
        np.testing.assert_array_equal(found["markers"][name], value)
    assert (found["text"], found["success"]) == (wanted["text"], wanted["success"])
    assert found["touched"] >= found["success"]
    assert found["record"]["seeds"] == [1]
    assert "--episode 3" in found["record"]["command"]
    assert found["model"].nq == found["qpos"].shape[1] == wanted["model"].nq


def test_the_tip_of_a_recording_is_where_its_joints_put_it(episode):
    import mujoco

    found = recorded.load(episode)
    data = mujoco.MjData(found["model"])
    for k in (0, 500, 999):
        data.qpos[:] = found["qpos"][k]
        mujoco.mj_kinematics(found["model"], data)
        np.testing.assert_allclose(data.site("tip").xpos, found["tip"][k], atol=1e-9)


@pytest.mark.parametrize("kind", ["truncated", "foreign", "text", "scene"])
def test_bad_recordings_are_refused(kind, episode, tmp_path):
    path = tmp_path / "bad.npz"
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


def test_unknown_episodes_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="episodes/none"):
        recorded.load("none")
    with pytest.raises(ValueError, match="lacks"):
        recorded.save(tmp_path / "x.npz", {}, {"study": "peg_push"})


def test_shipping_keeps_the_last_policy_or_all(run, tmp_path, capsys):
    source = run / "peg_push_frozen.safetensors"
    name = source.name
    shipping(["peg_push", str(run), "--out", str(tmp_path / "last")])
    shipping(["peg_push", str(run), "--out", str(tmp_path / "all"), "--all", "frozen"])
    assert name in capsys.readouterr().out
    kept = marks(STUDY, "frozen", source)
    assert marks(STUDY, "frozen", tmp_path / "last" / name) == kept[-1:]
    assert marks(STUDY, "frozen", tmp_path / "all" / name) == kept
    wanted, record = store.load_checkpoint(source)
    for folder in ("last", "all"):
        found, beside = store.load_checkpoint(tmp_path / folder / name)
        assert beside == record
        assert store.read_json((tmp_path / folder / name).with_suffix(".json")) == record
        for key, value in found.items():
            np.testing.assert_array_equal(value, wanted[key])
    with pytest.raises(FileNotFoundError, match="no checkpoint of peg_maze"):
        shipping(["peg_maze", str(run), "--out", str(tmp_path)])
    with pytest.raises(ValueError, match="unknown method"):
        shipping(["peg_push", str(run), "--out", str(tmp_path), "--all", "hiro"])
