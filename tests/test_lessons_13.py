"""Lesson 13: its plants, its promises against simulation, its sentences against its figures."""

from __future__ import annotations

import gymnasium
import nbformat
import numpy as np
import pytest
import torch
from lesson import lesson

from cmc import store
from cmc.envs.auxiliary_space import AuxiliarySpaceVectorWrapper
from cmc.envs.plant_env import PlantVectorEnv
from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.results import tidy
from cmc.robot.two_link import TwoLinkArm
from cmc.studies import composition
from cmc.theory.certify import certify
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region
from cmc.theory.simulate import closed_loop

pytest.importorskip("stable_baselines3")
HERE = lesson("13")


def possible(plant):
    return {option.name: option.possible for option in transforms_that_fit(plant)}


def test_the_tanks_eigenvalues_cross_and_reversed_order_fits():
    plant = HERE["plant"]
    crossing = np.array([0.8, 1.8])  # h2 = 2.25 h1
    A = plant.f_y(crossing, plant.hold(crossing))
    assert np.diff(np.diagonal(A))[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(np.diagonal(plant.f_y([0.6, 1.9], [1, 1])),
                               [-0.5 / 0.6**0.5, -0.75 / 1.9**0.5])  # fmt: skip
    fits = possible(plant)
    assert not fits["own order"]
    assert not fits["eigenvectors at every state"]
    assert HERE["chosen"].name == "reversed order"


def test_the_tanks_promise_is_kept_in_simulation():
    plant, space, goal, h = HERE["plant"], HERE["space"], HERE["y_star"], 0.25
    network = PositiveNetwork(2, slope_min=[0.5, 0.1], slope_max=[2.0, 0.5])
    policy = ModularPolicy(network, u0=plant.hold(goal))
    box = Region([0.6, 0.6], [1.4, 1.4], integral=0.5)
    answer = certify(policy, plant, region=box, h=h, transforms=space, y_ref=goal)
    assert answer
    assert 0 < answer.ball < np.inf
    refused = certify(policy, plant, region=Region([0.5, 0.5], [2, 2]), h=h, y_ref=goal)
    assert not refused
    assert "reversed order" in refused.reason
    rng = np.random.default_rng(0)
    d = rng.normal(size=(12, 4))
    d *= answer.ball / np.sqrt(np.einsum("ki,ij,kj->k", d, answer.metric, d))[:, None]
    s = answer.rest + d
    path = closed_loop(plant, policy, s[:, :2], h * np.arange(40), transforms=space, y_ref=goal,
                       h=h, integral=s[:, 2:], clip=True)  # fmt: skip
    before = np.concatenate([path.y[:-1], path.integral[:-1] - h * path.z[:-1]], -1) - answer.rest
    size = np.sqrt(np.einsum("tki,ij,tkj->tk", before, answer.metric, before))
    assert (size[1:] <= size[:-1] * np.exp(-answer.rate * h) + 1e-9).all()
    assert ((path.u > 0) & (path.u < 3)).all()


def test_the_vector_wrapper_is_the_loop_that_is_certified():
    plant, space, goal, h = HERE["plant"], HERE["space"], HERE["y_star"], 0.25
    env = PlantVectorEnv(2, plant, h, target=goal, horizon=6, room=1.6, substeps=40)
    wrapped = AuxiliarySpaceVectorWrapper(env, space)
    slopes = space.signed([1.0, 1.0], [0.3, 0.3])
    start = np.array([[0.8, 1.2], [1.1, 0.9]])
    seen, _ = wrapped.reset(options={"y": start})
    path = closed_loop(plant, slopes, start, h * np.arange(7), transforms=space, y_ref=goal, h=h,
                       u0=plant.hold(goal))  # fmt: skip
    for k in range(6):
        s = seen.reshape(2, 2, 2)
        np.testing.assert_allclose(s[..., 0], path.z[k], atol=1e-5)
        np.testing.assert_allclose(s[..., 1], path.integral[k], atol=1e-5)
        seen, _, _, cut, info = wrapped.step((slopes * s).sum(-1))
    assert cut.all()
    np.testing.assert_allclose(info["final_obs"].reshape(2, 2, 2)[..., 0], path.z[6], atol=1e-5)
    fresh = seen.reshape(2, 2, 2)  # the integral starts with the first error
    np.testing.assert_allclose(fresh[..., 1], h * fresh[..., 0], rtol=1e-5)


def test_the_satellite_is_a_lightly_damped_pair_with_a_road():
    craft = HERE["craft"]
    values = np.linalg.eigvals(craft.f_y([0, 0], [0, 0]))
    np.testing.assert_allclose(sorted(values.imag), [-(0.4**0.5), 0.4**0.5])
    assert values.real.max() == pytest.approx(-0.02)
    fits = possible(craft)
    assert fits["feedback"]
    assert fits["block schur"]
    assert not fits["eigenvectors of the middle"]


def test_the_satellites_interval_is_proved_up_to_a_hold():
    every, craft, turn = HERE["Anything"]([0.8, 0.2], [1.5, 0.3]), HERE["craft"], HERE["turn"]
    held = [bool(certify(every, craft, h=h, transforms=turn)) for h in (None, 0.2, 1.0, 1.6)]
    assert held == [True, True, True, False]
    rate = certify(every, craft, h=0.2, transforms=turn).rate
    rng = np.random.default_rng(1)  # slopes that jump about in the interval, sampled
    y, integral, energy = rng.normal(size=(50, 2)), np.zeros((50, 2)), []
    M = certify(every, craft, h=0.2, transforms=turn).metric
    for _ in range(60):
        slopes = rng.choice([0.0, 1.0], (50, 2, 2)) * [0.7, 0.1] + [0.8, 0.2]
        z = y @ turn.T_y.T
        s = np.concatenate([z, integral], -1)
        energy.append(np.sqrt(np.einsum("ki,ij,kj->k", s, M, s)))
        integral = integral + 0.2 * z
        a = -(slopes * np.stack([z, integral], -1)).sum(-1)
        u = a @ turn.T_a.T
        zero = np.zeros((2, 2))
        from scipy.linalg import expm

        A, B = craft.f_y([0, 0], [0, 0]), craft.f_u([0, 0], [0, 0])
        phi = expm(0.2 * np.block([[A, B], [zero, zero]]))[:2]
        y = np.concatenate([y, u], -1) @ phi.T
    assert (np.diff(np.log(energy), axis=0) <= -0.2 * rate + 1e-9).all()


@pytest.mark.parametrize(("low", "high", "hold", "said"), [
    (0.8, 1.5, 0.2, "proved,"), (0.8, 3.0, 2.0, "not proved"), (0.2, 3.0, 0.1, "not proved"),
])  # fmt: skip
def test_the_satellites_slider(low, high, hold, said):
    out = HERE["nutate"](low, high, hold)
    assert out["text"].startswith(said)
    assert np.isfinite(out["w1"]).all()


def test_swing_is_gymnasiums_pendulum():
    swing = HERE["swing"]
    env = gymnasium.make("Pendulum-v1").unwrapped
    env.reset(seed=0)
    env.state = np.array([0.5, -1.0])
    angles, torques = swing(0.5, -1.0, steps=40)
    for angle, torque in zip(angles, torques, strict=True):
        assert env.state[0] == pytest.approx(angle, abs=1e-9)
        env.step(np.array([torque]))


def test_what_a_limit_of_two_nm_can_do():
    back = [abs(HERE["swing"](np.radians(a))[0][-20:]).max() < 0.05 for a in (15, 40, 180)]
    assert back == [True, False, False]
    free = HERE["swing"](np.radians(180.0), limit=1e9)[0]
    assert abs(free[-1]) < 0.01  # perfect without the limit
    assert "comes upright" in HERE["hold_up"](20, 2.0, 4.0)["text"]
    assert "does not come" in HERE["hold_up"](60, 2.0, 16.0)["text"]


def test_the_composite_signal_obeys_its_linear_model():
    env = HERE["Upright"](gymnasium.make("Pendulum-v1"))
    env.unwrapped.dt = h = 1e-4  # Gymnasium's own step is too long for a derivative
    env.reset(seed=0)
    env.unwrapped.state = np.array([0.2, 0.1])

    def signal():
        angle, speed = env.unwrapped.state
        return HERE["signal"]([np.cos(angle), np.sin(angle), speed])

    y, u = signal(), np.array([0.1])
    np.testing.assert_allclose(y, -(4.0 * 0.2 + 0.1))  # K1 e + K2 e' with e = -angle
    f_y, f_u = HERE["pole"].f_y(y, y)[0, 0], HERE["pole"].f_u(y, y)[0, 0]
    for _ in range(10):
        env.step(u)
        np.testing.assert_allclose((signal() - y) / h, f_y * y + f_u * u, atol=2e-3)
        y = signal()


@pytest.fixture(scope="module")
def peers():
    return tidy("own_plant")


def test_what_is_said_about_the_peers(peers):
    by = peers.groupby("method")
    mean = by["return"].mean().round(2)
    assert (mean["ppo"], mean["convex"], mean["cppo"], mean["lqr"]) == (-0.21, -0.21, -0.26, -0.30)
    assert mean["penalty"] < -1.0
    low, high = by.unstable_shifted.min(), by.unstable_shifted.max()
    assert (high["cppo"], high["lqr"]) == (0.0, 0.0)
    assert (low["convex"], high["convex"], low["ppo"], high["ppo"]) == (0.15, 0.31, 0.38, 0.49)
    certified = peers.set_index("method").certified_m
    assert (certified[["ppo", "penalty"]] == 0.0).all()
    assert (certified[["cppo", "convex", "lqr"]] == 0.5).all()
    assert by.off_shifted.mean().idxmin() == "lqr"
    assert by.off_shifted.mean()["lqr"] == 0.04
    assert (peers[["unstable"]] == 0).to_numpy().all()


def test_what_is_said_about_the_composition():
    costs = tidy("composition")
    above = costs.pivot(index="test", columns="method", values="above_percent").round(1)
    assert above.loc["pendulum"].to_dict() == {
        "hand-made": 2.1, "learned": 0.4, "learned, wide bounds": 1.8, "optimum": 0.0
    }  # fmt: skip
    assert above.loc["two-link arm"].round().tolist() == [21, 10, 14, 0]
    certified = costs.set_index("method").rate
    assert (certified[["hand-made", "learned"]] > 0.04).all()
    assert certified[["learned, wide bounds", "optimum"]].isna().all()


def test_the_prices_are_the_torques_of_the_mechanisms():
    rng = np.random.default_rng(0)
    e, e_dot, p = rng.normal(size=(3, 5, 2))
    arm = TwoLinkArm(gravity=0.0)
    q, dq = [0.3, np.pi / 2] - e, -e_dot
    wanted = (arm.inertia(q) @ p[..., None])[..., 0] + arm.bias(q, dq)
    found = composition._arm_torque(*(torch.as_tensor(x) for x in (e, e_dot, p)))
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    tau = composition._pendulum_torque(*(torch.as_tensor(x[:, :1]) for x in (e, e_dot, p)))
    np.testing.assert_allclose(15 * np.sin(-e[:, :1]) + 3 * tau.numpy(), p[:, :1])  # -e'' = p


def test_the_template_runs_outside_of_the_repository(tmp_path, monkeypatch, capsys):
    import matplotlib

    matplotlib.use("Agg")
    monkeypatch.setenv("CMC_FAST", "1")
    monkeypatch.chdir(tmp_path)
    notebook = nbformat.read(store.asset("template", "own_plant.ipynb"), as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and len(cell.source.splitlines()) <= 20 for cell in cells)
    space: dict = {"__name__": "mine"}
    for cell in cells:
        exec(compile(cell.source, cell.id, "exec"), space)
    assert space["answer"]
    assert "contracting" in capsys.readouterr().out
