"""A mesh-free Franka Emika Panda that holds a peg: scenes, kinematics, inverse kinematics.

The arm is one MJCF file, `assets/scenes/panda.xml` (sources of every number are cited there); the
task scenes include it. `load_scene` fits the peg and compiles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.store import asset

Array = NDArray[np.float64]

JOINTS = 7
#: Modified Denavit-Hartenberg rows (a [m], d [m], alpha [rad]), one per joint.
DH = np.array(
    [
        (0.0, 0.333, 0.0),
        (0.0, 0.0, -np.pi / 2),
        (0.0, 0.316, np.pi / 2),
        (0.0825, 0.0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0.0, 0.0, np.pi / 2),
        (0.088, 0.0, np.pi / 2),
    ]
)
FLANGE = 0.107
"""Distance from joint 7's frame to the flange along its z axis, m."""
FINGERTIP = 0.1124
"""Distance from the flange to the ends of the fingers, where the peg's free length starts, m."""
READY = np.array([0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4])
"""Franka's ready pose, rad."""
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
TORQUE_LIMIT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
VELOCITY_LIMIT = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
DOWN = np.array([0.0, 1.0, 0.0, 0.0])
"""Orientation (w, x, y, z) of a hand that points straight down, its x axis along the world's."""


class SceneError(ValueError):
    """A scene file that is missing, does not parse, or lacks what the task needs."""


class UnreachableError(ValueError):
    """A pose that the arm cannot take within its joint limits."""


@dataclass(frozen=True)
class Peg:
    """The tool: a capsule whose end is the tip.

    Attributes:
        length: free length below the fingers, m.
        radius: m.
        stiffness: of the two lateral springs of the mount, N/m; 0 means a rigid mount.
        damping: of the same springs, N s/m.
        mass: kg; part of the hand's load when the mount is rigid.
    """

    length: float = 0.05
    radius: float = 0.0008
    stiffness: float = 0.0
    damping: float = 8.0
    mass: float = 0.03

    def __post_init__(self) -> None:
        for name in ("length", "radius", "mass"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"peg {name} must be positive, got {getattr(self, name)}")
        for name in ("stiffness", "damping"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"peg {name} must be at least 0, got {getattr(self, name)}")
        if self.length <= 2 * self.radius:
            raise ValueError(f"a peg of radius {self.radius} m must be longer than {self.length} m")


def load_scene(
    scene: str | Path = "panda.xml",
    peg: Peg | None = None,
    timestep: float = 0.002,
    history: int = 0,
) -> mujoco.MjModel:
    """Compile a scene with the Panda and its peg.

    Args:
        scene: name of a shipped scene or path of an MJCF file that includes `panda.xml`.
        peg: the tool; a rigid 50 mm peg by default.
        timestep: physics step, s.
        history: number of physics steps the contact sensors remember in `data.history`.

    Raises:
        SceneError: if the file is missing, does not parse, or holds no peg.
        ValueError: if `timestep` is not in (0, 5 ms]: contact needs two steps in 10 ms.
    """
    spec = scene_spec(scene, peg, timestep)
    for sensor in spec.sensors:
        sensor.nsample = history
    try:
        return spec.compile()
    except ValueError as error:
        raise SceneError(f"scene {scene} does not compile: {error}") from error


def scene_spec(
    scene: str | Path = "panda.xml", peg: Peg | None = None, timestep: float = 0.002
) -> mujoco.MjSpec:
    """The same scene before it is compiled, for what needs its MJCF text; see `load_scene`."""
    if not 0 < timestep <= 0.005:
        raise ValueError(f"the physics step must be in (0, 0.005] s, got {timestep}")
    spec = _read(scene)
    _fit(spec, peg or Peg(), scene)
    spec.option.timestep = timestep
    return spec


def _read(scene: str | Path) -> mujoco.MjSpec:
    path = Path(scene)
    if not path.is_file():
        try:
            path = asset("scenes", str(scene))
        except FileNotFoundError as error:
            raise SceneError(f"no scene {scene}: neither a file nor a shipped scene") from error
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise SceneError(f"scene {path} does not parse: {error}") from error


