"""Random questions for `certify`, some of them wrong on purpose, in units between 1e-9 and 1e9.

Wrong are another sign of R, a coupled policy, a slip in a Jacobian, slopes outside of what is
stated, commands that act non-linearly, and observations that VecNormalize scales.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from cmc.plants import LinearPlant, Plant
from cmc.theory import combinations
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certify import certify
from cmc.theory.exact import Region

KINDS = {
    "linear, real modes": 4,
    "linear, complex pairs": 3,
    "linear, own transforms": 3,
    "linear, stiff under a hold": 1,
    "wrong or scaled R": 2,
    "no integral": 1,
    "coupled policy": 1,
    "slopes outside of what is stated": 1,
    "slip in a Jacobian": 1,
    "no bypass, in a box": 1,
    "nonlinear, in a box": 3,
    "non-affine command, in a box": 2,
    "command limits": 1,
    "SB3": 1,
    "SB3 behind VecNormalize": 2,
}


class Tanh:
    """pi_i = bypass_i . s_i + tanh(room_i . s_i), or with `mix` a coupled one."""

    def __init__(self, bypass: np.ndarray, room: np.ndarray, size: np.ndarray) -> None:
        self.bypass, self.room, self.mix, self.boast, self.u0 = bypass, room, None, 1.0, 0.0
        self.integral, self.normalise, self.size = True, False, size

    def pi(self, s):
        x = s / self.size
        out = (self.bypass * x).sum(-1) + np.tanh((self.room * x).sum(-1))
        return out if self.mix is None else out @ self.mix.T

    def slope_bounds(self):
        low, high = self.bypass / self.size, self.boast * (self.bypass + self.room) / self.size
        keep = np.array([1.0, float(self.integral)])
        return low * keep, high * keep


class Blank(gymnasium.Env):
    """Spaces of n signals and nothing else: Stable-Baselines3 builds its policies for them."""

    def __init__(self, n: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-1e9, 1e9, (2 * n,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1e9, 1e9, (n,), np.float64)


class Learnt:
    """An untrained policy of Stable-Baselines3, as the loop of its algorithm runs it."""

    integral, normalise, size = True, False, 1.0

    def __init__(self, rng: np.random.Generator, low: np.ndarray, scaled: bool) -> None:
        from stable_baselines3 import PPO
        from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

        from cmc.sb3 import ContractingPolicy

        envs: Any = DummyVecEnv([lambda: Blank(len(low))])
        self.mean, self.std, self.clip = 0.0, np.ones(low.shape), np.inf
        if scaled:
            envs = VecNormalize(envs, norm_reward=False, training=False)
            envs.obs_rms.var[:] = 10 ** rng.uniform(-2, 1, low.size)
            envs.obs_rms.mean[:] = rng.normal(size=low.size) * rng.choice([0.0, 0.1])
            self.mean, self.clip = envs.obs_rms.mean.reshape(low.shape), envs.clip_obs
            self.std = np.sqrt(envs.obs_rms.var + envs.epsilon).reshape(low.shape)
        floor = low[0] * (self.std.mean(axis=0) if rng.random() < 0.7 else 1.0)
        slopes = {"slope_min": floor.tolist(), "slope_max": (floor * rng.uniform(1.2, 2)).tolist()}
        kwargs = {"network_kwargs": slopes, "net_arch": {"pi": [4], "vf": [4]}}
        seed = int(rng.integers(1000))
        self.model = PPO(
            ContractingPolicy, envs, policy_kwargs=kwargs, n_steps=8, batch_size=8, seed=seed
        )
        self.network = copy.deepcopy(self.model.policy.actor.network).double()

    def pi(self, s):
        seen = np.clip((s - self.mean) / self.std, -self.clip, self.clip)
        return self.network(next(self.network.parameters()).new_tensor(seen)).detach().numpy()


class Curved(Plant):
    """y' = A y + B (u + g u^3) + N sin(W y), Jacobians with an optional slip."""

    name = "curved"

    def __init__(self, A, B, N, W, g, slip, box):
        self.n, self.A, self.B, self.N, self.W, self.g, self.slip = len(A), A, B, N, W, g, slip
        self._box([box] * self.n, [10.0] * self.n)

    def f(self, y, u, t=0.0):
        y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
        acts = u + self.g * u * u * u
        return y @ self.A.T + acts @ self.B.T + np.sin(y @ self.W.T) @ self.N.T

    def f_y(self, y, u, t=0.0):
        y = np.asarray(y, dtype=float)
        return self._slipped(self.A + (self.N * np.cos(y @ self.W.T)[..., None, :]) @ self.W, 0)

    def f_u(self, y, u, t=0.0):
        u = np.asarray(u, dtype=float)
        J = self.B * (1 + 3 * self.g * u**2)[..., None, :] + 0 * np.asarray(y)[..., None]
        return self._slipped(J, 1)

    def _slipped(self, J, which):
        if self.slip is not None and self.slip[0] == which:
            J = np.array(J)
            J[..., self.slip[1], self.slip[2]] *= self.slip[3]
        return J


