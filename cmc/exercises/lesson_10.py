"""Exercises of lesson 10: the task-space torque, a posture the tip does not feel, a soft press."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.exercises import check, expect, expect_close
from cmc.robot.panda import JOINTS, READY, load_scene

Array = NDArray[np.float64]


def _states() -> Iterator[tuple[Array, Array, Array, Array]]:
    """M (7, 7), J (6, 7), h (7,) and J' q' (6,) of the Panda in random states."""
    model = load_scene("panda.xml")
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    site = model.site("tip_nominal").id
    for _ in range(5):
        data.qpos[:JOINTS] = READY + 0.3 * rng.normal(size=JOINTS)
        data.qvel[:JOINTS] = rng.normal(size=JOINTS)
        mujoco.mj_forward(model, data)
        M, (J, rate) = np.zeros((model.nv, model.nv)), np.zeros((2, 6, model.nv))
        mujoco.mj_fullM(model, data, M)
        mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
        body = int(model.site_bodyid[site])
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], data.site_xpos[site], body)
        yield M, J, data.qfrc_bias - data.qfrc_passive, rate @ data.qvel


def _joints(answer: object, what: str) -> Array:
    expect(answer is not None, f"{what} is None; does your function return something?")
    tau = np.asarray(answer, dtype=float)
    expect(tau.shape == (JOINTS,), f"{what} should have shape (7,), yours {tau.shape}")
    return tau


@check("10-torque")
def torque(answer: Callable[[Array, Array, Array, Array, Array], Array]) -> None:
    """Judge `my_torque(M, J, h, drift, p)` by the tip acceleration it gives, J M^-1 (tau - h)."""
    rng = np.random.default_rng(1)
    for M, J, h, drift in _states():
        p = rng.normal(size=6)
        tau = _joints(answer(M, J, h, drift, p), "the torque")
        found = J @ np.linalg.solve(M, tau - h) + drift
        rest = J @ np.linalg.solve(M, tau - h)
        expect(not np.allclose(rest, p), "J' q' counts twice: p is the whole acceleration x''")
        expect(not np.allclose(found, p + J @ np.linalg.solve(M, -h)), "h is missing")
        expect_close(found, p, "the tip acceleration under your torque", atol=1e-7)
        right = M @ np.linalg.pinv(J) @ (p - drift) + h
        expect(
            np.allclose(tau, right, atol=1e-6),
            "the tip is right, but the joints differ: the acceleration form was asked for, M J^+",
        )


@check("10-posture")
def posture(answer: Callable[[Array, Array, Array], Array]) -> None:
    """Judge `my_posture(M, J, qn)`: J M^-1 tau = 0, and as much of q'' = qn as that allows."""
    rng = np.random.default_rng(2)
    for M, J, _, _ in _states():
        qn = rng.normal(size=JOINTS)
        tau = _joints(answer(M, J, qn), "the torque")
        pull = J @ np.linalg.solve(M, tau)
        expect_close(pull, np.zeros(6), "what your torque does to the tip", atol=1e-7)
        free = np.linalg.svd(J)[2][-1]  # the joint motion that the tip does not feel
        made = np.linalg.solve(M, tau)
        wanted = free @ qn, free @ M @ qn / (free @ M @ free)
        expect(
            np.isclose(free @ made, wanted).any(),
            f"the elbow should accelerate at {wanted[0]:.3g} or {wanted[1]:.3g} (M-weighted),"
            f" yours at {free @ made:.3g}",
        )


@check("10-limit")
def limit(answer: Callable[[float, float, float], float]) -> None:
    """Judge `my_limit(mass, K_p, clip)`: mass (K_p clip + limit) = 1 N, and never below 0."""
    for mass, clip in ((1.7, 0.005), (4.0, 0.004), (7.0, 0.005)):
        wanted = max(0.0, 1.0 / mass - 40.0 * clip)
        expect_close(
            answer(mass, 40.0, clip), wanted, f"the limit for {mass} kg and {1e3 * clip:g} mm"
        )
