"""The command line: requests that make sense work, the others say what was wanted."""

import json

import pytest

from cmc.__main__ import main


def test_list_names_studies_and_methods(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert "peg_touch" in out
    assert "cppo_capped" in out


def test_train_writes_a_checkpoint_and_goes_on(tmp_path, capsys):
    request = ["train", "peg_touch", "--method", "cppo", "--seeds", "2", "--out", str(tmp_path)]
    assert main([*request, "--episodes", "16"]) == 0
    assert (tmp_path / "peg_touch_cppo.safetensors").is_file()
    assert "peg_touch_cppo" in capsys.readouterr().out


def test_evaluate_ends_with_one_json_object(tmp_path, capsys):
    request = ["evaluate", "peg_touch", "--method", "pi", "--trajectories", "8", "--json"]
    copy = tmp_path / "copy.json"
    assert main([*request, "--out", str(tmp_path), "--write", str(copy)]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert answer["methods"]["pi"]["tests"]
    assert json.loads(copy.read_text()) == answer


def test_play_writes_a_picture(tmp_path):
    path = tmp_path / "motion.png"
    assert main(["play", "peg_touch", "--method", "pi", "--out", str(path)]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (["train", "peg_pull", "--method", "cppo"], "unknown study 'peg_pull'"),
        (["train", "peg_touch", "--method", "sac"], "unknown method 'sac'"),
        (["train", "peg_touch", "--method", "cppo", "--seeds", "0"], "at least 1, got 0"),
        (["train", "peg_touch", "--method", "cppo", "--episodes", "0"], "at least 1, got 0"),
        (["train", "peg_touch", "--method", "pi"], "fixed gains"),
        (["evaluate", "peg_touch", "--method", "sac"], "unknown method 'sac'"),
        (["evaluate", "peg_touch", "--method", "pi", "--trajectories", "0"], "at least 1"),
        (["play", "peg_touch", "--method", "pi", "--out", "motion.gif"], r".png"),
        (["play", "peg_touch", "--method", "cppo", "--seed", "9"], "seed: wanted"),
    ],
)
def test_wrong_requests_say_what_was_wanted(request_, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(request_) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_no_command_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2
