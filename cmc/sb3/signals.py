"""What all policies of this room share: spaces that fit, and how they act on the plain signals."""

from __future__ import annotations

import copy
import gc
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from cmc.policies import ModularPolicy

Array = NDArray[np.float64]
Layout = dict[str, slice] | None


def check_spaces(seen: spaces.Space[Any], action: spaces.Space[Any], layout: Layout) -> None:
    """Refuse spaces that hold no (n, 2) signals for n actions, or a layout that does not fit.

    Raises:
        ValueError: with what was wanted and what came.
    """
    if not isinstance(action, spaces.Box) or len(action.shape) != 1:
        raise ValueError(f"wanted actions in a Box of one axis; got {action}")
    n, shape = action.shape[0], seen.shape or ()
    if layout is None and shape != (2 * n,):
        raise ValueError(
            f"wanted observations of shape ({2 * n},), (z_i, integral of z_i) for each of "
            f"{n} actions, or a layout; got {seen.shape}"
        )
    wanted = {"s": 2 * n, "R": n, "T_a": n * n}
    for name, part in (layout or {}).items():
        inside = range(*part.indices(shape[0])) if len(shape) == 1 else range(0)
        if name in wanted and (len(inside) != wanted[name] or (part.stop or 0) > shape[0]):
            raise ValueError(
                f"layout: {name!r} needs {wanted[name]} numbers for {n} actions, got {part} of an "
                f"observation of shape {shape}"
            )


def hidden_layers(net_arch: Any, **default: tuple[int, ...]) -> dict[str, Any]:
    """Sizes by key; as in Stable-Baselines3, a key left out means no hidden layer."""
    if net_arch is None:
        return dict(default)
    both = net_arch if isinstance(net_arch, dict) else dict.fromkeys(default, net_arch)
    return {**dict.fromkeys(default, ()), **both}


def normalisation(policy: nn.Module) -> Any:
    """VecNormalize of the algorithm that holds a policy, if it scales observations; else None."""
    holders = gc.get_referrers(policy)
    holders += [owner for part in holders if isinstance(part, dict) for owner in _owners(part)]
    for holder in holders:
        if isinstance(holder, BaseAlgorithm):
            found = holder.get_vec_normalize_env()
            if found is not None and found.norm_obs:
                return found
    return None


def _owners(attributes: dict[Any, Any]) -> list[Any]:
    return [x for x in gc.get_referrers(attributes) if getattr(x, "__dict__", None) is attributes]


class OnSignals:
    """A `ModularPolicy` as it acts in a loop: w pi((s - mean) / std), or w tanh(pi(...)).

    VecNormalize gives mean and std and clips: its slopes are 1/std times as large, and vanish where
    it clips. An off-policy algorithm scales actions from [-1, 1] to the action space: w is half its
    width, its middle joins `u0`.

    Args:
        policy: what sees the signals as the algorithm delivers them.
        scales: the VecNormalize, whose present mean and variance count, or None.
        box: action space that [-1, 1] is scaled to, or None.

    Raises:
        ValueError: if VecNormalize also scales T_a or R on their way to the policy.
    """

    def __init__(
        self, policy: ModularPolicy, scales: Any = None, box: spaces.Box | None = None
    ) -> None:
        if scales is not None and set(policy.layout) != {"s"}:
            raise ValueError("VecNormalize scales T_a and R as well: the policy sees wrong ones")
        self.n, self.layout, self.normalise = policy.n, policy.layout, policy.normalise
        self.integral, self.squash, self.R = policy.integral, policy.squash, policy.R.numpy()
        low, high = (-1.0, 1.0) if box is None else (box.low.astype(float), box.high.astype(float))
        self.half, self.u0 = (high - low) / 2, (high + low) / 2 + policy.u0.numpy()
        self.network = copy.deepcopy(policy.network).double()
        self.mean, self.std, self.clip = 0.0, np.ones((self.n, 2)), np.inf
        if scales is not None:
            part, shape = policy.layout["s"], (self.n, 2)
            self.mean = scales.obs_rms.mean[part].reshape(shape)
            self.std = np.sqrt(scales.obs_rms.var[part] + scales.epsilon).reshape(shape)
            self.clip = float(scales.clip_obs)
        self.bounds = policy.slope_bounds()

    def pi(self, s: Array) -> Array:
        """The action before the sign rule, on the plain signals, (..., n, 2) to (..., n)."""
        seen = np.clip((s - self.mean) / self.std, -self.clip, self.clip)
        seen = seen * [1.0, float(self.integral)]
        like = next(self.network.parameters())
        value = self.network(like.new_tensor(seen)).detach().numpy()
        return np.asarray(self.half * (np.tanh(value) if self.squash else value))

    def slope_bounds(self) -> tuple[Array, Array]:
        """Slopes' magnitude, (n, 2) each; from 0 where something clips or saturates."""
        low, high = (np.asarray(self.half)[..., None] * b / self.std for b in self.bounds)
        return low * (np.isinf(self.clip) and not self.squash), high
