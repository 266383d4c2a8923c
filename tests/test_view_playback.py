"""Playback without a browser: what is recorded, how it is packed, what the live view leaves."""

import base64
import html as html_
import json
import re

import ipywidgets
import mujoco
import numpy as np
import pytest
import umsgpack

from cmc.view.playback import Arrow, Camera, Marker, around, record
from cmc.view.playback.cameras import FIELD_OF_VIEW
from cmc.view.playback.geometry import color, geom_mesh
from cmc.view.playback.overlays import as_overlays
from cmc.view.playback.page import page_id, scene_data

SCENE = """
<mujoco>
  <asset>
    <material name="blue" rgba=".2 .6 .9 1"/>
    <mesh name="tetrahedron" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1"/>
    <geom name="pad" type="plane" size=".2 .3 .1" pos="0 0 .001"/>
    <geom name="post" type="cylinder" size=".02 .3" pos=".5 .2 .3"/>
    <geom name="hidden" type="sphere" size=".1" group="3"/>
    <geom name="clear" type="sphere" size=".1" rgba="1 1 1 0"/>
    <body name="torso" pos="0 0 .8">
      <freejoint/>
      <geom name="chest" type="capsule" size=".07" fromto="0 -.1 0 0 .1 0" material="blue"/>
      <geom name="belly" type="ellipsoid" size=".08 .05 .1" pos="0 0 -.15" rgba=".9 .6 .2 1"/>
      <body name="head/top" pos="0 0 .2">
        <joint axis="0 1 0"/>
        <geom name="head" type="sphere" size=".09" rgba=".9 .4 .4 .7"/>
      </body>
      <body name="arm" pos="0 .2 0">
        <joint axis="1 0 0"/>
        <geom name="bone" type="cylinder" size=".04 .15" pos="0 .15 0" euler="90 0 0"/>
        <body pos="0 .3 0">
          <joint axis="0 0 1"/>
          <geom name="hand" type="box" size=".05 .04 .02" pos="0 .06 0" euler="10 20 30"/>
          <geom name="nail" type="mesh" mesh="tetrahedron" pos="0 .1 .05" euler="0 40 0"/>
          <site name="tip" pos="0 .1 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def page_id_of(scene):
    return page_id([scene])


@pytest.fixture(autouse=True)
def served(monkeypatch):
    """As in JupyterLab, whatever the tests run in."""
    for name in ("CMC_EMBED", "VSCODE_PID", "SERVER_SOFTWARE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SCENE)


def tumble(model, frames=40, seed=0):
    """Joint positions (T, nq), full states (T, n) and times of a falling, turning body."""
    data, full = mujoco.MjData(model), int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data.qvel[:] = np.random.default_rng(seed).normal(size=model.nv)
    qpos, states = [], np.empty((frames, mujoco.mj_stateSize(model, full)))
    for k in range(frames):
        mujoco.mj_step(model, data, 10)
        mujoco.mj_getState(model, data, states[k], full)
        qpos.append(data.qpos.copy())
    return np.array(qpos), states, 0.02 * np.arange(1, frames + 1)


@pytest.fixture(scope="module")
def recording(model):
    qpos, _, times = tumble(model)
    return record(model, qpos, times, trails=["tip"], title="Tumble")


def commands(recording):
    return [umsgpack.unpackb(c) for c in recording.commands]


def test_poses_equal_mujoco_s_and_static_bodies_are_not_stored(model, recording):
    qpos, _, _ = tumble(model)
    data = mujoco.MjData(model)
    assert recording.bodies == ("torso", "head|top", "arm", "body4")
    for k in (0, 17, 39):
        data.qpos[:] = qpos[k]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(recording.poses[k, :, :3], data.xpos[1:], atol=1e-7)
        np.testing.assert_allclose(recording.poses[k, :, 3:], data.xquat[1:], atol=1e-7)
        tip = data.site("tip").xpos
        np.testing.assert_allclose(recording.overlays[0].points[k], tip, atol=1e-12)


def test_full_states_and_lists_give_the_same_recording(model, recording):
    qpos, states, times = tumble(model)
    assert model.nq not in {states.shape[1]}
    for given in (states, list(states), list(qpos)):
        assert np.array_equal(record(model, given, times).poses, recording.poses)


def test_geoms_stand_where_mujoco_puts_them(model, recording):
    """Body pose times the drawn geom's transform is geom_xpos and geom_xmat, but for the axis."""
    drawn = {c["path"]: np.reshape(c["matrix"], (4, 4)).T for c in commands(recording)
             if c["type"] == "set_transform"}  # fmt: skip
    data = mujoco.MjData(model)
    data.qpos[:] = tumble(model)[0][0]
    mujoco.mj_forward(model, data)
    seen = 0
    for geom in range(model.ngeom):
        body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, model.geom_bodyid[geom])
        body = (body or f"body{model.geom_bodyid[geom]}").replace("/", "|")
        path = f"/meshcat/{body}/geom{geom}"
        if path not in drawn:
            assert model.geom(geom).name in ("hidden", "clear")
            continue
        seen += 1
        world = drawn[f"/meshcat/{body}"] @ drawn[path]
        rotation = data.geom_xmat[geom].reshape(3, 3)
        np.testing.assert_allclose(world[:3, 3], data.geom_xpos[geom], atol=1e-12)
        turned = model.geom(geom).name in ("post", "chest", "bone")
        z_axis = world[:3, 1] if turned else world[:3, 2]
        np.testing.assert_allclose(z_axis, rotation[:, 2], atol=1e-12)
        assert np.linalg.det(world[:3, :3]) == pytest.approx(1.0)
    assert seen == model.ngeom - 2


