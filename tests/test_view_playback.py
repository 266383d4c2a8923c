"""Playback without a browser: what is recorded, how it is drawn and packed."""

import base64
import json
import re

import mujoco
import numpy as np
import pytest
from scenes import SCENE, at, attribute, commands, load, still, tumble, tumbled

from cmc.view.playback import Arrow, Camera, Marker, around, record
from cmc.view.playback.cameras import FIELD_OF_VIEW
from cmc.view.playback.page import page_id


@pytest.fixture(scope="module")
def model():
    return load(SCENE)


@pytest.fixture(scope="module")
def recording(model):
    return tumbled(model, trails=["tip"], title="Tumble")


def test_poses_equal_mujoco_s_and_static_bodies_are_not_stored(model, recording):
    """From joint positions and from full states, in arrays or lists."""
    qpos, states, times = tumble(model)
    assert recording.bodies == ["torso", "head|top", "arm", "body4"]
    for k in (0, 17, 39):
        data = at(model, qpos[k])
        place = np.c_[data.xpos, data.xquat][1:]
        np.testing.assert_allclose(recording.poses[k], place, atol=1e-7)
        tip = data.site("tip").xpos
        np.testing.assert_allclose(recording.overlays[0]["points"][k], tip, atol=1e-12)
    assert model.nq not in {states.shape[1]}
    for given in (states, list(states), list(qpos)):
        assert np.array_equal(record(model, given, times).poses, recording.poses)


def test_mocap_bodies_move_with_full_states():
    model = load(
        '<mujoco><worldbody><body mocap="true"><geom size=".1"/></body></worldbody></mujoco>'
    )
    data, spec = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION
    states = np.empty((2, mujoco.mj_stateSize(model, spec)))
    for k, row in enumerate(states):
        data.mocap_pos[0, 0] = 0.5 * k
        mujoco.mj_getState(model, data, row, spec)
    np.testing.assert_allclose(record(model, states, [0.0, 1.0]).poses[:, 0, 0], [0.0, 0.5])


def look(drawn):
    color = drawn["materials"][0]["color"]
    return [*(c / 255 for c in color.to_bytes(3, "big")), drawn["materials"][0]["opacity"]]


def test_colors_follow_mujoco_s_rule():
    """The geom's own unless it is the default and a material is set; a texture's mean."""
    drawn = still(
        """<mujoco><asset><material name="blue" rgba=".2 .6 .9 1"/>
        <texture name="t" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="16"
        height="16"/><material name="m" texture="t"/></asset><worldbody>
        <geom size=".1" material="blue"/><geom size=".1" rgba=".9 .4 .4 .7"/>
        <geom size=".1" material="blue" rgba=".9 .4 .4 1"/><geom size=".1"/>
        <geom size=".1" material="m"/></worldbody></mujoco>"""
    )
    wanted = [[0.2, 0.6, 0.9, 1], [0.9, 0.4, 0.4, 0.7], [0.9, 0.4, 0.4, 1], [0.5] * 3 + [1]]
    for k, rgba in enumerate([*wanted, [0.5, 0, 0.5, 1]]):
        assert look(drawn[f"geom{k}"]) == pytest.approx(rgba, abs=0.01)


def test_a_texture_is_multiplied_by_the_color_that_its_geom_would_have_without_it():
    drawn = still(
        """<mujoco><asset><texture name="t" type="2d" builtin="checker" width="16" height="16"/>
        <material name="m" texture="t" rgba=".2 .6 .9 1"/></asset><worldbody>
        <geom type="plane" size="1 1 1" material="m"/>
        <geom type="plane" size="1 1 1" material="m" rgba=".8 .9 .7 .5"/></worldbody></mujoco>"""
    )
    for k, rgba in enumerate([[0.2, 0.6, 0.9, 1], [0.8, 0.9, 0.7, 0.5]]):
        assert look(drawn[f"geom{k}"]) == pytest.approx(rgba, abs=0.01)
        assert drawn[f"geom{k}"]["images"]


def test_a_camera_within_a_mesh_looks_out_of_it_as_in_mujoco(recording):
    drawn = {p.split("/")[-1]: c["object"] for p, c in commands(recording, "set_object").items()}
    sides = {name: made["materials"][0]["side"] for name, made in drawn.items()}
    front, both = 0, 2  # FrontSide and DoubleSide of three.js
    assert (sides["geom0"], sides["geom10"]) == (both, front)


