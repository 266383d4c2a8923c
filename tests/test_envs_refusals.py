"""Bad input at every door of environments and robot: a sentence that names the argument."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from cmc import plants
from cmc.envs.auxiliary_space import AuxiliarySpaceVectorWrapper, AuxiliarySpaceWrapper
from cmc.envs.peg_maze import JOINT, SOFT, STIFF, PegMaze, PegMazeEnv, PegMazeVectorEnv
from cmc.envs.peg_push import PUSH, PegPush
from cmc.envs.peg_touch import PegShift, PegTouchConfig, PegTouchVectorEnv
from cmc.envs.plant_env import PlantEnv, PlantVectorEnv
from cmc.robot.osc import ControlLaw, Gains
from cmc.robot.panda import Peg, inverse_kinematics, load_scene
from cmc.robot.two_link import TwoLinkArm, simulate

LAGS = plants.get("coupled_lags")
SPACE = LAGS.space(np.zeros(2), np.zeros(2))
TIP, ARM, G = [0.42, -0.02, 0.01], TwoLinkArm(), [0.3, 0.8]
PLAIN = {"kp_trans": 40, "kd_trans": 20, "kp_rot": 20, "kd_rot": 10}
NAN, NONE = float("nan"), [None, "x", float("nan")]


def wrapped(**changes):
    model = {"model": lambda y: (LAGS.f_y(y, y), LAGS.f_u(y, y))}
    settings = {"error": lambda y: y, "h": 0.02, **model, **changes}
    env = AuxiliarySpaceWrapper(settings.pop("env", None) or PlantEnv(), **settings)
    env.reset(seed=0)
    return env


def vector(**changes):
    env, space = changes.pop("env", None) or PlantVectorEnv(2), changes.pop("transforms", SPACE)
    return AuxiliarySpaceVectorWrapper(env, space, **changes)


DOORS = {  # what is built or called with one bad argument; argument to bad values
    Peg: {n: [*NONE, -1.0, [1, 2]] for n in ("length", "radius", "stiffness", "damping", "mass")},
    load_scene: {"timestep": [*NONE, 0, 0.02], "history": [*NONE, -1, 2.5], "scene": [3, "nope"]},
    (lambda position=TIP, **k: inverse_kinematics(position, **k)): {
        "position": [*NONE, [0.4, 0.0], [NAN, 0, 0]],
        "quat": [*NONE, [0, 0, 0, 0]],
        "q0": [*NONE, [0.3] * 6],
        "tolerance": [*NONE, -1],
    },
    (lambda **k: Gains(**{**PLAIN, **k})): {n: [*NONE, -1.0] for n in PLAIN},
    ControlLaw: {
        "form": ["velocity"],
        "split": [3],
        "error_limit": ["x", NAN, -1.0],
        "posture": [*NONE, (0.0, 1.0)],
        "pivot_floor": [*NONE, 0],
    },
    TwoLinkArm: {n: [*NONE, (0.4, -1), (1.0,)] for n in ("lengths", "masses")},
    (lambda q=G, dq=G, tau=G: ARM.acceleration(q, dq, tau)): {
        n: [None, "x", 0.3, [0.3] * 3] for n in ("q", "dq", "tau")
    },
    (lambda times=(0, 1), law=lambda *a: G: simulate(ARM, law, G, G, times)): {
        "times": [*NONE, [1, 0]],
        "law": [3, lambda *a: NAN],
    },
    PegShift: {"tau_z": [*NONE, -1.0]},
    PegTouchConfig: {
        **{
            n: [*NONE, [31.0, NAN], [31, 1, 2]] for n in ("K_sur", "u0", "weight_x", "horizon", "h")
        },
        **{"tau_x": [0.0], "x_d": [(3.0, 1.0)], "interface": ["latent"], "shift": [{}]},
    },
    (lambda **k: PegMaze(replace(STIFF, **k))): {
        **{"timestep": [0.003, NAN], "u_limit": [(1.0,), (-1.0,) * 6], "ticks": [2.5, *NONE]},
        **{"command": ["torque"], "gains": [None], "subgoal_low": [(1.0,) * 3, (1.0,)]},
        **{"scene": ["nope"], "hold": ["x"], "tilt_limit": [*NONE, -1.0], "start": [*NONE, (1,)]},
    },
    PegMazeEnv: {"regime": ["hard"], "action_mode": ["fast"], "low_level": ["x", lambda y, i: y]},
    PegMazeVectorEnv: {"num_envs": [*NONE, 0], "autoreset_mode": ["never"]},
    PlantVectorEnv: {
        **{n: [*NONE, 0, -1] for n in ("num_envs", "h", "horizon", "substeps", "room")},
        **{"target": ["x", [1.0]], "plant": [3], "reward": [3]},
    },
    wrapped: {
        **{
            "h": [*NONE, 0.0],
            "u0": [*NONE, [1, 2, 3]],
            "limit": [*NONE, 0],
            "env": [gym.make("CartPole-v1")],
        },
        **{"error": [3, lambda y: NAN, lambda y: [1, 2, 3]], "model": [3, lambda y: NAN, None]},
    },
    vector: {"env": [PlantEnv()], "transforms": [3, None], "u0": ["x", [1, 2, 3]]},
}
EACH = [
    (door, n, bad) for door, names in DOORS.items() for n, all_ in names.items() for bad in all_
]


@pytest.mark.parametrize(("door", "name", "bad"), EACH)
def test_a_bad_argument_is_refused_by_name(door, name, bad):
    said = rf"\b({name.replace('num_envs', 'num_envs|worlds')})\b"
    with pytest.raises((ValueError, TypeError), match=said):
        door(**{name: bad})


def test_gains_without_a_composite_variable_are_refused():
    with pytest.raises(ValueError, match="4"):
        Gains(kp_trans=40, kd_trans=10, kp_rot=20, kd_rot=10)
    with pytest.raises(ValueError, match="split"):
        ControlLaw("acceleration", split=True)


ENVS = {
    "touch": (lambda: PegTouchVectorEnv(2), (2, 2)),
    "plant": (lambda: PlantVectorEnv(2), (2, 2)),
    "auxiliary": (vector, (2, 2)),
    "one": (
        lambda: AuxiliarySpaceWrapper(PlantEnv(), error=lambda y: y, transforms=SPACE, h=1),
        (2,),
    ),
    "maze": (lambda: PegMazeVectorEnv(2), (2, 9)),
    "low": (lambda: PegMazeVectorEnv(2, action_mode="low"), (2, 6)),
    "high": (lambda: PegMazeEnv(action_mode="high"), (3,)),
}


@pytest.mark.parametrize("name", ENVS)
def test_bad_steps_and_resets_are_refused_and_change_nothing(name):
    make, shape = ENVS[name]
    env, twin, zero = make(), make(), np.zeros(shape)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(zero)
    for e in (env, twin):
        e.reset(seed=0)
    for bad in (None, "x", zero + np.nan, zero - np.inf, zero[..., 1:], zero + 1j, [[1], [1, 2]]):
        with pytest.raises((ValueError, TypeError), match="action"):
            env.step(bad)
    for more in ({"seed": -1}, {"seed": "x"}, {"options": {"reset_mask": np.ones(3)}}):
        with pytest.raises((ValueError, TypeError, gym.error.Error), match=r"[Ss]eed|reset_mask"):
            env.reset(**more)
    np.testing.assert_array_equal(env.step(zero)[0], twin.step(zero)[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"K_surf": 1.0}, "K_surf"),
        ({"K_sur": np.inf}, "K_sur needs finite"),
        ({"K_sur": -1.0}, "K_sur needs positive"),
        ({"x_d": [1.0, 2.0, 3.0]}, "x_d needs shape"),
    ],
)
def test_bad_parameters_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        PegTouchVectorEnv(2).reset(options={"parameters": options})
    with pytest.raises(ValueError, match="divides 2"):
        PegTouchVectorEnv(2).reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    "config", [STIFF, SOFT, JOINT, PUSH], ids=["stiff", "soft", "joint", "push"]
)
def test_bad_calls_leave_the_worlds_alone(config):
    task = (PegPush if config is PUSH else PegMaze)(config, 2, seed=0)
    low, high, before = config.low_size, config.high_size, task.snapshot()["physics"]
    for bad in (np.zeros(low), np.zeros((2, low + 1)), np.full((2, low), np.nan)):
        with pytest.raises(ValueError, match="low-level action needs"):
            task.step(bad)
    for bad in (np.zeros((1, high)), np.full((2, high), np.inf)):
        with pytest.raises(ValueError, match="high-level action needs"):
            task.set_subgoal(bad)
    calls = {"mask": lambda: task.reset(np.array([True])), "seed": lambda: task.seed([1])}
    calls["push needs shape"] = lambda: task.worlds.push(np.zeros(3))
    calls["push needs finite"] = lambda: task.worlds.push(np.full((2, 3), np.nan))
    calls["snapshot"] = lambda: task.restore({})
    for message, call in calls.items():
        with pytest.raises((ValueError, TypeError), match=message):
            call()
    np.testing.assert_array_equal(task.snapshot()["physics"], before)
