"""The two-link arm against MuJoCo's own arm, and its task-space torque."""

import mujoco
import numpy as np
import pytest

from cmc.robot.two_link import TwoLinkArm, simulate

ARM = TwoLinkArm(lengths=(0.4, 0.3), masses=(3.0, 2.0))


def reference():
    """The same arm as MJCF: x to the right, z up, hinges about -y."""
    links = [(0.4, 3.0), (0.3, 2.0)]
    inertia = [m * l**2 / 12 for l, m in links]
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option gravity="0 0 -9.81"/><worldbody>
      <body><joint axis="0 -1 0"/>
        <inertial pos=".2 0 0" mass="3" diaginertia="1e-3 {inertia[0]} {inertia[0]}"/>
        <body pos=".4 0 0"><joint axis="0 -1 0"/>
          <inertial pos=".15 0 0" mass="2" diaginertia="1e-3 {inertia[1]} {inertia[1]}"/>
          <site name="tip" pos=".3 0 0"/></body></body>
    </worldbody></mujoco>""")
    return model, mujoco.MjData(model)


def states(n, seed=0):
    rng = np.random.default_rng(seed)
    q = np.stack([rng.uniform(-3, 3, n), rng.uniform(0.3, 2.8, n)], -1)
    return q, rng.normal(size=(n, 2)), rng.normal(size=(n, 2)) * 5


def test_dynamics_and_kinematics_equal_mujoco_s():
    model, data = reference()
    full = np.zeros((2, 2))
    for q, dq, tau in zip(*states(50), strict=True):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, dq, tau
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(ARM.position(q), data.site("tip").xpos[[0, 2]], atol=1e-12)
        np.testing.assert_allclose(ARM.bias(q, dq), data.qfrc_bias, atol=1e-10)
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(ARM.inertia(q), full, atol=1e-12)
        np.testing.assert_allclose(ARM.acceleration(q, dq, tau), data.qacc, rtol=1e-8, atol=1e-8)


def test_jacobians_equal_finite_differences():
    q, dq, _ = states(30)
    h = 1e-6
    for i, axis in enumerate(np.eye(2)):
        slope = (ARM.position(q + h * axis) - ARM.position(q - h * axis)) / (2 * h)
        np.testing.assert_allclose(ARM.jacobian(q)[..., i], slope, atol=1e-8)
    change = (ARM.jacobian(q + h * dq) - ARM.jacobian(q - h * dq)) / (2 * h)
    np.testing.assert_allclose(
        ARM.jacobian_rate(q, dq), np.einsum("nij,nj->ni", change, dq), atol=1e-7
    )


def test_task_torque_gives_the_tip_the_wanted_acceleration():
    q, dq, p = states(500)
    ddq = ARM.acceleration(q, dq, ARM.task_torque(q, dq, p))
    tip = np.einsum("nij,nj->ni", ARM.jacobian(q), ddq) + ARM.jacobian_rate(q, dq)
    np.testing.assert_allclose(tip, p, atol=1e-9)


def test_reach_inverts_position_and_refuses_what_is_out_of_reach():
    q, _, _ = states(200)
    tip = ARM.position(q)
    np.testing.assert_allclose(ARM.position(ARM.reach(tip)), tip, atol=1e-9)
    for far in ([0.8, 0.0], [0.05, 0.0]):
        with pytest.raises(ValueError, match="reaches 0.1 to 0.7 m"):
            ARM.reach(far)


def test_simulation_keeps_energy_and_follows_mujoco():
    model, data = reference()
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 0.001
    data.qpos[:] = [0.3, 0.7]
    times = 0.001 * np.arange(801)
    q, dq = simulate(ARM, lambda t, q, dq: np.zeros(2), [0.3, 0.7], [0, 0], times)
    mujoco.mj_step(model, data, 800)
    np.testing.assert_allclose(q[-1], data.qpos, atol=1e-8)
    kinetic = 0.5 * np.einsum("ti,tij,tj->t", dq, ARM.inertia(q), dq)
    elbow = 0.4 * np.sin(q[:, 0])
    height = 3.0 * elbow / 2 + 2.0 * (elbow + 0.15 * np.sin(q.sum(axis=1)))
    energy = kinetic + 9.81 * height
    assert np.ptp(energy) < 1e-6
    assert np.ptp(kinetic) > 1.0


def test_singular_poses_are_refused():
    for q in ([0.3, 0.0], [0.3, np.pi]):
        with pytest.raises(ValueError, match="straight or folded"):
            ARM.task_torque(q, [0, 0], [1, 0])
