"""Models of others in the real page: what changes shape, cameras, textures, twins, two scenes."""

import itertools

import mujoco
import numpy as np
import pytest
from test_browser_playback import matrix, offline, picture, until
from test_view_playback import at, attribute, commands, load

from cmc.view.playback import beside, record

pytestmark = pytest.mark.browser

CORNERS = """(name) => {
  const found = cmcPlayback.viewer.scene.getObjectByName("overlay " + name);
  return Array.from(found.geometry.attributes.position.array);
}"""
CAMERA = """() => {
  const camera = cmcPlayback.viewer.camera;
  cmcPlayback.viewer.render();
  camera.updateMatrixWorld(true);
  return { matrix: camera.matrixWorld.toArray(), fov: camera.fov };
}"""
Z_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # the model's axes in three.js's

CLOTH = """<mujoco><option timestep=".002" solver="CG"/><worldbody>
  <geom type="cylinder" size=".05 .4" pos="0 0 .4"/>
  <flexcomp name="cloth" type="grid" count="6 6 1" spacing=".12 .12 .12" pos="0 0 1" radius=".01"
    dim="2" mass=".2" rgba=".8 .2 .4 1"><edge equality="true"/></flexcomp></worldbody></mujoco>"""
TWINS = """<mujoco><worldbody>
  <body name="body2" pos="0 0 1"><joint type="slide" axis="1 0 0"/><geom size=".1"/></body>
  <body pos="0 1 1"><joint type="slide" axis="0 1 0"/><geom size=".1"/></body>
  <body name="arm/tip" pos="0 2 1"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>
  <body name="arm|tip" pos="0 3 1"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body>
  </worldbody></mujoco>"""
RUNNER = """<mujoco><asset>
  <texture name="squares" type="2d" builtin="checker" rgb1=".8 .8 .8" rgb2=".3 .3 .3"
    width="64" height="64"/>
  <texture name="dice" type="cube" builtin="gradient" rgb1="1 0 0" rgb2="0 0 1" width="8"/>
  <material name="squares" texture="squares" texrepeat="20 20" texuniform="true"/>
  <material name="dice" texture="dice"/></asset>
  <worldbody><geom name="floor" type="plane" size="0 0 .1" material="squares"/>
  <geom name="box" type="box" size=".1 .1 .1" pos="0 1 .1" material="dice"/>
  <body name="runner" pos="0 0 .3">
    <camera name="track" mode="trackcom" pos="0 -3 .5" xyaxes="1 .2 0 -.04 .2 1" fovy="50"/>
    <joint type="slide" axis="1 0 0"/>
    <geom type="capsule" size=".1" fromto="-.2 0 0 .2 0 0"/>
    <body name="mast" pos=".1 0 .1"><joint axis="0 1 0"/><geom size=".05 .1" type="cylinder"/>
      <camera name="rider" pos="0 0 .3" euler="60 20 10"/></body></body>
  </worldbody></mujoco>"""
STRING = """<mujoco><worldbody><site name="hook" pos="0 0 1"/>
  <geom name="pulley" type="cylinder" size=".1 .05" pos=".2 0 .6" euler="90 0 0"/>
  <site name="beside" pos=".4 0 .6"/>
  <body name="ball"><joint type="slide" axis="0 0 1"/><geom size=".05"/><site name="eye"/></body>
  </worldbody><tendon><spatial name="string" width=".01" rgba="1 0 0 1"><site site="hook"/>
  <geom geom="pulley" sidesite="beside"/><site site="eye"/></spatial></tendon></mujoco>"""
WORM = """<mujoco><asset><mesh name="tetra" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
  <texture name="squares" type="2d" builtin="checker" rgb1="1 0 0" width="16" height="16"/>
  <material name="squares" texture="squares" rgba=".5 1 1 1"/></asset>
  <worldbody><body name="a"><joint axis="0 0 1"/><geom size=".02" group="4"/>
  <body name="b" pos=".3 0 0"><joint axis="0 1 0"/><geom size=".02" group="4"/></body></body>
  </worldbody><deformable><skin name="s" vertex="0 0 0 .3 0 0 .3 .1 0 .6 0 0" face="0 1 2 1 3 2"
  material="squares" texcoord="0 0 .5 0 .5 1 1 .25">
  <bone body="a" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 .5 .3"/>
  <bone body="b" bindpos=".3 0 0" bindquat="1 0 0 0" vertid="1 2 3" vertweight=".5 .7 1"/>
  </skin></deformable></mujoco>"""


@pytest.fixture
def opened(browser, tmp_path):
    """Save what plays and open it."""
    with offline(browser, 400, 300) as open_:

        def save_and_open(made):
            page = open_(made.save(tmp_path / "page.html"))
            until(page, "window.cmcPlayback")
            return page

        yield save_and_open


def corners(page, name):
    return np.reshape(page.evaluate(CORNERS, name), (-1, 3))


