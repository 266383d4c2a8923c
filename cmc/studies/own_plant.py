"""Peers on a plant that is not the paper's: two tanks, one budget, five ways to control them.

`python -m cmc evaluate own_plant` computes the table, which lesson 13 shows. Every learner sees
s = (z, int z) in reversed order, adds its action to the same u0, and has the same critic, noise,
seeds and number of steps. "Shifted" plants: pumps 0.5 to 3 times as strong, outlets 0.7 to 1.4
times as wide, drawn log-uniformly. A test is unstable if a level still moves by over 5 cm in its
last quarter, and off if it rests over 5 cm from its goal, as it must where a pump is too weak. All
of it is our choice: the paper has no such plant.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import control
import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from cmc.envs.auxiliary_space import AuxiliarySpaceVectorWrapper
from cmc.envs.plant_env import PlantVectorEnv
from cmc.learning.ppo import PPO, PPOConfig
from cmc.plants import Plant
from cmc.policies import (
    ConvexGradientNetwork,
    DirectPolicy,
    JointNetwork,
    ModularPolicy,
    PositiveNetwork,
)
from cmc.studies.study import Array
from cmc.theory.certify import certify
from cmc.theory.combinations import transforms_that_fit
from cmc.theory.exact import Region

GOAL, H, STEPS = np.ones(2), 0.25, 48  # m, min, steps of an episode
SEEDS, EACH, UPDATES = (0, 1, 2), 16, 45
FLOOR, CAP = [0.5, 0.1], [2.0, 0.5]  # slopes in z, 1/min, and in int z, 1/min^2
PENALTY = 0.001  # times the squared Jacobian, our choice
TESTS, SIZES = 100, (0.5, 0.3, 0.1)  # m: half-widths of the box around the goal


def _tanks(y: Any, u: Any, pump: Any = (1.0, 1.0), outlet: Any = (1.0, 1.5)) -> Any:
    """Levels in m, inflows in m/min; the first tank drains into the second."""
    first, second = outlet[0] * y[0] ** 0.5, outlet[1] * y[1] ** 0.5
    return [pump[0] * u[0] - first, first - second + pump[1] * u[1]]


PLANT = Plant.from_function(
    lambda y, u: _tanks(y, u), y=([0.5, 0.5], [2.0, 2.0]), u=(0.0, 3.0), name="two tanks"
)
SPACE = {o.name: o.transforms for o in transforms_that_fit(PLANT)}["reversed order"]
U0 = PLANT.hold(GOAL)


class _PenalisedPPO(PPO):
    """PPO, and after every minibatch one step down the squared Jacobian da/ds of its policy."""

    def _minibatch(self, batch: Tensor) -> dict[str, Tensor]:
        report = super()._minibatch(batch)
        s = batch[..., : self._columns[0]].detach().requires_grad_()
        mean = self.policy(s)
        rows = [torch.autograd.grad(mean[..., i].sum(), s, create_graph=True)[0] for i in (0, 1)]
        size = torch.stack(rows).square().sum((0, -1)).mean(1).sum()
        weights = [w for name, w in self.parameters.items() if name.startswith("policy")]
        steps = torch.autograd.grad(size, weights, allow_unused=True)
        with torch.no_grad():
            for weight, step in zip(weights, steps, strict=True):
                if step is not None:
                    weight.sub_(PENALTY * step)
        return report


def _lqr() -> nn.Linear:
    """The linear-quadratic regulator of the tanks at the goal, a = -K (z, int z)."""
    zero = np.zeros((2, 2))
    Lambda = SPACE.T_y @ PLANT.f_y(GOAL, U0) @ np.linalg.inv(SPACE.T_y)
    A = np.block([[Lambda, zero], [np.eye(2), zero]])
    B = np.vstack([SPACE.T_y @ PLANT.f_u(GOAL, U0) @ SPACE.T_a, zero])
    K, _, _ = control.lqr(A, B, np.diag([1.0, 1.0, 0.1, 0.1]), 0.5 * np.eye(2))
    policy = nn.Linear(4, 2, bias=False)
    s = [0, 2, 1, 3]  # is (z1, int z1, z2, int z2)
    policy.weight = nn.Parameter(torch.as_tensor(-K[:, s], dtype=torch.float32))
    return policy


def _of_seed(policy: nn.Module, k: int) -> Any:
    """One seed's a as a function of s (..., 2, 2), in double precision on numpy arrays."""

    def action(s: Array) -> Array:
        flat = np.reshape(s, (1, -1, 4))
        wide = flat if isinstance(policy, nn.Linear) else np.repeat(flat, len(SEEDS), axis=0)
        with torch.no_grad():
            a = policy.double()(torch.as_tensor(wide, dtype=torch.float64)).numpy()
        return np.asarray(a[min(k, len(a) - 1)].reshape(*np.shape(s)[:-2], 2))

    return action


