"""Lesson 09: PPO against C-PPO on peg touch, from live training to the paper's claims."""

from __future__ import annotations

import difflib
import inspect
import textwrap
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.fast import budget
from cmc.learning.ppo import PPO
from cmc.policies import IndependentNetwork, PositiveNetwork
from cmc.studies import peg_touch
from cmc.studies.detectors import judge
from cmc.studies.peg_touch_evaluation import equilibrium, predicted_oscillation, record
from cmc.theory.sampled import largest_slope

Array = NDArray[np.float64]
Show = Callable[[int, float, float], object]
TITLES = {"ppo": "PPO", "cppo": "C-PPO", "cppo_capped": "C-PPO, capped"}


def live_training(
    show: Show | None = None, seeds: Sequence[int] = (0, 1, 2), episodes: int | None = None
) -> dict[str, Any]:
    """Train PPO and C-PPO side by side, update by update.

    Args:
        show: called now and then with the episode and both returns, averaged over seeds.
        seeds: one training each.
        episodes: of each seed; 2500, or 320 in fast mode.

    Returns:
        `episode` (U,), and by method the returns (seeds, U) and under `policies` the policy.
    """
    study = peg_touch.PegTouchStudy()
    size = study.episodes_per_update
    count = (budget(2500, 320) if episodes is None else episodes) // size
    policies = {name: peg_touch.build(name, seeds, study) for name in ("ppo", "cppo")}
    trainers = {
        name: PPO(PegTouchVectorEnv(len(seeds) * size, study.task), policy, seeds, study.ppo)
        for name, policy in policies.items()
    }
    returns: dict[str, list[Array]] = {name: [] for name in trainers}
    for update in range(count):
        for name, trainer in trainers.items():
            returns[name].append(trainer.update()["episode_return"])
        if show is not None and (update % 5 == 4 or update == count - 1):
            last = [float(np.mean(returns[name][-5:])) for name in ("ppo", "cppo")]
            show((update + 1) * size, *last)
    curves = {name: np.array(rows).T for name, rows in returns.items()}
    return {"episode": size * np.arange(1, count + 1), **curves, "policies": policies}


def _diff(first: Callable[..., Any], second: Callable[..., Any]) -> list[str]:
    """Lines of the two bodies that differ, marked - and +."""
    bodies = []
    for function in (first, second):
        text = textwrap.dedent(inspect.getsource(function)).split('"""')[-1]
        bodies.append([line for line in text.splitlines() if line and not line.startswith("def")])
    lines = difflib.ndiff(bodies[0], bodies[1])
    return [line.rstrip() for line in lines if line[0] in "-+"]


def difference() -> str:
    """What separates PPO (-) from C-PPO (+): the policy that is built, and its forward pass."""
    built = _diff(peg_touch.METHODS["ppo"].build, peg_touch.METHODS["cppo"].build)
    passed = _diff(IndependentNetwork.forward, PositiveNetwork.forward)
    weights = [
        "    " + line.strip()
        for line in inspect.getsource(PositiveNetwork.positive_weights).splitlines()
        if ".abs()" in line
    ]
    head = ["the policy", *built, "", "its forward pass", *passed]
    return "\n".join([*head, "", "where positive_weights begins with", *weights])


def local_slopes(method: str, episode: int, trajectories: int = 500) -> Array:
    """k1 + (h/2) k2 times K of the force loop at the equilibrium of each test, all seeds, flat."""
    policy, task = peg_touch.load(method, episode), peg_touch.task_of(method)
    seeds = len(peg_touch.contents(method)[1]["seeds"])
    envs = PegTouchVectorEnv(seeds * trajectories, task)
    envs.reset(seed=[0] * seeds)
    s, exists = equilibrium(policy, envs, seeds)
    with torch.no_grad():
        slope = policy.jacobian(s)[..., 1, :].double().numpy()  # type: ignore[operator]
    K = envs.sampled["K_sur"].reshape(seeds, trajectories)
    gain: Array = K * (slope[..., 0] + 0.5 * task.h * slope[..., 1])
    return gain[exists[..., 1]]


def bounds() -> dict[str, float]:
    """The largest K (k1 + (h/2) k2) of a stable force loop, with K as in training.

    Returns:
        The bound `as trained`, and if the plant is `faster and stiffer`: half the lag, twice K.
    """
    task = peg_touch.PegTouchStudy().task
    values = largest_slope(task.tau_z * np.array([1.0, 0.5]), np.array([1.0, 2.0]), task.h)
    return {"as trained": float(values[0]), "faster and stiffer": float(values[1])}


