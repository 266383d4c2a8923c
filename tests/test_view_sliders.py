"""Sliders and pictures in the kernel: frames, probing, errors, coalescing, live curves."""

import asyncio
import json
import zlib

import numpy as np
import pytest

from cmc.view import picture
from cmc.view import sliders as ui

PANEL = ui.panel(ui.lines("t", "y"), x="time (s)", y="y", title="rate {rate:.1f}")
PLAIN = ui.panel(ui.lines("t", "y"), x="t", y="y")


def wave(rate, shift=0.0):
    t = np.linspace(0.0, 4.0, 100)
    y = np.exp(-rate * t[:, None]) * np.cos(t[:, None] + shift + np.arange(7))
    return {"t": t, "y": y, "rate": np.array(rate), "text": f"rate {rate}"}


class Counted:
    """A callback that keeps what it is called with, and fails where it is told to."""

    def __init__(self, low=9.0, high=9.0):
        self.seen, self.low, self.high = [], low, high

    def __call__(self, rate, shift=0.0):
        self.seen.append((rate, shift))
        if self.low <= rate <= self.high:
            raise ValueError("no such rate")
        return wave(rate, shift)


def explore(callback=wave, **more):
    controls = {"rate": ui.slider(0.0, 2.0, 0.5), "shift": ui.slider(0.0, 1.0, 0.25)}
    return ui.explore(callback, PANEL, describe="Waves decay.", **{**controls, **more})


def table(callback=wave, **controls):
    controls = controls or {"rate": ui.slider(0.0, 2.0, 0.5)}
    return ui.explore(callback, PANEL, describe="d", frames=True, **controls).canvas.table


def unpack(frame, ref):
    numbers = np.frombuffer(frame["data"], np.float32)
    size = int(np.prod(ref["shape"]))
    return numbers[ref["at"] : ref["at"] + size].reshape(ref["shape"])


def test_a_frame_holds_the_arrays_of_the_callback_and_nothing_else():
    frame, data = explore().canvas.frame, wave(0.5, 0.25)
    (layer,) = frame["panels"][0]["layers"]
    np.testing.assert_allclose(unpack(frame, layer["x"]), data["t"], rtol=1e-6)
    np.testing.assert_allclose(unpack(frame, layer["y"]), data["y"].T, rtol=1e-5, atol=1e-6)
    assert len(frame["data"]) == 4 * (100 + 100 * 7)
    assert frame["panels"][0]["title"] == "rate 0.5"
    assert frame["text"] == "rate 0.5"
    low, high = frame["panels"][0]["ylim"]
    assert low < data["y"].min() < data["y"].max() < high


def test_the_callback_is_tried_at_the_start_the_ends_and_the_corners():
    quick, slow = Counted(), Counted()
    explore(quick)
    assert quick.seen[-1] == (0.5, 0.25)
    ends = {(0.0, 0.25), (2.0, 0.25), (0.5, 0.0), (0.5, 1.0)}
    corners = {(r, s) for r in (0.0, 2.0) for s in (0.0, 1.0)}
    assert ends | corners <= set(quick.seen)
    explore(slow, slow=True)
    assert corners.isdisjoint(slow.seen)


@pytest.mark.parametrize("bad", [0.5, 0.0, 2.0])
def test_a_callback_that_fails_at_the_start_or_an_end_fails_the_cell(bad):
    with pytest.raises(ValueError, match="no such rate"):
        explore(Counted(bad, bad))


def test_a_later_failure_is_kept_and_shown_and_then_taken_back():
    live = explore(Counted(0.9, 1.1))
    before = live.canvas.frame
    live.controls["rate"].value = 1.0
    assert live.errors == ["ValueError: no such rate (at rate = 1.0, shift = 0.25)"]
    assert live.canvas.error == live.errors[0]
    assert live.canvas.frame is before
    live.controls["rate"].value = 1.5
    assert live.canvas.error == ""
    assert len(live.errors) == 1