def _fit(spec: mujoco.MjSpec, peg: Peg, scene: str | Path) -> None:
    """Give the peg its length, radius and mass, and a rigid or a compliant mount."""
    body, geom = spec.body("peg"), spec.geom("peg")
    tips = [spec.site(name) for name in ("tip", "tip_nominal")]
    joints = [spec.joint(name) for name in ("peg_x", "peg_y")]
    if body is None or geom is None or None in tips or None in joints:
        raise SceneError(f"scene {scene} holds no peg: it must include panda.xml")
    geom.fromto = [0, 0, -0.010, 0, 0, peg.length - peg.radius]
    geom.size = [peg.radius, 0, 0]
    tips[0].pos = [0, 0, peg.length]
    tips[1].pos = [0, 0, FINGERTIP + peg.length]
    body.mass = peg.mass
    body.ipos = [0, 0, peg.length / 2]
    slender = peg.mass * peg.length**2 / 12
    body.inertia = [slender, slender, peg.mass * peg.radius**2 / 2]
    for joint in joints:
        if peg.stiffness == 0:
            spec.delete(joint)
        else:
            joint.stiffness = np.array([peg.stiffness, 0, 0])
            joint.damping = np.array([peg.damping, 0, 0])


def forward_kinematics(q: ArrayLike, tool: float = 0.0) -> tuple[Array, Array]:
    """Pose of the hand, or of a point `tool` metres down its z axis, from the DH table.

    T_i = Rot_x(alpha_i) Trans_x(a_i) Rot_z(q_i) Trans_z(d_i), then the flange and -45 degrees.

    Args:
        q: joint angles (..., 7), rad.
        tool: distance from the flange along the hand's z axis, m.

    Returns:
        Position (..., 3) in m and rotation matrix (..., 3, 3).
    """
    q = np.asarray(q, dtype=float)
    if q.shape[-1:] != (JOINTS,):
        raise ValueError(f"wanted joint angles of shape (..., {JOINTS}), got {q.shape}")
    position = np.zeros((*q.shape[:-1], 3))
    rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
    turn = np.concatenate([q, np.full((*q.shape[:-1], 1), -np.pi / 4)], axis=-1)
    rows = np.vstack([DH, (0.0, FLANGE, 0.0)])
    for i, (a, d, alpha) in enumerate(rows):
        c, s, ca, sa = np.cos(turn[..., i]), np.sin(turn[..., i]), np.cos(alpha), np.sin(alpha)
        step = np.stack([np.full_like(c, a), np.full_like(c, -sa * d), np.full_like(c, ca * d)], -1)
        position = position + np.einsum("...ij,...j->...i", rotation, step)
        zero = np.zeros_like(c)
        link = np.stack([c, -s, zero, s * ca, c * ca, zero - sa, s * sa, c * sa, zero + ca], -1)
        rotation = rotation @ link.reshape(*c.shape, 3, 3)
    return position + tool * rotation[..., :, 2], rotation


def inverse_kinematics(
    position: ArrayLike,
    quat: ArrayLike = DOWN,
    tool: float = FINGERTIP + 0.05,
    q0: ArrayLike = READY,
    tolerance: float = 1e-10,
) -> Array:
    """Joint angles that put the tool tip at a pose, by damped least squares from `q0`.

    Args:
        position: of the tip, (3,), m.
        quat: orientation (w, x, y, z), (4,).
        tool: distance from the flange to the tip along the hand's z axis, m.
        q0: first guess, (7,), rad; it also decides the posture.
        tolerance: on the pose error, m and rad.

    Raises:
        UnreachableError: if no joint angles within the limits are found.
        ValueError: on wrong shapes or values that are not finite.
    """
    target, orientation = np.asarray(position, float), np.asarray(quat, float)
    if target.shape != (3,) or orientation.shape != (4,):
        raise ValueError(f"wanted (3,) and (4,), got {target.shape} and {orientation.shape}")
    if not (np.isfinite(target).all() and np.linalg.norm(orientation) > 0):
        raise ValueError(f"wanted a finite pose, got {target} and {orientation}")
    orientation = orientation / np.linalg.norm(orientation)
    model = _bare_arm()
    data, hand = mujoco.MjData(model), model.body("hand").id
    jac, error, offset = np.zeros((6, model.nv)), np.zeros(6), np.array([0.0, 0.0, tool])
    q = np.clip(np.asarray(q0, float), LOWER, UPPER)
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
    raise UnreachableError(
        f"no joint angles within the limits put the tip at {np.round(target, 4)} m: "
        f"{np.linalg.norm(error[:3]):.3g} m and {np.linalg.norm(error[3:]):.3g} rad are left"
    )


@cache
def _bare_arm() -> mujoco.MjModel:
    return load_scene()


def _rotation_between(start: Array, end: Array) -> Array:
    """Rotation vector in the world frame that turns `start` into `end`, (3,)."""
    conjugate, difference, vector = np.empty(4), np.empty(4), np.empty(3)
    mujoco.mju_negQuat(conjugate, start)
    mujoco.mju_mulQuat(difference, end, conjugate)
    mujoco.mju_quat2Vel(vector, difference, 1.0)
    return vector
