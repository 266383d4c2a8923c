"""The playback page in a real browser, from disk and with the network off."""

import io
import time
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from matplotlib.image import imread
from test_view_playback import SCENE, at, tumble

from cmc.view.playback import Arrow, Marker, record
from cmc.view.playback.page import page_id

pytestmark = pytest.mark.browser

MATRIX = """(path) => {
  const scene = cmcPlayback.viewer.scene;
  scene.updateMatrixWorld(true);
  const world = cmcPlayback.viewer.scene_tree.find(path).object.matrixWorld.clone();
  return scene.matrixWorld.clone().invert().multiply(world).toArray();
}"""
OVERLAY = """(name) => {
  const found = cmcPlayback.viewer.scene.getObjectByName("overlay " + name);
  return { visible: found.visible, position: found.position.toArray(),
           quaternion: found.quaternion.toArray() };
}"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SCENE)


@pytest.fixture(scope="module")
def recording(model):
    qpos, _, times = tumble(model)
    goal = np.tile([0.2, 0.1, 0.5], (40, 1))
    goal[30:] = np.nan
    force = np.zeros((40, 3))
    force[10:, 1] = 2.0
    return record(
        model,
        qpos,
        times + 3.0,  # a recording need not start at zero
        title="Tumble",
        trails=["tip"],
        markers={"goal": Marker(goal, radius=0.02)},
        arrows={"force": Arrow([0.1, 0.2, 0.3], force, scale=0.1)},
        readouts={"height [m]": qpos[:, 2]},
    )


@contextmanager
def offline(browser, width=480, height=360):
    """Open files with the network off; nothing may fail, and nothing be asked for but the file."""
    pages = []

    def open_(file):
        size = {"width": width, "height": height}
        page = browser.new_context(offline=True, viewport=size).new_page()
        page.asked, page.failed = [], []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("pageerror", lambda error: page.failed.append(str(error)))
        page.on("console", lambda line: line.type == "error" and page.failed.append(line.text))
        page.goto(file.as_uri())
        pages.append(page)
        return page

    yield open_
    for page in pages:
        assert page.failed == []
        assert len([url for url in page.asked if not url.startswith(("blob:", "data:"))]) == 1
        page.context.close()


@pytest.fixture(scope="module")
def page(browser, recording, tmp_path_factory):
    with offline(browser) as open_:
        page = open_(recording.save(tmp_path_factory.mktemp("page") / "tumble.html"))
        until(page, "window.cmcPlayback")
        yield page


def until(frame, expression, seconds=30.0):
    """Wait for an expression; Playwright's own waiting needs eval, which the page forbids."""
    deadline = time.monotonic() + seconds
    while not frame.evaluate(f"Boolean({expression})"):
        assert time.monotonic() < deadline, f"never true: {expression}"
        frame.wait_for_timeout(20)


def matrix(page, *path):
    return np.reshape(page.evaluate(MATRIX, ["meshcat", *path]), (4, 4)).T


def seek(page, seconds):
    page.evaluate("(t) => { cmcPlayback.setPlaying(false); cmcPlayback.seek(t); }", seconds)


def state(page):
    return page.evaluate("cmcPlayback.state()")