def raw_gains(
    episodes: Sequence[int] = (5000, 7500, 10_000, 12_500, 15_000), trajectories: int = 300
) -> dict[str, Array]:
    """K |d a_2 / d f| of PPO on raw inputs where its trajectories come to rest.

    Without an integral the force loop is k1 alone, so the bound on it is that of `bounds`.

    Returns:
        `episode` (E,), `gain`: its 95 % quantile, and `beyond`: the share of trajectories above
        the bound, (seeds, E) each.
    """
    task, bound = peg_touch.task_of("ppo_raw"), bounds()["as trained"]
    seeds = len(peg_touch.contents("ppo_raw")[1]["seeds"])
    test = peg_touch.TestConfig(trajectories=trajectories)
    kept = [1000 * round(episode / 1000) for episode in episodes]
    gains, beyond = [], []
    for episode in kept:
        policy = peg_touch.load("ppo_raw", episode)
        run = record(policy, task, test, seeds)
        mean = torch.as_tensor(run.mean_s, dtype=torch.float32).flatten(-2).requires_grad_(True)
        slope = torch.autograd.grad(policy(mean)[..., 1].sum(), mean)[0][..., 1].numpy()
        gain = -slope * run.envs.sampled["K_sur"].reshape(seeds, trajectories)
        gains.append(np.quantile(gain, 0.95, axis=1))
        beyond.append(np.mean(gain > bound, axis=1))
    return {
        "episode": np.array(kept, float),
        "gain": np.array(gains).T,
        "beyond": np.array(beyond).T,
    }


@lru_cache(maxsize=64)
def _policy(method: str, episode: int, seed: int) -> nn.Module:
    return peg_touch.load(method, episode, seed=seed)


def press(
    episode: int = 5000,
    seed: int = 0,
    h: float = 10.0,
    shift: str = "nominal",
    signal: str = "force",
    trajectories: int | None = None,
) -> dict[str, Any]:
    """Test PPO, C-PPO and capped C-PPO on the same trajectories.

    Args:
        episode: which kept policy.
        seed: which of the five trainings.
        h: control period, ms.
        shift: one of `peg_touch.SHIFTS`.
        signal: "force" for f - f_d, "position" for 10 (x - x_d).
        trajectories: for each method.

    Returns:
        By method the errors of 12 trajectories (T, 12), their times under `METHOD_t`, and under
        `METHOD_text` the shares of oscillation (measured and, for C-PPO, predicted) and of drift.
    """
    column, scale = {"position": (0, 10.0), "force": (1, 1.0)}[signal]
    num = budget(100, 40) if trajectories is None else trajectories
    test = peg_touch.TestConfig(trajectories=num, duration=1.5, sign_every=10_000)
    answer: dict[str, Any] = {}
    for method in TITLES:
        task = peg_touch.shifted(peg_touch.task_of(method), shift, h / 1000.0)
        policy = _policy(method, 1000 * round(episode / 1000), seed)
        run = record(policy, task, test, 1)
        verdict = judge(run.tail[:, 0], task.h, test.detectors)
        shares = verdict.shares()
        text = f"{shares['oscillation']:.0%} oscillate"
        if method != "ppo":
            s, _ = equilibrium(policy, run.envs, 1)
            text += f" (predicted {predicted_oscillation(policy, s, run.envs).mean():.0%})"
        text += f", {shares['drift']:.0%} drift" if shares["drift"] > 0 else ""
        answer[f"{method}_text"] = f"{TITLES[method]}: {text}"
        # every trajectory's last second, at most 200 points of it
        step = max(1, len(run.tail) // 200)
        answer[method] = scale * run.tail[::step, 0, :12, column].astype(float)
        answer[f"{method}_t"] = task.h * step * np.arange(len(answer[method]))
    return answer


def turned_base(
    angles: Sequence[float] = (0, 30, 60, 80, 100, 120, 150, 180), episode: int = 15_000
) -> dict[str, Any]:
    """C-PPO with and without the transforms on a robot whose base is turned, never retrained.

    Returns:
        `angle` in degrees (A,), and by method the share of trajectories (A,) whose force error
        ends above 0.1 N or whose position error ends above 0.02 m.
    """
    test = peg_touch.TestConfig(trajectories=budget(400, 100), sign_every=10_000)
    answer: dict[str, Any] = {"angle": np.asarray(angles, dtype=float)}
    for method in ("cppo", "cppo_identity"):
        missed = []
        for angle in angles:
            task = peg_touch.task_of(method)
            turned = peg_touch.PegTouchConfig(
                interface=task.interface, mount_angle=float(np.deg2rad(angle))
            )
            run = record(_policy(method, episode, 0), turned, test, 1)
            size = np.abs(run.tail).mean(axis=0)[0]
            missed.append(np.mean((size[:, 0] > 0.02) | (size[:, 1] > 0.1)))
        answer[method] = np.array(missed)
    return answer
