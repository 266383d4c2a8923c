"""The slider widget's real JavaScript in a real browser: what it draws, by keyboard, offline."""

import base64
import io
import json

import numpy as np
import pytest
from matplotlib.image import imread
from test_browser_playback import offline

from cmc.view import sliders as ui
from cmc.view.canvas import SCRIPT, STYLE

pytestmark = pytest.mark.browser


def motion(damping):
    t = np.linspace(0.0, 10.0, 500)
    y = np.exp(-damping * t)[:, None] * np.cos(2 * t[:, None] + np.linspace(0, 3, 50))
    eig, F = np.array([-damping + 2j, -damping - 2j]), np.array([[1.0, -2.0], [0.0, damping]])
    paths = np.stack([y, np.gradient(y, t, axis=0)], axis=-1)
    text = f"damping {damping:.2f} 1/s"
    return {"t": t, "y": y, "paths": paths, "eig": eig, "F": F, "text": text}


def explorer(**more):
    low_left = {"xlim": (-3, 1), "ylim": (-3, 3)}
    return ui.explore(
        motion,
        ui.panel(ui.lines("t", "y", label="$y_1$"), x="time (s)", y="$y_1$ (m)", ylim=(-1, 1)),
        ui.panel(ui.paths("paths", color="vermillion"), x="$y_1$ (m)", y="v (m/s)", equal=True),
        ui.panel(
            ui.shade(x=(-np.inf, 0.0)), ui.rule(y=0.0), ui.points("eig"), x="re", y="im", **low_left
        ),
        ui.panel(ui.cells("F"), x="", y="", title="$F$"),
        damping=ui.slider(0.0, 2.0, 1.0, step=0.2, unit="1/s"),
        describe="Oscillations die out faster when damping grows.",
        **more,
    )


def picture(page, index=0):
    """Pixels (rows, columns, 3) of one canvas."""
    url = page.evaluate("(k) => document.querySelectorAll('canvas')[k].toDataURL()", index)
    return imread(io.BytesIO(base64.b64decode(url.split(",")[1])))[..., :3]


def ink(pixels):
    """Number of pixels that are nearer to the lines' blue than to white."""
    return int((np.linalg.norm(pixels - np.array([0, 114, 178]) / 255, axis=-1) < 0.59).sum())


def drawn(page, serial):
    page.wait_for_function(f"() => document.querySelector('.cmc-view').dataset.serial == {serial}")


def shows(page, where, text):
    page.wait_for_function(f"() => document.querySelector('{where}').innerText == '{text}'")


PAGE = """<!doctype html><html><head><meta charset="utf-8"><title>host</title>
<style>{style}</style></head><body style="color: #111"><div id="view"></div>
<div class="widget-slider"><label class="widget-label">damping (1/s)</label>
<div class="noUi-handle" role="slider" tabindex="0"></div></div>
<script type="module">{script}
class Model {{  // what anywidget and ipywidgets offer to the script, without a kernel
  constructor(state) {{ this.state = state; this.heard = []; this.comm_live = false; }}
  get(name) {{ return this.state[name]; }}
  set(name, value) {{
    if (this.state[name] === value) return;
    this.state[name] = value;
    for (const [names, act] of this.heard) if (names.includes("change:" + name)) act();
  }}
  on(names, act) {{ this.heard.push([names.split(" "), act]); }}
  off(name, act) {{ this.heard = this.heard.filter((item) => item[1] !== act); }}
}}
const raw = (text, offset = 0) => {{  // at any offset in a larger buffer, as a message has it
  const whole = Uint8Array.from(" ".repeat(offset) + atob(text), (c) => c.charCodeAt(0));
  return new DataView(whole.buffer, offset);
}};
const content = JSON.parse({content}, (key, value) => value?.bytes ? raw(value.bytes) : value);
const controls = content.states.map((state) => new Model(state));
const model = new Model(content);
model.widget_manager = {{ get_model: async (id) => controls[content.controls.indexOf(id)] }};
await connect(model, content.controls);
window.remove = render({{ model, el: document.getElementById("view") }});
window.show = (frame, offset) => model.set("frame", {{ ...frame, data: raw(frame.data, offset) }});
Object.assign(window, {{ model, controls }});
</script></body></html>"""


def text(data):
    return base64.b64encode(data).decode()


def sent(live, serial):
    return {**live.canvas.frame, "data": text(live.canvas.frame["data"]), "serial": serial}


