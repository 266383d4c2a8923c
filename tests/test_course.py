"""`make course`: what it checks before it opens JupyterLab, and what JupyterLab then serves."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TEXT = {"capture_output": True, "text": True, "check": False}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_make_starts_the_lab_with_the_course_s_settings() -> None:
    command = next(line for line in (ROOT / "Makefile").read_text().splitlines() if "lab" in line
                   and line.startswith("\t@JUPYTER"))  # fmt: skip
    assert 'JUPYTER_CONFIG_PATH="$(CURDIR)/assets/jupyter"' in command
    assert command.endswith("$(BIN)/python -m jupyterlab --port $(PORT)")


def test_the_lab_serves_the_first_notebook_on_loopback_with_a_token(tmp_path: Path) -> None:
    port = free_port()
    environment = {
        **os.environ,
        "JUPYTER_TOKEN": "letmein",
        "HOME": str(tmp_path),
        "JUPYTER_CONFIG_PATH": str(ROOT / "assets" / "jupyter"),
    }
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--port", str(port)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    where = {"env": environment, "cwd": tmp_path}
    server = subprocess.Popen(command, **where, **quiet)
    try:
        url = f"http://127.0.0.1:{port}/api/contents/00_start_here.ipynb?content=0"
        wait_for(f"http://127.0.0.1:{port}/api", server)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(url, timeout=10)
        with urllib.request.urlopen(f"{url}&token=letmein", timeout=10) as answer:
            assert "00_start_here.ipynb" in answer.read().decode()
        with socket.socket() as probe:  # a server on all interfaces would answer here
            assert probe.connect_ex(("127.0.0.2", port)) != 0
        again = subprocess.run(command, **where, **TEXT, timeout=60)
        assert again.returncode != 0
        assert f"port {port} is not available" in again.stderr
    finally:
        server.terminate()
        server.wait(timeout=30)


def wait_for(url: str, server: subprocess.Popen, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert server.poll() is None, "the server ended by itself"
        try:
            return urllib.request.urlopen(url, timeout=5).close()
        except urllib.error.HTTPError:
            return
        except OSError:
            time.sleep(0.3)
    raise AssertionError(f"nothing answered at {url} within {seconds} s")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def fake_python(folder: Path, script: str) -> Path:
    path = folder / "fake-python"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return path


def make_course(folder: Path, python: str) -> list[str]:
    command = ["make", "--no-print-directory", "course", f"PYTHON={python}"]
    run = subprocess.run(command, cwd=folder, **TEXT)
    assert run.returncode != 0
    assert not (folder / ".venv" / ".made").exists()
    return run.stdout.splitlines()


def test_no_python_an_old_one_and_one_without_venv_get_one_sentence(checkout: Path) -> None:
    assert "No missing-python on the PATH" in make_course(checkout, "missing-python")[-1]
    old = fake_python(checkout, 'case "$1" in -V) echo Python 3.9.2;; *) exit 1;; esac')
    (line,) = make_course(checkout, str(old))
    assert "Python 3.9.2" in line
    assert "needs Python 3.11" in line
    bare = fake_python(checkout, 'case "$2" in *ensurepip*) exit 1;; *) exit 0;; esac')
    (line,) = make_course(checkout, str(bare))
    assert "lacks the venv module" in line
