"""Peg push: the table's geometry, a plan that solves it, and cheats that do not."""

import mujoco
import numpy as np
import pytest

from cmc.envs.peg_push import BOX_TOP, PUSH, TARGET, PegPush
from cmc.robot import panda

MM = 1e-3
PLAN = np.array([(9.5, 4), (9.5, -3), (-5.1, -3), (3, -3), (3, -12.5), (0, -12.5)]) * MM
"""Tip (y, z) from the box's top: beside the lid, down, push it, enter, push, touch."""


def move(task, aim, u, ticks, below=np.inf):
    """Sub-goal increments towards `aim` (from the box's top) under a constant action.

    Stops when the tip rises above `below`.
    """
    deepest, force, num = 0.0, 0.0, task.num
    for k in range(ticks):
        if task.worlds.tip[0, 2] - BOX_TOP[2] > below:
            break
        if k % 20 == 0:
            step = aim - (task.worlds.tip - BOX_TOP)
            task.set_subgoal(np.hstack([step, np.zeros((num, 3))]))
        info = task.step(np.tile(u, (num, 1)))[4]
        deepest = max(deepest, info["penetration"].max())
        force = max(force, info["contact_force_max"].max())
    return deepest, force, info["success"].any()


def place(start, lid, obstacle=(0.0, 0.0)):
    """A world with the tip at `start` from the box's top and the sliders as given."""
    task = PegPush(PUSH, 1, seed=0)
    tool = panda.FINGERTIP + 0.02
    q = panda.inverse_kinematics(BOX_TOP + start, tool=tool, q0=task._q_start)
    task.worlds.reset(np.hstack([q, lid, obstacle])[None], np.array([True]))
    return task


def test_the_scripted_plan_solves_the_task_through_the_controller():
    num = 4
    task = PegPush(PUSH, num, seed=0)
    task.reset()
    stage, total, deepest = np.zeros(num, dtype=int), np.zeros(num), 0.0
    for k in range(PUSH.ticks):
        if k % PUSH.horizon == 0:
            tip = task.worlds.tip - BOX_TOP
            near = np.abs(tip[:, 1:] - PLAN[stage]).max(-1) < 0.7 * MM
            stage = np.minimum(stage + near, len(PLAN) - 1)
            step = np.column_stack([-tip[:, 0], PLAN[stage] - tip[:, 1:]])
            obs = task.set_subgoal(np.hstack([step, -task.worlds.rotation]))
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        obs, reward, _, truncated, info = task.step(np.tanh(2.0 * (y + integral)))
        total += reward
        deepest = max(deepest, info["penetration"].max())
    assert truncated.all()
    assert info["success"].all()
    assert (total > -400).all()
    assert deepest < 0.1 * MM
    np.testing.assert_allclose(task.worlds.tip, np.tile(TARGET, (num, 1)), atol=0.3 * MM)


def test_without_a_low_level_action_the_same_plan_is_too_slow():
    """The paper's gains cover a fifth of a sub-goal in 20 ticks: TD3/Control is handicapped."""
    task = PegPush(PUSH, 1, seed=0)
    task.reset()
    start = task.worlds.tip.copy()
    task.set_subgoal(np.array([[0.005, 0, 0, 0, 0, 0]]))
    for _ in range(20):
        task.step(np.zeros((1, 6)))
    covered = (task.worlds.tip - start)[0, 0] / 0.005
    assert covered == pytest.approx(0.22, abs=0.02)


IN, TOP = -11.9 * MM, -10.98  # the lid pushed in; the tip just above the obstacle, mm
CHEATS = [((x, 0, TOP), (IN,), (0, 0, -1), 100, 5.0) for x in (0.0, 0.3, -0.3, 0.9)]
# Beside the obstacle there is room for less than the peg: it stays out or climbs over it.
CHEATS += [((0.83, 0, -12), (IN, (-0.98 * MM, 0.0)), (-1, 0, z), 100, 1.0) for z in (0, -1)]
CHEATS += [((0, 0, 0.02), (0.0,), (0, 0, -1), 40, 5.0)]  # on the closed lid


