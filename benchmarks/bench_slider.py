"""From a key pressed on a slider to the new picture: 50 trajectories of 500 points, in Chromium.

`saved` is a notebook opened again, whose kernel knows nothing of it: pictures come from the table
that it holds. `lab` has a kernel that computes every picture. Both are a JupyterLab on loopback.
Times count until the browser begins the frame after the drawn one. `ratio` compares with making a
new inline matplotlib figure of the same data.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
from nbclient import NotebookClient
from nbformat.sign import NotebookNotary

PRESSES = 40
WATCH = """
() => {
  window.cmcTimes = [];
  let pressed = null;
  addEventListener("keydown", (event) => {
    if (event.key.startsWith("Arrow")) pressed = performance.now();
  }, true);
  const root = document.querySelector(".cmc-view");
  new MutationObserver(() => {
    const began = pressed;
    if (began === null) return;
    pressed = null;
    requestAnimationFrame(() => window.cmcTimes.push(performance.now() - began));
  }).observe(root, { attributes: true, attributeFilter: ["data-serial"] });
}
"""
NOTEBOOK = "from benchmarks.bench_slider import explorer\nexplorer(frames={})"
ROOT = Path(__file__).resolve().parent.parent


def bundle(damping: float) -> dict[str, Any]:
    """Fifty damped oscillations, 500 points each."""
    t = np.linspace(0.0, 10.0, 500)
    phase = np.linspace(0.0, 3.0, 50)
    return {"t": t, "y": np.exp(-damping * t)[:, None] * np.cos(2 * t[:, None] + phase)}


def explorer(frames: bool) -> Any:
    """Return the explorer whose slider is moved."""
    from cmc.view.sliders import explore, lines, panel, slider

    picture = panel(lines("t", "y"), x="time (s)", y="position (m)", ylim=(-1, 1))
    damping = slider(0.0, 2.0, 1.0)
    return explore(bundle, picture, damping=damping, frames=frames, describe="Oscillations.")


def figure_ms() -> float:
    """Median CPU time of a new inline figure of the same data, ms."""
    from cmc.view import style
    from cmc.view.figures import trajectories

    times = []
    for damping in np.linspace(0.2, 1.0, 5):
        began = time.process_time()
        data = bundle(float(damping))
        style.png(trajectories(data["t"], data["y"]))
        times.append(time.process_time() - began)
    return 1e3 * statistics.median(times)


def press(page: Any, count: int = PRESSES) -> list[float]:
    """Press arrow keys one by one and return the times to the new pictures, ms."""
    page.evaluate(WATCH)
    for k in range(count):
        page.keyboard.press("ArrowRight" if k % 8 < 4 else "ArrowLeft")
        page.wait_for_function(f"() => window.cmcTimes.length > {k}", timeout=20_000)
        page.wait_for_timeout(30)
    return page.evaluate("() => window.cmcTimes")


def hold(page: Any, count: int = 60) -> float:
    """Hold a key (a repeat each 30 ms) and return how long the last picture lags behind, ms."""
    before = page.evaluate("() => +document.querySelector('.cmc-view').dataset.serial")
    for k in range(count):
        page.keyboard.down("ArrowLeft" if k % 40 < 20 else "ArrowRight")
        page.wait_for_timeout(30)
    page.keyboard.up("ArrowLeft")
    released, last, changed = time.perf_counter(), before, time.perf_counter()
    while time.perf_counter() - changed < 1.5:
        serial = page.evaluate("() => +document.querySelector('.cmc-view').dataset.serial")
        if serial != last:
            last, changed = serial, time.perf_counter()
        page.wait_for_timeout(10)
    return 1e3 * max(0.0, changed - released)


def installed_browser() -> str | None:
    """Path of a Chromium or Chrome on the PATH, or None."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium, closed afterwards."""
    from playwright.sync_api import sync_playwright

    root = hasattr(os, "geteuid") and os.geteuid() == 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=installed_browser(), args=["--no-sandbox"] if root else []
        )
        try:
            yield browser
        finally:
            browser.close()


def measure(
    browser: Any, folder: Path, saved: bool, shot: str | None = None
) -> tuple[list[float], float]:
    """Times in JupyterLab, and the lag of a held key.

    Args:
        browser: a Chromium.
        folder: where to put the notebook.
        saved: whether the notebook has been run and saved elsewhere before it is opened.
        shot: file for a picture of the page.
    """
    cell = nbformat.v4.new_code_cell(NOTEBOOK.format(saved))
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = nbformat.v4.new_notebook(cells=[cell], metadata={"kernelspec": kernel})
    if saved:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        NotebookClient(notebook).execute(env=environment)
        NotebookNotary().sign(notebook)  # as the reader's own run would be
    nbformat.write(notebook, folder / "slider.ipynb")
    with lab(folder) as address:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(address)
        page.wait_for_selector(".jp-Notebook .jp-CodeCell", timeout=90_000)
        if not saved:
            execute(page)
        page.wait_for_selector(".cmc-view canvas", timeout=90_000)
        page.focus(".noUi-handle")
        times = press(page)
        lag = hold(page)
        if shot:
            page.screenshot(path=shot)
        return times, lag


def execute(page: Any, tries: int = 10) -> None:
    """Run the first cell until its canvas is there: a kernel that still starts drops requests."""
    for _ in range(tries):
        page.click(".jp-Notebook .jp-CodeCell .cm-content")
        page.keyboard.press("Control+Enter")
        for _ in range(50):
            page.wait_for_timeout(200)
            if page.query_selector(".cmc-view canvas"):
                page.wait_for_timeout(1500)
                return
    raise TimeoutError("no canvas appeared in JupyterLab")


@contextmanager
def lab(folder: Path) -> Iterator[str]:
    """A JupyterLab on a free loopback port with a token; yields the address of the notebook."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    token = os.urandom(16).hex()
    command = [sys.executable, "-m", "jupyterlab", "--allow-root", "--no-browser"]
    command += ["--ServerApp.ip=127.0.0.1", f"--ServerApp.port={port}"]
    command += [f"--ServerApp.root_dir={folder}", "--LabApp.news_url="]
    environment = {**os.environ, "JUPYTER_TOKEN": token, "PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen(command, env=environment, **quiet)
    try:
        for _ in range(300):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.2)
        yield f"http://127.0.0.1:{port}/doc/tree/slider.ipynb?token={token}"
    finally:
        server.terminate()
        server.wait(timeout=30)


def run(shot: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield one row for the saved notebook and one for the live one; none without a browser."""
    if installed_browser() is None:
        print("no Chromium or Chrome on the PATH: sliders are not measured", file=sys.stderr)
        return
    figure = figure_ms()
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder = Path(name)
        for where, saved in (("saved", True), ("lab", False)):
            times, lag = measure(browser, folder, saved, shot)
            yield {**row(where, figure, times), "held_key_lag_ms": round(lag, 1)}


def row(where: str, figure: float, times: list[float]) -> dict[str, Any]:
    """One row: the ratio, the median, the best and the 95 % quantile, ms."""
    median = statistics.median(times)
    return {
        "name": f"slider to picture, {where}, 50 x 500 points, against a new inline figure",
        "ratio": round(figure / median, 2),  # CPU time of the figure: cautious
        "median_ms": round(median, 1),
        "best_ms": round(min(times), 1),
        "q95_ms": round(float(np.quantile(times, 0.95)), 1),
        "figure_ms": round(figure, 1),
        "presses": len(times),
    }


if __name__ == "__main__":
    for line in run(sys.argv[1] if len(sys.argv) > 1 else None):
        print(json.dumps(line), flush=True)
