"""Sliders and pictures in the kernel: frames, probing, errors, coalescing, live curves."""

import asyncio
import json
import zlib

import numpy as np
import pytest

from cmc.view import picture
from cmc.view import sliders as ui
from cmc.view.layers import PictureError


def wave(rate, shift=0.0):
    t = np.linspace(0.0, 4.0, 100)
    y = np.exp(-rate * t[:, None]) * np.cos(t[:, None] + shift + np.arange(7))
    return {"t": t, "y": y, "rate": np.array(rate), "text": f"rate {rate}"}


PANEL = ui.panel(ui.lines("t", "y"), x="time (s)", y="y", title="rate {rate:.1f}")


def explore(callback=wave, **more):
    controls = {"rate": ui.slider(0.0, 2.0, 0.5), "shift": ui.slider(0.0, 1.0, 0.25)}
    return ui.explore(callback, PANEL, describe="Waves decay.", **{**controls, **more})


def unpack(frame, ref):
    numbers = np.frombuffer(frame["data"], np.float32)
    size = int(np.prod(ref["shape"]))
    return numbers[ref["at"] : ref["at"] + size].reshape(ref["shape"])


def test_a_frame_holds_the_arrays_of_the_callback():
    live = explore()
    frame = live.canvas.frame
    data = wave(0.5, 0.25)
    (layer,) = frame["panels"][0]["layers"]
    np.testing.assert_allclose(unpack(frame, layer["x"]), data["t"], rtol=1e-6)
    np.testing.assert_allclose(unpack(frame, layer["y"]), data["y"].T, rtol=1e-5, atol=1e-6)
    assert frame["panels"][0]["title"] == "rate 0.5"
    assert frame["text"] == "rate 0.5"
    low, high = frame["panels"][0]["ylim"]
    assert low < data["y"].min() < data["y"].max() < high


def test_fifty_by_five_hundred_points_are_a_hundred_kilobytes():
    def bundle(k):
        return {"t": np.zeros(500), "y": np.zeros((500, 50))}

    live = ui.explore(bundle, PANEL_OF_Y, k=ui.slider(0, 3), describe="d")
    assert len(live.canvas.frame["data"]) == 4 * (500 + 500 * 50)


PANEL_OF_Y = ui.panel(ui.lines("t", "y"), x="t", y="y")


def test_the_callback_is_tried_at_the_start_the_ends_and_the_corners():
    seen = []

    def callback(rate, shift):
        seen.append((rate, shift))
        return wave(rate, shift)

    explore(callback)
    assert seen[-1] == (0.5, 0.25)
    ends = {(0.0, 0.25), (2.0, 0.25), (0.5, 0.0), (0.5, 1.0)}
    corners = {(r, s) for r in (0.0, 2.0) for s in (0.0, 1.0)}
    assert ends | corners <= set(seen)
    seen.clear()
    explore(callback, slow=True)
    assert corners.isdisjoint(seen)


@pytest.mark.parametrize("bad", [0.5, 0.0, 2.0])
def test_a_callback_that_fails_at_the_start_or_an_end_fails_the_cell(bad):
    def callback(rate, shift):
        if rate == bad:
            raise ZeroDivisionError("division by zero")
        return wave(rate, shift)

    with pytest.raises(ZeroDivisionError):
        explore(callback)


def test_a_later_failure_is_kept_and_shown_and_then_taken_back():
    def callback(rate, shift):
        if 0.9 < rate < 1.1:
            raise ValueError("no rate of one")
        return wave(rate, shift)

    live = explore(callback)
    before = live.canvas.frame
    live.controls["rate"].value = 1.0
    assert live.errors == ["ValueError: no rate of one (at rate = 1.0, shift = 0.25)"]
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


def test_changes_that_wait_in_the_queue_are_answered_once():
    calls = []

    def callback(rate, shift):
        calls.append(rate)
        return wave(rate, shift)

    live = explore(callback)
    calls.clear()

    async def held_key():
        for k in range(100):
            live.controls["rate"].value = 0.01 * (k + 60)
        await asyncio.sleep(0.1)

    asyncio.run(held_key())
    assert calls == [pytest.approx(1.59)]


def test_controls():
    live = ui.explore(
        lambda n, on, kind: {"t": np.arange(n), "y": np.full(n, on + len(kind))},
        PANEL_OF_Y,
        n=ui.slider(2, 9, label="number", unit="-"),
        on=ui.toggle(True),
        kind=ui.choice("a", "bb"),
        describe="d",
    )
    assert live.values == {"n": 5, "on": True, "kind": "a"}
    assert [type(c).__name__ for c in live.controls.values()] == [
        "IntSlider",
        "Checkbox",
        "Dropdown",
    ]
    assert live.controls["n"].description == "number (-)"
    assert ui.explore(wave, PANEL, rate=ui.slider(0, 1.0), describe="d").values == {"rate": 0.5}


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
        (lambda: ui.rule(), "wanted x=number or y=number"),
        (lambda: ui.shade(), "wanted x="),
    ],
)
def test_bad_layouts_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_unknown_looks_are_named():
    with pytest.raises(TypeError, match=r"unknown look \['colour'\]"):
        ui.lines("t", "y", colour="red")


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (ui.lines("t", "absent"), r"no 'absent', only \['M', 'n', 't', 'words', 'y'\]"),
        (ui.lines("t", "n"), r"lines\('t', 'n'\): wanted \(m,\) and \(m, number\)"),
        (ui.lines("t", "words"), "'words': wanted numbers"),
        (ui.paths("t"), r"paths\('t'\): wanted \(time, number, 2\)"),
        (ui.points("y"), r"points\('y'\): wanted complex numbers"),
        (ui.arrows("y", "y"), r"wanted twice \(rows, columns, 2\)"),
        (ui.band("t", "t", "n"), "thrice"),
        (ui.cells("t"), r"cells\('t'\): wanted \(rows, columns\)"),
    ],
)
def test_arrays_that_do_not_fit_a_layer_are_named(layer, message):
    data = {"t": np.zeros(5), "y": np.zeros((5, 3)), "n": np.zeros(4), "words": "a", "M": [[1.0]]}
    with pytest.raises(PictureError, match=message):
        picture.encode([ui.panel(layer, x="x", y="y")], data)