def extent(mesh):
    """Half-size of a meshcat object along its own axes."""
    data = mesh.lower()
    geometry = data["geometries"][0]
    scale = np.abs(np.reshape(data["object"]["matrix"], (4, 4))[:3, :3]).sum(axis=0)
    kind = geometry["type"]
    if kind == "BoxGeometry":
        return np.array([geometry["width"], geometry["height"], geometry["depth"]]) / 2 * scale
    if kind == "SphereGeometry":
        return geometry["radius"] * scale
    if kind == "CylinderGeometry":
        assert geometry["radiusTop"] == geometry["radiusBottom"]
        return np.array([geometry["radiusTop"], geometry["height"] / 2, geometry["radiusTop"]])
    if kind == "LatheGeometry":
        x, y = np.array([[p["x"], p["y"]] for p in geometry["points"]]).T
        return np.array([x.max(), y.max(), x.max()])
    packed = geometry["data"]["attributes"]["position"]["array"].data
    return np.abs(np.frombuffer(packed, np.float32).reshape(-1, 3)).max(axis=0)


@pytest.mark.parametrize("name", ["post", "chest", "belly", "head", "bone", "hand", "nail", "pad"])
def test_drawn_sizes_are_mujoco_s(model, name):
    geom = model.geom(name).id
    mesh, _ = geom_mesh(model, geom)
    size = extent(mesh)
    if name in ("post", "chest", "bone"):  # their axis is y here, z in MuJoCo
        size = size[[0, 2, 1]]
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    wanted = np.abs(np.stack([center - half, center + half])).max(axis=0)
    if name == "pad":
        wanted = np.array([0.2, 0.3, 0.0])
    np.testing.assert_allclose(size, wanted, atol=1e-6)


def test_capsule_surface_is_one_radius_from_its_axis(model):
    geometry = geom_mesh(model, model.geom("chest").id)[0].lower()["geometries"][0]
    points = np.array([[p["x"], p["y"]] for p in geometry["points"]])
    nearest = np.stack([np.zeros(len(points)), np.clip(points[:, 1], -0.1, 0.1)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), 0.07, atol=1e-12)
    assert (np.diff(points[:, 1]) > 0).all()  # no fold, and normals that point outwards


def test_colors_follow_mujoco_s_rule(model):
    assert color(model, model.geom("chest").id) == pytest.approx((0.2, 0.6, 0.9, 1.0))
    assert color(model, model.geom("head").id) == pytest.approx((0.9, 0.4, 0.4, 0.7))
    assert color(model, model.geom("post").id) == pytest.approx((0.5, 0.5, 0.5, 1.0))


