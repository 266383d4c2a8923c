"""Task-space control: exact in free space, predicted by its gains, chattering where it should."""

import mujoco
import numpy as np
import pytest
from numpy_control import Compiled, jacobian
from numpy_control import torque as numpy_torque

from cmc.robot import panda
from cmc.robot.osc import MAZE_GAINS, PUSH_GAINS, ControlLaw
from cmc.theory.arrays import compiled

each_form = pytest.mark.parametrize("form", [ControlLaw("acceleration"), ControlLaw("force")])
TIP = np.array([0.42, -0.02, 0.01])
STILL = np.zeros(6)


@pytest.fixture(scope="module")
def start():
    return panda.inverse_kinematics(TIP)


@pytest.fixture(scope="module")
def model():
    return panda.load_scene(history=1)


def site_acceleration(model, data):
    """J q'' + (dJ/dt) q' with dJ/dt by central differences along the motion."""

    step = 1e-4
    ahead, behind = (
        jacobian(model, place(model, data.qpos + s * data.qvel)) for s in (step, -step)
    )
    return jacobian(model, data) @ data.qacc + (ahead - behind) / (2 * step) @ data.qvel


def place(model, qpos, qvel=0.0):
    data = mujoco.MjData(model)
    data.qpos[:7], data.qvel[:7] = qpos, qvel
    mujoco.mj_forward(model, data)
    return data


def press(controller, model, data, steps, push=None):
    """Hold the tip at `TIP` with control at every physics step, pushed by a force (3,), N."""
    for _ in range(steps):
        mujoco.mj_step1(model, data)
        if push is not None:
            data.qfrc_applied[:] = 0
            point, body = data.site("tip").xpos, model.body("peg").id
            mujoco.mj_applyFT(model, data, push, np.zeros(3), point, body, data.qfrc_applied)
        data.ctrl[:] = controller.torque(data, TIP, panda.DOWN, STILL)
        mujoco.mj_step2(model, data)


@each_form
def test_free_space_acceleration_is_the_reference(model, start, form):
    """Against finite differences of the Jacobian, and against MuJoCo's own acceleration."""
    rng, controller = np.random.default_rng(0), Compiled(model, MAZE_GAINS, form)
    site = model.site("tip_nominal").id
    for speed, tolerance in ((0.0, 1e-9), (0.3, 1e-7), (1.0, 1e-6)):
        for _ in range(20):
            data = place(model, start + rng.normal(0, 0.1, 7), rng.normal(0, 1, 7) * speed)
            reference = rng.normal(size=6)
            data.ctrl[:] = controller.torque_for(data, reference)
            mujoco.mj_forward(model, data)
            found = site_acceleration(model, data)
            np.testing.assert_allclose(found, reference, atol=tolerance)
            mujoco.mj_rnePostConstraint(model, data)
            kind, moved = mujoco.mjtObj.mjOBJ_SITE, np.zeros(6)
            mujoco.mj_objectAcceleration(model, data, kind, site, moved, 0)
            np.testing.assert_allclose(moved[:3], reference[3:], atol=1e-9)
            np.testing.assert_allclose(moved[3:] - [0, 0, 9.81], reference[:3], atol=1e-9)


def test_without_posture_the_null_space_drifts_and_the_tip_does_not_care(model, start):
    """The same tip motion, but the free elbow keeps swinging unless the posture holds it."""
    speeds = []
    for stiffness, damping in ((1.0, 2.0), (0.0, 0.0)):
        law = ControlLaw("force", posture_stiffness=stiffness, posture_damping=damping)
        controller, data = Compiled(model, MAZE_GAINS, law), place(model, start)
        data.qvel[:] = 0.3 * np.linalg.svd(jacobian(model, data))[2][-1]  # leaves the tip alone
        press(controller, model, data, 500)
        speeds.append(np.linalg.norm(data.qvel))
        assert np.linalg.norm(data.site("tip").xpos - TIP) < 5e-4
    assert speeds[0] < 0.1 * 0.3
    assert speeds[1] > 0.5 * 0.3


