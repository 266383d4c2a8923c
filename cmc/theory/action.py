"""What the theory needs to know about a policy: its action, and the interval of its slopes."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from cmc.theory.arrays import Array, checked

Action = Callable[[Array, Array], Array]


def action_of(policy: Any, n: int) -> Action:
    """A policy as a function from s = (z, int z), (..., n, 2), and diag(R), (..., n), to a.

    Signed slopes (n, 2) and a function of s give a as they are. Everything else (an object with
    `pi(s)`, a network, `ModularPolicy`, the policy of `cmc.sb3`) obeys a_i = -sign(R_ii) pi_i
    (`constraint_sign`), with the R that it was told, if it was.

    Raises:
        TypeError: If it cannot be evaluated.
    """
    if not callable(policy) and not hasattr(policy, "pi"):
        slopes = checked("policy", _numbers(policy), "... n 2", n=n)
        return lambda s, gains: (slopes * s).sum(axis=-1)
    if not hasattr(policy, "pi") and not hasattr(policy, "parameters"):
        return lambda s, gains: np.asarray(policy(s), dtype=float)
    pi = policy.pi if hasattr(policy, "pi") else _in_double(policy)
    seen = np.array([1.0, 1.0 if getattr(policy, "integral", True) else 0.0])

    def action(s: Array, gains: Array) -> Array:
        return np.asarray(-factor_of(policy, gains) * pi(s * seen))  # constraint_sign

    return action


def inner(policy: Any) -> Any:
    """The policy that acts on s: what `cmc.sb3` keeps inside, the thing itself otherwise."""
    return policy.on_signals() if hasattr(policy, "on_signals") else policy


def factor_of(policy: Any, gains: Array) -> Array:
    """What multiplies -pi: sign(R_ii), or 1/R_ii with `normalise`; R as told, or the plant's."""
    told = None if "R" in getattr(policy, "layout", {}) else getattr(policy, "R", None)
    R = gains if told is None else np.asarray(told, dtype=float)
    return np.asarray(1 / R if getattr(policy, "normalise", False) else np.sign(R))


def slope_interval(policy: Any, gains: Array) -> tuple[Array, Array]:
    """Smallest and largest signed slopes da_i/ds_ij, (n, 2) each; seeds are covered all at once.

    Raises:
        TypeError: If nothing bounds its slopes.
        ValueError: If the bounds are no intervals, slopes lie outside of what was stated, or a_i
            depends on other signals than its own.
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
    n, rng = lower.shape[-2], np.random.default_rng(0)
    one = np.ones(n)
    factor = np.broadcast_to(np.abs(factor_of(policy, one)), (n,))
    pi = action_of(policy, n)
    lead = lower.shape[:-2]
    size = 10.0 ** rng.uniform(-3, 3, (*lead, 64, 1, 1))
    s = size * rng.normal(size=(*lead, 64, n, 2))
    here = pi(s, one)
    for j in range(n):
        for m in range(2):
            ahead = s.copy()
            step = 1e-4 * size[..., 0, 0]
            ahead[..., j, m] += step
            change = pi(ahead, one) - here
            rounding = 1e-12 * (np.abs(here) + np.abs(change)).max(axis=-1)
            others = np.delete(np.abs(change), j, axis=-1).max(axis=-1, initial=0.0)
            if (others > 1e-9 * np.abs(change).max(axis=-1) + 10 * rounding).any():
                name = type(getattr(policy, "network", policy)).__name__
                raise ValueError(
                    f"{name} is coupled: signal {j + 1} also moves other actions than its own, so "
                    "slope_bounds() says too little; a box (`region`) looks at the full Jacobian"
                )
            slope = np.abs(change[..., j]) / step / factor[j]  # the sign rule has its own check
            slack = 1e-6 * upper[..., None, j, m] + rounding / step / factor[j]
            low, high = lower[..., None, j, m], upper[..., None, j, m]
            if ((slope < low - slack) | (slope > high + slack)).any():
                raise ValueError(
                    f"slope_bounds() of {type(policy).__name__} states [{low.min():.4g}, "
                    f"{high.max():.4g}] for signal ({j + 1}, {m + 1}), its slopes reach from "
                    f"{slope.min():.4g} to {slope.max():.4g}"
                )


def _in_double(policy: Any) -> Callable[[Array], Array]:
    """A torch network on numpy arrays, in double precision."""
    if hasattr(policy, "part"):
        name = type(policy).__name__
        raise TypeError(f"{name} sees a part of an observation, not (z, int z): pass a function")
    network = copy.deepcopy(getattr(policy, "network", policy)).double()
    like = next(network.parameters())
    end = np.tanh if getattr(policy, "squash", False) else np.asarray
    return lambda s: end(network(like.new_tensor(s)).detach().numpy())


def _numbers(policy: Any) -> Any:
    if isinstance(policy, (list, tuple, np.ndarray)):
        return policy
    raise TypeError(
        f"{type(policy).__name__} is no policy: it has neither pi(s) nor a network to evaluate"
    )
