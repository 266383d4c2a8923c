"""The live page: the same episodes as in Python, nothing loaded, and an arm that comes back."""

from __future__ import annotations

import numpy as np
import pytest

from cmc.studies import live, peg_maze, peg_push, runner
from cmc.view.simulator import live_page, save_live_page

STUDIES = {"peg_maze": peg_maze.STUDY, "peg_push": peg_push.STUDY}
METHODS = {"peg_maze": ["ctd3"], "peg_push": ["ctd3", "frozen"]}
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def pages(browser, tmp_path_factory):
    """Opened pages of both studies, with all that they requested and complained about."""
    opened = {}
    for name, study in STUDIES.items():
        task = live.live_task(study, 2)
        policies = [
            {**p, "color": color}
            for p, color in zip(
                live.live_policies(study, METHODS[name]), ["#0072B2", "#D55E00"], strict=False
            )
        ]
        arms = [{"method": k, "kept": 0, "seed": 0} for k in range(len(policies))]
        path = tmp_path_factory.mktemp("live") / f"{name}.html"
        save_live_page(path, task, policies, title=name, arms=arms, plan=False)
        page = browser.new_page(viewport={"width": 700, "height": 500})
        page.requests, page.errors = [], []
        page.on("request", lambda r, page=page: page.requests.append(r.url))
        page.on("pageerror", lambda e, page=page: page.errors.append(str(e)))
        page.goto(path.as_uri())
        page.wait_for_function("live.ready || live.failed", timeout=60_000)
        assert page.evaluate("live.failed") is None
        opened[name] = page
    return opened


@pytest.mark.parametrize(("name", "start"), [("peg_maze", 0), ("peg_maze", 1), ("peg_push", 1)])
def test_an_episode_is_the_same_in_the_browser(pages, name, start):
    page, study = pages[name], STUDIES[name]
    policy = runner.load(study, "ctd3", seed=1).policy
    here = study.motion(study.config_of("ctd3"), policy, start)["qpos"][:-1]
    page.evaluate(
        "([start, ticks]) => { live.replayed = null;"
        " live.replay({method: 0, kept: 0, seed: 1}, start, ticks); }",
        [start, len(here)],
    )
    page.wait_for_function("live.replayed", timeout=60_000)
    there = np.array(page.evaluate("live.replayed"))
    assert np.ptp(here[:, :7], axis=0).max() > 0.01  # the arm moved
    assert np.abs(there - here).max() < 1e-4  # rad


def test_nothing_is_loaded_and_nothing_fails(pages):
    for page in pages.values():
        elsewhere = [u for u in page.requests if not u.startswith(("file:", "blob:", "data:"))]
        assert elsewhere == []
        assert sum(u.startswith("file:") for u in page.requests) == 1
        assert page.errors == []


def error(page, arm):
    """Distance from tip to sub-goal of one arm, m."""
    state = page.evaluate(f"live.states[{arm}]")
    return float(np.linalg.norm(np.subtract(state["tip"], state["target"])))


def test_a_contracting_arm_comes_back_after_a_push(pages):
    page = pages["peg_push"]
    page.wait_for_function("live.states[0].time > 4", timeout=60_000)
    at_rest, before = error(page, 0), page.evaluate("live.states[0].time")
    page.get_by_role("button", name="push 5 newtons along +x").click()
    page.wait_for_function(f"live.states[0].time > {before} + 6", timeout=60_000)
    trace = np.array(page.evaluate("live.traces[0]"))  # time in s, distance in mm
    peak = 1e-3 * trace[trace[:, 0] > before, 1].max()
    assert at_rest < 1e-5
    assert peak > 3e-4
    assert error(page, 0) < 0.05 * peak


def test_controls_work_by_keyboard(pages):
    page = pages["peg_maze"]
    page.get_by_role("button", name="running").focus()
    page.keyboard.press("Enter")
    page.wait_for_timeout(150)
    stopped = page.evaluate("live.states[0].time")
    page.wait_for_timeout(300)
    assert page.evaluate("live.states[0].time") == stopped
    page.keyboard.press("Enter")
    page.wait_for_function(f"live.states[0].time > {stopped}", timeout=10_000)
    page.locator(".pane").focus()
    page.keyboard.down("PageUp")
    page.wait_for_function("live.states[0].pushed[2] > 0", timeout=10_000)
    page.keyboard.up("PageUp")
    page.wait_for_function("live.states[0].pushed[2] === 0", timeout=10_000)
    page.get_by_role("button", name="you set the sub-goal").press("Enter")
    before = page.evaluate("live.states[0].target")
    page.wait_for_function(
        "(before) => live.states[0].target.some((x, k) => x !== before[k])", arg=before
    )


def test_bad_arms_are_refused():
    with pytest.raises(ValueError, match="wanted one or two, got 3"):
        live_page({}, [], title="", arms=[{}] * 3)
    with pytest.raises(ValueError, match="no policy"):
        live_page({}, [], title="", arms=[{"method": 0, "kept": 0, "seed": 0}])
