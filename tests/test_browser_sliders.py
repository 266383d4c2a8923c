"""The slider widget's real JavaScript in a real browser: what it draws, by keyboard, offline."""

import base64
import io
import json

import numpy as np
import pytest
from matplotlib.image import imread

from cmc.view import sliders as ui
from cmc.view.canvas import SCRIPT, STYLE
from cmc.view.page import write_page

pytestmark = pytest.mark.browser

BLUE = np.array([0, 114, 178]) / 255


def motion(damping, count=50):
    t = np.linspace(0.0, 10.0, 500)
    y = np.exp(-damping * t)[:, None] * np.cos(2 * t[:, None] + np.linspace(0, 3, int(count)))
    paths = np.stack([y, np.gradient(y, t, axis=0)], axis=-1)
    return {
        "t": t,
        "y": y,
        "paths": paths,
        "eig": np.array([-damping + 2j, -damping - 2j]),
        "F": np.array([[1.0, -2.0], [0.0, damping]]),
        "text": f"damping {damping:.2f} 1/s",
    }


def explorer(time=None):
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9)), axis=-1)
    return ui.explore(
        motion,
        ui.panel(ui.lines("t", "y", label="$y_1$"), x="time (s)", y="$y_1$ (m)", ylim=(-1, 1)),
        ui.panel(
            ui.arrows(grid, -grid),
            ui.paths("paths", color="vermillion"),
            x="$y_1$ (m)",
            y=r"$\dot y_1$ (m/s)",
            equal=True,
        ),
        ui.panel(
            ui.shade(x=(-np.inf, 0.0)),
            ui.rule(y=0.0),
            ui.points("eig"),
            x="real part (1/s)",
            y="imaginary part (1/s)",
            xlim=(-3, 1),
            ylim=(-3, 3),
        ),
        ui.panel(ui.cells("F"), x="", y="", title="$F$"),
        damping=ui.slider(0.0, 2.0, 1.0, unit="1/s"),
        time=time,
        describe="Oscillations die out faster when damping grows.",
    )


def picture(page, index=0):
    """Pixels (rows, columns, 3) of one canvas."""
    url = page.evaluate("(k) => document.querySelectorAll('canvas')[k].toDataURL()", index)
    return imread(io.BytesIO(base64.b64decode(url.split(",")[1])))[..., :3]


def ink(pixels):
    """Number of pixels that are nearer to the lines' blue than to white."""
    return int((np.linalg.norm(pixels - BLUE, axis=-1) < 0.59).sum())


def drawn(page, serial):
    page.wait_for_function(f"() => document.querySelector('.cmc-view').dataset.serial == {serial}")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_page(explorer(time="t"), tmp_path_factory.mktemp("page") / "page.html", count=5)


@pytest.fixture
def page(browser, path):
    context = browser.new_context(offline=True, viewport={"width": 1000, "height": 1000})
    page = context.new_page()
    page.asked, page.failed = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("pageerror", lambda error: page.failed.append(str(error)))
    page.on("console", lambda line: line.type == "error" and page.failed.append(line.text))
    page.goto(path.as_uri())
    drawn(page, 3)
    yield page
    assert page.failed == []
    context.close()


def test_the_page_asks_the_network_for_nothing(page, path):
    assert page.asked == [path.as_uri()]


def test_every_panel_is_drawn_and_says_what_it_is(page):
    for k in range(4):
        assert picture(page, k).std() > 0.02
        node = page.locator("canvas").nth(k)
        assert node.get_attribute("role") == "img"
        assert node.get_attribute("aria-label").endswith("faster when damping grows.")
    assert "y1 (m) over time (s)" in page.locator("canvas").first.get_attribute("aria-label")
    assert page.locator(".cmc-status").get_attribute("aria-live") == "polite"


def test_a_key_on_the_slider_brings_the_next_picture(page):
    before = picture(page)
    page.focus("#control")
    page.keyboard.press("ArrowRight")
    drawn(page, 4)
    assert np.abs(picture(page) - before).max() > 0.3
    assert page.locator(".cmc-status").inner_text() == "damping 1.50 1/s"
    page.keyboard.press("ArrowLeft")
    drawn(page, 3)
    np.testing.assert_array_equal(picture(page), before)