def test_a_callback_must_return_a_mapping_and_titles_need_their_keys():
    with pytest.raises(PictureError, match="wanted a mapping"):
        picture.encode([PANEL], np.zeros(3))
    with pytest.raises(PictureError, match="cannot fill the title"):
        picture.encode([PANEL], {"t": np.zeros(2), "y": np.zeros(2)})


def test_titles_are_filled_outside_of_mathematics():
    data = {"rate": np.array([0.25]), "t": np.zeros(2), "name": "F"}
    assert picture.fill("$F_{11}$ at {rate:.1f} 1/s", data) == "$F_{11}$ at 0.2 1/s"
    assert picture.fill("{name} and $x^{rate}$", data) == "F and $x^{rate}$"


def test_arrows_point_along_the_field_and_stay_in_their_cell():
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-10, 10, 6)), axis=-1)
    field = np.random.default_rng(1).normal(size=grid.shape) * [1.0, 30.0]
    field[0, 0] = 0.0
    arrays = ui.arrows(grid, field).fetch({})
    tips = np.stack([arrays["dx"], arrays["dy"]], -1)
    V, cell = field.reshape(-1, 2), np.array([0.5, 4.0])
    cross = tips[:, 0] * V[:, 1] - tips[:, 1] * V[:, 0]
    np.testing.assert_allclose(cross, 0.0, atol=1e-9)
    assert ((tips * V).sum(-1)[1:] > 0).all()
    length = np.linalg.norm(tips / cell, axis=-1)
    assert length.max() == pytest.approx(0.9)
    assert length[0] == 0.0


def test_limits_hold_finite_values_only():
    assert picture.limits([np.array([np.nan, np.inf])], log=False) == (0.0, 1.0)
    low, high = picture.limits([np.array([1.0, np.inf, 3.0])], log=False)
    assert low < 1.0 < 3.0 < high < 4.0
    low, high = picture.limits([np.array([-1.0, 0.0, 1e-3, 1.0])], log=True)
    assert 0 < low < 1e-3
    low, high = picture.limits([np.zeros(3)], log=False)
    assert low < 0 < high


def test_a_live_curve_keeps_every_point_but_sends_few_frames():
    live = ui.LiveCurve(["PPO", "C-PPO"], x="episode", y="return")
    for k in range(2000):
        live.add(k, -float(k), **{"C-PPO": float(k)})
    assert live.frame["serial"] < 200
    live.finish("done")
    layers = live.frame["panels"][0]["layers"]
    np.testing.assert_array_equal(unpack(live.frame, layers[1]["y"])[0], np.arange(2000.0))
    assert live.frame["text"] == "done"
    live.add(2000)
    assert np.isnan(live.arrays()["PPO"][-1])
    with pytest.raises(ValueError, match="wanted values of"):
        live.add(1, 2.0, 3.0, 4.0)
    with pytest.raises(ValueError, match="wanted values of"):
        live.add(1, TD3=4.0)


def explore_frames(callback=wave, **controls):
    controls = controls or {"rate": ui.slider(0.0, 2.0, 0.5)}
    return ui.explore(callback, PANEL, describe="d", frames=True, **controls)


def test_frames_are_made_only_when_asked_for(monkeypatch):
    assert explore().canvas.table == {}
    assert explore_frames().canvas.table["counts"] == [101]
    monkeypatch.setenv("CMC_EXPORT", "1")
    made = explore(shift=ui.choice(0.0, 1.0))
    assert made.canvas.table["counts"] == [101, 2]
    assert len(made.canvas.controls) == 2


def test_few_combinations_have_all_their_pictures_and_many_one_control_at_a_time():
    few = {"rate": ui.slider(0, 20), "shift": ui.slider(0, 19)}
    many = {"rate": ui.slider(0, 20), "shift": ui.slider(0, 21)}
    table = explore_frames(**few).canvas.table
    assert (table["full"], len(table["sizes"])) == (True, 420)
    table = explore_frames(**many).canvas.table
    assert (table["full"], len(table["sizes"])) == (False, 21 + 22)
    assert table["starts"] == [10, 10]


def test_the_values_of_a_slider_hold_its_start_and_both_ends():
    assert ui.slider(0.0, 1.0, 0.3, step=0.4).values == [0.0, 0.3, 0.4, 0.8, 1.0]
    assert ui.slider(0, 3).values == [0, 1, 2, 3]
    assert len(ui.slider(0.0, 2.0, 0.5).values) == 101
    assert ui.choice(True, False).values == [False, True]  # a check box is off, then on


def test_a_picture_that_fails_is_kept_as_its_error():
    def callback(rate):
        if 0.9 < rate < 1.1:
            raise ValueError("no rate of one")
        return wave(rate)

    table = explore_frames(callback).canvas.table
    layouts = json.loads(zlib.decompress(table["layouts"]))
    wrong = [k for k, layout in enumerate(layouts) if "error" in layout]
    assert wrong == list(range(46, 55))
    assert layouts[50] == {"error": "ValueError: no rate of one"}
    assert table["sizes"][50] == 0


def test_tables_are_small():
    """101 pictures of seven curves with 100 points: a fifth of their float32 bytes."""
    table = explore_frames().canvas.table
    assert len(table["words"]) < 0.2 * 101 * 4 * 800