def test_the_same_recording_is_the_same_page(model, recording):
    again = record(model, *tumble(model)[::2], trails=["tip"], title="Tumble")
    assert again.html() == recording.html()
    assert page_id_of(again) == page_id_of(recording)
    other = record(model, *tumble(model, seed=1)[::2], trails=["tip"], title="Tumble")
    assert page_id_of(other) != page_id_of(recording)


def test_page_loads_nothing_and_says_so(recording):
    html = recording.html()
    own = html[: html.index("<script>")]
    assert "default-src 'none'" in own
    assert "connect-src" not in own
    assert not re.search(r"<(script|link|iframe|img|object|embed)[^>]*(src|href|data)=", html)
    assert html.count("</script>") == 3
    assert "@@" not in re.sub(r"<script>.*?</script>", "", html, flags=re.S)


def test_a_hostile_title_or_name_stays_text(model):
    qpos, _, times = tumble(model, frames=2)
    name = "</script><script>alert(1)</script>"
    html = record(model, qpos, times, title=name, readouts={name: [0.0, 1.0]}).html()
    assert html.count("</script>") == 3
    assert "<script>alert" not in html


def test_twenty_seconds_of_a_humanoid_s_worth_of_bodies_stay_below_three_megabytes():
    bodies = "".join(
        f'<body name="b{i}" pos="{i} 0 0"><joint/><geom type="capsule" size=".1 .2"/></body>'
        for i in range(17)
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    qpos = np.random.default_rng(0).normal(size=(1001, model.nq))
    recording = record(model, qpos, 0.02 * np.arange(1001), trails=["b1"])
    assert len(recording.bodies) == 17
    assert len(recording.html().encode()) < 3e6


def test_packed_arrays_decode_to_the_recording(recording):
    data = json.loads(json.dumps(scene_data(recording)))
    poses = np.frombuffer(base64.b64decode(data["poses"]), "<f4")
    assert np.array_equal(poses.reshape(recording.poses.shape), recording.poses)
    assert np.array_equal(np.frombuffer(base64.b64decode(data["times"]), "<f8"), recording.times)


def test_overlays_are_broadcast_and_checked(model):
    qpos, _, times = tumble(model, frames=3)
    path = np.array([[0, 0, 1], [np.nan] * 3, [0, 1, 1.0]])
    made = record(
        model, qpos, times,
        markers={"goal": [0, 0, 1.0], "way": Marker("way", path, radius=0.01)},
        arrows={"force": Arrow([0, 0, 1.0], np.ones((3, 3)), scale=0.1)},
        readouts={"f": [1, 2, 3]},
    )  # fmt: skip
    goal, way, force = made.overlays
    assert goal.points.shape == force.points.shape == force.vectors.shape == (3, 3)
    assert way.radius == 0.01
    assert force.name == "force"
    for wrong in (
        {"markers": {"goal": [0.0, 0.0]}},
        {"arrows": {"force": Arrow([0, 0, 1.0], np.ones((2, 3)))}},
        {"arrows": {"force": Arrow([0, 0, np.nan], np.ones((3, 3)))}},
        {"readouts": {"f": [1.0, 2.0]}},
        {"trails": ["nowhere"]},
    ):
        with pytest.raises(ValueError, match=next(iter(next(iter(wrong.values()))))):
            record(model, qpos, times, **wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda q, t: (q[:, :-1], t), "states must have shape"),
        (lambda q, t: (q[0], t), "states must have shape"),
        (lambda q, t: (q, t[:-1]), "times must have shape"),
        (lambda q, t: (q[:0], t[:0]), "one frame"),
        (lambda q, t: (q, t[::-1]), "increase"),
        (lambda q, t: (np.where(q == q[1, 0], np.nan, q), t), "finite"),
    ],
)
def test_bad_trajectories_are_refused(model, change, message):
    qpos, _, times = tumble(model, frames=3)
    with pytest.raises(ValueError, match=message):
        record(model, *change(qpos, times))