def turned(vector):
    """Pointing down, then turned by a rotation vector in world axes."""
    turn, quat, angle = np.empty(4), np.empty(4), np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(turn, np.array(vector) / (angle or 1.0), angle)
    mujoco.mju_mulQuat(quat, turn, panda.DOWN)
    return quat


def drive(model, start, gains, law, u_of, seconds, dt=0.02, offset=(0.005, 0, 0, 0, 0, 0)):
    """Errors e and y at each tick of `dt` with torques held, from rest with an initial error."""
    controller, data = Compiled(model, gains, law), place(model, start)
    target, quat = TIP + np.array(offset[:3]), turned(offset[3:])
    errors, latents = [], []
    for _ in range(round(seconds / dt)):
        error, velocity = controller.look(data, target, quat)
        errors.append(error)
        latents.append(gains.latent.y(error, -velocity))
        data.ctrl[:] = controller.torque(data, target, quat, u_of(latents[-1]))
        mujoco.mj_step(model, data, round(dt / model.opt.timestep))
        mujoco.mj_forward(model, data)
    return np.array(errors), np.array(latents)


@each_form
@pytest.mark.parametrize("gains", [MAZE_GAINS, PUSH_GAINS])
def test_the_latent_model_of_the_gains_predicts_the_arm(model, start, gains, form):
    """A y' + B y + u = 0, with A and B from the gains alone, against the simulated y(t)."""
    slope, seconds = 3.0, 0.4
    offset = (0.003, -0.002, 0.002, 0.02, -0.03, 0.04)
    _, found = drive(model, start, gains, form, lambda y: slope * y, seconds, 0.002, offset)
    kp, kd = gains.kp, gains.kd  # appendix D, written out independently
    k2 = (kd - np.sqrt(kd**2 - 4 * kp)) / 2
    rate = k2 * (1 + slope)  # y' = -(B + g) / A y with B = 1, A = 1 / K2
    times = 0.002 * np.arange(len(found))
    predicted = found[0] * np.exp(-np.outer(times, rate))
    np.testing.assert_allclose(found, predicted, atol=0.02 * np.abs(found[0]).max(axis=-1))


@each_form
def test_a_held_torque_at_50_hz_tracks_like_the_ideal_equation(model, start, form):
    errors, _ = drive(model, start, MAZE_GAINS, form, lambda y: STILL, 0.42)
    left = errors[20, 0] / 0.005
    fast, slow = (-(20 + s * np.sqrt(240)) / 2 for s in (1, -1))
    ideal = (slow * np.exp(fast * 0.4) - fast * np.exp(slow * 0.4)) / (slow - fast)
    assert left == pytest.approx(ideal, abs=0.02)
    assert np.abs(errors[:, [1, 2]]).max() < 2e-5
    assert np.abs(errors[:, 3:]).max() < 2e-3


@pytest.mark.parametrize("gains", [MAZE_GAINS, PUSH_GAINS])
def test_chatter_starts_where_the_sampled_bound_says(model, start, gains):
    """(K_d + g K2) dt < 2: decay just below, growing alternation just above."""

    def moves(margin):
        slope = (margin / 0.02 - gains.kd) / gains.latent.K2
        slope[3:] = 0.0
        law, offset = ControlLaw("acceleration"), (0.0005, 0, 0, 0, 0, 0)
        errors, _ = drive(model, start, gains, law, lambda y: slope * y, 1.2, offset=offset)
        return np.diff(errors[:, 0])

    calm, wild = moves(1.9), moves(2.1)
    assert np.abs(calm[-5:]).max() < 1e-6
    assert np.abs(wild[-5:]).max() > 5e-4  # as large as the initial error, until torques saturate
    growth = wild[9:20] / wild[8:19]
    assert (growth < -1.0).all()  # alternates at half the sampling rate, and grows


