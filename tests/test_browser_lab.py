"""Every lesson in a real JupyterLab: Run All, sliders by keyboard, players, nothing left behind."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from test_browser_playback import until
from test_course import free_port, wait_for

ROOT = Path(__file__).resolve().parent.parent
LESSONS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NOTEBOOK = "window.jupyterapp.shell.currentWidget"
ERRORS = f"""[...{NOTEBOOK}.content.model.cells].filter((c) => c.type === "code").flatMap((c) =>
  c.outputs.toJSON().filter((o) => o.output_type === "error").map((o) => o.ename + o.evalue))"""
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A JupyterLab over a copy of the notebooks; at the end no process of it is left."""
    home, port = tmp_path_factory.mktemp("lab"), free_port()
    shutil.copytree(ROOT / "notebooks", home / "notebooks")
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--port", str(port)]
    command += ["--expose-app-in-browser", f"--ServerApp.root_dir={home / 'notebooks'}"]
    settings = {"JUPYTER_TOKEN": "letmein", "HOME": str(home), "CMC_FAST": "1"}
    settings |= {"JUPYTER_CONFIG_PATH": str(ROOT / "assets" / "jupyter")}
    with open(home / "log", "w") as log:
        server = subprocess.Popen(
            command, env={**os.environ, **settings}, cwd=home, stdout=log, stderr=log
        )
        try:
            wait_for(f"http://127.0.0.1:{port}/api", server)
            yield f"http://127.0.0.1:{port}"
        finally:
            begun = psutil.Process(server.pid).children(recursive=True)
            server.terminate()
            server.wait(timeout=60)
            assert psutil.wait_procs(begun, timeout=30)[1] == []


@pytest.fixture(params=LESSONS, ids=lambda path: path.stem, scope="module")
def lesson(request, browser, lab):
    """A lesson after Run All, with what its page asked for and complained about."""
    page = browser.new_context(viewport={"width": 1300, "height": 1000}).new_page()
    page.asked, page.failed, page.source = [], [], request.param.read_text("utf-8")
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("websocket", lambda socket: page.asked.append(socket.url))
    page.on("pageerror", lambda error: page.failed.append(str(error)))
    page.on("console", lambda line: line.type == "error" and page.failed.append(line.text))
    page.goto(f"{lab}/lab/tree/{request.param.name}?token=letmein&reset")
    until(page, f"window.jupyterapp && {NOTEBOOK}?.content?.model?.cells?.length > 5", 60)
    until(page, f"{NOTEBOOK}.sessionContext.session?.kernel?.status === 'idle'", 60)
    page.evaluate(
        "() => { jupyterapp.commands.execute('notebook:run-all-cells').then(() => { ran = 1; }); }"
    )
    until(page, "window.ran", 600)
    yield page
    page.evaluate(f"() => {NOTEBOOK}.sessionContext.shutdown()")
    page.context.close()


def views(page, selector):
    """Elements in the outputs, cell by cell: cells out of view are not in the page."""
    outputs = f"""[...{NOTEBOOK}.content.model.cells].map((c) =>
      c.type === "code" ? JSON.stringify(c.outputs.toJSON()) : "")"""
    for k, text in enumerate(page.evaluate(outputs)):
        if "widget-view+json" in text or "<iframe" in text:
            page.evaluate(f"(k) => {NOTEBOOK}.content.scrollToItem(k, 'start')", k)
            cell = page.locator(f".jp-Cell[data-windowed-list-index='{k}'] .jp-OutputArea-output")
            cell.locator(".jupyter-widgets, iframe, canvas").first.wait_for()
            yield from cell.locator(selector).all()


def test_no_cell_fails_and_sliders_and_players_answer(lesson):
    assert lesson.evaluate(ERRORS) == []
    sliders = players = 0
    for handle in views(lesson, ".noUi-handle, iframe"):
        if handle.evaluate("(node) => node.tagName") == "IFRAME":
            assert plays(handle.element_handle().content_frame())
            players += 1
            continue
        output = handle.locator("xpath=ancestor::*[contains(@class, 'jp-OutputArea-output')]")
        if not output.locator(".cmc-view").count():
            continue
        view = output.locator(".cmc-view").element_handle()
        serial, low = view.get_attribute("data-serial"), handle.get_attribute("aria-valuemin")
        assert handle.get_attribute("aria-label")
        handle.press("ArrowRight" if handle.get_attribute("aria-valuenow") == low else "ArrowLeft")
        lesson.wait_for_function("([node, was]) => node.dataset.serial !== was", arg=[view, serial])
        sliders += 1
    assert sliders >= lesson.source.count("ui.explore(")
    assert players >= lesson.source.count("playback/")
    home = lesson.url.split("/lab")[0].split("//")[1]
    assert [u for u in lesson.asked if home not in u and not u.startswith(("blob:", "data:"))] == []
    assert lesson.failed == []


def plays(frame):
    """Whether the frame is a player or a live page that works; it plays, seeks once and stays."""
    until(frame, "window.cmcPlayback || typeof live !== 'undefined'", 60)
    if frame.evaluate("typeof live !== 'undefined'"):
        until(frame, "live.failed || live.states?.[0].time > 0.2", 60)
        return frame.evaluate("live.failed") is None
    frame.locator("#play").click()
    until(frame, "cmcPlayback.state().time > 0")
    frame.locator("#time").fill("0.5")
    frame.wait_for_timeout(300)
    return frame.evaluate("cmcPlayback.state().time") == pytest.approx(0.5, abs=0.05)