def test_moving_a_slider_and_reset():
    live = explore()
    first = live.canvas.frame
    live.controls["shift"].value = 0.75
    assert live.canvas.frame["serial"] == first["serial"] + 1
    assert live.canvas.frame["data"] != first["data"]
    live.reset()
    assert live.values == {"rate": 0.5, "shift": 0.25}
    assert live.canvas.frame["data"] == first["data"]


def test_a_change_is_answered_at_once_and_those_that_wait_meanwhile_by_one_picture():
    callback = Counted()
    live = explore(callback)
    callback.seen.clear()

    async def held_key():
        for k in range(100):
            live.controls["rate"].value = 0.01 * (k + 60)
        await asyncio.sleep(0.1)

    asyncio.run(held_key())
    assert callback.seen == [(pytest.approx(0.6), 0.25), (pytest.approx(1.59), 0.25)]


def test_controls():
    live = ui.explore(
        lambda n, on, kind: {"t": np.arange(n), "y": np.full(n, on + len(kind))},
        PLAIN,
        n=ui.slider(2, 9, label="number", unit="-"),
        on=ui.toggle(True),
        kind=ui.choice("a", "bb"),
        describe="d",
    )
    assert live.values == {"n": 5, "on": True, "kind": "a"}
    kinds = [type(control).__name__ for control in live.controls.values()]
    assert kinds == ["IntSlider", "Checkbox", "Dropdown"]
    assert live.controls["n"].description == "number (-)"
    assert ui.explore(wave, PANEL, rate=ui.slider(0, 1.0), describe="d").values == {"rate": 0.5}
    # all that a control can have, its start and both ends among it; a box is off, then on
    assert ui.slider(0.0, 1.0, 0.3, step=0.4).values == [0.0, 0.3, 0.4, 0.8, 1.0]
    assert ui.slider(0, 3).values == [0, 1, 2, 3]
    assert len(ui.slider(0.0, 2.0, 0.5).values) == 101
    assert ui.toggle(True).values == [False, True]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ui.slider(1.0, 0.0), "low <= start <= high"),
        (lambda: ui.slider(0.0, 1.0, 2.0), "low <= start <= high"),
        (lambda: ui.slider(0.0, np.nan), "finite"),
        (lambda: ui.slider(0.0, 1.0, step=2.0), "wanted 0 < step"),
        (lambda: ui.choice("a"), "at least two"),
        (lambda: ui.choice("a", "b", start="c"), "a start among"),
        (lambda: ui.explore(wave, PANEL, describe="d"), "at least one slider"),
        (lambda: ui.explore(wave, PANEL, rate=ui.slider(0, 1), describe=" "), "description"),
        (lambda: ui.panel(x="a", y="b"), "at least one layer"),
        (lambda: ui.panel(ui.rule(y=0), x="a", y="b", xlim=(1, 0)), "xlim: wanted two finite"),
        (lambda: ui.rule(), "wanted x="),
        (lambda: ui.shade(), "wanted x="),
        (lambda: ui.lines("t", "y", colour="red"), r"unknown look \['colour'\]"),
        (lambda: picture.encode([PANEL], np.zeros(3)), "wanted a mapping"),
        (lambda: picture.encode([PANEL], {"t": [0, 1], "y": [0, 1]}), "cannot fill the title"),
    ],
)
def test_bad_layouts_are_named(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (ui.lines("t", "absent"), r"no 'absent', only \['M', 'n', 't', 'words', 'y'\]"),
        (ui.lines("t", "n"), r"lines\('t', 'n'\): wanted \(m,\) and \(m, number\)"),
        (ui.lines("t", "words"), "'words': wanted numbers"),
        (ui.paths("t"), r"paths\('t'\): wanted \(time, number, 2\)"),
        (ui.points("y"), r"points\('y'\): wanted complex numbers"),
        (ui.band("t", "t", "n"), "thrice"),
        (ui.cells("t"), r"cells\('t'\): wanted \(rows, columns\)"),
    ],
)
def test_arrays_that_do_not_fit_a_layer_are_named(layer, message):
    data = {"t": np.zeros(5), "y": np.zeros((5, 3)), "n": np.zeros(4), "words": "a", "M": [[1.0]]}
    with pytest.raises(ValueError, match=message):
        picture.encode([ui.panel(layer, x="x", y="y")], data)


