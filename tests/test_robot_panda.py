"""The arm against its own table: kinematics, inertia, gravity, limits."""

import mujoco
import numpy as np
import pytest

from cmc.robot import panda

# The published numbers once more, typed from the sources and used by nothing but this test.
TABLE = [  # a, d, alpha
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
]
LINKS = [  # mass, com, (ixx iyy izz ixy ixz iyz)
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),  # noqa: E501
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),  # noqa: E501
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),  # noqa: E501
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),  # noqa: E501
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),  # noqa: E501
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),  # noqa: E501
    (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),  # noqa: E501
]  # fmt: skip
HAND = (0.73, (-0.01, 0, 0.03), (0.001, 0.0025, 0.0017, 0, 0, 0))
PEG_MASS, PEG_LENGTH, PEG_RADIUS = 0.03, 0.05, 0.0008
GRAVITY = np.array([0, 0, -9.81])


def transform(a, d, alpha, theta):
    """Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d) as a product of four 4x4 matrices."""

    def turn(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(4)
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
        return matrix

    def shift(x, y, z):
        matrix = np.eye(4)
        matrix[:3, 3] = x, y, z
        return matrix

    return turn(0, alpha) @ shift(a, 0, 0) @ turn(2, theta) @ shift(0, 0, d)


def frames(q):
    """Frames of the seven links and the hand in the world."""
    frame, found = np.eye(4), []
    for row, angle in zip(TABLE, q, strict=True):
        frame = frame @ transform(*row, angle)
        found.append(frame)
    return [*found, frame @ transform(0, 0.107, 0, -np.pi / 4)]


def bodies(q):
    """Mass, centre of mass, inertia about it (world axes), and number of joints below it."""
    chain = frames(q)
    parts = [*zip(LINKS, chain[:7], range(1, 8), strict=True), (HAND, chain[7], 7)]
    slender = PEG_MASS * PEG_LENGTH**2 / 12
    peg = (PEG_MASS, (0, 0, 0.1124 + PEG_LENGTH / 2), (slender, slender, PEG_MASS * PEG_RADIUS**2 / 2, 0, 0, 0))  # noqa: E501  # fmt: skip
    for (mass, com, (xx, yy, zz, xy, xz, yz)), frame, joints in [*parts, (peg, chain[7], 7)]:
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        rotation = frame[:3, :3]
        centre = rotation @ np.array(com) + frame[:3, 3]
        yield mass, centre, rotation @ tensor @ rotation.T, joints


def mass_and_gravity(q):
    """M = sum m Jv^T Jv + Jw^T I Jw (+ armature), g = -sum m Jv^T gravity, from the table alone."""
    chain = frames(q)
    mass_matrix, torque = 0.1 * np.eye(7), np.zeros(7)
    for mass, centre, inertia, joints in bodies(q):
        linear, angular = np.zeros((3, 7)), np.zeros((3, 7))
        for j in range(joints):
            angular[:, j] = chain[j][:3, 2]
            linear[:, j] = np.cross(chain[j][:3, 2], centre - chain[j][:3, 3])
        mass_matrix += mass * linear.T @ linear + angular.T @ inertia @ angular
        torque -= mass * linear.T @ GRAVITY
    return mass_matrix, torque


def coriolis(q, velocity, step=1e-6):
    """C q' = (dM/dt) q' - 1/2 d(q'^T M q')/dq by central differences of M."""
    around = [
        (mass_and_gravity(q + s)[0] - mass_and_gravity(q - s)[0]) / (2 * step)
        for s in step * np.eye(7)
    ]
    rate = sum(v * matrix for v, matrix in zip(velocity, around, strict=True))
    return rate @ velocity - 0.5 * np.array([velocity @ matrix @ velocity for matrix in around])


@pytest.fixture(scope="module")
def scene():
    model = panda.load_scene()
    return model, mujoco.MjData(model)


def poses(count, seed=0):
    return np.random.default_rng(seed).uniform(panda.LOWER, panda.UPPER, (count, 7))


def test_kinematics_equal_the_table(scene):
    model, data = scene
    for q in poses(50):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        chain = frames(q)
        for i in range(7):
            body = data.body(f"link{i + 1}")
            np.testing.assert_allclose(body.xpos, chain[i][:3, 3], atol=1e-12)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), chain[i][:3, :3], atol=1e-12)
        hand = chain[7]
        np.testing.assert_allclose(data.body("hand").xmat.reshape(3, 3), hand[:3, :3], atol=1e-12)
        tip = hand @ [0, 0, 0.1124 + PEG_LENGTH, 1]
        np.testing.assert_allclose(data.site("tip").xpos, tip[:3], atol=1e-12)


