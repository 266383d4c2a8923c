"""Peg maze: the layout blocks the straight path, a plan through it touches nothing."""

import mujoco
import numpy as np
import pytest

from cmc.envs.peg_maze import GOAL_HIGH, GOAL_LOW, JOINT, SOFT, STIFF, PegMaze
from cmc.robot import panda

DETOUR = [(0.4290, -0.0235)] * 2 + [(0.4290, -0.0295)] * 2 + [(0.4212, -0.0295)] * 2
DETOUR += [(0.4212, -0.0240)] + [(0.4212, -0.0180)] * 2 + [(0.4165, -0.0180)] * 2
DETOUR += [(0.4150, -0.0195)] * 2
"""Sub-goals (x, y) around both walls, one per 20 ticks; then the goal itself."""


def travel(config, plan, num=4):
    """Follow sub-goals with a positive proportional-integral low level; what happened."""
    task = PegMaze(config, num, seed=0)
    goal = task.reset()[:, task.layout["goal"]]
    bound = np.array(config.u_limit)
    gain = np.array([20.0] * 3 + [2.0] * 3)
    force, penetration = np.zeros(num), np.zeros(num)
    for k in range(config.ticks):
        if k % config.horizon == 0:
            i = k // config.horizon
            xyz = np.tile([*plan[i], 0.010], (num, 1)) if i < len(plan) else goal
            obs = task.set_subgoal(xyz)
        y, integral = (obs[:, task.layout[name]] for name in ("latent", "integral"))
        obs, *_, truncated, info = task.step(gain * (y + integral) / bound)
        force = np.maximum(force, info["contact_force_max"])
        penetration = np.maximum(penetration, info["penetration"])
    assert truncated.all()
    return np.linalg.norm(goal - task.worlds.tip, axis=-1), force, info["success"], penetration


@pytest.mark.parametrize(("config", "most"), [(STIFF, np.inf), (SOFT, 1.0)], ids=["stiff", "soft"])
def test_the_straight_path_is_blocked_and_a_detour_touches_nothing(config, most):
    distance, force, success, penetration = travel(config, [])
    assert not success.any()
    assert (distance > 0.010).all()  # twice the success radius
    assert (force > (0.1 if config is SOFT else 5.0)).all()
    assert (force < most).all()
    assert (penetration < 2e-4).all()  # stopped by the wall, not slowed inside it
    distance, force, success, _ = travel(config, DETOUR)
    assert success.all()
    assert (distance < 1e-3).all()
    assert (force == 0).all()


def test_goals_and_start_are_the_papers():
    task = PegMaze(STIFF, 50, seed=0)
    obs = task.reset()
    goals, tips = (obs[:, task.layout[n]] for n in ("goal", "position"))
    assert (goals >= GOAL_LOW).all()
    assert (goals <= GOAL_HIGH).all()
    assert (np.ptp(goals, axis=0) > 0.8 * (GOAL_HIGH - GOAL_LOW)).all()
    assert np.linalg.norm(tips - STIFF.start, axis=-1).max() < 3e-3
    assert np.linalg.norm(goals - tips, axis=-1).min() > 0.005  # no success at the start
    assert (task.worlds.peaks == 0).all()


def test_obstacles_reach_over_every_sub_goal():
    """No sub-goal lets the tip pass above a wall: 15 mm is the highest, walls end at 30 mm."""
    model = panda.load_scene("peg_maze.xml")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name in ("wall_a", "wall_b", "post_1", "post_2", "post_3"):
        geom = model.geom(name)
        half = geom.size[2] if name.startswith("wall") else geom.size[1]
        assert data.geom(name).xpos[2] + half == pytest.approx(0.030)
        assert data.geom(name).xpos[2] - half == pytest.approx(-0.020)
    assert STIFF.subgoal_high[2] < 0.030 - 0.01


def test_the_hood_keeps_the_peg_between_the_obstacles():
    """Joint variant: lifting is stopped by the hood, and the wrist is what it stops."""
    task = PegMaze(JOINT, 1, seed=0)
    task.reset()
    lift = panda.inverse_kinematics([0.429, -0.019, 0.07], q0=task._q_start)
    heights = {}
    for scene in ("peg_maze_hood.xml", "peg_maze.xml"):
        model = panda.load_scene(scene)
        data = mujoco.MjData(model)
        data.qpos[:] = task._q_start
        mujoco.mj_forward(model, data)
        for _ in range(1500):
            mujoco.mj_step1(model, data)
            pull = 30.0 * (lift - data.qpos) - 10.0 * data.qvel
            data.ctrl[:] = pull + data.qfrc_bias
            mujoco.mj_step2(model, data)
        heights[scene] = data.site("tip").xpos[2]
    assert heights["peg_maze.xml"] > 0.05
    assert heights["peg_maze_hood.xml"] < 0.030  # the top of the obstacles


def test_softness_is_of_the_peg_and_observed_at_its_true_tip():
    """Leaning on a wall, the compliant tip stays behind the hand; observation follows the tip."""
    task = PegMaze(SOFT, 1, seed=0)
    obs = task.set_subgoal(np.array([[0.40, -0.02, 0.008]]))
    for _ in range(100):
        obs = task.step(np.array([[-1.0, 0, 0, 0, 0, 0]]))[0]
    worlds = task.worlds
    behind = worlds.tip[0, 0] - worlds.nominal[0, 0]
    assert 2e-4 < behind < 5e-3
    np.testing.assert_array_equal(obs[0, :3], worlds.tip[0])
    spring = SOFT.peg.stiffness * behind
    assert spring == pytest.approx(np.linalg.norm(worlds.force[0]), rel=0.25)
