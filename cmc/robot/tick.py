"""The control law and the tick of a world, compiled: the same code for one world and for many.

A world is a row of records (`ROW`): where MuJoCo keeps its arrays, where the tip is to go, and what
was last seen of it. The law is `cmc.robot.osc`'s. MuJoCo's C functions are called by name, which
numba can keep in its cache, and its arrays are read by address: whoever passes one keeps the object
behind it alive and states its size truly. All that is compiled into `tick` stands in this file, so
that the cache never misses a change.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numba
import numpy as np
from llvmlite import binding
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from cmc.robot.panda import JOINTS
from cmc.theory.arrays import Array, compiled

Record = NDArray[np.void]

_FOLDER = Path(mujoco.__file__).parent
_FOUND = [
    p for name in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll") for p in _FOLDER.glob(name)
]
if not _FOUND:
    raise ImportError(f"wanted MuJoCo's library in {_FOLDER}")
binding.load_library_permanently(str(min(_FOUND)))


def _c(name: str, arguments: str) -> Any:
    """MuJoCo's function of a name; arguments are addresses (p), integers (i) and numbers (n)."""
    kinds = {"p": types.intp, "i": types.int32, "n": types.float64}
    return types.ExternalFunction(name, types.void(*(kinds[kind] for kind in arguments)))


mj_step = _c("mj_step", "pp")
mj_step1 = _c("mj_step1", "pp")
mj_step2 = _c("mj_step2", "pp")
mj_jacSite = _c("mj_jacSite", "ppppi")
mj_jacDot = _c("mj_jacDot", "pppppi")
mj_mulM = _c("mj_mulM", "pppp")
mj_solveM = _c("mj_solveM", "ppppi")
mju_cholFactor = _c("mju_cholFactor", "pin")
mju_cholSolve = _c("mju_cholSolve", "pppi")
mju_mat2Quat = _c("mju_mat2Quat", "pp")
mju_subQuat = _c("mju_subQuat", "ppp")
mju_rotVecQuat = _c("mju_rotVecQuat", "ppp")
mju_mulQuat = _c("mju_mulQuat", "ppp")
mju_quat2Vel = _c("mju_quat2Vel", "ppn")