def test_a_cloth_is_drawn_and_falls(opened):
    model = load(CLOTH)
    data, states, full = mujoco.MjData(model), [], mujoco.mjtState.mjSTATE_FULLPHYSICS
    places = []
    for _ in range(3):
        states.append(np.empty(mujoco.mj_stateSize(model, full)))
        mujoco.mj_getState(model, data, states[-1], full)
        mujoco.mj_forward(model, data)
        places.append(data.flexvert_xpos.copy())
        mujoco.mj_step(model, data, 50)
    page = opened(record(model, states, [0.0, 0.1, 0.2]))
    for t, place in zip((0.0, 0.1, 0.2), places, strict=True):
        page.evaluate(f"cmcPlayback.seek({t})")
        np.testing.assert_allclose(corners(page, "flex 0"), place, atol=2e-5)
    assert places[2][:, 2].min() < 0.95


def test_a_skin_goes_along_with_its_bones_as_mujoco_s_does(opened):
    model = load(WORM)
    made = record(model, np.array([[0.0, 0.0], [0.7, -0.9]]), [0.0, 1.0])
    page = opened(made)
    data, seen = at(model, [0.7, -0.9]), mujoco.MjvScene(model, 100)
    option, eye = mujoco.MjvOption(), mujoco.MjvCamera()
    option.flags[mujoco.mjtVisFlag.mjVIS_SKIN] = 1
    mujoco.mjv_updateScene(model, data, option, None, eye, mujoco.mjtCatBit.mjCAT_ALL, seen)
    page.evaluate("cmcPlayback.seek(1)")
    wanted = np.reshape(seen.skinvert, (-1, 3))[: model.nskinvert]
    np.testing.assert_allclose(corners(page, "skin 0"), wanted, atol=1e-5)
    assert np.ptp(wanted[:, 2]) > 0.1
    skin = "cmcPlayback.viewer.scene.getObjectByName('overlay skin 0')"
    until(page, f"{skin}.material.map?.image?.width === 16")
    assert page.evaluate(f"{skin}.material.color.toArray()") == pytest.approx([0.5, 1, 1], abs=0.01)
    given = page.evaluate(f"Array.from({skin}.geometry.attributes.uv.array)")
    assert given == [0, 0, 0.5, 0, 0.5, 1, 1, 0.25]


def test_a_string_runs_over_its_pulley(opened):
    model = load(STRING)
    data = at(model, [0.3])
    path = data.wrap_xpos.reshape(-1, 3)[: data.ten_wrapnum[0]]
    assert len(path) == 4  # hook, where it meets and leaves the pulley, eye
    page = opened(record(model, np.array([[0.0], [0.3]]), [0.0, 1.0]))
    page.evaluate("cmcPlayback.seek(1)")
    tubes = corners(page, "tendon 0").reshape(-1, 2, 6, 3).mean(axis=2)
    np.testing.assert_allclose(tubes[:3, 0], path[:-1], atol=1e-4)
    np.testing.assert_allclose(tubes[:3, 1], path[1:], atol=1e-4)


def test_twin_names_stay_four_bodies_and_labels_stand_beside_them(opened):
    model, labels = load(TWINS), {"ball": "body2", "here": [1, 2, 3]}
    qpos = np.array([[0.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3, 0.4]])
    made = record(model, qpos, [0.0, 1.0], labels=labels)
    assert len(set(made.bodies)) == 4
    page = opened(made)
    page.evaluate("cmcPlayback.seek(1)")
    data = at(model, qpos[1])
    for body, name in enumerate(made.bodies, start=1):
        np.testing.assert_allclose(matrix(page, name)[:3, 3], data.xpos[body], atol=1e-6)
    place = "cmcPlayback.viewer.scene.getObjectByName('overlay {}').position.toArray()"
    np.testing.assert_allclose(page.evaluate(place.format("ball")), data.xpos[1], atol=1e-6)
    assert page.evaluate(place.format("here")) == [1, 2, 3]


