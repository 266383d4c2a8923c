"""The built site in a browser, from disk with the network off: lesson 00 stands for all."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from test_browser_playback import until

ROOT = Path(__file__).resolve().parent.parent
LESSON = "notebooks/00_start_here.html"
PAGES = [LESSON, "index.html", "live.html", "claims.html", "results.html", "notation.html"]
PAGES += ["teaching.html", "changelog.html", "api.html", "api/theory.html"]
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site as `make site` builds it, with one executed lesson; CMC_SITE names a built one."""
    if "CMC_SITE" in os.environ:
        return Path(os.environ["CMC_SITE"])
    out = tmp_path_factory.mktemp("built") / "site"
    command = [sys.executable, "site/build.py", "--only", "00", "--jobs", "1", "--out", str(out)]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout[-2000:] + made.stderr[-2000:]
    return out


@pytest.fixture(scope="module")
def opened(browser, site):
    """Open a page of the site and collect what it asks for and complains about."""
    context = browser.new_context(offline=True, viewport={"width": 1200, "height": 900})

    def open_(name, page=None):
        page = page or context.new_page()
        page.asked, page.failed = [], []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("pageerror", lambda error: page.failed.append(str(error)))
        page.on("console", lambda line: line.type == "error" and page.failed.append(line.text))
        page.goto((site / name).as_uri())
        return page

    yield open_
    context.close()


@pytest.fixture(scope="module")
def lesson(opened):
    page = opened(LESSON)
    until(page, "document.documentElement.dataset.widgets === 'ready'")
    return page


@pytest.mark.parametrize("name", PAGES)
def test_no_page_fails_loads_from_elsewhere_or_is_too_wide_for_a_phone(opened, name):
    page = opened(name)
    page.set_viewport_size({"width": 390, "height": 800})
    until(page, "document.readyState === 'complete'")
    if page.evaluate("Boolean(document.querySelector('.math'))"):
        until(page, "document.querySelector('mjx-container')")
        assert page.locator("mjx-merror").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert [url for url in page.asked if not url.startswith(("file:", "blob:", "data:"))] == []
    assert page.failed == []
    page.close()


def test_exercises_answer_without_a_traceback_and_tables_are_tables(site):
    text = (site / LESSON).read_text("utf-8")
    assert re.search("<th[^>]*><p>in code", text)
    assert "exercises.check" in re.sub("<[^>]*>", "", text)
    assert "output traceback" not in text


PICTURE = "[...document.querySelectorAll('.cmc-view canvas')].map((c) => c.toDataURL()).join()"


def test_every_slider_is_labelled_and_changes_the_picture_by_key(lesson):
    sliders = lesson.locator(".cmc-widget input[type=range]:visible")
    assert sliders.count() >= 2
    for slider in sliders.all():
        assert slider.get_attribute("aria-label")
        before = lesson.evaluate(PICTURE)
        slider.focus()
        lesson.keyboard.press("ArrowLeft")
        until(lesson, f"{PICTURE} !== {before!r}")


def test_canvases_follow_the_theme(lesson):
    corner = "[...document.querySelector('.cmc-view canvas').getContext('2d')"
    corner += ".getImageData(2, 2, 1, 1).data]"
    for theme, dark in (("dark", True), ("light", False)):
        lesson.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
        until(lesson, f"({corner}[0] < 80) === {str(dark).lower()}")


def frame_of(page, name):
    """The document in a frame of the page, which loads once it is in view."""
    element = page.locator(f"iframe[src$='{name}']")
    element.scroll_into_view_if_needed()
    return element.element_handle().content_frame()


def test_a_player_plays_seeks_once_and_stays(lesson):
    frame = frame_of(lesson, "00_panda.html")
    until(frame, "window.cmcPlayback")
    frame.locator("#play").click()
    until(frame, "cmcPlayback.state().time > 0")
    frame.locator("#time").fill("1.5")
    lesson.wait_for_timeout(400)
    assert frame.evaluate("cmcPlayback.state().time") == pytest.approx(1.5, abs=0.02)


def test_the_arms_of_the_live_page_move(lesson):
    frame = frame_of(lesson, "00_live.html")
    until(frame, "typeof live !== 'undefined' && (live.ready || live.failed)", 60)
    assert frame.evaluate("live.failed") is None
    until(frame, "live.states && live.states[1].time > 0.5")
    assert lesson.failed == []
    assert {url.split(":")[0] for url in lesson.asked} <= {"file", "blob", "data"}
