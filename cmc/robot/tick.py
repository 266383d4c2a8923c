"""The control law and the tick of a world, compiled: the same code for one world and for many.

A world is a row of records (`ROW`): where MuJoCo keeps its arrays, where the tip is to go, and what
was last seen of it. The law is `cmc.robot.osc`'s. All that is compiled into `tick` stands in this
file, so that the cache of compiled code never misses a change.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.robot import compiled as mj
from cmc.robot.compiled import compiled, view
from cmc.robot.panda import JOINTS

Array = NDArray[np.float64]
Record = NDArray[np.void]


def _record(integers: str, numbers: dict[str, int]) -> np.dtype[Any]:
    """Record of integers (addresses, sizes, flags) and of vectors by size (0: one number)."""
    vectors = [(name, float, size) if size else (name, float) for name, size in numbers.items()]
    return np.dtype([(name, np.intp) for name in integers.split()] + vectors)


#: One world: addresses of MuJoCo's arrays, where it is to go, and what was last observed of it.
ROW = _record(
    "data qpos qvel ctrl bias passive site_pos site_mat tip_pos hand_mat push forces distances",
    {"target": 3, "quat": 4, "target_joints": JOINTS, "turn": 4, "nominal": 3}
    | {"tip": 3, "rotation": 3, "tip_velocity": 6, "signals": 12, "latent": 6, "integral": 6}
    | {"force": 3, "peaks": 2},
)
#: What all worlds share: the model, gains and law, and how a tick is made of physics steps.
LAW = _record(
    "model nv site body substeps hold joint acceleration split drift compliant",
    {"kp": 6, "kd": 6, "K1": 6, "K2": 6, "posture": JOINTS, "u_limit": JOINTS}
    | dict.fromkeys(("error_limit", "posture_stiffness", "posture_damping", "pivot_floor"), 0)
    | dict.fromkeys(("tick", "joint_stiffness"), 0),
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
    mj.cholFactor(matrix.ctypes.data, len(right), floor)
    mj.cholSolve(right.ctypes.data, matrix.ctypes.data, right.ctypes.data, len(right))


@compiled
def _observe(w: Any, law: Any, jac: Array) -> None:
    """Pose, Jacobian (6, nv) of the driven joints and velocity of the site; the true tip."""
    mj.jacSite(law.model, w.data, jac.ctypes.data, jac[3:].ctypes.data, law.site)
    jac[:, JOINTS:] = 0.0  # sliders and the peg's mount have no motor
    qvel = view(w.qvel, law.nv)
    w.nominal[:] = view(w.site_pos, 3)
    mj.mat2Quat(w.turn.ctypes.data, w.site_mat)
    _times(jac, qvel, w.signals[6:])
    w.tip[:], w.tip_velocity[:] = w.nominal, w.signals[6:]
    if law.compliant:
        w.tip[:], axes = view(w.tip_pos, 3), view(w.hand_mat, (3, 3))
        for i in range(3):
            slide = axes[i, 0] * qvel[JOINTS] + axes[i, 1] * qvel[JOINTS + 1]
            w.tip_velocity[i] += slide


@compiled
def _aim(w: Any, law: Any) -> None:
    """Pose error e = (x_d - x, rotation vector from x to x_d in the world frame) and y."""
    error, local = w.signals[:6], np.empty(3)
    error[:3] = w.target - w.nominal
    mj.subQuat(local.ctypes.data, w.quat.ctypes.data, w.turn.ctypes.data)  # in the site's frame
    mj.rotVecQuat(error[3:].ctypes.data, local.ctypes.data, w.turn.ctypes.data)
    length = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    if length > law.error_limit:
        error[:3] *= law.error_limit / length
    w.latent[:] = law.K1 * error - law.K2 * w.signals[6:]  # mapping_pos, e' = -velocity


@compiled
def _torque(w: Any, law: Any, jac: Array, reference: Array, tau: Array) -> None:
    """Joint torques (nv,) that give the tip the acceleration `reference` (6,)."""
    nv = law.nv
    q, dq = view(w.qpos, JOINTS), view(w.qvel, nv)
    qn, r, undo = np.zeros(nv), reference.copy(), np.empty(6)
    qn[:JOINTS] = law.posture_stiffness * (law.posture - q) - law.posture_damping * dq[:JOINTS]
    _times(jac, qn, undo)  # what the posture would do to the tip
    if law.drift:
        rate, drift = np.empty((6, nv)), np.empty(6)
        point = w.nominal.ctypes.data
        mj.jacDot(law.model, w.data, rate.ctypes.data, rate[3:].ctypes.data, point, law.body)
        _times(rate[:, :JOINTS], dq, drift)
        r -= drift
    inverse = np.empty((6, 6))
    if law.acceleration:
        _times_transposed(jac, jac, inverse)
        r -= undo
        _solve(inverse, r, law.pivot_floor)
        _add_transposed(jac, r, qn)
        mj.mulM(law.model, w.data, tau.ctypes.data, qn.ctypes.data)  # tau_task_space_control
    else:
        solved = np.empty((6, nv))
        mj.mulM(law.model, w.data, tau.ctypes.data, qn.ctypes.data)
        mj.solveM(law.model, w.data, solved.ctypes.data, jac.ctypes.data, 6)
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
    tau += view(w.bias, nv)
    tau -= view(w.passive, nv)  # joint damping is compensated


@compiled
def _command(w: Any, law: Any, jac: Array, u: Array, tau: Array) -> None:
    """Torques of the pose or of the joint controller for the state last observed."""
    if law.joint:
        gap = w.target_joints - view(w.qpos, JOINTS)
        tau[:JOINTS] = law.joint_stiffness * gap + u + view(w.bias, JOINTS)
    else:
        _aim(w, law)
        reference = law.kp * w.signals[:6] - law.kd * w.signals[6:] + u[:6]  # 2nd_sys
        _torque(w, law, jac, reference, tau)


@compiled
def _look(w: Any, law: Any, jac: Array) -> None:
    """Everything that is seen of a world whose derived quantities are current (`mj_step1`)."""
    _observe(w, law, jac)
    _aim(w, law)
    down = np.empty(4)
    mj.mulQuat(down.ctypes.data, w.turn.ctypes.data, _UP.ctypes.data)
    mj.quat2Vel(w.rotation.ctypes.data, down.ctypes.data, 1.0)


@compiled
def refresh(rows: Record, laws: Record, jacs: Array) -> None:
    """Look at all worlds."""
    for k in range(len(rows)):
        _look(rows[k], laws[0], jacs[k])


@compiled
def tick(rows: Record, laws: Record, jacs: Array, actions: Array, start: int, stop: int) -> bool:
    """One tick of the worlds from `start` to `stop`; False, and nothing done, without numbers.

    Actions (N, 6 or 7) are in units of `u_limit`, and clipped to [-1, 1].
    """
    law = laws[0]
    for value in actions.flat:
        if not np.isfinite(value):
            return False
    tau, u = np.zeros(law.nv), np.zeros(JOINTS)
    for k in range(start, stop):
        w, jac = rows[k], jacs[k]
        for i in range(actions.shape[1]):
            u[i] = law.u_limit[i] * min(max(actions[k, i], -1.0), 1.0)
        if law.joint:
            # The low-level action may only add to the pull towards the sub-goal (appendix G).
            u[:] = np.abs(u) * np.sign(w.target_joints - view(w.qpos, JOINTS))
        for step in range(law.substeps):
            if step and law.hold:
                mj.step(law.model, w.data)
                continue
            if step:
                mj.step1(law.model, w.data)
                _observe(w, law, jac)
            _command(w, law, jac, u, tau)
            view(w.ctrl, JOINTS)[:] = tau[:JOINTS]
            mj.step2(law.model, w.data)
        mj.step1(law.model, w.data)
        _contact(w, law.substeps)
        _look(w, law, jac)
        w.integral[:3] += law.tick * w.latent[:3]  # I_k = I_{k-1} + h y_k
    return True


@compiled
def _contact(w: Any, steps: int) -> None:
    """Force at the end of the tick; the largest and the deepest penetration of its steps."""
    w.force[:] = -view(w.push, 3)  # the sensor: the peg's push
    forces, distances = view(w.forces, (steps, 3)), view(w.distances, steps)
    largest, nearest = 0.0, 0.0
    for i in range(steps):
        largest = max(largest, forces[i, 0] ** 2 + forces[i, 1] ** 2 + forces[i, 2] ** 2)
        nearest = min(nearest, distances[i])
    w.peaks[0], w.peaks[1] = np.sqrt(largest), -nearest


@compiled
def torque(rows: Record, laws: Record, jacs: Array, reference: Array, tau: Array) -> None:
    """Torque of the law for one world that was last looked at in its present state."""
    _torque(rows[0], laws[0], jacs[0], reference, tau)
