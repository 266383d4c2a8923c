"""What the theory knows of a policy: its action, its slopes, and the loop as a function of them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from cmc.theory.arrays import Array, checked
from cmc.theory.auxiliary import AuxiliarySpace
from cmc.theory.certificates import SHARE, Certificate, circle_criterion, common_metric, corners
from cmc.theory.contraction import metric_factor
from cmc.theory.sampled import hold

EPS = 2.2e-16

Action = Callable[[Array, Array], Array]


def action_of(policy: Any, n: int) -> Action:
    """A policy as a function from s = (z, int z), (..., n, 2), and diag(R), (..., n), to a.

    Signed slopes (n, 2) and a function of s give a as they are. Everything else (an object with
    `pi(s)`, a network, `ModularPolicy`, the policy of `cmc.sb3`) obeys a_i = -sign(R_ii) pi_i
    (`constraint_sign`), with the R that it was told, if it was.
    """
    if isinstance(policy, (list, tuple, np.ndarray)):
        slopes = checked("policy", policy, "... n 2", n=n)
        return lambda s, gains: (slopes * s).sum(axis=-1)
    if not callable(policy) and not hasattr(policy, "pi"):
        raise TypeError(
            f"{type(policy).__name__} is no policy: it has neither pi(s) nor a network to evaluate"
        )
    if not hasattr(policy, "pi") and not hasattr(policy, "parameters"):
        return lambda s, gains: np.asarray(policy(s), dtype=float)
    pi = policy.pi if hasattr(policy, "pi") else _in_double(policy)
    seen = np.array([1.0, 1.0 if getattr(policy, "integral", True) else 0.0])
    return lambda s, gains: np.asarray(-factor_of(policy, gains) * pi(s * seen))  # constraint_sign


def inner(policy: Any) -> Any:
    """The policy that acts on s, on the CPU: what `cmc.sb3` keeps inside, or the thing itself."""
    policy = policy.on_signals() if hasattr(policy, "on_signals") else policy
    return copy.deepcopy(policy).cpu() if hasattr(policy, "cpu") else policy


def factor_of(policy: Any, gains: Array) -> Array:
    """What multiplies -pi: sign(R_ii), or 1/R_ii with `normalise`; R as told, or the plant's."""
    told = None if "R" in getattr(policy, "layout", {}) else getattr(policy, "R", None)
    R = gains if told is None else np.asarray(told, dtype=float)
    return np.asarray(1 / R if getattr(policy, "normalise", False) else np.sign(R))


def _in_double(policy: Any) -> Callable[[Array], Array]:
    """A torch network on numpy arrays, in double precision."""
    if hasattr(policy, "part"):
        name = type(policy).__name__
        raise TypeError(f"{name} sees a part of an observation, not (z, int z): pass a function")
    network = copy.deepcopy(getattr(policy, "network", policy)).double()
    like = next(iter([*network.parameters(), *network.buffers()]))  # fixed gains are buffers
    end = np.tanh if getattr(policy, "squash", False) else np.asarray
    return lambda s: end(network(like.new_tensor(s)).detach().numpy())


def slope_interval(policy: Any, gains: Array) -> tuple[Array, Array]:
    """Smallest and largest signed slopes da_i/ds_ij, (n, 2) each; seeds are covered all at once.

    A policy without bounds is a TypeError; bounds that are no intervals or that its slopes leave,
    and an a_i that depends on other signals than its own, are a ValueError.
    """
    n = gains.shape[-1]
    if isinstance(policy, (list, tuple, np.ndarray)):
        slopes = checked("policy", policy, "n 2", n=n)
        return slopes, slopes
    if not hasattr(policy, "slope_bounds"):
        raise TypeError(f"{type(policy).__name__} has no slope_bounds(): nothing bounds its slopes")
    lower, upper = (np.asarray(bound, dtype=float) for bound in policy.slope_bounds())
    if lower.shape[-2:] != (n, 2) or upper.shape != lower.shape:
        raise ValueError(f"slope_bounds() needs two of shape ({n}, 2), got {lower.shape}")
    if not np.isfinite([lower, upper]).all() or (lower < 0).any() or (lower > upper).any():
        raise ValueError(f"slope bounds need 0 <= lower <= upper, got {lower} and {upper}")
    if callable(policy) or hasattr(policy, "pi"):
        _probe(policy, lower, upper)
    lower, upper = lower.reshape(-1, n, 2).min(axis=0), upper.reshape(-1, n, 2).max(axis=0)
    ends = -factor_of(policy, gains)[:, None] * np.stack([lower, upper])
    return ends.min(axis=0), ends.max(axis=0)


