"""The peg-touch study: policies, caps and certificates, predictions against measurements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cmc import studies
from cmc.studies.evaluation import evaluate
from cmc.studies.peg_touch import METHODS, STUDY, change
from cmc.studies.peg_touch_tests import SHIFTS, detect, equilibrium, measure, record
from cmc.studies.runner import load, train
from cmc.theory.sampled import hold_lag, sampled_margin

TRAINED = [name for name, method in METHODS.items() if method.trained]
CAPS = studies.get("peg_touch_caps")


def untrained(study, name, seeds):
    return study.build(name, seeds).acting()


@pytest.mark.parametrize("name", TRAINED)
def test_every_method_trains_and_one_seed_acts_as_among_others(name: str, tmp_path: Path) -> None:
    path = train(STUDY, name, [0, 1], length=16, out=tmp_path)
    both, obs = load(STUDY, name, path=path).policy, torch.randn(2, 9, 4)
    for seed in range(2):
        alone = load(STUDY, name, seed=seed, path=path).policy
        torch.testing.assert_close(alone(obs[seed : seed + 1])[0], both(obs)[seed])
    assert not torch.equal(untrained(STUDY, name, [0, 1])(obs), both(obs))


def test_one_seed_is_tested_like_all_of_them(tmp_path: Path) -> None:
    path = train(STUDY, "cppo_bounded", [3, 5], length=32, out=tmp_path)
    task = STUDY.config_of("cppo_bounded").task
    both = record(load(STUDY, "cppo_bounded", path=path).policy, task, 64, 2)
    for seed in range(2):
        policy = load(STUDY, "cppo_bounded", seed=seed, path=path).policy
        alone = record(policy, task, 64)
        np.testing.assert_allclose(alone.returns[0], both.returns[seed], rtol=1e-4)


@pytest.mark.parametrize("name", ["pi", "pi_scaled"])
@pytest.mark.parametrize("shift", list(SHIFTS))
def test_prediction_meets_measurement_for_known_gains(name: str, shift: str) -> None:
    config = change(shift)(STUDY.config_of(name))
    found = measure(untrained(STUDY, name, [0]), config.task, 500, 1)
    (row,) = found["tests"]
    assert row["prediction"] == "weights"
    assert row["agreement"] >= 0.98
    assert row["drift"] == 0.0
    assert sum(bin_["count"] for bin_ in found["histograms"]) == 500
    if name == "pi_scaled":
        assert row["oscillation"] == 0.0


def test_the_equilibrium_of_fixed_gains_is_the_one_on_paper() -> None:
    policy, task = untrained(STUDY, "pi", [0]), STUDY.config.task
    envs = record(policy, task, 64).envs
    s, exists = equilibrium(policy, envs, 1)
    assert exists.all()
    gains = policy.network.gains.numpy()
    z_d = envs.sampled["f_d"] / envs.sampled["K_sur"] + envs.true_peg.surface(envs.sampled["x_d"])
    np.testing.assert_allclose(s[0, :, 0, 1], (2.0 - envs.sampled["x_d"]) / gains[0, 1], atol=1e-4)
    np.testing.assert_allclose(s[0, :, 1, 1], (-0.5 - z_d) / gains[1, 1], atol=1e-4)


# -- caps: whatever the weights, the sampled loop of the worst plant of the design is stable --

CAPPED = [
    *((STUDY, name) for name in ("cppo_capped", "cppo_bypass", "cppo_scaled", "cppo_bounded")),
    *((CAPS, name) for name in CAPS.methods if not name.startswith("none")),
]


def worst_margin(config, slope):
    """Margin of the sampled-data bound for half the lags and twice the stiffest surface."""
    task = config.task
    stiffest = task.stiffness_reference or task.K_sur[1]
    tau, K = 0.5 * np.array([task.tau_x, task.tau_z]), np.array([1.0, 2.0 * stiffest])
    return sampled_margin(slope[..., 0], np.maximum(slope[..., 1], 1e-9), tau, K, task.h)


@pytest.mark.parametrize(("study", "name"), CAPPED, ids=lambda x: getattr(x, "name", x))
def test_the_worst_sampled_loop_is_stable_for_any_weights(study, name: str) -> None:
    policy, config = untrained(study, name, [0, 1]), study.config_of(name)
    for scale in (0.3, 3.0, 30.0):
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.copy_(scale * torch.randn(parameter.shape))
            s = torch.randn(2, 500, 2, 2) * torch.tensor([1.0, 0.1])
            s[:, 0] = 0.0
            slope = policy.jacobian(s).double().numpy()
        assert (worst_margin(config, slope) >= 0).all()
        high = policy.slope_bounds()[1]
        assert (worst_margin(config, high) > 0).all()
        assert (slope.max(axis=1) <= high * (1 + 1e-4)).all()


def test_without_a_cap_some_weights_are_unstable() -> None:
    policy = untrained(CAPS, "none", [0])
    slope = policy.jacobian(torch.zeros(1, 1, 2, 2)).detach().double().numpy()
    assert (worst_margin(CAPS.config, slope) < 0).any()


# -- tables ----------------------------------------------------------------------------------


def test_tables_say_what_was_tested(tmp_path: Path) -> None:
    study = replace(STUDY, every=16)
    train(study, "cppo_capped", [0, 1], length=32, out=tmp_path)
    options = {"trajectories": 32, "folder": tmp_path / "kept", "checkpoints": tmp_path}
    tables = evaluate(study, ["cppo_capped", "pi"], **options)
    rows = [row for row in tables["tests"] if row["method"] == "cppo_capped"]
    assert {(row["episode"], row["test"]) for row in rows if row["h"] == 0.01} == {
        (mark, shift) for mark in (16, 32) for shift in SHIFTS
    }
    assert {row["h"] for row in rows} == {0.002, 0.005, 0.01, 0.02, 0.03}
    assert {row["seed"] for row in rows} == {0, 1}
    fixed = [row for row in tables["tests"] if row["method"] == "pi"]
    assert {(row["episode"], row["seed"], row["last"]) for row in fixed} == {(0, 0, True)}
    certified = [row for row in tables["certificates"] if row["method"] == "cppo_capped"]
    marks = [(row["episode"], row["seed"]) for row in certified]
    assert marks == [(16, 0), (16, 1), (32, 0), (32, 1)]
    assert all(row["signs"] and row["design"] for row in certified)
    assert {row["episode"] for row in tables["histograms"]} == {32, 0}


def test_another_control_period_keeps_durations() -> None:
    slow, fast = STUDY.config, studies.get("peg_touch_2ms").config
    assert fast.task.h * fast.task.horizon == pytest.approx(slow.task.h * slow.task.horizon)
    assert fast.ppo.steps == fast.task.horizon
    assert fast.ppo.gamma**fast.task.horizon == pytest.approx(slow.ppo.gamma**slow.task.horizon)


# -- detectors: on signals whose answer is known, and against the bound of sampled loops -----------

H = 0.01
T = np.arange(200) * H
QUIET = np.zeros_like(T)


def verdict_of(x, f=QUIET):
    answer = detect(np.stack([x, f], axis=-1)[:, None], H)
    found = [name for name, flag in answer.items() if flag[0]]
    assert len(found) <= 1
    return found[0] if found else "converged"


@pytest.mark.parametrize(
    ("x", "f", "wanted"),
    [
        (QUIET, QUIET, "converged"),
        (np.exp(-T / 0.05), 2 * np.exp(-T / 0.1), "converged"),
        (0.1 * np.sin(30 * T), QUIET, "oscillation"),
        (0.005 * np.sin(30 * T), QUIET, "converged"),
        (np.exp(-5 * T) * np.sin(30 * T), QUIET, "converged"),
        (QUIET, 0.3 * np.sin(40 * T), "oscillation"),
        (0.1 * T, QUIET, "drift"),
        (0.5 - 0.1 * T, QUIET, "offset"),
        (QUIET, 0.5 + QUIET, "offset"),
        (0.1 * T, 0.3 * np.sin(40 * T), "oscillation"),
        (QUIET, np.where(np.arange(200) % 2 == 0, 0.2, -0.2), "oscillation"),
    ],
)
def test_signals_with_a_known_answer(x, f, wanted):
    assert verdict_of(x, f) == wanted


def simulate(k1, k2, tau, K, steps=300):
    """Sampled loops e_{k+1} = phi e_k - G (k1 e_k + k2 I_k), clipped as an actuator would."""
    phi, G = hold_lag(-1 / tau, K / tau, H)
    e, integral = np.ones_like(K), np.zeros_like(K)
    path = []
    for _ in range(steps):
        path.append(e)
        integral = integral + H * e
        e = phi * e + G * np.clip(-(k1 * e + k2 * integral), -3.0, 3.0)
    return np.array(path)


def test_oscillation_agrees_with_the_sampled_bound():
    rng = np.random.default_rng(0)
    n = 20_000
    tau, K = rng.uniform(0.005, 0.05, n), rng.uniform(1.0, 60.0, n)
    k1 = rng.uniform(0.2, 2.0, n) / (np.tanh(H / (2 * tau)) * K)
    k2 = rng.uniform(0.2, 0.5, n) / (K * tau)  # quick enough to settle within the test
    path = simulate(k1, k2, tau, K)
    measured = detect(np.stack([path, np.zeros_like(path)], axis=-1), H)["oscillation"]
    margin = sampled_margin(k1, k2, tau, K, H)
    assert np.mean(measured == (margin < 0)) > 0.98
    assert 0.1 < measured.mean() < 0.9


def test_a_wrong_sign_of_the_integral_drifts():
    n = 50
    tau, K = np.full(n, 0.02), np.linspace(1.0, 20.0, n)
    path = 10.0 * simulate(0.2 / K, -0.5 / K, tau, K)
    verdict = detect(np.stack([path, np.zeros_like(path)], axis=-1), H)
    assert not verdict["oscillation"].any()
    assert verdict["drift"].mean() > 0.9


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (np.zeros((50, 1, 2)), "no shorter"),
        (np.zeros((200, 1, 3)), "wanted"),
        (np.full((200, 1, 2), np.nan), "finite"),
    ],
)
def test_bad_records_are_refused(error, message):
    with pytest.raises(ValueError, match=message):
        detect(error, H)
