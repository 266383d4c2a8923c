"""The command line: requests that make sense work, the others say what was wanted."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cmc.__main__ import main

CPPO = ["train", "peg_touch", "--method", "cppo", "--seeds", "2"]


def test_list_names_studies_methods_and_what_is_shipped(capsys: pytest.CaptureFixture) -> None:
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("peg_touch: PPO against C-PPO") for line in lines)
    assert "  cppo_capped        C-PPO, capped" in lines
    assert any("(not shipped)" in line for line in lines)


def test_train_goes_on_and_ship_puts_it_among_the_assets(tmp_path: Path, capsys) -> None:
    run, assets = tmp_path / "run", tmp_path / "assets"
    for episodes in ("16", "32"):
        assert main([*CPPO, "--out", str(run), "--episodes", episodes]) == 0
    shown = capsys.readouterr()
    assert "return" in shown.err  # how well it goes, beside the time that is left
    assert "peg_touch_cppo.safetensors" in shown.out
    assert main([*CPPO[:-1], "3", "--out", str(run)]) == 2
    said = capsys.readouterr().err
    assert "seeds [0, 1], not [0, 1, 2]: go on with it by --seeds 2, use another folder" in said
    assert main(["ship", "peg_touch", str(tmp_path / "none"), "--assets", str(assets)]) == 2


def test_evaluate_prints_means_over_seeds_and_one_json_object(tmp_path: Path, capsys) -> None:
    request = ["evaluate", "peg_touch", "--method", "pi", "--trajectories", "8", "--json"]
    assert main([*request, "--out", str(tmp_path)]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert any(line.startswith("Hand-tuned PI: oscillation 0 %") for line in lines)
    rows = json.loads(last)["tests"]
    assert {row["method"] for row in rows} == {"pi"}
    assert (tmp_path / "pi.json").is_file()


def test_play_says_what_the_episode_did_and_writes_it(tmp_path: Path, capsys) -> None:
    path = tmp_path / "motion.png"
    assert main(["play", "peg_touch", "--method", "pi", "--out", str(path)]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")
    assert "peg_touch, Hand-tuned PI, seed 0: 50 trajectories end" in capsys.readouterr().out
    page = tmp_path / "maze.html"
    request = ["play", "peg_maze", "--method", "frozen", "--seed", "1", "--episode", "2"]
    assert main([*request, "--out", str(page)]) == 0
    out = capsys.readouterr().out
    assert "peg_maze, TD3/frozen random C, seed 1: the tip ends" in out
    assert re.search(r"\d mm from the goal \([a-z ]+\), largest force \d", out)
    assert "contact force" in page.read_text()


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (["train", "peg_pull"], "unknown study 'peg_pull'; wanted one of peg_touch"),
        (["train", "peg_touch", "--method", "sac"], "unknown method 'sac'"),
        (["train", "peg_push", "--method", "hiro"], "unknown method 'hiro'"),
        ([*CPPO[:-1], "0"], "seeds: wanted at least one"),
        ([*CPPO, "--episodes", "0"], "length (episodes) needs"),
        ([*CPPO, "--steps", "3"], "use --episodes"),
        ([*CPPO, "--jobs", "0"], "jobs needs"),
        ([*CPPO, "--address", "nowhere"], "--address: only with --backend dask"),
        (["train", "peg_maze", "--method", "frozen", "--episodes", "3"], "use --steps"),
        (["train", "peg_touch", "--method", "pi"], "fixed gains"),
        (["evaluate", "peg_touch", "--method", "sac"], "unknown method 'sac'"),
        (["evaluate", "peg_push", "--trajectories", "0"], "trajectories needs"),
        (["evaluate", "peg_touch", "--checkpoints", "x"], "no checkpoint of peg_touch in x"),
        (["evaluate", "composition", "--method", "x"], "--method: not for a table"),
        (["play", "peg_maze", "--live", "--beside", "nope"], "unknown method 'nope'"),
        (["play", "peg_maze", "--beside", ""], "unknown method ''"),
        (["play", "peg_maze", "--live", "--checkpoint", "x"], "--checkpoint: not with a live page"),
        (["play", "peg_maze", "--live", "--out", "x.png"], "--out: wanted a .html file"),
        (["evaluate", "peg_maze", "--method", "frozen", "--checkpoints", "."], "no checkpoint"),
        (["play", "peg_touch", "--method", "pi", "--out", "motion.gif"], ".png"),
        (["play", "peg_touch", "--method", "cppo", "--seed", "9"], "seed: wanted a position"),
        (["play", "peg_touch", "--method", "cppo", "--checkpoint", "x"], "no checkpoint at x"),
        (["play", "peg_touch", "--method", "pi", "--episode", "-1"], "at least 0, got -1"),
        ([*CPPO, "--episodes", "16", "--out", "/dev/null/run"], "Not a directory"),
    ],
)
def test_wrong_requests_are_one_sentence_each(request_, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(request_) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert message in said
    assert said.startswith("python -m cmc ")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_says_how_to_go_on(tmp_path: Path, capsys, monkeypatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert main([*CPPO, "--episodes", "16", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert (
        f"No space left on device: '{tmp_path / 'peg_touch_cppo.safetensors'}'; make room" in said
    )
    assert not list(tmp_path.iterdir())


def test_no_command_is_a_usage_error() -> None:
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2


def test_an_interrupt_says_what_was_saved_and_that_is_there(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cmc", *CPPO, "--out", str(tmp_path)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, **options)  # type: ignore[call-overload]
    begun = b""
    assert process.stderr is not None
    deadline = time.monotonic() + 120
    while b"return" not in begun:
        assert time.monotonic() < deadline, "the training did not begin"
        begun += process.stderr.buffer.read1(4096)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate()
    assert process.returncode == 130
    assert "interrupted; stopped and saved at episode" in out
    assert (tmp_path / "cppo_state.safetensors").is_file()
    assert (tmp_path / "peg_touch_cppo.safetensors").is_file()