@intrinsic
def _pointer(context: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(signature.return_type)
        return builder.inttoptr(arguments[0], kind)

    return types.CPointer(types.float64)(types.intp), generate


@compiled
def _view(address: int, shape: int | tuple[int, ...]) -> Any:
    """The numbers at an address as an array of a shape."""
    return numba.carray(_pointer(address), shape)  # type: ignore[call-arg]


def _record(integers: str, numbers: dict[str, int]) -> np.dtype[Any]:
    """Record of integers (addresses, sizes, flags) and of vectors by size (0: one number)."""
    vectors = [(name, float, size) if size else (name, float) for name, size in numbers.items()]
    return np.dtype([(name, np.intp) for name in integers.split()] + vectors)


ROOM = 16
"""Joints of a scene that are observed, the first ones."""
#: One world: addresses of MuJoCo's arrays, where it is to go, and what was last observed of it.
#: `numbers`: distance to the goal, m; tilt, rad; contact force, and the largest of the tick, N;
#: deepest penetration, m; minus the distances to the sub-goal, m (or rad, of joints), and rad.
#: `flags`: terminated (never), truncated (the time is up), success.
ROW = _record(
    "data qpos qvel ctrl bias passive site_pos site_mat tip_pos hand_mat push forces distances",
    {"target": 3, "quat": 4, "target_joints": JOINTS, "goal": 3, "turn": 4, "nominal": 3}
    | {"tip": 3, "rotation": 3, "tip_velocity": 6, "signals": 12, "latent": 6, "integral": 6}
    | {"joints": ROOM, "joint_velocity": ROOM, "joint_error": JOINTS, "left": 0, "ticks": 0}
    | {"force": 3, "peaks": 2, "numbers": 7, "flags": 3},
)
#: What all worlds share: the model, gains and law, how a tick is made of physics steps, the length
#: of an episode in ticks, and what counts as success (see `cmc.envs.panda_task`).
LAW = _record(
    "model nv site body substeps hold joint acceleration split drift compliant",
    {"kp": 6, "kd": 6, "K1": 6, "K2": 6, "posture": JOINTS, "u_limit": JOINTS, "box": 3}
    | dict.fromkeys(("error_limit", "posture_stiffness", "posture_damping", "pivot_floor"), 0)
    | dict.fromkeys(("tick", "joint_stiffness", "ticks", "near"), 0),
)
_UP = np.array([0.0, -1.0, 0.0, 0.0])  # times it, a turn is told from pointing straight down


@compiled
def _times(matrix: Array, vector: Array, out: Array) -> None:
    for i in range(matrix.shape[0]):
        total = 0.0
        for j in range(matrix.shape[1]):
            total += matrix[i, j] * vector[j]
        out[i] = total


@compiled
def _times_transposed(a: Array, b: Array, out: Array) -> None:
    for i in range(6):
        _times(b, a[i], out[i])


@compiled
def _add_transposed(matrix: Array, vector: Array, out: Array) -> None:
    for i in range(6):
        out += vector[i] * matrix[i]


@compiled
def _solve(matrix: Array, right: Array, floor: float) -> None:
    """Solve in place with a positive matrix whose pivots are kept from zero; overwrites both."""
    mju_cholFactor(matrix.ctypes.data, len(right), floor)
    mju_cholSolve(right.ctypes.data, matrix.ctypes.data, right.ctypes.data, len(right))


@compiled
def _observe(w: Any, law: Any, jac: Array) -> None:
    """Pose, Jacobian (6, nv) of the driven joints and velocity of the site; the true tip."""
    mj_jacSite(law.model, w.data, jac.ctypes.data, jac[3:].ctypes.data, law.site)
    jac[:, JOINTS:] = 0.0  # sliders and the peg's mount have no motor
    qvel = _view(w.qvel, law.nv)
    w.nominal[:] = _view(w.site_pos, 3)
    mju_mat2Quat(w.turn.ctypes.data, w.site_mat)
    _times(jac, qvel, w.signals[6:])
    w.tip[:], w.tip_velocity[:] = w.nominal, w.signals[6:]
    if law.compliant:
        w.tip[:], axes = _view(w.tip_pos, 3), _view(w.hand_mat, (3, 3))
        for i in range(3):
            w.tip_velocity[i] += axes[i, 0] * qvel[JOINTS] + axes[i, 1] * qvel[JOINTS + 1]


@compiled
def _aim(w: Any, law: Any) -> None:
    """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame) and y."""
    error, local = w.signals[:6], np.empty(3)
    error[:3] = w.target - w.nominal
    mju_subQuat(local.ctypes.data, w.quat.ctypes.data, w.turn.ctypes.data)  # in the site's frame
    mju_rotVecQuat(error[3:].ctypes.data, local.ctypes.data, w.turn.ctypes.data)
    length = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    if length > law.error_limit:
        error[:3] *= law.error_limit / length
    w.latent[:] = law.K1 * error - law.K2 * w.signals[6:]  # mapping_pos, e' = -velocity


@compiled
def _torque(w: Any, law: Any, jac: Array, reference: Array, tau: Array) -> None:
    """Joint torques (nv,) that give the tip the acceleration `reference` (6,)."""
    nv = law.nv
    q, dq = _view(w.qpos, JOINTS), _view(w.qvel, nv)
    qn, r, undo = np.zeros(nv), reference.copy(), np.empty(6)
    qn[:JOINTS] = law.posture_stiffness * (law.posture - q) - law.posture_damping * dq[:JOINTS]
    _times(jac, qn, undo)  # what the posture would do to the tip
    if law.drift:
        rate, drift = np.empty((6, nv)), np.empty(6)
        point = w.nominal.ctypes.data
        mj_jacDot(law.model, w.data, rate.ctypes.data, rate[3:].ctypes.data, point, law.body)
        _times(rate[:, :JOINTS], dq, drift)
        r -= drift
    inverse = np.empty((6, 6))
    if law.acceleration:
        _times_transposed(jac, jac, inverse)
        r -= undo
        _solve(inverse, r, law.pivot_floor)
        _add_transposed(jac, r, qn)
        mj_mulM(law.model, w.data, tau.ctypes.data, qn.ctypes.data)  # tau_task_space_control
    else:
        solved = np.empty((6, nv))
        mj_mulM(law.model, w.data, tau.ctypes.data, qn.ctypes.data)
        mj_solveM(law.model, w.data, solved.ctypes.data, jac.ctypes.data, 6)
        _times_transposed(solved, jac, inverse)  # J M^-1 J^T
        if law.split:
            translation, rotation = inverse[:3, :3].copy(), inverse[3:, 3:].copy()
            _solve(translation, r[:3], law.pivot_floor)
            _solve(rotation, r[3:], law.pivot_floor)
            _solve(inverse, undo, law.pivot_floor)
            r -= undo
        else:
            r -= undo
            _solve(inverse, r, law.pivot_floor)
        _add_transposed(jac, r, tau)  # Nakanishi 3.3
    tau += _view(w.bias, nv)
    tau -= _view(w.passive, nv)  # joint damping is compensated


@compiled
def _command(w: Any, law: Any, jac: Array, u: Array, tau: Array) -> None:
    """Torques of the pose or of the joint controller for the state last observed."""
    if law.joint:
        gap = w.target_joints - _view(w.qpos, JOINTS)
        tau[:JOINTS] = law.joint_stiffness * gap + u + _view(w.bias, JOINTS)
    else:
        _aim(w, law)
        reference = law.kp * w.signals[:6] - law.kd * w.signals[6:] + u[:6]  # 2nd_sys
        _torque(w, law, jac, reference, tau)


@compiled
def _length(vector: Array) -> Any:
    return np.sqrt((vector * vector).sum())


@compiled
def _look(w: Any, law: Any, jac: Array) -> None:
    """Everything that is seen of a world whose derived quantities are current (`mj_step1`)."""
    _observe(w, law, jac)
    _aim(w, law)
    down, n, numbers = np.empty(4), min(law.nv, ROOM), w.numbers
    mju_mulQuat(down.ctypes.data, w.turn.ctypes.data, _UP.ctypes.data)
    mju_quat2Vel(w.rotation.ctypes.data, down.ctypes.data, 1.0)
    w.joints[:n], w.joint_velocity[:n] = _view(w.qpos, n), _view(w.qvel, n)
    w.joint_error[:] = w.target_joints - w.joints[:JOINTS]
    away = w.goal - w.tip
    numbers[0], numbers[1], numbers[2] = _length(away), _length(w.rotation), _length(w.force)
    numbers[3:5], numbers[6] = w.peaks, -_length(w.signals[3:6])
    numbers[5] = -_length(w.joint_error) if law.joint else -_length(w.target - w.tip)
    w.flags[1] = w.ticks >= law.ticks
    w.flags[2] = numbers[0] < law.near and (np.abs(away) < law.box).all()


@compiled
def refresh(rows: Record, laws: Record, jacs: Array) -> None:
    """Look at all worlds."""
    for k in range(len(rows)):
        _look(rows[k], laws[0], jacs[k])


@compiled
def tick(rows: Record, laws: Record, jacs: Array, actions: Array) -> bool:
    """One tick; False, and nothing done, without finite numbers.

    Actions (N, 6 or 7) are in units of `u_limit`, and clipped to [-1, 1].
    """
    law = laws[0]
    for value in actions.flat:
        if not np.isfinite(value):
            return False
    tau, u = np.zeros(law.nv), np.zeros(JOINTS)
    for k in range(len(rows)):
        w, jac = rows[k], jacs[k]
        for i in range(actions.shape[1]):
            u[i] = law.u_limit[i] * min(max(actions[k, i], -1.0), 1.0)
        if law.joint:
            # The low-level action may only add to the pull towards the sub-goal (appendix G).
            u[:] = np.abs(u) * np.sign(w.target_joints - _view(w.qpos, JOINTS))
        for step in range(law.substeps):
            if step and law.hold:
                mj_step(law.model, w.data)
                continue
            if step:
                mj_step1(law.model, w.data)
                _observe(w, law, jac)
            _command(w, law, jac, u, tau)
            _view(w.ctrl, JOINTS)[:] = tau[:JOINTS]
            mj_step2(law.model, w.data)
        mj_step1(law.model, w.data)
        _contact(w, law.substeps)
        w.left -= law.tick
        w.ticks += 1.0
        _look(w, law, jac)
        w.integral[:3] += law.tick * w.latent[:3]  # I_k = I_{k-1} + h y_k
    return True


@compiled
def _contact(w: Any, steps: int) -> None:
    """Force at the end of the tick; the largest and the deepest penetration of its steps."""
    w.force[:] = -_view(w.push, 3)  # the sensor: the peg's push
    forces, distances = _view(w.forces, (steps, 3)), _view(w.distances, steps)
    largest, nearest = 0.0, 0.0
    for i in range(steps):
        largest = max(largest, forces[i, 0] ** 2 + forces[i, 1] ** 2 + forces[i, 2] ** 2)
        nearest = min(nearest, distances[i])
    w.peaks[0], w.peaks[1] = np.sqrt(largest), -nearest