@dataclass
class Trial:
    kind: str
    plant: Any
    policy: Any
    transforms: Any
    region: Any
    h: float | None

    def ask(self) -> Any:
        """The certificate of this question."""
        policy = getattr(getattr(self.policy, "model", None), "policy", self.policy)
        kwargs = {"region": self.region, "h": self.h, "transforms": self.transforms}
        return certify(policy, self.plant, **kwargs)


def modes(rng, n, pairs):
    """A random state matrix with real modes, or with complex pairs where they fit."""
    D = np.diag(rng.choice([-1.0, -1.0, -1.0, 0.3], n) * rng.uniform(0.2, 4.0, n))
    if pairs:
        for i in range(0, n - 1, 2):
            s, w = -rng.uniform(0.05, 2.0), rng.uniform(0.2, 6.0)
            D[i : i + 2, i : i + 2] = [[s, w], [-w, s]]
    V = np.eye(n) + rng.uniform(0.1, 0.6) * rng.normal(size=(n, n))
    return V @ D @ np.linalg.inv(V)


def draw(seed: int, kind: str | None = None) -> Trial:
    """One random question, of a kind."""
    rng = np.random.default_rng(seed)
    drawn = str(rng.choice(list(KINDS), p=np.array(list(KINDS.values())) / sum(KINDS.values())))
    kind = drawn if kind is None else kind
    curved = kind in ("nonlinear, in a box", "non-affine command, in a box", "slip in a Jacobian")
    box, learnt, pairs = curved or "box" in kind or "Vec" in kind, "SB3" in kind, "pairs" in kind
    n = int(rng.choice([1, 2, 3, 4, 5, 6, 7, 8], p=[0.2, 0.3, 0.2, 0.15, 0.07, 0.05, 0.02, 0.01]))
    n = min(n, 3 if seed % 4 == 0 else 2) if box else n
    n = max(n, 2) if pairs or kind == "coupled policy" else n
    A, B = modes(rng, n, pairs), np.eye(n) + 0.5 * rng.normal(size=(n, n))
    rate, unit = 10.0 ** rng.integers(-9, 10, 2) if rng.random() < 0.3 else np.ones(2)
    rate, unit = (1.0, 1.0) if box or learnt else (rate, unit)
    h = None if rng.random() < 0.5 else float(10 ** rng.uniform(-2.5, -0.3)) / rate
    if "stiff" in kind:
        A = A - np.diag(10 ** rng.uniform(0, 3.5, n))
        h = float(10 ** rng.uniform(-1.5, -0.5)) / rate
    low = 10 ** rng.uniform(-1.5, 0.7, (n, 2))
    room = low * rng.uniform(0, 1.5, (n, 2))
    room[4 if n > 5 else n :] = 0.0  # 4^n corners of the slopes would have to be listed
    policy: Any = Tanh(low, room, size=np.array([1.0, 1 / rate]) * unit)
    A, B = A * rate, B * rate * unit  # y in `unit`, u in 1
    size = float(rng.uniform(0.05, 0.5))
    region = Region([-size] * n, [size] * n, integral=size, points=5) if box else None
    transforms = None
    if pairs:
        transforms = (combinations.feedback if rng.random() < 0.5 else combinations.block_schur)(
            A, B
        )
    if kind == "linear, own transforms":
        if rng.random() < 0.5:  # nearly triangular, in bad units
            A, B = np.triu(A), np.triu(B) * 10 ** rng.uniform(-3, 3, (n, n))
            B += np.tril(rng.normal(size=(n, n)), -1) * 10 ** rng.uniform(-12, 0)
        transforms = AuxiliarySpace.identity(A, B)
        policy.R = np.where(np.diag(B) < 0, -1.0, 1.0)
    plant: Any = LinearPlant(A, B)
    plant.u_low, plant.u_high = np.full(n, -np.inf), np.full(n, np.inf)
    if kind == "command limits":
        plant.u_low, plant.u_high = np.full(n, -1.0), np.full(n, 2.0)
    if kind == "wrong or scaled R":
        policy.R = rng.choice([1.0, 1.0, -1.0], n) * 10 ** rng.uniform(-1, 1, n)
        policy.normalise = bool(rng.random() < 0.5)
    policy.integral = kind != "no integral" or rng.random() < 0.2
    if kind == "coupled policy":
        policy.mix = np.eye(n) + rng.uniform(0, 3) * rng.normal(size=(n, n))
    if kind == "slopes outside of what is stated":
        policy.boast = rng.uniform(0.3, 1.2)
    if kind == "no bypass, in a box":
        policy.bypass, policy.room = 0 * low, low * 2
    if curved:
        N, W = rng.normal(size=(2, n, n)) * rng.uniform(0.1, 1.2)
        g = rng.uniform(0, 1.0) if "non-affine" in kind else 0.0
        wrong = 1 + rng.choice([-2, -1, 0.5, 2])
        slip = (int(rng.integers(2)), *rng.integers(n, size=2), wrong) if "slip" in kind else None
        plant = Curved(A, B, N, W, g, slip, size)
    if learnt:
        policy = Learnt(rng, low, "Vec" in kind)
    return Trial(kind, plant, policy, transforms, region, h)