def test_control_at_every_physics_step_follows_the_same_path(model, start):
    held, _ = drive(model, start, MAZE_GAINS, ControlLaw(), lambda y: STILL, 0.4, 0.02)
    dense, _ = drive(model, start, MAZE_GAINS, ControlLaw(), lambda y: STILL, 0.4, 0.002)
    np.testing.assert_allclose(held[:, 0], dense[::10, 0], atol=1e-4)


def test_orientation_error_is_the_rotation_vector(model, start):
    """Log map: a target turned by 0.7 rad gives an error of 0.7, not sin(0.35)."""
    controller, rng = Compiled(model, MAZE_GAINS), np.random.default_rng(2)
    data = place(model, start)
    for _ in range(50):
        vector = rng.normal(size=3)
        vector *= rng.uniform(0, 3.0) / np.linalg.norm(vector)
        for sign in (1, -1):  # q and -q are one orientation
            found = controller.look(data, TIP, sign * turned(vector))[0][3:]
            np.testing.assert_allclose(found, vector, atol=1e-7)


LAWS = [
    ControlLaw("acceleration"),
    ControlLaw("force"),
    ControlLaw("force", split=True, error_limit=0.005),
    ControlLaw("acceleration", drift=False),
]


@pytest.mark.parametrize("law", LAWS, ids=["acceleration", "force", "split", "still"])
@pytest.mark.parametrize("stiffness", [0.0, 200.0])
def test_the_compiled_law_is_the_numpy_law(start, law, stiffness):
    model = panda.load_scene(peg=panda.Peg(stiffness=stiffness), history=1)
    rng, controller = np.random.default_rng(3), Compiled(model, MAZE_GAINS, law)
    for k in range(8):
        qpos = start + rng.normal(0, 0.4, 7) if k else np.zeros(7)  # the first is singular
        data = place(model, qpos, rng.normal(0, 0.5, 7))
        target, u = TIP + rng.normal(0, 0.02, 3), rng.normal(size=6)
        data.qvel[7:] = rng.normal(0, 0.5, model.nv - 7)
        mujoco.mj_forward(model, data)
        wanted = numpy_torque(model, data, MAZE_GAINS, law, target, panda.DOWN, u)
        found = controller.torque(data, target, panda.DOWN, u)
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", LAWS, ids=["acceleration", "force", "split", "still"])
def test_singular_poses_give_bounded_torques(model, law):
    """The stretched arm (q = 0) has no six-dimensional task space; the solve is damped."""
    controller, data = Compiled(model, MAZE_GAINS, law), place(model, np.zeros(7))
    assert np.isfinite(controller.torque(data, TIP, panda.DOWN, STILL)).all()
    assert np.linalg.cond(jacobian(model, data)) > 1e6
    press(controller, model, data, 500)
    assert np.isfinite(data.qpos).all()
    assert data.qpos[3] < 0.05  # stays at or returns inside joint 4's range


def test_split_blocks_keep_a_pressing_peg_upright(model, start):
    """A sideways contact force turns the hand through the 6x6 and hardly at all when split."""
    tilts = []
    for split in (True, False):
        law = ControlLaw("force", split=split)
        controller, data = Compiled(model, MAZE_GAINS, law), place(model, start)
        press(controller, model, data, 1000, push=np.array([0, 3.0, 0]))
        tilts.append(np.linalg.norm(controller.look(data, TIP)[0][3:]))
    assert tilts[0] < 0.1 * tilts[1]


def test_without_a_place_to_keep_it_code_is_compiled_anyway(monkeypatch):
    """A read-only installation: numba finds no folder for its cache."""
    from numba.core import caching

    monkeypatch.setattr(caching.FunctionCache._impl_class, "_locator_classes", [])
    assert compiled(lambda x: 2 * x)(3) == 6
