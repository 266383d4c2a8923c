"""The command line on the two-level studies: train, test, play, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cmc.__main__ import main


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    request = ["train", "peg_maze", "--method", "frozen", "--seeds", "2", "--out", str(folder)]
    assert main([*request, "--steps", "160"]) == 0
    return folder


def test_evaluate_ends_with_one_json_object(trained: Path, capsys) -> None:
    request = ["evaluate", "peg_maze", "--method", "frozen", "--checkpoints", str(trained)]
    request += ["--out", str(trained / "tests"), "--trajectories", "1", "--json"]
    assert main(request) == 0
    first = json.loads(capsys.readouterr().out.splitlines()[-1])
    final = first["methods"]["frozen"]["final"]
    assert final["step"] == 160
    for rule in final["force"].values():
        assert 0.0 <= rule["zero"] <= rule["below_1_N"] <= rule["below_5_N"] <= 1.0
    larger, smaller = final["force"]["at_50_hz"], final["force"]["largest"]
    assert larger["below_1_N"] >= smaller["below_1_N"]
    low, high = final["success_interval"]
    assert low <= sum(final["success"]) / 2 <= high
    gains = final["gains"]
    assert gains["bounded"]
    assert all(s <= b for row in gains["slope"] for s, b in zip(row, gains["bound"], strict=True))
    assert len(final["consistency_mm"]["spread"]) == 2
    # What is finished is not tested again.
    kept = (trained / "tests" / "frozen.json").read_text()
    (trained / "tests" / "frozen.json").write_text(kept.replace('"return": [', '"return": [7.5, '))
    assert main(request) == 0
    again = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert again["methods"]["frozen"]["final"]["return"][0] == 7.5


def test_play_writes_the_page_of_an_episode(trained: Path, tmp_path: Path) -> None:
    page = tmp_path / "maze.html"
    file = trained / "peg_maze_frozen.safetensors"
    request = ["play", "peg_maze", "--method", "frozen", "--seed", "1", "--checkpoint", str(file)]
    assert main([*request, "--out", str(page)]) == 0
    text = page.read_text()
    assert "TD3/frozen random C, seed 1" in text
    assert "contact force" in text


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (["train", "peg_push", "--method", "hiro"], "unknown method 'hiro'"),
        (["train", "peg_maze", "--method", "frozen", "--episodes", "3"], "use --steps"),
        (["train", "peg_touch", "--method", "cppo", "--steps", "3"], "use --episodes"),
        (["train", "peg_maze", "--method", "frozen", "--steps", "0"], "at least 1, got 0"),
        (["train", "peg_maze", "--method", "frozen", "--jobs", "0"], "at least 1, got 0"),
        (["evaluate", "peg_maze", "--method", "frozen", "--checkpoints", "."], "no checkpoint"),
        (["evaluate", "peg_push", "--trajectories", "0"], "at least 1, got 0"),
        (["play", "peg_maze", "--method", "frozen", "--out", "maze.png"], r".html"),
        (["play", "peg_maze", "--method", "frozen", "--checkpoint", "x"], "no checkpoint at x"),
        (["play", "peg_touch", "--method", "pi", "--checkpoint", "x"], "shipped policies only"),
    ],
)
def test_wrong_requests_say_what_was_wanted(request_, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(request_) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_policy_of_another_seed_count_is_named(trained: Path, tmp_path: Path, capsys) -> None:
    file = trained / "peg_maze_frozen.safetensors"
    request = ["play", "peg_maze", "--method", "frozen", "--seed", "2", "--checkpoint", str(file)]
    assert main([*request, "--out", str(tmp_path / "maze.html")]) == 2
    assert "seed: wanted 0 to 1, got 2" in capsys.readouterr().err