def test_a_bundle_lies_where_its_numbers_are(page):
    """With damping 0 the bundle fills the panel; with damping 2 the late half is one thin line."""
    page.focus("#control")
    counts = {}
    for key, serial in (("Home", 1), ("End", 5)):
        page.keyboard.press(key)
        drawn(page, serial)
        pixels = picture(page)
        counts[serial] = ink(pixels[:, pixels.shape[1] // 2 :])
    assert counts[1] > 8 * counts[5] > 0


def test_the_time_cursor_moves_by_keys_and_plays_without_the_kernel(page):
    page.focus(".cmc-cursor")
    assert page.locator(".cmc-clock").inner_text() == "t = 10.00 s"
    end = picture(page)
    page.keyboard.press("Home")
    page.wait_for_function("() => document.querySelector('.cmc-clock').innerText == 't = 0.00 s'")
    assert page.locator(".cmc-cursor").get_attribute("aria-valuetext") == "t = 0.00 s"
    np.testing.assert_array_equal(picture(page), end)  # these lines have no head
    start = picture(page, 1)
    page.click(".cmc-play")
    page.wait_for_function("() => +document.querySelector('.cmc-cursor').value > 20")
    page.click(".cmc-play")
    assert np.abs(picture(page, 1) - start).max() > 0.3


HOST = """<!doctype html><meta charset="utf-8"><style>{style}</style><div id="view"></div>
<script type="module">{script}
const handlers = {{}};
window.state = {{ description: "A test.", error: "", frame: {{}} }};
window.tell = (name, value) => {{ state[name] = value; handlers["change:" + name]?.(); }};
window.show = (frame, offset) => {{
  // A view at any offset in a larger buffer, as a message of the kernel has.
  const bytes = Uint8Array.from(atob(frame.data), (c) => c.charCodeAt(0));
  const whole = new Uint8Array(bytes.length + offset);
  whole.set(bytes, offset);
  tell("frame", {{ ...frame, data: new DataView(whole.buffer, offset) }});
}};
const model = {{
  get: (name) => state[name],
  on: (name, handler) => (handlers[name] = handler),
  off: (name) => delete handlers[name],
}};
window.remove = render({{ model, el: document.getElementById("view") }});
window.handlers = handlers;
</script>"""


def sent(frame):
    return {**frame, "data": base64.b64encode(frame["data"]).decode()}


@pytest.fixture
def host(browser, tmp_path):
    """The widget's script with a model that the test plays."""
    script = SCRIPT.read_text().replace("export default { render };", "")
    file = tmp_path / "host.html"
    file.write_text(HOST.format(style=STYLE.read_text(), script=script))
    context = browser.new_context(offline=True)
    page = context.new_page()
    page.failed = []
    page.on("pageerror", lambda error: page.failed.append(str(error)))
    page.goto(file.as_uri())
    yield page
    assert page.failed == []
    context.close()


@pytest.mark.parametrize("offset", [0, 1, 3, 4])
def test_bytes_may_begin_anywhere_in_a_message(host, offset):
    live = explorer()
    host.evaluate("([f, o]) => show(f, o)", [sent(live.canvas.frame), offset])
    drawn(host, live.canvas.frame["serial"])
    assert picture(host).std() > 0.02


def test_an_error_is_shown_and_taken_back(host):
    live = explorer()
    host.evaluate("(f) => show(f, 0)", sent(live.canvas.frame))
    assert not host.locator(".cmc-error").is_visible()
    host.evaluate("() => tell('error', 'ZeroDivisionError: division by zero (at damping = 0.5)')")
    assert host.locator(".cmc-error").is_visible()
    assert host.locator(".cmc-error").get_attribute("role") == "alert"
    assert "ZeroDivisionError" in host.locator(".cmc-error").inner_text()
    host.evaluate("() => tell('error', '')")
    assert not host.locator(".cmc-error").is_visible()


def test_of_frames_that_pile_up_only_the_newest_is_drawn(host):
    live = explorer()
    frames = []
    for k in range(30):
        live.evaluate(damping=0.05 * k)
        frames.append(sent(live.canvas.frame))
    host.evaluate(
        """(frames) => {
          window.seen = [];
          const root = document.querySelector(".cmc-view");
          new MutationObserver(() => seen.push(+root.dataset.serial))
            .observe(root, { attributes: true });
          for (const frame of frames) show(frame, 0);
        }""",
        frames,
    )
    drawn(host, frames[-1]["serial"])
    assert host.evaluate("() => seen") == [frames[-1]["serial"]]


def test_gaps_infinities_empty_ranges_and_a_log_axis_do_not_break_the_drawing(host):
    panels = [
        ui.panel(ui.lines("t", "y"), x="time (s)", y="distance", log=True),
        ui.panel(ui.lines("t", "z"), ui.points("p"), x="time (s)", y="z"),
    ]
    t = np.linspace(0, 1, 50)
    y = np.stack([10.0 ** (-8 * t), np.where(t > 0.5, np.nan, 0.0)], axis=1)
    z = np.where(t > 0.5, np.inf, 3.0)

    def data(k):
        return {"t": t, "y": y, "z": z, "p": np.full((3, 2), np.nan)}

    live = ui.explore(data, *panels, k=ui.slider(0, 3), describe="Broken numbers.")
    host.evaluate("(f) => show(f, 0)", sent(live.canvas.frame))
    drawn(host, live.canvas.frame["serial"])
    assert ink(picture(host, 0)) > 100
    assert ink(picture(host, 1)) > 100


def test_removing_the_view_leaves_no_handler(host):
    live = explorer()
    host.evaluate("(f) => show(f, 0)", sent(live.canvas.frame))
    assert host.evaluate("() => Object.keys(handlers).length") == 2
    host.evaluate("() => remove()")
    assert host.evaluate("() => Object.keys(handlers).length") == 0
    assert host.locator("canvas").count() == 0


def test_markup_cannot_leave_the_page_data(tmp_path):
    """A text that would close the script stays text."""

    def evil(k):
        return {"t": np.arange(3.0), "text": "</script><b>out</b>"}

    live = ui.explore(
        evil,
        ui.panel(ui.lines("t", "t"), x="a", y="b"),
        k=ui.slider(0, 2),
        describe="</script><i>out</i>",
    )
    source = write_page(live, tmp_path / "evil.html").read_text()
    assert source.count("</script>") == 1
    assert json.dumps("</script><b>out</b>").replace("</", "<\\/") in source
