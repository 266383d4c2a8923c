"""Open the course in JupyterLab: `python -m cmc.course [--port 8888]`.

The server binds loopback only, asks for its token, checks for no updates and fetches no news.
"""

from __future__ import annotations

import argparse
import os
import socket
import sys
import webbrowser
from pathlib import Path

from cmc.store import asset

FIRST = "00_start_here.ipynb"


def port_is_free(port: int) -> bool:
    """Whether loopback `port` can be bound."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def notebooks_folder() -> Path:
    """The folder of notebooks beside the package.

    Raises:
        FileNotFoundError: if the package is not in a checkout of the course.
    """
    folder = Path(__file__).resolve().parent.parent / "notebooks"
    if not (folder / FIRST).is_file():
        raise FileNotFoundError(
            f"no {FIRST} in {folder}: the notebooks come with the repository, not in the wheel"
        )
    return folder


def lab_arguments(folder: Path, port: int, *, root: bool, browser: bool) -> list[str]:
    """Command-line arguments of `jupyter lab` for the course."""
    arguments = [
        f"--ServerApp.root_dir={folder}",
        "--ServerApp.ip=127.0.0.1",
        f"--ServerApp.port={port}",
        "--ServerApp.port_retries=0",
        f"--LabApp.default_url=/lab/tree/{FIRST}",
        "--LabApp.check_for_updates_class=jupyterlab.handlers.announcements.NeverCheckForUpdate",
        "--LabApp.news_url=None",
    ]
    if root:
        arguments.append("--allow-root")
    if not browser:
        arguments.append("--no-browser")
    return arguments


def _has_browser() -> bool:
    try:
        webbrowser.get()
    except webbrowser.Error:
        return False
    return True


def main(arguments: list[str] | None = None) -> int:
    """Check the port, then hand this process to JupyterLab."""
    parser = argparse.ArgumentParser(prog="python -m cmc.course", description=__doc__)
    parser.add_argument("--port", type=int, default=8888, help="loopback port (default 8888)")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    options = parser.parse_args(arguments)
    if not 1 <= options.port <= 65535:
        print(f"Port {options.port} is not a port: choose one between 1 and 65535.")
        return 2
    if not port_is_free(options.port):
        print(f"Port {options.port} is taken: run  make course PORT={options.port % 65535 + 1}")
        return 2
    try:
        folder = notebooks_folder()
    except FileNotFoundError as error:
        print(error)
        return 2
    # Settings that keep JupyterLab from asking whether it may fetch news.
    folders = [str(asset("jupyter")), *filter(None, [os.environ.get("JUPYTER_CONFIG_PATH")])]
    os.environ["JUPYTER_CONFIG_PATH"] = os.pathsep.join(folders)
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    browser = _has_browser() and not options.no_browser
    command = [sys.executable, "-m", "jupyterlab"]
    os.execv(
        sys.executable, command + lab_arguments(folder, options.port, root=root, browser=browser)
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