def test_sites_are_drawn_where_they_have_a_material():
    model = load(
        """<mujoco><asset><material name="goal" rgba="0 1 0 .4"/></asset><worldbody>
        <site type="box" size=".1 .2 .3" pos="1 2 3" material="goal"/>
        <site size=".1"/></worldbody></mujoco>"""
    )
    made = record(model, np.zeros((1, 0)), [0.0])
    ((path, zone),) = commands(made, "set_object").items()
    assert zone["object"]["geometries"][0]["height"] == pytest.approx(0.4)
    assert look(zone["object"])[3] == pytest.approx(0.4)
    assert commands(made, "set_transform")[path]["matrix"][12:15] == [1, 2, 3]


def test_height_fields_lie_where_mujoco_has_them():
    """Rays down onto MuJoCo's field meet the drawn surface."""
    xml = """<mujoco><asset><hfield name="h" nrow="3" ncol="4" size="2 1 .5 .1"
      elevation="0 1 2 3 0 4 1 0 2 2 0 5"/></asset><worldbody>
      <geom name="hill" type="hfield" hfield="h"/></worldbody></mujoco>"""
    vertices = attribute(still(xml)["geom0"], "position")
    assert len(vertices) == 12
    model = load(xml)
    data = at(model, [])
    for x, y, z in vertices.astype(float) * [0.999, 0.999, 1]:
        found, start = np.zeros(1, dtype=np.int32), np.array([x, y, 2.0])
        down = mujoco.mj_ray(model, data, start, np.array([0, 0, -1.0]), None, 1, -1, found)
        assert 2.0 - down == pytest.approx(z, abs=2e-3)


@pytest.mark.parametrize(
    ("size", "repeat", "uniform", "wanted"),
    [
        ("1 .5 .1", "1 1", "false", [0.525, 0.45]),
        ("1 .5 .1", "2 1", "false", [1.05, 0.45]),
        ("1 .5 .1", "1 1", "true", [0.525, 0.225]),
        ("0 0 .1", "2 1", "true", [0.55, 0.475]),
    ],
)
def test_textures_of_planes_lie_as_mujoco_draws_them(size, repeat, uniform, wanted):
    """Texture coordinates at (0.05, 0.05) m, read from pictures of MuJoCo's renderer."""
    plane = still(
        f"""<mujoco><asset><texture name="t" type="2d" builtin="flat" width="8" height="8"/>
        <material name="m" texture="t" texrepeat="{repeat}" texuniform="{uniform}"/></asset>
        <worldbody><geom type="plane" size="{size}" material="m"/></worldbody></mujoco>"""
    )["geom0"]
    uv, corners = (attribute(plane, name).astype(float) for name in ("uv", "position"))
    slope = (uv[2] - uv[0]) / (corners[2] - corners[0])[:2]
    found = uv[0] + slope * (np.array([0.05, 0.05]) - corners[0, :2])
    np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_a_recording_is_one_page_that_holds_its_arrays(model, recording):
    again, html = tumbled(model, trails=["tip"], title="Tumble"), recording.html()
    assert again.html() == html
    assert page_id([again]) == page_id([recording])
    assert page_id([tumbled(model, seed=1, trails=["tip"])]) != page_id([recording])
    start = html.index("const CONTENT = ") + 16
    (scene,) = json.loads(html[start : html.index(";</script>", start)])["scenes"]
    poses = np.frombuffer(base64.b64decode(scene["poses"]), "<f4")
    assert np.array_equal(poses.reshape(recording.poses.shape), recording.poses)
    assert np.array_equal(np.frombuffer(base64.b64decode(scene["times"]), "<f8"), recording.times)


def test_page_loads_nothing_and_hostile_names_stay_text(model):
    name = "</script><script>alert(1)</script>"
    html = tumbled(model, 2, title=name, readouts={name: [0.0, 1.0]}).html()
    own = html[: html.index("<script>")]
    assert "default-src 'none'" in own
    assert "connect-src" not in own
    assert not re.search(r"<(script|link|iframe|img|object|embed)[^>]*(src|href|data)=", html)
    assert html.count("</script>") == 4  # the viewer, what it must not do, the scene, the player
    assert "<script>alert" not in html
    assert "@@" not in re.sub(r"<script>.*?</script>", "", html, flags=re.S)


