"""Tests of a peg-touch policy: stability shares, prediction, slope signs and error histograms."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.envs.peg_touch_config import PegShift, PegTouchConfig
from cmc.studies.detectors import DetectorConfig, judge
from cmc.theory.sampled import sampled_margin

Array = NDArray[np.float64]

SHIFTS: dict[str, PegShift] = {
    "nominal": PegShift(),
    "lags x 0.5": PegShift(tau_x=0.5, tau_z=0.5),
    "lags x 1.5": PegShift(tau_x=1.5, tau_z=1.5),
    "stiffness x 2": PegShift(K_sur=2.0),
    "surface x 0.5": PegShift(surface=0.5),
    "surface x 1.5": PegShift(surface=1.5),
    "all, slow": PegShift(tau_x=1.5, tau_z=1.5, K_sur=2.0, surface=1.5),
    "all, fast": PegShift(tau_x=0.5, tau_z=0.5, K_sur=2.0, surface=1.5),
}
"""The paper's shifts of the plant, singly and jointly; the controller keeps the nominal model."""

ERROR_BINS: Array = np.logspace(-5, 2, 57)
"""Edges of the error histograms, common to x [m] and f [N]."""


@dataclass(frozen=True)
class TestConfig:
    """A test: how many trajectories, how long, from which random stream."""

    __test__ = False  # not a pytest class

    trajectories: int = 8000
    """Trajectories for each seed and checkpoint. Paper, fig:1."""
    duration: float = 2.0
    """Length of a test [s]. Our choice: four training episodes; its second half is judged."""
    seed: int = 20_231_103
    """Random stream of the tests; never used in training. Our choice."""
    detectors: DetectorConfig = field(default_factory=DetectorConfig)
    """Definitions of oscillation, drift and offset. Our choice."""
    sign_every: int = 25
    """Steps between two samples of the slopes on visited states. Our choice."""


@dataclass
class Recording:
    """What one test leaves: arrays lead with (seeds, trajectories)."""

    tail: NDArray[np.float32]
    """Errors in the judged window, (time, seeds, trajectories, 2) [m, N]."""
    mean_s: Array
    """Mean of the policy's input over that window, (seeds, trajectories, 2, 2)."""
    returns: Array
    """Sum of rewards over the first `horizon` steps, (seeds, trajectories)."""
    wrong_sign: Array | None
    """Share of visited states with a negative slope in [signal, integral], (seeds, 2)."""
    envs: PegTouchVectorEnv
    """The environment after the last step."""


def record(
    policy: nn.Module, config: PegTouchConfig, test: TestConfig, seeds: int = 1
) -> Recording:
    """Run a policy with its leading axis of `seeds` on the same trajectories for each seed."""
    num = test.trajectories
    envs = PegTouchVectorEnv(seeds * num, config, AutoresetMode.DISABLED, privileged=False)
    steps, count = round(test.duration / config.h), round(test.detectors.window / config.h)
    obs, _ = envs.reset(seed=[test.seed] * seeds)
    returns = np.zeros(seeds * num)
    tail = np.empty((count, seeds * num, 2), dtype=np.float32)
    mean_s = np.zeros((seeds, num, 4))
    wrong, sampled = np.zeros((seeds, 2)), 0
    signs = hasattr(policy, "jacobian")
    for k in range(steps):
        s = torch.as_tensor(obs).reshape(seeds, num, 4)
        with torch.no_grad():
            action = policy(s)
            if signs and k % test.sign_every == 0:
                slope = policy.jacobian(s.unflatten(-1, (2, 2)))  # type: ignore[operator]
                wrong += (slope < 0).any(dim=-2).double().mean(dim=1).numpy()
                sampled += 1
        obs, reward, *_ = envs.step(action.reshape(seeds * num, 2).numpy())
        if k < config.horizon:
            returns += reward
        if k >= steps - count:
            tail[k - steps + count] = envs.error
            mean_s += obs.reshape(seeds, num, 4) / count
    return Recording(
        tail.reshape(count, seeds, num, 2),
        mean_s.reshape(seeds, num, 2, 2),
        returns.reshape(seeds, num),
        wrong / sampled if signs else None,
        envs,
    )


def equilibrium(
    policy: nn.Module, envs: PegTouchVectorEnv, seeds: int
) -> tuple[Tensor, NDArray[np.bool_]]:
    """The input (0, I*) at which a contracting policy holds the targets, by bisection.

    pi_i(0, I) grows with I, so I* solves u0 - pi(0, I*) = (x_d, f_d / K + g(x_d)).

    Returns:
        The input (seeds, trajectories, 2, 2), and whether an equilibrium exists, (..., 2): tanh
        networks saturate, and some targets need more command than they can give.
    """
    c, x_d = envs.config, envs.sampled["x_d"]
    wanted = np.stack([x_d, envs.true_peg.height(x_d, envs.sampled["f_d"])], axis=-1)
    a = wanted - np.asarray(c.u0)
    if c.stiffness_reference is not None:
        a[:, 1] *= envs.sampled["K_sur"] / c.stiffness_reference
    target = torch.as_tensor(a.reshape(seeds, -1, 2), dtype=torch.float32)
    low, high = torch.full_like(target, -1e3), torch.full_like(target, 1e3)

    def command(integral: Tensor) -> Tensor:
        s = torch.stack([torch.zeros_like(integral), integral], dim=-1)
        return policy(s.flatten(-2))

    with torch.no_grad():
        exists = (command(low) > target) & (command(high) < target)
        for _ in range(40):
            middle = 0.5 * (low + high)
            above = command(middle) > target
            low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    middle = 0.5 * (low + high)
    return torch.stack([torch.zeros_like(middle), middle], dim=-1), exists.numpy()