@pytest.fixture
def opened(browser, tmp_path):
    """Open the widget with the state that a saved notebook holds, without kernel and network."""

    def open_live(live):
        canvas, widgets = live.canvas, list(live.controls.values())
        names = ("description", "controls", "values", "frame", "error", "note", "table")
        content = {name: getattr(canvas, name) for name in names}
        keys = ("value", "index")
        content["states"] = [{k: getattr(w, k) for k in keys if hasattr(w, k)} for w in widgets]
        script = SCRIPT.replace("export default { initialize, render };", "")
        data = json.dumps(json.dumps(content, default=lambda data: {"bytes": text(data)}))
        page = PAGE.format(style=STYLE.read_text(), script=script, content="@@").replace("@@", data)
        file = tmp_path / "page.html"
        file.write_text(page)
        page = open_(file)
        page.wait_for_function("() => window.model && document.querySelector('canvas')")
        drawn(page, canvas.frame["serial"])
        return page

    with offline(browser, 1000, 1000) as open_:
        yield open_live


@pytest.fixture(scope="module")
def live():
    return explorer(time="t", frames=True)


@pytest.fixture
def page(opened, live):
    return opened(live)


def test_every_panel_is_drawn_and_says_what_it_is(page):
    for k, node in enumerate(page.locator("canvas").all()):
        assert picture(page, k).std() > 0.02
        assert node.get_attribute("role") == "img"
        assert node.get_attribute("aria-label").endswith("faster when damping grows.")
    assert "y1 (m) over time (s)" in page.locator("canvas").first.get_attribute("aria-label")
    assert page.locator(".cmc-status").get_attribute("aria-live") == "polite"
    page.wait_for_function("() => document.querySelector('.noUi-handle').ariaLabel")
    assert page.locator(".noUi-handle").get_attribute("aria-label") == "damping (1/s)"


def test_a_moved_slider_brings_the_next_picture(page):
    before = picture(page)
    page.evaluate("() => controls[0].set('value', 1.2)")
    drawn(page, 7)
    assert np.abs(picture(page) - before).max() > 0.3
    assert page.locator(".cmc-status").inner_text() == "damping 1.20 1/s"


def test_a_bundle_lies_where_its_numbers_are(page):
    """With damping 0 the bundle fills the panel; with damping 2 the late half is one thin line."""
    counts = []
    for value, serial in ((0.0, 1), (2.0, 11)):
        page.evaluate("(v) => controls[0].set('value', v)", value)
        drawn(page, serial)
        counts.append(ink(np.split(picture(page), 2, axis=1)[1]))
    assert counts[0] > 8 * counts[1] > 0


def test_the_time_cursor_moves_by_keys_and_plays_without_the_kernel(page):
    page.focus(".cmc-cursor")
    assert page.locator(".cmc-clock").inner_text() == "t = 0.00 s"  # it opens at the beginning
    page.keyboard.press("End")
    shows(page, ".cmc-clock", "t = 10.00 s")
    assert page.locator(".cmc-cursor").get_attribute("aria-valuetext") == "t = 10.00 s"
    page.keyboard.press("Home")
    shows(page, ".cmc-clock", "t = 0.00 s")
    start = picture(page, 1)
    page.click(".cmc-play")
    page.wait_for_function("() => +document.querySelector('.cmc-cursor').value > 20")
    page.click(".cmc-play")
    assert np.abs(picture(page, 1) - start).max() > 0.3


def test_an_error_is_shown_and_taken_back(page):
    error = page.locator(".cmc-error")
    assert (error.is_visible(), error.get_attribute("role")) == (False, "alert")
    page.evaluate("() => model.set('error', 'ZeroDivisionError: division by zero')")
    assert "ZeroDivisionError" in error.inner_text()
    page.evaluate("() => model.set('error', '')")
    assert not error.is_visible()


def test_of_frames_that_pile_up_only_the_newest_is_drawn(page, live):
    seen = page.evaluate(
        """async (frames) => {
          const root = document.querySelector(".cmc-view"), seen = [];
          new MutationObserver(() => seen.push(+root.dataset.serial))
            .observe(root, { attributes: true });
          for (const frame of frames) show(frame, 0);
          await new Promise((done) => setTimeout(done, 500));
          return seen;
        }""",
        [sent(live, 50 + k) for k in range(8)],
    )
    assert seen == [57]


def test_gaps_infinities_empty_ranges_and_a_log_axis_do_not_break_the_drawing(opened):
    t = np.linspace(0, 1, 50)
    far = np.stack([10.0 ** (-8 * t), np.where(t > 0.5, np.nan, 0.0)], axis=1)
    edge, none = np.where(t > 0.5, np.inf, 3.0), np.full((3, 2), np.nan)
    cells = ui.cells([[1.0, np.nan], [np.nan, 2.0]])
    panels = [
        ui.panel(ui.lines(t, far), x="time (s)", y="distance", log=True),
        ui.panel(ui.lines(t, edge), ui.points(none), x="time (s)", y="z"),
        ui.panel(cells, x="", y="", title="M", size=(200, 200)),
    ]
    page = opened(ui.explore(lambda k: {}, *panels, k=ui.slider(0, 3), describe="Broken."))
    assert ink(picture(page, 0)) > 100
    assert ink(picture(page, 1)) > 100
    empty = picture(page, 2)[:120, 110:]
    assert (empty.min(axis=-1) < 0.2).mean() < 0.02  # no black square