def test_overlays_are_broadcast_and_get_different_colors(model):
    path = np.array([[0, 0, 1], [np.nan] * 3, [0, 1, 1.0]])
    markers = {"goal": [0, 0, 1.0], "way": Marker(path, radius=0.01), "own": Marker(path)}
    arrows = {"force": Arrow([0, 0, 1.0], np.ones((3, 3)), scale=0.1)}
    made = tumbled(model, 3, markers=markers, arrows=arrows, readouts={"f": [1, 2, 3]})
    goal, way, own, force = made.overlays
    assert goal["points"].shape == force["points"].shape == force["vectors"].shape == (3, 3)
    assert way["radius"] == 0.01
    assert force["name"] == "force"
    assert len({goal["color"], way["color"], own["color"]}) == 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"markers": {"goal": [0.0, 0.0]}}, "goal"),
        ({"arrows": {"force": Arrow([0, 0, 1.0], np.ones((2, 3)))}}, "force"),
        ({"arrows": {"force": Arrow([0, 0, np.nan], np.ones((3, 3)))}}, "force"),
        ({"readouts": {"f": [1.0, 2.0]}}, "f"),
        ({"trails": ["nowhere"]}, "no site and no body named 'nowhere'"),
        ({"labels": {"a": "nowhere"}}, "no site and no body named 'nowhere'"),
        (lambda q, t: (q[:, :-1], t), "states must have shape"),
        (lambda q, t: (q[0], t), "states must have shape"),
        (lambda q, t: (q, t[:-1]), "states must have shape .* a row for each time"),
        (lambda q, t: (q[:0], t[:0]), "times must be at least one"),
        (lambda q, t: (q, t[::-1]), "increase"),
        (lambda q, t: (np.where(q == q[1, 0], np.nan, q), t), "finite"),
    ],
)
def test_bad_trajectories_and_overlays_are_refused(model, wrong, message):
    qpos, _, times = tumble(model, frames=3)
    more, change = ({}, wrong) if callable(wrong) else (wrong, lambda q, t: (q, t))
    with pytest.raises(ValueError, match=message):
        record(model, *change(qpos, times), **more)


def test_default_camera_frames_every_solid_geom(model, recording):
    """Every geom's centre lies in the cone of the first preset."""
    camera = next(iter(recording.cameras.values()))
    data = at(model, tumble(model)[0][0])
    axis = np.subtract(camera.target, camera.position)
    axis /= np.linalg.norm(axis)
    solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
    ray = data.geom_xpos[solid] - camera.position
    angle = np.degrees(np.arccos(ray @ axis / np.linalg.norm(ray, axis=1)))
    assert angle.max() < FIELD_OF_VIEW / 2
    assert angle.max() > FIELD_OF_VIEW / 16  # and the scene is not a dot


def test_own_cameras_replace_the_presets(model):
    mine = {"mine": Camera((1, 0, 0), (0, 0, 0))}
    assert tumbled(model, 2, cameras=mine).cameras == mine
    for bad in (lambda: around([0, 0], 1.0), lambda: around([0, 0, 0], 0.0)):
        with pytest.raises(ValueError, match=r"center|radius"):
            bad()


def test_what_cannot_be_drawn_is_named_and_the_rest_is_drawn(model, monkeypatch):
    from cmc.view.playback import shapes

    def refuse(model, what, index, known):
        if index == model.geom("head").id:
            raise ValueError("a shape without a counterpart")
        return made(model, what, index, known)

    made = shapes._three_object
    monkeypatch.setattr(shapes, "_three_object", refuse)
    with pytest.warns(UserWarning, match="left out: geom head, a shape without"):
        whole = tumbled(model, 2)
    assert len(whole.bodies) == 4
    assert len(commands(whole, "set_object")) == model.ngeom - 3


def test_an_empty_picture_is_a_warning(model):
    with pytest.warns(UserWarning, match=r"nothing of groups \(5,\) is seen; geoms: \[0, 3\]"):
        tumbled(model, 2, groups=(5,))


def test_a_page_of_20_s_with_17_moving_bodies_is_small():
    bodies = "".join(f'<body name="b{i}"><freejoint/><geom size=".1"/></body>' for i in range(17))
    model = load(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    qpos = np.random.default_rng(0).normal(size=(1001, model.nq))
    recording = record(model, qpos, 0.02 * np.arange(1001), trails=["b1"])
    assert len(recording.bodies) == 17
    assert len(recording.html().encode()) < 3e6