def test_default_camera_frames_every_solid_geom(model, recording):
    """Every geom's centre lies in the cone of the first preset."""
    camera = next(iter(recording.cameras.values()))
    data = mujoco.MjData(model)
    data.qpos[:] = tumble(model)[0][0]
    mujoco.mj_forward(model, data)
    axis = np.subtract(camera.target, camera.position)
    axis /= np.linalg.norm(axis)
    solid = [g for g in range(model.ngeom) if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
    ray = data.geom_xpos[solid] - camera.position
    angle = np.degrees(np.arccos(ray @ axis / np.linalg.norm(ray, axis=1)))
    assert angle.max() < FIELD_OF_VIEW / 2
    assert angle.max() > FIELD_OF_VIEW / 16  # and the scene is not a dot
    for bad in (lambda: around([0, 0], 1.0), lambda: around([0, 0, 0], 0.0)):
        with pytest.raises(ValueError, match=r"center|radius"):
            bad()
    assert around([1, 2, 3], 1.0, azimuth=0, elevation=0).position[1:] == pytest.approx((2, 3))


def test_shown_in_a_notebook_as_a_frame_on_the_file(recording, tmp_path, monkeypatch):
    """The page has the one time slider: nothing else is shown."""
    monkeypatch.chdir(tmp_path)
    frame = recording.show("playback/tumble.html", height=300)
    assert 'src="playback/tumble.html"' in frame._repr_html_()
    assert (tmp_path / "playback/tumble.html").stat().st_size > 800_000
    for path in (tmp_path / "x.html", "../x.html"):
        with pytest.raises(ValueError, match="relative"):
            recording.show(path)


def test_embedded_in_the_notebook_without_a_file(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    markup = html_.unescape(recording.show()._repr_html_())
    assert recording.html() in markup
    assert 'sandbox="allow-scripts"' in markup
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value"), [("CMC_EMBED", "1"), ("VSCODE_PID", "7"), ("SERVER_SOFTWARE", "voila/0.5")]
)
def test_embedded_where_no_server_would_deliver_a_file(
    recording, tmp_path, monkeypatch, name, value
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(name, value)
    assert "srcdoc=" in recording.show("playback/tumble.html")._repr_html_()
    assert list(tmp_path.iterdir()) == []


def test_a_slider_of_ones_own_replaces_the_page_s(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mine = ipywidgets.FloatSlider(max=0.78)
    frame, slider, link = recording.show("playback/tumble.html", slider=mine).children
    assert "playback/tumble.html" in frame.value
    assert slider is mine
    assert link.scene == page_id_of(recording)
    assert '"slider":false' in (tmp_path / "playback/tumble.html").read_text()
    assert '"slider":true' in recording.html()


def test_goal_zones_of_the_model_are_taken_over():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><material name="goal" rgba="0 1 0 .4"/></asset><worldbody>
        <body><joint/><geom size=".1"/></body>
        <site name="zone" type="box" size=".1 .2 .3" pos="1 2 3" material="goal"/>
        <site name="frame" size=".1"/></worldbody></mujoco>"""
    )
    made = record(model, np.zeros((1, 1)), [0.0])
    drawn = {c["path"]: c for c in commands(made) if c["type"] == "set_object"}
    assert "/meshcat/world/site1" not in drawn
    box = drawn["/meshcat/world/site0"]["object"]
    assert box["geometries"][0]["height"] == pytest.approx(0.4)
    assert box["materials"][0]["opacity"] == pytest.approx(0.4)
    place = next(c["matrix"] for c in commands(made) if c["path"] == "/meshcat/world/site0"
                 and c["type"] == "set_transform")  # fmt: skip
    assert place[12:15] == [1, 2, 3]


def test_own_cameras_replace_the_presets(model):
    qpos, _, times = tumble(model, frames=2)
    mine = {"mine": Camera((1, 0, 0), (0, 0, 0))}
    assert record(model, qpos, times, cameras=mine).cameras == mine


def test_markers_without_a_color_get_different_ones():
    points = np.zeros((4, 3))
    given = {
        "goal": Marker("goal", points),
        "way": Marker("way", points),
        "own": Marker("o", points, 7),
    }
    colors = [overlay.color for overlay in as_overlays(4, given, {})]
    assert None not in colors
    assert len(set(colors)) == 3
    assert colors[2] == 7


def test_height_fields_lie_where_mujoco_has_them():
    """Rays down onto MuJoCo's field meet the drawn surface."""
    xml = """<mujoco><asset><hfield name="h" nrow="3" ncol="4" size="2 1 .5 .1"
      elevation="0 1 2 3 0 4 1 0 2 2 0 5"/></asset><worldbody>
      <geom name="hill" type="hfield" hfield="h"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    geometry = geom_mesh(model, 0)[0].geometry
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert len(geometry.vertices) == 12
    for x, y, z in geometry.vertices * [0.999, 0.999, 1]:
        found = np.zeros(1, dtype=np.int32)
        down = mujoco.mj_ray(
            model, data, np.array([x, y, 2.0]), np.array([0, 0, -1.0]), None, 1, -1, found
        )
        assert 2.0 - down == pytest.approx(z, abs=2e-3)
    assert record(model, np.zeros((1, 0)), [0.0]).commands


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
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><texture name="t" type="2d" builtin="flat" width="8" height="8"/>
        <material name="m" texture="t" texrepeat="{repeat}" texuniform="{uniform}"/></asset>
        <worldbody><geom type="plane" size="{size}" material="m"/></worldbody></mujoco>"""
    )
    plane = geom_mesh(model, 0)[0].geometry
    slope = (plane.uv[2] - plane.uv[0]) / (plane.vertices[2] - plane.vertices[0])[:2]
    found = plane.uv[0] + slope * (np.array([0.05, 0.05]) - plane.vertices[0, :2])
    np.testing.assert_allclose(found, wanted, atol=5e-5)


def test_what_cannot_be_drawn_is_named_and_the_rest_is_drawn(model, monkeypatch):
    qpos, _, times = tumble(model, frames=2)

    def refuse(*arguments):
        raise ValueError("geom strange has no counterpart")

    monkeypatch.setattr("cmc.view.playback.drawing.geom_mesh", refuse)
    with pytest.warns(UserWarning, match="left out: geom strange"):
        made = record(model, qpos, times)
    assert len(made.bodies) == 4


def test_an_empty_picture_is_a_warning(model):
    qpos, _, times = tumble(model, frames=2)
    with pytest.warns(UserWarning, match=r"nothing of groups \(5,\) is seen; geoms: \[0, 3\]"):
        record(model, qpos, times, groups=(5,))


def test_a_recording_may_end_when_the_action_does(model):
    """Half a second after the last motion: of 4 s of which 1 s moves, 1.5 s stay."""
    times = 0.1 * np.arange(41)
    qpos = np.tile(tumble(model, frames=1)[0], (41, 1))
    qpos[:, 0] = np.minimum(times, 1.0)
    whole = record(model, qpos, times, trails=["tip"], readouts={"x": times})
    made = record(model, qpos, times, trails=["tip"], readouts={"x": times}, tail=0.5)
    assert len(whole.times) == 41
    assert made.times[-1] == pytest.approx(1.4, abs=0.11)
    assert len(made.poses) == len(made.times) == len(made.readouts["x"])
    assert made.overlays[0].points.shape == (len(made.times), 3)
    assert len(np.atleast_2d(made.cameras["tip: follow"].position)) == len(made.times)


def test_labels_and_cameras_that_name_nothing_are_refused(model):
    lost = Camera((1, 0, 0), (0, 0, 0), follow="nowhere")
    qpos, _, times = tumble(model, frames=2)
    for wrong in (
        {"labels": {"a": "nowhere"}},
        {"cameras": {"a": lost}},
    ):
        with pytest.raises(ValueError, match="no site and no body named"):
            record(model, qpos, times, **wrong)


def test_a_textured_shape_without_a_map_has_the_mean_color():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><texture name="t" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
        width="16" height="16"/><material name="m" texture="t"/></asset><worldbody>
        <geom size=".1" material="m"/></worldbody></mujoco>"""
    )
    assert color(model, 0) == pytest.approx((0.5, 0, 0.5, 1), abs=0.01)