def test_mass_matrix_gravity_and_coriolis_equal_an_independent_computation(scene):
    model, data = scene
    rng = np.random.default_rng(1)
    for q in poses(10, seed=1):
        mass_matrix, gravity = mass_and_gravity(q)
        data.qpos[:], data.qvel[:] = q, 0
        mujoco.mj_forward(model, data)
        full = np.zeros((7, 7))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(full, mass_matrix, atol=1e-10)
        np.testing.assert_allclose(data.qfrc_bias, gravity, atol=1e-10)
        velocity = rng.normal(size=7)
        data.qvel[:] = velocity
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_bias - gravity, coriolis(q, velocity), atol=1e-6)
        np.testing.assert_allclose(data.qfrc_passive, -0.5 * velocity, atol=1e-12)


def test_limits_are_the_published_ones(scene):
    model, _ = scene
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    np.testing.assert_array_equal(model.jnt_range[:7], np.transpose([lower, upper]))
    np.testing.assert_array_equal(panda.LOWER, lower)
    np.testing.assert_array_equal(panda.UPPER, upper)
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], [87] * 4 + [12] * 3)
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 0], -model.actuator_ctrlrange[:, 1])
    assert model.jnt_limited[:7].all()
    assert model.actuator_ctrllimited.all()


def test_motors_clip_at_the_torque_limit(scene):
    model, data = scene
    mujoco.mj_resetData(model, data)
    data.qpos[:] = panda.READY
    data.ctrl[:] = 1e4
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(data.qfrc_actuator, [87] * 4 + [12] * 3)


def test_only_the_peg_collides(scene):
    model, _ = scene
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    assert {model.geom(int(i)).name for i in colliding} == {"peg", "wrist"}  # wrist: a hood only
    assert model.geom("wrist").conaffinity == 2
    np.testing.assert_allclose(model.geom_size[model.geom("peg").id][0], PEG_RADIUS)


def test_visual_shapes_stay_on_the_arm(scene):
    """Every link's shapes are within 0.3 m of its frame: nothing floats away when edited."""
    model, data = scene
    data.qpos[:] = panda.READY
    mujoco.mj_kinematics(model, data)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body:
            assert np.linalg.norm(data.geom_xpos[geom] - data.xpos[body]) < 0.3


def test_inverse_kinematics_reaches_the_pose_and_says_when_it_cannot():
    q = panda.inverse_kinematics([0.42, -0.02, 0.01])
    chain = frames(q)[7]
    np.testing.assert_allclose(chain @ [0, 0, 0.1624, 1], [0.42, -0.02, 0.01, 1], atol=1e-8)
    np.testing.assert_allclose(chain[:3, :3], np.diag([1, -1, -1]), atol=1e-8)
    with pytest.raises(ValueError, match="m and"):
        panda.inverse_kinematics([1.4, 0, 0])


def test_the_compliant_mount_is_two_springs_and_the_same_tip():
    rigid, soft = panda.load_scene(), panda.load_scene(peg=panda.Peg(stiffness=200, damping=8))
    assert (rigid.nq, soft.nq) == (7, 9)
    np.testing.assert_array_equal(soft.jnt_stiffness[7:], 200)
    np.testing.assert_array_equal(soft.dof_damping[7:], 8)
    data = mujoco.MjData(soft)
    data.qpos[:7] = panda.READY
    mujoco.mj_forward(soft, data)
    np.testing.assert_allclose(data.site("tip").xpos, data.site("tip_nominal").xpos, atol=1e-15)
    data.qpos[7] = 0.002
    mujoco.mj_forward(soft, data)
    offset = data.site("tip").xpos - data.site("tip_nominal").xpos
    np.testing.assert_allclose(np.linalg.norm(offset), 0.002, atol=1e-15)
    assert data.qfrc_passive[7] == pytest.approx(-0.4)


def test_bad_scenes_and_pegs_are_refused(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody>")
    with pytest.raises(ValueError, match="does not parse"):
        panda.load_scene(broken)
    broken.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="holds no peg"):
        panda.load_scene(broken)
    with pytest.raises(ValueError, match="peg"):
        panda.Peg(length=0.001)
