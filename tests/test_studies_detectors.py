"""Detectors: on signals whose answer is known, and against the analytic bound of sampled loops."""

import numpy as np
import pytest

from cmc.studies.detectors import DetectorConfig, judge
from cmc.theory.sampled import hold_lag, sampled_margin

H = 0.01
T = np.arange(200) * H
QUIET = np.zeros_like(T)


def verdict_of(x, f=QUIET):
    answer = judge(np.stack([x, f], axis=-1)[:, None], H)
    found = [name for name, flag in vars(answer).items() if flag[0]]
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
    measured = judge(np.stack([path, np.zeros_like(path)], axis=-1), H).oscillation
    margin = sampled_margin(k1, k2, tau, K, H)
    assert np.mean(measured == (margin < 0)) > 0.98
    assert 0.1 < measured.mean() < 0.9


def test_a_wrong_sign_of_the_integral_drifts():
    n = 50
    tau, K = np.full(n, 0.02), np.linspace(1.0, 20.0, n)
    path = 10.0 * simulate(0.2 / K, -0.5 / K, tau, K)
    verdict = judge(np.stack([path, np.zeros_like(path)], axis=-1), H)
    assert not verdict.oscillation.any()
    assert verdict.drift.mean() > 0.9


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
        judge(error, H)


def test_bad_thresholds_are_refused():
    with pytest.raises(ValueError, match="window"):
        DetectorConfig(window=0.0)
    with pytest.raises(ValueError, match="threshold"):
        DetectorConfig(threshold=(0.1, 0.0))
