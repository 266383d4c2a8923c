"""A mesh-free Franka Emika Panda that holds a peg: scenes and inverse kinematics.

The arm is one MJCF file, `assets/scenes/panda.xml` (sources of every number are cited there); the
task scenes include it. `load_scene` fits the peg and compiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from cmc.store import asset
from cmc.theory.arrays import Array, checked, number

JOINTS = 7
#: Modified Denavit-Hartenberg rows (a [m], d [m], alpha [rad]), one per joint.
DH = np.array(
    [(0, 0.333, 0), (0, 0, -np.pi / 2), (0, 0.316, np.pi / 2), (0.0825, 0, np.pi / 2)]
    + [(-0.0825, 0.384, -np.pi / 2), (0, 0, np.pi / 2), (0.088, 0, np.pi / 2)]
)
FLANGE = 0.107
"""Distance from joint 7's frame to the flange along its z axis, m."""
FINGERTIP = 0.1124
"""Distance from the flange to the ends of the fingers, where the peg's free length starts, m."""
READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
"""Franka's ready pose, rad."""
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
DOWN = np.array([0.0, 1.0, 0.0, 0.0])
"""Orientation (w, x, y, z) of a hand that points straight down, its x axis along the world's."""


@dataclass(frozen=True)
class Peg:
    """The tool: a capsule whose end is the tip."""

    length: float = 0.05  # free length below the fingers, m
    radius: float = 0.0008  # m
    stiffness: float = 0.0  # of the two lateral springs of the mount, N/m; 0 is a rigid mount
    damping: float = 8.0  # of the same springs, N s/m
    mass: float = 0.03  # kg; part of the hand's load when the mount is rigid

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            spring = name in ("stiffness", "damping")
            number(f"peg {name}", value, **({"least": 0.0} if spring else {"above": 0.0}))
        if self.length <= 2 * self.radius:
            raise ValueError(f"a peg of radius {self.radius} m must be longer than {self.length} m")


def load_scene(
    scene: str | Path = "panda.xml",
    peg: Peg | None = None,
    timestep: float = 0.002,
    history: int = 0,
) -> mujoco.MjModel:
    """Compile a scene with the Panda and its peg, by default a rigid one of 50 mm.

    The scene is the name of a shipped one or the path of an MJCF file that includes `panda.xml`.
    The contact sensors remember `history` physics steps in `data.history`.

    Raises:
        ValueError: if the file is missing, does not parse, or holds no peg, and if the physics step
            `timestep` is not in (0, 5 ms]: contact needs two steps in 10 ms.
    """
    spec, steps = scene_spec(scene, peg, timestep), number("history", history, least=0.0)
    if steps % 1:
        raise ValueError(f"history: wanted a whole number of steps, got {history}")
    for sensor in spec.sensors:
        sensor.nsample = int(steps)
    try:
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"scene {scene} does not compile: {error}") from error


def scene_spec(
    scene: str | Path = "panda.xml", peg: Peg | None = None, timestep: float = 0.002
) -> mujoco.MjSpec:
    """The same scene before it is compiled, for what needs its MJCF text; see `load_scene`."""
    if number("timestep", timestep, above=0.0) > 0.005:
        raise ValueError(f"timestep: the physics step must be in (0, 0.005] s, got {timestep}")
    if not isinstance(scene, str | Path) or not isinstance(peg, Peg | None):
        raise TypeError(f"scene and peg: wanted a name and a Peg, got {scene!r} and {peg!r}")
    try:
        path = Path(scene) if Path(scene).is_file() else asset("scenes", str(scene))
        spec = mujoco.MjSpec.from_file(str(path))
    except FileNotFoundError as error:
        raise ValueError(f"no scene {scene}: neither a file nor a shipped scene") from error
    except ValueError as error:
        raise ValueError(f"scene {path} does not parse: {error}") from error
    _fit(spec, peg or Peg(), scene)
    spec.option.timestep = timestep
    return spec


def _fit(spec: mujoco.MjSpec, peg: Peg, scene: str | Path) -> None:
    """Give the peg its length, radius and mass, and a rigid or a compliant mount."""
    body, geom = spec.body("peg"), spec.geom("peg")
    tips = [spec.site(name) for name in ("tip", "tip_nominal")]
    joints = [spec.joint(name) for name in ("peg_x", "peg_y")]
    if body is None or geom is None or None in tips or None in joints:
        raise ValueError(f"scene {scene} holds no peg: it must include panda.xml")
    geom.fromto = [0, 0, -0.010, 0, 0, peg.length - peg.radius]
    geom.size = [peg.radius, 0, 0]
    tips[0].pos, tips[1].pos = [0, 0, peg.length], [0, 0, FINGERTIP + peg.length]
    body.mass, body.ipos = peg.mass, [0, 0, peg.length / 2]
    slender = peg.mass * peg.length**2 / 12
    body.inertia = [slender, slender, peg.mass * peg.radius**2 / 2]
    for joint in joints:
        if peg.stiffness == 0:
            spec.delete(joint)
        else:
            joint.stiffness = np.array([peg.stiffness, 0, 0])
            joint.damping = np.array([peg.damping, 0, 0])


def inverse_kinematics(
    position: ArrayLike,
    quat: ArrayLike = DOWN,
    tool: float = FINGERTIP + 0.05,
    q0: ArrayLike = READY,
    tolerance: float = 1e-10,
) -> Array:
    """Joint angles (7,), rad, that put the tool tip at a pose, by damped least squares from `q0`.

    The pose is a position (3,), m, and an orientation (w, x, y, z); the tool reaches `tool` metres
    from the flange down the hand's z axis. `q0` also decides the posture; the `tolerance` is on the
    error of the pose, m and rad.
    A ValueError if no joint angles within the limits are found.
    """
    target, orientation = checked("position", position, "3"), checked("quat", quat, "4")
    orientation = orientation / number("length of quat", np.linalg.norm(orientation), above=0.0)
    tolerance = number("tolerance", tolerance, above=0.0)
    model = _bare_arm()
    data, hand = mujoco.MjData(model), model.body("hand").id
    jac, error = np.zeros((6, model.nv)), np.zeros(6)
    offset = np.array([0.0, 0.0, number("tool", tool)])
    q = np.clip(checked("q0", q0, "7"), LOWER, UPPER)
    for _ in range(100):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        tip = data.xpos[hand] + data.xmat[hand].reshape(3, 3) @ offset
        error[:3] = target - tip
        error[3:] = _rotation_between(data.xquat[hand], orientation)
        if np.abs(error).max() < tolerance:
            return q
        mujoco.mj_jac(model, data, jac[:3], jac[3:], tip, hand)
        step = jac.T @ np.linalg.solve(jac @ jac.T + 1e-9 * np.eye(6), error)
        q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), LOWER, UPPER)
    raise ValueError(
        f"no joint angles within the limits put the tip at {np.round(target, 4)} m: "
        f"{np.linalg.norm(error[:3]):.3g} m and {np.linalg.norm(error[3:]):.3g} rad are left"
    )


_bare_arm = cache(load_scene)


def _rotation_between(start: Array, end: Array) -> Array:
    """Rotation vector in the world frame that turns `start` into `end`, (3,)."""
    conjugate, difference, vector = np.empty(4), np.empty(4), np.empty(3)
    mujoco.mju_negQuat(conjugate, start)
    mujoco.mju_mulQuat(difference, end, conjugate)
    mujoco.mju_quat2Vel(vector, difference, 1.0)
    return vector