def test_titles_are_filled_outside_of_mathematics():
    def title(text):
        data = {"rate": np.array([0.25]), "name": "F"}
        return picture.encode([ui.panel(ui.rule(y=0), x="", y="", title=text)], data)

    for text, wanted in (
        ("$F_{11}$ at {rate:.1f} 1/s", "$F_{11}$ at 0.2 1/s"),
        ("{name} and $x^{rate}$", "F and $x^{rate}$"),
    ):
        assert title(text)["panels"][0]["title"] == wanted


@pytest.mark.parametrize(
    ("y", "log", "inside", "outside"),
    [
        ([np.nan, np.inf], False, (0.0, 1.0), (-0.1, 1.1)),
        ([1.0, np.inf, 3.0], False, (1.0, 3.0), (0.0, 4.0)),
        ([-1.0, 0.0, 1e-3, 1.0], True, (1e-3, 1.0), (1e-9, 10.0)),
        ([0.0, 0.0], False, (-1e-9, 1e-9), (-2.0, 2.0)),
    ],
)
def test_limits_hold_finite_values_only(y, log, inside, outside):
    panel = ui.panel(ui.lines(np.arange(len(y)), y), x="", y="", log=log)
    low, high = picture.encode([panel], {})["panels"][0]["ylim"]
    assert outside[0] < low <= inside[0] < inside[1] <= high < outside[1]


def test_a_live_curve_keeps_every_point_but_sends_few_frames():
    live = ui.LiveCurve(["PPO", "C-PPO"], x="episode", y="return")
    for k in range(2000):
        live.add(k, -float(k), **{"C-PPO": float(k)})
    assert live.frame["serial"] < 200
    live.add(2000, 1.0)
    live.finish("done")
    one, two = live.frame["panels"][0]["layers"]
    np.testing.assert_array_equal(unpack(live.frame, two["y"])[0], [*np.arange(2000.0), np.nan])
    np.testing.assert_array_equal(unpack(live.frame, one["y"])[0], [*-np.arange(2000.0), 1.0])
    assert live.frame["text"] == "done"
    for wrong in (lambda: live.add(1, 2.0, 3.0, 4.0), lambda: live.add(1, TD3=4.0)):
        with pytest.raises(ValueError, match="wanted values of"):
            wrong()


def test_frames_are_made_only_when_asked_for(monkeypatch):
    assert explore().canvas.table == {}
    assert table()["counts"] == [101]
    assert len(table()["words"]) < 0.2 * 101 * 4 * 800  # a fifth of their float32 bytes
    monkeypatch.setenv("CMC_EXPORT", "1")
    made = explore(shift=ui.choice(0.0, 1.0))
    assert made.canvas.table["counts"] == [101, 2]
    assert len(made.canvas.controls) == 2


def test_few_combinations_have_all_their_pictures_and_many_one_control_at_a_time():
    few = table(rate=ui.slider(0, 20), shift=ui.slider(0, 19))
    assert (few["full"], len(few["sizes"])) == (True, 420)
    many = table(rate=ui.slider(0, 20), shift=ui.slider(0, 21))
    assert (many["full"], len(many["sizes"])) == (False, 21 + 22)
    assert many["starts"] == [10, 10]


def test_a_picture_that_fails_is_kept_as_its_error():
    made = table(Counted(0.91, 1.09))
    layouts = json.loads(zlib.decompress(made["layouts"]))
    wrong = [k for k, layout in enumerate(layouts) if "error" in layout]
    assert wrong == list(range(46, 55))
    assert layouts[50] == {"error": "ValueError: no such rate"}
    assert made["sizes"][50] == 0
