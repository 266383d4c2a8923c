"""A scene that falls and turns, and what is drawn of a recording, for tests of the playback."""

import mujoco
import numpy as np
import umsgpack

from cmc.view.playback import record

SCENE = """<mujoco><asset><material name="blue" rgba=".2 .6 .9 1"/>
  <mesh name="tetrahedron" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset><worldbody>
  <geom name="floor" type="plane" size="0 0 .1"/>
  <geom name="pad" type="plane" size=".2 .3 .1" pos="0 0 .001"/>
  <geom name="post" type="cylinder" size=".02 .3" pos=".5 .2 .3"/>
  <geom name="hidden" type="sphere" size=".1" group="3"/>
  <geom name="clear" type="sphere" size=".1" rgba="1 1 1 0"/>
  <body name="torso" pos="0 0 .8"><freejoint/>
    <geom name="chest" type="capsule" size=".07" fromto="0 -.1 0 0 .1 0" material="blue"/>
    <geom name="belly" type="ellipsoid" size=".08 .05 .1" pos="0 0 -.15" rgba=".9 .6 .2 1"/>
    <body name="head/top" pos="0 0 .2"><joint axis="0 1 0"/>
      <geom name="head" type="sphere" size=".09" rgba=".9 .4 .4 .7"/></body>
    <body name="arm" pos="0 .2 0"><joint axis="1 0 0"/>
      <geom name="bone" type="cylinder" size=".04 .15" pos="0 .15 0" euler="90 0 0"/>
      <body pos="0 .3 0"><joint axis="0 0 1"/>
        <geom name="hand" type="box" size=".05 .04 .02" pos="0 .06 0" euler="10 20 30"/>
        <geom name="nail" type="mesh" mesh="tetrahedron" pos="0 .1 .05" euler="0 40 0"/>
        <site name="tip" pos="0 .1 0"/></body></body></body></worldbody></mujoco>"""


def load(xml):
    return mujoco.MjModel.from_xml_string(xml)


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


def tumbled(model, frames=40, seed=0, **more):
    qpos, _, times = tumble(model, frames, seed)
    return record(model, qpos, times, **more)


def at(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


def commands(made, kind):
    """Commands of one kind by the last part of their path below the scene."""
    found = [c for c in map(umsgpack.unpackb, made.commands) if c["type"] == kind]
    return {c["path"].removeprefix("/meshcat/"): c for c in found}


def still(xml):
    """Objects that are drawn of a model without motion, by `geom0` and so on."""
    model = load(xml)
    made = record(model, np.tile(model.qpos0, (1, 1)), [0.0])
    return {path.split("/")[-1]: c["object"] for path, c in commands(made, "set_object").items()}


def attribute(drawn, name):
    packed = drawn["geometries"][0]["data"]["attributes"][name]
    return np.frombuffer(packed["array"].data, np.float32).reshape(-1, packed["itemSize"])