def test_bytes_may_begin_anywhere_and_a_removed_view_leaves_no_handler(page, live):
    for offset in (0, 1, 3, 4):
        page.evaluate("([f, o]) => show(f, o)", [sent(live, 90 + offset), offset])
        drawn(page, 90 + offset)
        assert picture(page).std() > 0.02
    assert page.evaluate("() => model.heard.length") == 3
    page.evaluate("() => remove()")
    assert page.evaluate("() => model.heard.length") == 0
    assert page.locator("canvas").count() == 0


def test_numbers_of_the_table_are_those_of_the_callback(opened):
    """Small arrays exactly, large ones to a share of their range; logarithms, gaps, infinities."""
    t = np.linspace(0.0, 1.0, 200)

    def callback(k, on):
        y = np.stack([np.sin(k * t), np.where(t > 0.5, np.nan, k)], axis=1)
        y[3, 0] = np.inf
        small = np.array([k / 3.0, on * 1e-7])
        return {"t": t, "y": y, "far": 10.0 ** (-12 * t - k)[:, None], "p": small[None]}

    table = ui.explore(
        callback,
        ui.panel(ui.lines("t", "y"), ui.points("p"), x="t", y="y"),
        ui.panel(ui.lines("t", "far"), x="t", y="distance", log=True),
        k=ui.slider(0, 5),
        on=ui.toggle(True),
        describe="d",
        frames=True,
    )
    page = opened(table)
    page.evaluate("() => { controls[1].set('value', false); controls[0].set('value', 4); }")
    drawn(page, 2 * 4 + 0 + 1)
    numbers = page.evaluate("() => Array.from(model.get('frame').data, String)")
    numbers = np.array([float(x.replace("Infinity", "inf")) for x in numbers])
    t_, y, p, _, t_too, far = np.split(numbers, np.cumsum([200, 400, 1, 1, 200]))
    wanted = callback(4, False)
    np.testing.assert_allclose(y.reshape(2, 200), wanted["y"].T, atol=1e-4)
    np.testing.assert_array_equal(p, np.float32([4 / 3]))
    np.testing.assert_allclose(far, wanted["far"][:, 0], rtol=1e-3)
    np.testing.assert_allclose([t_, t_too], [t, t], atol=1e-4)


def small(callback, **more):
    return ui.explore(callback, ui.panel(ui.lines("t", "y"), x="t", y="y"), describe="d", **more)


def opacity(page):
    return float(page.locator(".cmc-panels").evaluate("(e) => getComputedStyle(e).opacity"))


def test_where_one_control_moves_at_a_time_the_others_go_back(opened):
    def callback(a, b, kind):
        return {"t": np.arange(3.0), "y": np.arange(3.0) * a, "text": f"{a} {b} {kind}"}

    sliders = {"a": ui.slider(0, 20, 3), "b": ui.slider(0.0, 1.0, 0.305)}
    page = opened(small(callback, **sliders, kind=ui.choice("x", "y"), frames=True))
    assert page.locator(".cmc-note").inner_text() == ""
    for change, status in (
        ("controls[0].set('value', 7)", "7 0.305 x"),
        ("controls[1].set('value', 0.5)", "3 0.5 x"),
        ("controls[2].set('index', 1)", "3 0.305 y"),
    ):
        page.evaluate(f"() => {change}")
        shows(page, ".cmc-status", status)
    assert page.evaluate("() => controls.map((c) => c.get('value'))")[:2] == [3, 0.305]
    assert "one control moves at a time" in page.locator(".cmc-note").inner_text()
    assert opacity(page) == 1


def test_without_a_table_the_picture_says_that_it_is_stale_unless_a_kernel_answers(opened):
    page = opened(small(motion, damping=ui.slider(0.0, 1.0)))
    page.evaluate("() => { controls[0].comm_live = true; controls[0].set('value', 0.4); }")
    page.wait_for_timeout(100)
    note = page.locator(".cmc-note")
    assert (note.get_attribute("role"), note.inner_text(), opacity(page)) == ("status", "", 1)
    page.evaluate("() => { controls[0].comm_live = false; controls[0].set('value', 0.7); }")
    page.wait_for_function("() => document.querySelector('.cmc-note').textContent")
    assert "no longer follows" in note.inner_text()
    assert opacity(page) < 0.5