def _trial(action: Any, shifted: bool) -> tuple[float, float, float]:
    """Mean return, share of unstable tests, share that are at rest and off."""
    rng = np.random.default_rng(7)
    spread = np.exp(rng.uniform(np.log([0.5, 0.5, 0.7, 0.7]), np.log([3, 3, 1.4, 1.4]), (TESTS, 4)))
    spread = spread.T if shifted else np.ones((4, TESTS))
    y, integral = rng.uniform(PLANT.y_low, PLANT.y_high, (TESTS, 2)), np.zeros((TESTS, 2))
    total, dt = np.zeros(TESTS), H / 8
    errors: list[Any] = []
    for _ in range(2 * STEPS):
        z = (y - GOAL) @ SPACE.T_y.T
        integral = integral + H * z
        u = np.clip(U0 + action(np.stack([z, integral], -1)) @ SPACE.T_a.T, 0.0, 3.0)
        for _ in range(8):
            outlet = np.array([1.0, 1.5])[:, None] * spread[2:]
            y = np.maximum(y + dt * np.stack(_tanks(y.T, u.T, spread[:2], outlet), -1), 1e-3)
        total -= np.mean(((y - GOAL) / 0.75) ** 2, -1) * (len(errors) < STEPS)
        errors.append(y - GOAL)
    late = np.array(errors[-STEPS // 2 :])
    moves = (np.ptp(late, axis=0) > 0.05).any(-1)
    off = (np.abs(late).max(axis=0) > 0.05).any(-1) & ~moves
    return float(total.mean()), float(moves.mean()), float(off.mean())


def _certified(action: Any) -> float:
    """Half-width of the largest box that was tried around the goal and is certified, m; or 0."""
    for size in SIZES:
        box = Region(GOAL - 0.999 * size, GOAL + 0.999 * size, points=5)
        if certify(action, PLANT, region=box, h=H, transforms=SPACE, y_ref=GOAL):
            return size
    return 0.0


BOUNDS: dict[str, Any] = {"hidden": (16, 16), "slope_min": FLOOR, "slope_max": CAP}
free = lambda: DirectPolicy(JointNetwork(2, inputs=4, seeds=SEEDS))  # noqa: E731
convex = lambda: ModularPolicy(ConvexGradientNetwork(2, seeds=SEEDS))  # noqa: E731
METHODS: dict[str, tuple[str, type[PPO] | None, Callable[[], nn.Module]]] = {
    "ppo": ("PPO", PPO, free),
    "penalty": ("PPO with a Jacobian penalty", _PenalisedPPO, free),
    "cppo": ("C-PPO", PPO, lambda: ModularPolicy(PositiveNetwork(2, seeds=SEEDS, **BOUNDS))),
    "convex": ("convex-gradient PI", PPO, convex),
    "lqr": ("LQR", None, _lqr),
}
"""Title, learner, and the policy of all seeds side by side."""


def table(updates: int = UPDATES) -> pd.DataFrame:
    """A row for each method and seed."""
    rows = []
    for name, (title, learner, build) in METHODS.items():
        begin, policy = time.process_time(), build()
        seeds: tuple[int, ...] = (0,)
        steps = 0
        if learner is not None:
            env = PlantVectorEnv(EACH * len(SEEDS), PLANT, H, target=GOAL, horizon=STEPS, room=1.6)
            seen = AuxiliarySpaceVectorWrapper(env, SPACE)
            learner(seen, policy, SEEDS, PPOConfig(steps=STEPS)).train(updates)
            seeds, steps = SEEDS, EACH * STEPS * updates
        spent = (time.process_time() - begin) / len(seeds)
        about = {"method": name, "title": title, "test": "nominal", "last": True, "step": steps}
        for k in seeds:
            action = _of_seed(policy, k)
            row: dict[str, Any] = about | {"seed": k}
            row["return"], row["unstable"], row["off"] = _trial(action, shifted=False)
            _, row["unstable_shifted"], row["off_shifted"] = _trial(action, shifted=True)
            rows.append(row | {"certified_m": _certified(action), "cpu_s": spent})
    return pd.DataFrame(rows).round(4)