@pytest.mark.parametrize(("start", "sliders", "u", "ticks", "least"), CHEATS)
def test_pressing_and_squeezing_do_not_solve_the_task(start, sliders, u, ticks, least):
    """Full force through obstacle or lid, or past it: 0.1 mm at most, and no touch."""
    task, below = place(np.array(start) * MM, *sliders), -11 * MM if u[0] else np.inf
    deepest, force, success = move(task, TARGET - BOX_TOP, [*u, 0, 0, 0], ticks, below)
    assert force > least
    assert deepest < 0.1 * MM
    assert not success
    if start[2] == TOP:
        assert np.abs(task.worlds.qpos[0, 8:]).max() < 1.1 * MM  # stood on, or stepped off


def test_an_impact_at_full_speed_penetrates_an_eighth_of_a_millimetre_at_most():
    """Contact parameters are the paper's: penetration grows with speed, not with force."""
    task = place(np.array([0, 0, -8.0]) * MM, lid=IN)
    deepest, _, success = move(task, TARGET - BOX_TOP, [0, 0, -1, 0, 0, 0], 100)
    assert deepest < 0.125 * MM
    assert not success


def test_geometry_is_the_tables():
    model = panda.load_scene("peg_push.xml", panda.Peg(length=0.02))
    size = {n: 2 * model.geom(n).size for n in ("lid", "obstacle", "base")}
    np.testing.assert_allclose(size["lid"], [36 * MM, 12 * MM, 4 * MM], atol=0.11 * MM)
    np.testing.assert_allclose(size["obstacle"], [2 * MM] * 3)
    np.testing.assert_allclose(size["base"][:2], [36 * MM] * 2)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)

    def faces(name, axis):
        half = model.geom(name).size[axis]
        centre = data.geom(name).xpos[axis] - BOX_TOP[axis]
        return centre - half, centre + half

    assert faces("side_right", 0)[0] - faces("side_left", 0)[1] == pytest.approx(4 * MM)
    assert faces("end_front", 1)[0] - faces("end_back", 1)[1] == pytest.approx(12 * MM)
    assert faces("base", 2) == pytest.approx((-20 * MM, -13 * MM))
    assert faces("side_left", 2)[1] == pytest.approx(-4 * MM)
    assert faces("obstacle", 2) == pytest.approx((-13 * MM, -11 * MM))
    assert model.body("lid").mass == pytest.approx(0.5)
    assert model.body("obstacle").mass == pytest.approx(0.5)
    assert model.geom("peg").size[0] == pytest.approx(0.8 * MM)
    np.testing.assert_allclose(TARGET - BOX_TOP, [0, 0, -12.5 * MM])
    np.testing.assert_allclose(model.jnt_range[7], [-12 * MM, 6 * MM])
    np.testing.assert_allclose(model.geom("peg").solref, [0.01, 1])
    np.testing.assert_allclose(model.geom("peg").solimp[:3], [0.9, 0.95, 0.001])


def test_starts_fill_the_papers_cube_without_contact():
    task = PegPush(PUSH, 60, seed=0)
    tips = (task.reset()[:, :3] - BOX_TOP) / MM
    assert (np.abs(tips - [0, 11.5, 4.5]) <= 4 + 1e-6).all()
    assert (np.ptp(tips, axis=0) > 6).all()
    for _ in range(2):
        info = task.step(np.zeros((60, 6)))[4]
    assert (info["contact_force_max"] == 0).all()
    assert not info["success"].any()
    np.testing.assert_allclose(task.worlds.rotation, 0, atol=1e-6)


def test_standing_on_the_obstacle_is_no_success():
    """Strict touch asks for depth: the obstacle's top is 1.5 mm above the target."""
    task = place(np.array([0, 0, TOP]) * MM, IN)
    assert not task.step(np.zeros((1, 6)))[4]["success"].any()
    task = place(np.array([0, 0, -12.5]) * MM, IN, (0.0, -2.0 * MM))
    assert task.step(np.zeros((1, 6)))[4]["success"].all()


def test_the_logged_force_is_what_the_world_does_to_the_peg():
    """Pressed down on the lid, the peg is pushed up, in one world and in many alike."""
    one = place(np.array([0.0, 0.0, 0.003]), 0.0)
    many = PegPush(PUSH, 2, seed=0)
    many.worlds.reset(np.repeat(one.worlds.qpos, 2, axis=0), np.array([True, True]))
    for task in (one, many):
        for k in range(30):
            if k % PUSH.horizon == 0:
                task.set_subgoal(np.tile([0, 0, -0.005, 0, 0, 0], (task.num, 1)))
            task.step(np.tile([0, 0, -1.0, 0, 0, 0], (task.num, 1)))
        assert (task.worlds.force[:, 2] > 1.0).all()