def _probe(policy: Any, lower: Array, upper: Array) -> None:
    """Ask the policy itself, at random signals of many sizes, whether its bounds can be true."""
    n, one = lower.shape[-2], np.ones(lower.shape[-2])
    pi, factor = action_of(policy, n), np.zeros(n) + np.abs(factor_of(policy, one))
    # signals of all sizes, half of them in the units in which each moves the action alike
    unit = np.ones((*lower.shape[:-2], 64, n, 2))
    unit[..., ::2, :, :] /= np.where(upper > 0, upper, 1.0)[..., None, :, :]
    unit *= 10.0 ** np.linspace(-6, 6, 64)[:, None, None]
    s, step = unit * np.random.default_rng(0).normal(size=unit.shape), 1e-4 * unit
    here = pi(s, one)
    ahead = s[..., None, None, :, :] + step[..., None, None] * np.eye(2 * n).reshape(n, 2, n, 2)
    change = np.abs(pi(ahead, one) - here[..., None, None, :])  # of a_k by s_jm, (..., j, m, k)
    rounding = 1e-12 * (np.abs(here)[..., None, None, :] + change).max(axis=-1)
    others = (change * (1 - np.eye(n)[:, None])).max(axis=-1)
    coupled = others > 1e-9 * change.max(axis=-1) + 10 * rounding
    if coupled.any():
        name = type(getattr(policy, "network", policy)).__name__
        raise ValueError(
            f"{name} is coupled: signal {np.argwhere(coupled)[0][-2] + 1} also moves other actions "
            "than its own, so slope_bounds() says too little; a box (`region`) looks at the full "
            "Jacobian"
        )
    own = step * factor[:, None]
    slope = np.einsum("...jmj->...jm", change) / own  # the sign rule has its own check
    low, high = lower[..., None, :, :], upper[..., None, :, :]
    slack = 1e-6 * high + rounding / own
    wrong = (slope < low - slack) | (slope > high + slack)
    if wrong.any():
        j, m = np.argwhere(wrong)[0][-2:]
        raise ValueError(
            f"slope_bounds() of {type(policy).__name__} states [{low[..., j, m].min():.4g}, "
            f"{high[..., j, m].max():.4g}] for signal ({j + 1}, {m + 1}), its slopes reach from "
            f"{slope[..., j, m].min():.4g} to {slope[..., j, m].max():.4g}"
        )


