"""The live page: the same episodes as in Python, nothing loaded, and an arm that comes back."""

from __future__ import annotations

import numpy as np
import pytest

from cmc.studies import live, peg_maze, peg_push, runner
from cmc.view.simulator import live_page

STUDIES = {"peg_maze": peg_maze.STUDY, "peg_push": peg_push.STUDY}
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def pages(browser, tmp_path_factory):
    """Opened pages of both studies, with all that they requested and complained about."""
    opened = {}
    policies = {name: live.live_policies(study, ["ctd3"]) for name, study in STUDIES.items()}
    policies["peg_push"] += live.live_policies(peg_push.STUDY, ["td3"])
    for name, study in STUDIES.items():
        task, arms = live.live_task(study, 2), len(policies[name])
        path = tmp_path_factory.mktemp("live") / f"{name}.html"
        path.write_text(live_page(task, policies[name], title=name, arms=arms), "utf-8")
        page = browser.new_page(viewport={"width": 700, "height": 500})
        page.requests, page.errors = [], []
        page.on("request", lambda r, page=page: page.requests.append(r.url))
        page.on("pageerror", lambda e, page=page: page.errors.append(str(e)))
        page.on("console", lambda m, page=page: m.type == "error" and page.errors.append(m.text))
        page.goto(path.as_uri())
        page.wait_for_function("live.ready || live.failed", timeout=60_000)
        assert page.evaluate("live.failed") is None
        opened[name] = page
    return opened


def replay(page, method, seed, start, ticks, **more):
    """An episode in the browser: joints (ticks, nq) and distances to the sub-goal (ticks,), m."""
    choice = {"method": method, "kept": 0, "seed": seed}
    page.evaluate(
        "([...of]) => { live.replayed = null; live.replay(...of); }", [choice, start, ticks, more]
    )
    page.wait_for_function("live.replayed", timeout=60_000)
    return [np.array(page.evaluate(f"live.replayed.{key}")) for key in ("qpos", "away")]


@pytest.mark.parametrize(("name", "start"), [("peg_maze", 0), ("peg_maze", 1), ("peg_push", 1)])
def test_an_episode_is_the_same_in_the_browser(pages, name, start):
    study = STUDIES[name]
    policy = runner.load(study, "ctd3", seed=1).policy
    here = study.motion(study.config_of("ctd3"), policy, start)["qpos"][:-1]
    there, _ = replay(pages[name], 0, 1, start, len(here))
    assert np.ptp(here[:, :7], axis=0).max() > 0.01  # the arm moved
    assert np.abs(there - here).max() < 1e-4  # rad


def test_every_contracting_seed_rests_after_a_push_and_free_ones_drift(pages):
    """A sub-goal in free space, and 5 N for 0.2 s after 4 s; contracting arms rest 13 s later."""
    more = {"target": pages["peg_push"].evaluate("PAGE.target"), "force": [5, 0, 0]}
    early = []
    for seed in range(5):
        _, away = replay(pages["peg_push"], 0, seed, 0, 860, span=[200, 210], **more)
        assert away[200:].max() > 3e-4
        assert away[199] < 2e-5
        assert away[-1] < 1e-5
        early.append(away[659] < 1e-5)
    assert sum(early) >= 4  # within .01 mm after 9 s; one seed takes longer
    free = [replay(pages["peg_push"], 1, seed, 0, 200, **more)[1][-1] for seed in range(5)]
    assert np.median(free) > 1e-3


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
    for name in ("planner sets the sub-goals", "you set the sub-goal"):
        page.get_by_role("button", name=name).press("Enter")
    before = page.evaluate("live.states[0].target")
    page.wait_for_function(
        "(before) => live.states[0].target.some((x, k) => x !== before[k])", arg=before
    )


def test_bad_arms_are_refused():
    one = {"name": "ctd3", "kept": [{"seeds": [0, 1]}]}
    for arms, policies in ((3, 3 * [one]), (2, [one])):
        with pytest.raises(ValueError, match=f"wanted 1 or 2, .* got {arms}"):
            live_page({}, policies, title="", arms=arms)
    with pytest.raises(ValueError, match="wanted 0 to 1 for ctd3, got 2"):
        live_page({}, [one], title="", seed=2)
