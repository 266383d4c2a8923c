"""Tests of a peg-touch policy: stability shares, prediction, slope signs, certificates, motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.envs.peg_touch_config import PegShift, PegTouchConfig
from cmc.policies import ConvexGradientNetwork, ModularPolicy
from cmc.studies.detectors import DetectorConfig, judge
from cmc.studies.study import Rows
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
"""Edges of the histograms of force errors, N."""


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


def own_slopes(policy: nn.Module, s: Tensor) -> Tensor | None:
    """Slopes d pi_i / d s_ij at s (..., 2, 2), before the sign rule; None if there are none."""
    if not isinstance(policy, ModularPolicy):
        return None
    slope: Tensor = policy.jacobian(s)
    return slope


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
    for k in range(steps):
        s = torch.as_tensor(obs).reshape(seeds, num, 4)
        with torch.no_grad():
            action = policy(s)
            slope = (
                own_slopes(policy, s.unflatten(-1, (2, 2))) if k % test.sign_every == 0 else None
            )
        if slope is not None:
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
        wrong / sampled if sampled else None,
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
    found = own_slopes(policy, s)
    assert found is not None, "wanted a modular policy"
    slope = found.detach().double().numpy()
    K = np.ones((envs.num_envs, 2))
    K[:, 1] = envs.true_peg.K_sur
    if c.stiffness_reference is not None:
        K[:, 1] *= c.stiffness_reference / envs.sampled["K_sur"]
    tau = np.array([c.tau_x * c.shift.tau_x, c.tau_z * c.shift.tau_z])
    K = K.reshape(*slope.shape[:2], 2)
    # only the upper side: a wrong sign drifts, it does not oscillate
    k1, k2 = np.maximum(slope[..., 0], 0.0), np.maximum(slope[..., 1], 0.0)
    return np.any(sampled_margin(k1, k2, tau, K, c.h) < 0, axis=-1)


def measure(
    policy: nn.Module, config: PegTouchConfig, test: TestConfig, seeds: int
) -> dict[str, Rows]:
    """Test a policy; the columns of `cmc.results`.

    Where the policy has slopes, oscillation is predicted: at the equilibrium found from the weights
    alone if they guarantee signs and see the integral, else at the mean input of the last second.

    Args:
        policy: maps (seeds, trajectories, 4) to actions.
        config: the task, shift included.
        test: length and number of trajectories.
        seeds: leading axis of the policy.
    """
    run = record(policy, config, test, seeds)
    count, _, num, _ = run.tail.shape
    verdict = judge(run.tail.reshape(count, seeds * num, 2), config.h, test.detectors)
    size = np.abs(run.tail).mean(axis=0, dtype=np.float64)
    found: dict[str, Array] = {"return": run.returns.mean(axis=1)}
    for name, flag in vars(verdict).items():
        found[name] = flag.reshape(seeds, num).mean(axis=1)
    found["error_x"] = np.median(size[..., 0], axis=1)
    found["error_f"] = np.median(size[..., 1], axis=1)
    found["error_f_90"] = np.quantile(size[..., 1], 0.9, axis=1)
    more: dict[str, Any] = {"trajectories": num, "h": config.h}
    if run.wrong_sign is not None:
        found["wrong_sign_signal"], found["wrong_sign_integral"] = run.wrong_sign.T
        flags = verdict.oscillation.reshape(seeds, num)
        more["prediction"], predicted = _prediction(policy, run, flags)
        found |= predicted
    rows = [{"seed": k, **more, **{name: v[k] for name, v in found.items()}} for k in range(seeds)]
    counts, _ = np.histogram(np.clip(size[..., 1], ERROR_BINS[0], ERROR_BINS[-1]), ERROR_BINS)
    bins = zip(ERROR_BINS, ERROR_BINS[1:], counts, strict=False)
    return {
        "tests": rows,
        "histograms": [{"low_N": a, "high_N": b, "count": int(c)} for a, b, c in bins if c],
    }


def signed(policy: nn.Module) -> bool:
    """Whether the weights guarantee the sign of every slope, each dimension on its own."""
    network = getattr(policy, "network", None)
    return hasattr(network, "slope_bounds") and not isinstance(network, ConvexGradientNetwork)


def _prediction(
    policy: nn.Module, run: Recording, measured: NDArray[np.bool_]
) -> tuple[str, dict[str, Array]]:
    seeds = len(measured)
    from_weights = signed(policy) and bool(policy.integral)
    if from_weights:
        s, exists = equilibrium(policy, run.envs, seeds)
        reachable = np.all(exists, axis=-1)
    else:
        s = torch.as_tensor(run.mean_s, dtype=torch.float32)
        reachable = np.ones(measured.shape)
    predicted = predicted_oscillation(policy, s, run.envs)
    return "weights" if from_weights else "visited", {
        "predicted_oscillation": predicted.mean(axis=1),
        "agreement": (predicted == measured).mean(axis=1),
        "reachable": reachable.mean(axis=1),
    }


def shifted(config: PegTouchConfig, name: str, h: float | None = None) -> PegTouchConfig:
    """The task under one of `SHIFTS`, and with another control period if given."""
    if name not in SHIFTS:
        raise ValueError(f"unknown shift {name!r}; wanted one of {sorted(SHIFTS)}")
    return replace(config, shift=SHIFTS[name], h=config.h if h is None else h)


def simulate(
    policy: nn.Module,
    config: PegTouchConfig,
    *,
    num: int = 50,
    duration: float = 1.0,
    seed: int = 0,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Run a policy without exploration noise.

    Args:
        policy: maps (num, 4), or (1, num, 4), to actions.
        config: the task.
        num: trajectories.
        duration: length [s].
        seed: random stream of starts and targets.
        parameters: values to fix, see `PegTouchVectorEnv`.

    Returns:
        `t` (time,), and by time and trajectory `x`, `z`, `f`, `e_x`, `e_f`, `u_x`, `u_z`,
        `reward`; `return`, the sum of rewards over the first `horizon` steps, (num,); and
        `sampled`, the values drawn.
    """
    envs = PegTouchVectorEnv(num, config, AutoresetMode.DISABLED)
    obs, _ = envs.reset(seed=seed, options={"parameters": dict(parameters or {})})
    rows: list[list[np.ndarray]] = []
    for _ in range(round(duration / config.h)):
        now = [*envs.position.T, envs.force, *envs.error.T]
        with torch.no_grad():
            action = policy(torch.as_tensor(obs)[None])[0].numpy()
        obs, reward, *_ = envs.step(action)
        rows.append([*now, *envs.command.T, reward])
    names = ("x", "z", "f", "e_x", "e_f", "u_x", "u_z", "reward")
    columns = (np.array(column) for column in zip(*rows, strict=True))
    recorded: dict[str, Any] = dict(zip(names, columns, strict=True))
    recorded["t"] = config.h * np.arange(len(rows))
    recorded["return"] = recorded["reward"][: config.horizon].sum(axis=0)
    return {**recorded, "sampled": envs.sampled}