def predicted_oscillation(
    policy: nn.Module, s: Tensor, envs: PegTouchVectorEnv
) -> NDArray[np.bool_]:
    """Whether the sampled loop of some dimension is unstable at the inputs `s`, (seeds, num).

    The local slopes k1, k2 go into k1 + (h/2) k2 < coth(h / (2 tau)) / K with the true tau and K.
    """
    c = envs.config
    with torch.no_grad():
        slope = policy.jacobian(s).double().numpy()  # type: ignore[operator]
    K = np.ones((envs.num_envs, 2))
    K[:, 1] = envs.true_peg.K_sur
    if c.stiffness_reference is not None:
        K[:, 1] *= c.stiffness_reference / envs.sampled["K_sur"]
    tau = np.array([c.tau_x * c.shift.tau_x, c.tau_z * c.shift.tau_z])
    K = K.reshape(*slope.shape[:2], 2)
    # only the upper side: a wrong sign drifts, it does not oscillate
    k1, k2 = np.maximum(slope[..., 0], 0.0), np.maximum(slope[..., 1], 0.0)
    return np.any(sampled_margin(k1, k2, tau, K, c.h) < 0, axis=-1)


def run_test(
    policy: nn.Module,
    config: PegTouchConfig,
    test: TestConfig,
    seeds: int,
    *,
    predict: str | None = None,
) -> dict[str, Any]:
    """Test a policy; the lists in the answer have one entry for each seed.

    Args:
        policy: maps (seeds, trajectories, 4) to actions.
        config: the task, shift included.
        test: length and number of trajectories.
        seeds: leading axis of the policy.
        predict: "weights" to predict oscillation at the equilibrium found from the weights alone,
            "visited" to do so at the mean input of the last second, None not to.
    """
    run = record(policy, config, test, seeds)
    count, _, num, _ = run.tail.shape
    verdict = judge(run.tail.reshape(count, seeds * num, 2), config.h, test.detectors)
    size = np.abs(run.tail).mean(axis=0, dtype=np.float64)
    answer: dict[str, Any] = {"return": _rounded(run.returns.mean(axis=1))}
    for name, flag in vars(verdict).items():
        answer[name] = _rounded(flag.reshape(seeds, num).mean(axis=1))
    answer["error_x"] = _rounded(np.median(size[..., 0], axis=1))
    answer["error_f"] = _rounded(np.median(size[..., 1], axis=1))
    answer["error_f_90"] = _rounded(np.quantile(size[..., 1], 0.9, axis=1))
    for index, name in enumerate("xf"):
        clipped = np.clip(size[..., index], ERROR_BINS[0], ERROR_BINS[-1])
        answer[f"histogram_{name}"] = np.histogram(clipped, ERROR_BINS)[0].tolist()
    if run.wrong_sign is not None:
        answer["wrong_sign_signal"] = _rounded(run.wrong_sign[:, 0])
        answer["wrong_sign_integral"] = _rounded(run.wrong_sign[:, 1])
    if predict is not None:
        answer |= _compare(policy, run, verdict.oscillation.reshape(seeds, num), predict)
    return answer


def _compare(
    policy: nn.Module, run: Recording, measured: NDArray[np.bool_], predict: str
) -> dict[str, Any]:
    seeds = len(measured)
    if predict == "weights":
        s, exists = equilibrium(policy, run.envs, seeds)
        predicted = predicted_oscillation(policy, s, run.envs)
        reachable = np.all(exists, axis=-1)
    else:
        s = torch.as_tensor(run.mean_s, dtype=torch.float32)
        predicted = predicted_oscillation(policy, s, run.envs)
        reachable = np.ones_like(predicted)
    return {
        "prediction": predict,
        "predicted_oscillation": _rounded(predicted.mean(axis=1)),
        "agreement": _rounded((predicted == measured).mean(axis=1)),
        "reachable": _rounded(reachable.mean(axis=1)),
    }


def shifted(config: PegTouchConfig, name: str, h: float | None = None) -> PegTouchConfig:
    """The task under one of `SHIFTS`, and with another control period if given."""
    if name not in SHIFTS:
        raise ValueError(f"unknown shift {name!r}; wanted one of {sorted(SHIFTS)}")
    return replace(config, shift=SHIFTS[name], h=config.h if h is None else h)


def _rounded(values: Any, digits: int = 6) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in np.atleast_1d(values)]