class BlockLoop:
    """The loop in (z, int z) as a function of its slopes, exactly, with its block structure."""

    def __init__(
        self, plant: Any, space: AuxiliarySpace, low: Array, high: Array, h: float | None
    ) -> None:
        n, zero = space.n, np.zeros(space.n)
        f_y, f_u = plant.f_y(zero, zero), plant.f_u(zero, zero)
        T, V = space.T_y, np.linalg.inv(space.T_y)
        self.n, self.low, self.high, self.h = n, low, high, h
        self.keep = np.concatenate([np.arange(n), n + np.flatnonzero((high != 0)[:, 1])])
        # the transformed plant as it is, not as it should be, and how far rounding may be off
        Lambda, R = T @ f_y @ V, T @ f_u @ space.T_a
        off = np.abs(T @ V - np.eye(n))
        d_L = 8 * n * EPS * np.abs(T) @ np.abs(f_y) @ np.abs(V) + np.abs(Lambda) @ off
        d_R = 8 * n * EPS * np.abs(T) @ np.abs(f_u) @ np.abs(space.T_a)
        Lambda = np.where(np.abs(Lambda) <= d_L, 0.0, Lambda)
        R = np.where(np.abs(R) <= d_R, 0.0, R)
        self.blocks = _blocks((Lambda != 0) | (R != 0))
        if h is not None:
            Lambda, R = hold(Lambda, R, h)
            reach = np.abs(Lambda)
            d_L = h * d_L + 40 * n * EPS * np.maximum(reach, reach.max())
            d_R = h * d_R + 40 * n * EPS * np.abs(R).max(axis=0)
            for block in self.blocks:  # an exponential keeps zeros, but for rounding
                below = np.ix_(range(block[-1] + 1, n), block)
                Lambda[below] = R[below] = 0.0
        self.space = replace(space, Lambda=Lambda, R=R)
        size = np.abs(np.stack([low, high])).max(axis=0)
        k1 = size[:, 0] + (0.0 if h is None else h * size[:, 1])
        self.slack = np.zeros((2 * n, 2 * n))
        self.slack[:n, :n], self.slack[:n, n:] = 2 * (d_L + d_R * k1), 2 * d_R * size[:, 1]
        self.slack = self.slack[np.ix_(self.keep, self.keep)]

    def matrix(self, slopes: Array) -> Array:
        """Jacobian, or with h the step in (z_k, I_{k-1}), for signed slopes (..., n, 2)."""
        return self.space.loop(slopes, self.h)[..., self.keep[:, None], self.keep]

    def corners(self, modes: Any) -> Array:
        """Matrices at all corners of the slopes of some modes, the others at their lower ends."""
        high = self.low.copy()
        high[list(modes)] = self.high[list(modes)]
        return self.matrix(corners(self.low, high))

    def states(self, block: list[int]) -> NDArray[np.intp]:
        """Where the block's z and int z stand in the state."""
        return np.flatnonzero(np.isin(self.keep % self.n, block))

    def block(self, block: list[int]) -> Certificate:
        """Certificate of one block alone."""
        at = self.states(block)
        corners = self.corners(block)[:, at[:, None], at]
        if len(at) == 1 and self.h is None:
            rate = -float(corners.max())
            return Certificate(
                rate > 0,
                rate=rate,
                metric=np.eye(1),
                violated=corners[np.argmax(corners)],
                reason=f"z grows at {-rate:.4g} 1/s",
            )
        if len(at) == 2 and len(block) == 1 and self.h is None:
            c, k = -corners[:, 0, 0], -corners[:, 0, 1]
            if c.min() == c.max():
                return circle_criterion(float(c[0]), float(k.min()), float(k.max()))
        return common_metric(corners, h=self.h)

    def couplings(self) -> dict[tuple[int, int], Array]:
        """Corners of the parts through which later blocks drive earlier ones."""
        found = {}
        for j, later in enumerate(self.blocks):
            corners = self.corners(later)
            for i, earlier in enumerate(self.blocks[:j]):
                rows, columns = self.states(earlier), self.states(later)
                found[i, j] = corners[:, rows[:, None], columns]
        return found


def _blocks(linked: Array) -> list[list[int]]:
    """The finest partition of the modes into neighbours that is block upper triangular."""
    blocks, n = [[0]], len(linked)
    for i in range(1, n):
        if linked[i:, : blocks[-1][-1] + 1].any():
            blocks[-1].append(i)
        else:
            blocks.append([i])
    return blocks


def compose_hierarchical(
    metrics: Sequence[Array],
    rates: Sequence[float],
    couplings: Mapping[tuple[int, int], ArrayLike],
    *,
    h: float | None = None,
) -> tuple[Array, float]:
    """Metric and rate of an upper block-triangular combination of contracting blocks.

    Block i is driven by blocks j > i only. Scaling block i by eps^(n-1-i) shrinks every coupling by
    a power of eps, so some eps > 0 keeps the rate as near to the slowest block's as wanted.

    One metric (m_i, m_i) and one rate (1/s) a block; couplings[i, j], i < j, are the vertices
    (V, m_i, m_j) through which j drives i; h (s) where the blocks are steps.
    """
    if not (np.isfinite(rates).all() and min(rates) > 0):
        raise ValueError(f"every block needs a positive rate, got {list(rates)}")
    if any(i >= j for i, j in couplings):
        raise ValueError("blocks may only be driven by later ones: couplings need i < j")
    theta = [metric_factor(metric) for metric in metrics]
    size = len(metrics)
    strength = np.zeros((size, size))
    for (i, j), block in couplings.items():
        local = theta[i] @ np.asarray(block, dtype=float) @ np.linalg.inv(theta[j])
        strength[i, j] = np.linalg.norm(local, 2, axis=(-2, -1)).max()
    eps, level = 1.0, np.arange(size)
    for _ in range(200):
        scaled = strength * eps ** np.maximum(level[None] - level[:, None], 0)
        if h is None:
            comparison = scaled - np.diag(rates)
            rate = -float(np.linalg.eigvalsh((comparison + comparison.T) / 2)[-1])
        else:
            comparison = scaled + np.diag(np.exp(-h * np.asarray(rates)))
            rate = -float(np.log(np.linalg.norm(comparison, 2))) / h
        if rate >= SHARE * min(rates):
            break
        eps *= 0.7
    blocks = [eps ** (2 * (size - 1 - i)) * metric for i, metric in enumerate(metrics)]
    return block_diag(*blocks), rate