def test_cameras_and_textures_of_a_runner(opened):
    """With the first preset it stays near the middle over ten metres.

    The model's own cameras have MuJoCo's position, direction, roll and field of view meanwhile.
    """
    model = load(RUNNER)
    qpos = np.stack([np.linspace(0, 10, 21), np.linspace(0, 1, 21)], axis=1)
    made = record(model, qpos, np.linspace(0, 2, 21))
    page = opened(made)
    for t in (0, 1.03, 2):
        page.evaluate(f"cmcPlayback.seek({t})")
        page.evaluate(CAMERA)
        seen = page.evaluate(
            """() => {
              const { viewer } = cmcPlayback;
              viewer.scene.updateMatrixWorld(true);
              const body = viewer.scene_tree.find(["meshcat", "runner"]).object;
              const place = new MeshCat.THREE.Vector3().setFromMatrixPosition(body.matrixWorld);
              return place.project(viewer.camera).toArray();
            }"""
        )
        assert np.abs(seen[:2]).max() < 0.5
    for name, frame in itertools.product(("track", "rider"), (0, 7, 20)):
        page.evaluate(f"cmcPlayback.look({list(made.cameras).index(name)})")
        page.evaluate(f"cmcPlayback.seek({made.times[frame]})")
        seen = page.evaluate(CAMERA)
        data, camera = at(model, qpos[frame]), model.camera(name).id
        world = np.reshape(seen["matrix"], (4, 4)).T
        np.testing.assert_allclose(world[:3, 3], Z_UP @ data.cam_xpos[camera], atol=1e-4)
        turned = Z_UP @ data.cam_xmat[camera].reshape(3, 3)
        np.testing.assert_allclose(world[:3, :3], turned, atol=1e-3)
        assert seen["fov"] == model.cam_fovy[camera]
    page.evaluate("cmcPlayback.look(0); cmcPlayback.seek(0)")
    for name in ("floor", "box"):
        path = ["meshcat", "world", f"geom{model.geom(name).id}", "<object>"]
        found = "cmcPlayback.viewer.scene_tree.find(" + str(path) + ").object"
        until(page, f"{found}.material.map?.image?.width > 4")
        assert page.evaluate(f"{found}.geometry.attributes.uv.count") in (4, 24)
    page.wait_for_timeout(100)
    assert picture(page)[150:].std() > 0.1  # the floor is no plain surface


def test_a_mesh_used_often_is_stored_and_held_once(opened):
    def model(count):
        geoms = "".join(f'<geom type="mesh" mesh="m" pos="{k} 0 0"/>' for k in range(count))
        rng = np.random.default_rng(0)
        points = " ".join(f"{x:.3f}" for x in rng.normal(size=900))
        asset = f'<asset><mesh name="m" vertex="{points}"/></asset>'
        return load(f"<mujoco>{asset}<worldbody>{geoms}</worldbody></mujoco>")

    made = record(model(30), np.zeros((1, 0)), [0.0])
    one = record(model(1), np.zeros((1, 0)), [0.0])
    each = (len(made.html()) - len(one.html())) / 29
    assert each < 1500
    page = opened(made)
    held = page.evaluate(
        """() => {
          const shapes = new Set(), seen = cmcPlayback.viewer.scene_tree.find(["meshcat"]).object;
          let corners = 0;
          seen.traverse((o) => { if (o.isMesh) {
            shapes.add(o.geometry); corners += o.geometry.attributes.position.count; } });
          return [shapes.size, corners];
        }"""
    )
    (mesh,) = (c["object"] for c in commands(one, "set_object").values())
    assert held == [1, 30 * len(attribute(mesh, "position"))]


def test_a_texture_used_often_is_stored_and_held_once(opened):
    def made(count):
        geoms = "".join(
            f'<geom type="box" size=".1 .1 .1" pos="{k} 0 0" material="m"/>' for k in range(count)
        )
        asset = """<texture name="t" type="2d" builtin="flat" random=".5" mark="random" width="256"
          height="256" rgb1="1 0 0"/><material name="m" texture="t"/>"""
        xml = f"<mujoco><asset>{asset}</asset><worldbody>{geoms}</worldbody></mujoco>"
        return record(load(xml), np.zeros((1, 0)), [0.0])

    (first,) = (c["object"] for c in commands(made(1), "set_object").values())
    each = (len(made(9).html()) - len(made(1).html())) / 8
    assert each < 5000 < len(first["images"][0]["url"]) / 2
    page = opened(made(9))
    widths = """() => {
      const maps = new Set(), seen = cmcPlayback.viewer.scene_tree.find(["meshcat"]).object;
      seen.traverse((o) => { if (o.isMesh) maps.add(o.material.map); });
      return Array.from(maps).map((map) => map.image?.width);
    }"""
    until(page, f"({widths})()[0]")
    assert page.evaluate(widths) == [256]


def test_two_scenes_play_side_by_side_under_one_slider(opened):
    model = load(TWINS)
    times = np.array([0.0, 1.0])
    calm = record(model, np.zeros((2, 4)) + [[0.0], [0.1]], times, title="calm")
    far = record(model, np.zeros((2, 4)) + [[0.0], [0.9]], times * 2, title="far")
    page = opened(beside(calm, far))
    assert page.locator("canvas").count() == 2
    assert page.locator("input[type=range]:visible").count() == 1
    assert page.locator("h1").all_inner_texts() == ["calm", "far"]
    page.fill("#time", "2")
    body = "viewer.scene_tree.find(['meshcat', 'body2']).object"
    where = [page.evaluate(f"cmcPlayback.stages[{k}].{body}.position.x") for k in (0, 1)]
    assert where == pytest.approx([0.1, 0.9])  # the shorter one stays at its end
    with pytest.raises(ValueError, match="at least one"):
        beside()