@pytest.mark.parametrize("frame", [0, 1, 13, 39])
def test_world_matrices_in_the_page_equal_mujoco_s(page, model, recording, frame):
    qpos, _, times = tumble(model)
    seek(page, times[frame] - times[0])
    data = at(model, qpos[frame])
    for body, name in enumerate(recording.bodies, start=1):
        world = matrix(page, name)
        np.testing.assert_allclose(world[:3, 3], data.xpos[body], atol=1e-5)
        np.testing.assert_allclose(world[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-5)
    paths = ["world", *recording.bodies]
    drawn = [g for g in range(model.ngeom) if model.geom(g).name not in ("hidden", "clear")]
    for geom in drawn:  # the axis of cylinders and capsules is y here, z in MuJoCo
        turned = model.geom(geom).name in ("post", "chest", "bone")
        world = matrix(page, paths[model.geom_bodyid[geom]], f"geom{geom}", "<object>")
        np.testing.assert_allclose(world[:3, 3], data.geom_xpos[geom], atol=1e-5)
        z_axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        z_axis = z_axis * np.linalg.norm(world[:3, 2])  # ellipsoids and spheres are scaled
        np.testing.assert_allclose(world[:3, 1 if turned else 2], z_axis, atol=1e-5)
        assert np.linalg.det(world[:3, :3]) > 0


def test_between_frames_the_motion_is_interpolated(page, recording):
    seek(page, 0.25 * 0.02)
    a, b = recording.poses[0, 0, :3], recording.poses[1, 0, :3]
    np.testing.assert_allclose(matrix(page, "torso")[:3, 3], 0.75 * a + 0.25 * b, atol=1e-6)
    rotation = matrix(page, "torso")[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)


def test_the_drawn_geometry_is_as_large_as_mujoco_s(page, model, recording):
    """Bounding boxes that three.js computes, for the shapes it builds itself."""
    box = """(path) => {
      const mesh = cmcPlayback.viewer.scene_tree.find(path).object;
      mesh.geometry.computeBoundingBox();
      const size = mesh.geometry.boundingBox.max.clone().sub(mesh.geometry.boundingBox.min);
      return size.multiply(mesh.scale).toArray();
    }"""
    for name in ("post", "chest", "belly", "head", "bone", "hand", "nail", "pad"):
        geom, paths = model.geom(name).id, ["world", *recording.bodies]
        path = ["meshcat", paths[model.geom_bodyid[geom]], f"geom{geom}", "<object>"]
        size = page.evaluate(box, path)
        if name in ("post", "chest", "bone"):  # their axis is y here, z in MuJoCo
            size = [size[0], size[2], size[1]]
        wanted = 2 * model.geom_aabb[geom, 3:] if name != "pad" else [0.4, 0.6, 0.0]
        np.testing.assert_allclose(size, wanted, rtol=5e-3, atol=1e-6)


def test_overlays_follow_the_time(page, recording):
    seek(page, 0.1)
    goal, force = page.evaluate(OVERLAY, "goal"), page.evaluate(OVERLAY, "force")
    assert goal["visible"]
    np.testing.assert_allclose(goal["position"], [0.2, 0.1, 0.5], atol=1e-6)
    assert not force["visible"]
    seek(page, 0.7)
    goal, force = page.evaluate(OVERLAY, "goal"), page.evaluate(OVERLAY, "force")
    assert not goal["visible"]
    assert force["visible"]
    np.testing.assert_allclose(force["quaternion"], [0, 0, 0, 1], atol=1e-6)  # +y is its axis
    assert page.inner_text(".readouts").split()[-1] == f"{recording.readouts['height [m]'][35]:.3g}"


def test_play_pause_keys_slider_and_speed(page):
    seek(page, 0)
    page.select_option("#speed", "0.25")
    assert state(page)["speed"] == 0.25
    page.evaluate("cmcPlayback.setSpeed(0.005)")  # it must not end meanwhile, on any machine
    page.click("#play")
    until(page, "cmcPlayback.state().time > 0")
    page.click("#play")
    assert not state(page)["playing"]
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    stopped = state(page)["time"]
    page.keyboard.press("ArrowLeft")
    assert stopped - state(page)["time"] == pytest.approx(0.02, abs=1e-9)
    page.fill("#time", "0.5")
    assert state(page)["time"] == pytest.approx(0.5)
    page.keyboard.press("Space")
    assert state(page)["playing"]
    page.select_option("#speed", "4")
    until(page, "!cmcPlayback.state().playing")  # it stops at the end
    assert state(page)["time"] == pytest.approx(0.78)


def test_camera_presets_change_the_view_and_follow(page, recording):
    seek(page, 0)
    where = "cmcPlayback.viewer.camera.position.toArray()"
    for index, (name, camera) in enumerate(recording.cameras.items()):
        page.get_by_role("button", name=name, exact=True).click()
        x, y, z = np.atleast_2d(camera.position)[0]
        np.testing.assert_allclose(page.evaluate(where), [x, z, -y], atol=1e-5)
        page.keyboard.press(str(index + 1))
    page.get_by_role("button", name="tip: follow", exact=True).click()
    before = np.array(page.evaluate(where))
    seek(page, 0.4)
    step = recording.overlays[0]["points"][20] - recording.overlays[0]["points"][0]
    moved = np.array(page.evaluate(where)) - before
    np.testing.assert_allclose(moved, [step[0], step[2], -step[1]], atol=1e-5)
    page.keyboard.press("1")


def picture(page):
    return imread(io.BytesIO(page.screenshot()))[:, :, :3]


def test_the_scene_is_drawn_and_moves(page):
    page.get_by_role("button", name="whole scene", exact=True).click()
    seek(page, 0)
    page.wait_for_timeout(300)
    first = picture(page)
    seek(page, 0.7)
    page.wait_for_timeout(300)
    second = picture(page)
    assert first.std() > 0.03  # not an empty canvas
    assert (np.abs(first - second).max(axis=2) > 0.1).mean() > 0.005
    assert first[5, -5].min() > 0.7  # a light background, even above a grey floor


def test_one_message_seeks_once_and_the_page_answers_none(browser, recording, tmp_path):
    """From the page around it, if it names the page's id.

    The viewer's bundle holds a worker that would answer each message to its own window.
    """
    (tmp_path / "notebook.html").write_text(recording.show(height=200)._repr_html_())
    page = browser.new_context(offline=True).new_page()
    page.goto((tmp_path / "notebook.html").as_uri())
    frame = page.frames[1]
    until(frame, "window.cmcPlayback")
    frame.evaluate("window.heard = 0; addEventListener('message', () => { heard += 1 })")
    send = "([id, t]) => frames[0].postMessage({ cmcPlayback: id, seek: t }, '*')"
    for k in range(1, 11):
        page.evaluate(send, [page_id([recording]), 0.05 * k])
    page.evaluate(send, ["another", 0.1])
    until(frame, "heard === 11")
    seen = set()
    for _ in range(10):
        page.wait_for_timeout(20)
        seen.add(frame.evaluate("cmcPlayback.state().time"))
    assert seen == {0.5}
    assert frame.evaluate("heard") == 11
    frame.evaluate("cmcPlayback.setSpeed(0.01); cmcPlayback.setPlaying(true)")
    until(frame, "cmcPlayback.state().time > 0.5")
    assert frame.evaluate("cmcPlayback.state().playing")
    page.context.close()


def test_live_view_moves_a_body_in_the_browser(browser, model):
    qpos, _, times = tumble(model, frames=1)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    with record(model, qpos, times).serve(timeout=60) as live:
        page = browser.new_context().new_page()
        page.goto(live.url)
        until(page, "window.cmcPlayback")
        data.qpos[0] = 0.375
        mujoco.mj_kinematics(model, data)
        live.update(data)
        until(
            page,
            "cmcPlayback.viewer.scene_tree.find(['meshcat', 'torso']).object.position.x === 0.375",
        )
        assert page.evaluate("cmcPlayback.viewer.scene_tree.find(['meshcat', 'torso', 'geom5',"
                             " '<object>']).object.isMesh")  # fmt: skip
        page.context.close()


def test_a_browser_without_webgl_says_so(browser, recording, tmp_path):
    path = recording.save(tmp_path / "scene.html")
    page = browser.new_context(offline=True).new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null;")
    page.goto(path.as_uri())
    assert "needs WebGL" in page.inner_text("#failure")
    page.context.close()
