"""Lesson 10: the Panda and its peg, from kinematics to a soft touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.envs.peg_maze import SOFT
from cmc.fast import budget
from cmc.lessons.panda_bench import (
    START,
    SUBSTEPS,
    TICK,
    Setup,
    effective_mass,
    run,
    saturated,
    world,
)
from cmc.robot.panda import (
    DOWN,
    JOINTS,
    LOWER,
    READY,
    UPPER,
    Peg,
    forward_kinematics,
)
from cmc.robot.task_space import MAZE_GAINS, ControlLaw, Form, Gains, TaskSpaceController
from cmc.theory.composite import InfeasibleGainsError

Array = NDArray[np.float64]

FREE = Setup(scene="panda.xml", start=(0.42, -0.02, 0.05))
"""The peg above an empty table."""
STIFF = Gains(kp_trans=200.0, kd_trans=40.0, kp_rot=200.0, kd_rot=40.0)
"""Gains at which a disturbance of the posture hardly shows at the tip."""
WALL = {"x": (START, (-1.0, 0.0, 0.0)), "y": ((0.4245, -0.0300, 0.008), (0.0, 1.0, 0.0))}
"""For pressing along x and along y: first tip position, m, and direction towards a wall."""
WAYPOINTS = np.array(
    [
        (0.4290, -0.0190, 0.008),
        (0.4290, -0.0315, 0.008),
        (0.4213, -0.0315, 0.008),
        (0.4213, -0.0172, 0.009),
        (0.4155, -0.0188, 0.010),
        (0.4125, -0.0225, 0.010),
    ]
)
"""A way through the maze, m."""
SPRING = SOFT.peg
"""The compliant peg of the soft maze: two lateral springs."""


def kinematics_check(number: int = 200) -> dict[str, float]:
    """Largest differences between the DH table and MuJoCo: position (m) and rotation (1)."""
    model, data = world(FREE)
    rng, position, rotation = np.random.default_rng(0), 0.0, 0.0
    for q in rng.uniform(LOWER, UPPER, (number, JOINTS)):
        data.qpos[:JOINTS] = q
        mujoco.mj_kinematics(model, data)
        p, R = forward_kinematics(q)
        position = max(position, float(np.abs(data.body("hand").xpos - p).max()))
        rotation = max(rotation, float(np.abs(data.body("hand").xmat.reshape(3, 3) - R).max()))
    return {"position": position, "rotation": rotation}


def literal(every_step: bool, seconds: float = 0.8) -> dict[str, Array]:
    """The gains as newtons, tau = J^T (K_p e - K_d v) + h: a 10 mm step, without the inertia."""
    model, data = world(FREE)
    controller = TaskSpaceController(model, MAZE_GAINS)
    goal = np.array(FREE.start) + [0.01, 0.0, 0.0]
    error = []
    for _ in range(round(seconds / TICK)):
        for k in range(SUBSTEPS):
            if k == 0 or every_step:
                mujoco.mj_forward(model, data)
                controller.observe(data)
                e = controller.error(goal, DOWN)
                wrench = MAZE_GAINS.kp * e - MAZE_GAINS.kd * controller.velocity
                bias = data.qfrc_bias[:JOINTS] - data.qfrc_passive[:JOINTS]
                data.ctrl[:JOINTS] = controller.jac.T @ wrench + bias
            if k == 0:
                error.append(e)
            mujoco.mj_step(model, data)
    return {"t": TICK * np.arange(len(error), dtype=float), "e": np.array(error)}


def step(setup: Setup = FREE, length: float = 0.01, seconds: float = 0.8) -> dict[str, Array]:
    """A step of the target along x, with the motion that the latent model predicts.

    The prediction knows the gains and the recorded u, and nothing of the arm: `e_model` and
    `y_model` (T, 3) from e'' + K_d e' + K_p e + u = 0, held over each tick.
    """
    goal = np.array(setup.start) + [length, 0.0, 0.0]
    out = run(setup, lambda t: goal, seconds)
    return out | predict(setup.gains, out["e"][0], out["u"])


def predict(gains: Gains, e0: Array, u: Array) -> dict[str, Array]:
    """Errors (T, 3) and latent signals of the model made of gains, from rest at e0, under u.

    The acceleration K_p e + K_d e' + u is held over each tick, as on the robot: exact sampling of
    a double integrator.
    """
    latent, K_p, K_d = gains.latent, gains.kp[:3], gains.kd[:3]
    e, v = e0[:3].copy(), np.zeros(3)
    errors, signals = [], []
    for row in u[:, :3]:
        errors.append(e)
        signals.append(latent.K1[:3] * e + latent.K2[:3] * v)
        held = -(K_p * e + K_d * v + row)  # 2nd_sys
        e, v = e + TICK * v + TICK**2 / 2 * held, v + TICK * held
    return {"e_model": np.array(errors), "y_model": np.array(signals)}


def null_space(form: Form, posture: bool, seconds: float | None = None) -> dict[str, Array]:
    """Hold the tip still while joints 1 and 3 get a short push of 1 N m, in opposite directions.

    Returns the run and `joints` (T, 7), the change of the joint angles since the start.
    """
    gain = (1.0, 2.0) if posture else (0.0, 0.0)
    law = ControlLaw(form=form, posture_stiffness=gain[0], posture_damping=gain[1])
    law = replace(law, posture=tuple(_start_posture()))
    pushed = np.array([1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0])
    out = run(
        replace(FREE, law=law, gains=STIFF),
        lambda t: FREE.start,
        seconds or budget(6.0, 4.0),
        push=lambda t: pushed * (t < 0.2),
    )
    return out | {"joints": out["qpos"][:, :JOINTS] - out["qpos"][0, :JOINTS]}


def posture_torques() -> dict[str, Array]:
    """Acceleration of the tip (3,), m/s^2, that a posture torque causes, by how it enters.

    The same posture acceleration q_n'' = q_0 - q enters with the inertia and the dynamically
    consistent projector, without the inertia, and without any projector.
    """
    model, data = world(FREE)
    jac, dense = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
    mujoco.mj_jacSite(model, data, jac[:3], jac[3:], model.site("tip_nominal").id)
    mujoco.mj_fullM(model, data, dense)
    M, J = dense[:JOINTS, :JOINTS], jac[:, :JOINTS]
    wanted = READY - data.qpos[:JOINTS]
    inverse = np.linalg.inv(M)
    L = np.linalg.inv(J @ inverse @ J.T)
    consistent = np.eye(JOINTS) - J.T @ L @ J @ inverse  # I - J^T Jbar^T
    kinematic = np.eye(JOINTS) - np.linalg.pinv(J) @ J
    torques = {
        "with inertia, M (I - J⁺J) q": M @ kinematic @ wanted,
        "consistent, (I - JᵀJ̄ᵀ) M q": consistent @ M @ wanted,
        "without inertia, (I - J⁺J) q": kinematic @ wanted,
        "no projector, M q": M @ wanted,
    }
    return {n: np.asarray((J @ inverse @ tau)[:3], float) for n, tau in torques.items()}


def press(
    axis: str = "x", peg: Peg | None = None, clip: float | None = None, limit: float = 1.0
) -> dict[str, Any]:
    """Aim 15 mm beyond a wall of the maze: impact, pressing force, and what a formula says.

    Args:
        axis: "x" or "y", along which the peg presses.
        peg: rigid by default.
        clip: limit of the position error, m, or None.
        limit: largest |u|, m/s^2.

    Returns:
        The run and `impact`, the largest force (N), `pressing`, the last one (N), `predicted`,
        m_eff (K_p e + u) (N), `mass` (kg) and `speed`, the largest approach speed (m/s).
    """
    start, direction = WALL[axis]
    law = ControlLaw(split=True, error_limit=clip)
    setup = Setup(peg=peg or Peg(), law=law, policy=saturated(20.0, limit), start=start)
    towards = np.array(direction)
    goal = np.array(start) + 0.015 * towards
    out = run(setup, lambda t: goal, budget(2.0, 1.6))
    mass = float(effective_mass(*world(setup)) @ np.abs(towards))
    last = float(np.linalg.norm(out["e"][-1, :3]))
    force = MAZE_GAINS.kp_trans * last + float(np.linalg.norm(out["u"][-1, :3]))
    return out | {
        "impact": float(out["peak"].max()),
        "pressing": float(np.linalg.norm(out["force"][-1])),
        "predicted": mass * force,
        "mass": mass,
        "speed": float((out["velocity"][:, :3] @ towards).max()),
    }


def regimes(axis: str = "x") -> dict[str, dict[str, Any]]:
    """Rigid or spring, with or without limits (error 5 mm, u 0.2 m/s^2): four runs of `press`."""
    return {
        "rigid, no limits": press(axis),
        "rigid, limits": press(axis, clip=0.005, limit=0.2),
        "spring, no limits": press(axis, SPRING),
        "spring, limits": press(axis, SPRING, clip=0.005, limit=0.2),
    }


def impacts(number: int | None = None) -> dict[str, Array]:
    """Force at a first touch along x against the speed of approach, rigid peg and spring.

    The target moves at a constant speed, u = 0; the force is the largest within 60 ms of the touch.
    """
    speeds = np.linspace(0.005, 0.05, number or budget(10, 5))
    start, direction = np.array(START), np.array([-1.0, 0.0, 0.0])
    out: dict[str, list[float]] = {"speed": [], "rigid": [], "spring": []}
    for speed in speeds:
        for name, peg in (("rigid", Peg()), ("spring", SPRING)):
            setup = Setup(peg=peg, law=ControlLaw(split=True))

            def target(t: float, speed: float = float(speed)) -> Array:
                return start + direction * speed * t

            done = run(setup, target, 0.0027 / speed + 0.9)
            touch = int(np.argmax(done["peak"] > 1e-6))
            out[name].append(float(done["peak"][touch : touch + 3].max()))
            if name == "rigid":
                out["speed"].append(float(-done["velocity"][max(touch - 1, 0), 0]))
    mass = float(effective_mass(*world(Setup()))[0])
    result = {name: np.array(values) for name, values in out.items()}
    slope = float(result["rigid"] @ result["speed"] / (result["speed"] @ result["speed"]))
    spring = np.sqrt(SPRING.stiffness * mass) * result["speed"]
    constants = {"mass": mass, "slope": slope, "stiffness": SPRING.stiffness}
    numbers = {name: np.array(value) for name, value in constants.items()}
    return result | numbers | {"spring_model": spring}


def response(K_p: float, K_d: float, gain: float, dx: float, dz: float) -> dict[str, Any]:
    """Step of the tip by (dx, dz) mm with any gains and u = gain y; the slider's picture."""
    try:
        gains = Gains(K_p, K_d, 20.0, 10.0)
    except InfeasibleGainsError:
        gap = np.full(40, np.nan)
        out = {"t": TICK * np.arange(40), "e": np.stack([gap] * 2, axis=-1), "model": gap}
        return out | {"u": gap, "text": f"refused: K_d must be at least {2 * np.sqrt(K_p):.1f}"}
    setup = replace(FREE, gains=gains, policy=saturated(gain))
    goal = np.array(FREE.start) + [dx * 1e-3, 0.0, dz * 1e-3]
    done = run(setup, lambda t: goal, 0.8)
    model = predict(gains, done["e"][0], done["u"])["e_model"]
    level = float((K_d + gain * gains.latent.K2[0]) * TICK)
    first, later = (float(np.linalg.norm(done["e"][k, :3])) for k in (0, 20))
    left = later / max(first, 1e-9)
    return {
        "t": done["t"],
        "e": 1e3 * done["e"][:, [0, 2]],
        "model": 1e3 * model[:, 0],
        "u": done["u"][:, 0],
        "text": f"{left:.0%} is left after 0.4 s; (K_d + g K2) dt = {level:.2f}",
    }


def maze_run(soft: bool = False) -> dict[str, Array]:
    """Through the maze along `WAYPOINTS`, stiff or soft; one waypoint every 0.8 s."""
    law = ControlLaw(split=True, error_limit=0.005 if soft else None)
    setup = Setup(
        peg=SPRING if soft else Peg(), law=law, policy=saturated(20.0, 0.2 if soft else 1.0)
    )

    def target(t: float) -> Array:
        done: Array = WAYPOINTS[min(1 + int(t / 0.8), len(WAYPOINTS) - 1)]
        return done

    return run(setup, target, 0.8 * len(WAYPOINTS))


def _start_posture() -> Array:
    return world(FREE)[1].qpos[:JOINTS].copy()
