"""The control law and the tick once more, in numpy; and the compiled ones, asked in any state."""

import mujoco
import numpy as np

from cmc.robot.osc import ControlLaw, Worlds
from cmc.robot.panda import DOWN, JOINTS


def rotation_vector(end, start):
    """Log map of the rotation from `start` to `end` (unit quaternions), in world axes, (3,)."""
    a, (w, *v) = np.asarray(end), start
    scalar = a[0] * w + a[1:] @ v
    vector = -a[0] * np.array(v) + w * a[1:] - np.cross(a[1:], v)
    if scalar < 0:
        scalar, vector = -scalar, -vector
    sine = np.linalg.norm(vector)
    return vector * (2.0 * np.arctan2(sine, scalar) / sine if sine > 1e-12 else 2.0)


def solve(matrix, right, floor):
    """Cholesky with pivots (squared diagonal) kept from below."""
    factor = np.zeros_like(matrix)
    for j in range(len(matrix)):
        pivot = matrix[j, j] - factor[j, :j] @ factor[j, :j]
        factor[j, j] = np.sqrt(max(pivot, floor))
        factor[j + 1 :, j] = (matrix[j + 1 :, j] - factor[j + 1 :, :j] @ factor[j, :j]) / factor[
            j, j
        ]
    return np.linalg.solve(factor.T, np.linalg.solve(factor, right))


def pose_error(model, data, law, position, quat, site="tip_nominal"):
    """Error (6,), velocity (6,) and Jacobian (6, nv) of the driven joints."""
    index, jac = model.site(site).id, jacobian(model, data, site)
    jac[:, JOINTS:] = 0.0
    turn = np.empty(4)
    mujoco.mju_mat2Quat(turn, data.site_xmat[index])
    move = np.asarray(position) - data.site_xpos[index]
    length = np.linalg.norm(move)
    if law.error_limit is not None and length > law.error_limit:
        move = move * (law.error_limit / length)
    return np.concatenate([move, rotation_vector(quat, turn)]), jac @ data.qvel, jac


def torque(model, data, gains, law, position, quat, u):
    """Joint torques (7,), by dense matrices; `data` must be current."""
    error, velocity, jac = pose_error(model, data, law, position, quat)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    r = gains.kp * error - gains.kd * velocity + u
    qn = np.zeros(model.nv)
    qn[:JOINTS] = law.posture_stiffness * (np.array(law.posture) - data.qpos[:JOINTS])
    qn[:JOINTS] -= law.posture_damping * data.qvel[:JOINTS]
    if law.drift:
        rate, site = np.zeros((6, model.nv)), model.site("tip_nominal").id
        body = model.site_bodyid[site]
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], data.site_xpos[site], body)
        r = r - rate[:, :JOINTS] @ data.qvel[:JOINTS]
    floor, undo = law.pivot_floor, jac @ qn
    if law.form == "acceleration":
        tau = mass @ (qn + jac.T @ solve(jac @ jac.T, r - undo, floor))
    else:
        inverse = jac @ np.linalg.solve(mass, jac.T)
        if law.split:
            blocks = [solve(inverse[b, b], r[b], floor) for b in (slice(3), slice(3, 6))]
            force = np.concatenate(blocks) - solve(inverse, undo, floor)
        else:
            force = solve(inverse, r - undo, floor)
        tau = mass @ qn + jac.T @ force
    return (tau + data.qfrc_bias - data.qfrc_passive)[:JOINTS]


def tick(model, data, config, law, position, u, quat=DOWN):
    """One tick of pose control; the largest force and the deepest penetration of its steps."""
    largest = deepest = 0.0
    steps = round(config.tick / config.timestep)
    for k in range(steps):
        if k == 0 or not config.hold:
            data.ctrl[:] = torque(model, data, config.gains, law, position, quat, u)
        mujoco.mj_step2(model, data)
        force, distance = (data.sensor(name).data for name in ("peg_force", "peg_distance"))
        largest, deepest = max(largest, np.linalg.norm(force)), max(deepest, -distance[0])
        mujoco.mj_step1(model, data)
    return largest, deepest


class Compiled:
    """The compiled law of one arm, from a scene with a history: errors and torques of states."""

    def __init__(self, model, gains, law=None, unit=1e3):
        self.gains, self.unit = gains, unit
        self.worlds = Worlds(model, gains, law or ControlLaw(), u_limit=np.full(JOINTS, unit))

    def look(self, data, position, quat=DOWN):
        """Pose error (6,) and velocity (6,) of the tip."""
        worlds = self.worlds
        worlds.data[0].qpos[:], worlds.data[0].qvel[:] = data.qpos, data.qvel
        worlds.target[:], worlds.quat[:] = position, quat
        mujoco.mj_step1(worlds.model, worlds.data[0])
        worlds.refresh()
        return worlds.signals[0, :6].copy(), worlds.signals[0, 6:].copy()

    def torque(self, data, position, quat, u):
        """Joint torques (7,) before the motors' limits."""
        self.look(data, position, quat)
        self.worlds.tick(np.array(u)[None] / self.unit)
        return self.worlds.data[0].ctrl.copy()

    def torque_for(self, data, reference):
        """Joint torques (7,) for the tip acceleration `reference` (6,)."""
        error, velocity = self.look(data, np.zeros(3))
        u = reference - self.gains.kp * error + self.gains.kd * velocity
        return self.torque(data, np.zeros(3), DOWN, u)


def jacobian(model, data, site="tip_nominal"):
    """Jacobian (6, nv) of a site."""
    jac = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jac[:3], jac[3:], model.site(site).id)
    return jac
