"""The policies of this package as Stable-Baselines3 policy classes (extra `cmc[sb3]`).

    model = PPO(ContractingPolicy, env)

is the whole change to a training with Stable-Baselines3: the mean of the Gaussian policy becomes
`ModularPolicy`, with one positive network per dimension; the critic, the noise and the algorithm
stay. `save` and `load` are Stable-Baselines3's own (a zip file that it reads with pickle: load only
files that you trust); to keep weights without pickle, store `model.policy.actor.state_dict()` with
`cmc.store.save_checkpoint`.
"""

from __future__ import annotations

import copy
import gc
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from torch import Tensor, nn

from cmc.policies import ConvexGradientNetwork, IndependentNetwork, ModularPolicy, PositiveNetwork

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError("cmc.sb3 needs Stable-Baselines3: pip install 'cmc[sb3]'") from error

Array = NDArray[np.float64]
ACTOR_HIDDEN, CRITIC_HIDDEN = (32, 32), (64, 64)


_WHERE = "is for PPO, A2C and their like, which ask a policy for a Gaussian action and a value"
# What other algorithms ask their policies for.
_FOREIGN = {"critic", "critic_target", "actor_target", "q_net", "lstm_actor", "quantile_net"}


class _ModularActorCritic(ActorCriticPolicy):
    """Gaussian policy whose mean is a `ModularPolicy` on the observation.

    The observation is s, the flat (n, 2) array of (z_i, integral of z_i), or holds it where
    `layout` says; n is the size of the action.

    Args:
        observation_space: a Box of one axis.
        action_space: a Box of one axis, n entries.
        lr_schedule: of the optimiser, given by the algorithm.
        network_kwargs: for the network, such as `slope_min`, `slope_max` and `joint_cap`.
        layout: see `ModularPolicy`, as are `R`, `u0`, `normalise` and `integral`.
        R: diagonal of R where the observation does not hold it.
        u0: centre of the action.
        normalise: divide by |R_ii| in place of taking the sign alone.
        integral: False hides the integrals.
        net_arch: `{"pi": sizes, "vf": sizes}`, hidden layers of the networks and of the critic.
        **kwargs: for `ActorCriticPolicy`.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Any = None,
        *,
        network_kwargs: dict[str, Any] | None = None,
        layout: dict[str, slice] | None = None,
        R: Any = 1.0,
        u0: Any = 0.0,
        normalise: bool = False,
        integral: bool = True,
        net_arch: Any = None,
        **kwargs: Any,
    ) -> None:
        if lr_schedule is None or "n_critics" in kwargs:
            raise TypeError(f"{type(self).__name__} {_WHERE}")
        if not isinstance(action_space, spaces.Box) or len(action_space.shape) != 1:
            raise ValueError(f"wanted actions in a Box of one axis; got {action_space}")
        n = action_space.shape[0]
        if layout is None and observation_space.shape != (2 * n,):
            raise ValueError(
                f"wanted observations of shape ({2 * n},), (z_i, integral of z_i) for each of "
                f"{n} actions, or a layout; got {observation_space.shape}"
            )
        _check_layout(layout, observation_space.shape or (), n)
        sizes: dict[str, Any] = {"pi": ACTOR_HIDDEN, "vf": CRITIC_HIDDEN}
        if net_arch is not None:  # as in Stable-Baselines3, a key left out means no hidden layer
            both = net_arch if isinstance(net_arch, dict) else {"pi": net_arch, "vf": net_arch}
            sizes = {"pi": (), "vf": (), **both}
        self._hidden = tuple(sizes["pi"])
        self._network_kwargs = dict(network_kwargs or {})
        self._modular = {
            "layout": layout,
            "R": R,
            "u0": u0,
            "normalise": normalise,
            "integral": integral,
        }
        critic = {"pi": [], "vf": list(sizes["vf"])}  # no layer between observation and mean
        super().__init__(observation_space, action_space, lr_schedule, critic, **kwargs)

    def make_network(self, n: int, hidden: Sequence[int], **kwargs: Any) -> nn.Module:
        """Build the network of the mean."""
        raise NotImplementedError

    @property
    def actor(self) -> ModularPolicy:
        """The mean as a policy of this package, with `slope_bounds` and `jacobian`."""
        assert isinstance(self.action_net, ModularPolicy)
        return self.action_net

    def on_signals(self) -> Any:
        """The mean as a function of the plain s: behind the algorithm's VecNormalize if it has one.

        Raises:
            ValueError: if VecNormalize also scales T_a or R on their way to the policy.
        """
        found = _normalisation(self)
        return self.actor if found is None else Normalised(self.actor, found)

    def __getattr__(self, name: str) -> Any:
        if name in _FOREIGN:
            raise AttributeError(f"{type(self).__name__} {_WHERE}: it has no {name!r}")
        return super().__getattr__(name)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes of the network, before the sign rule: s (..., n, 2) to (..., n, 2)."""
        return self.actor.jacobian(s)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Guaranteed interval of the slopes' magnitude, (n, 2) each."""
        return self.actor.slope_bounds()

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        n = self.action_space.shape[0]  # type: ignore[index]
        network = self.make_network(n, self._hidden, **self._network_kwargs)
        self.action_net = ModularPolicy(network, **self._modular)
        self.optimizer = self.optimizer_class(  # again, because a module was replaced
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        sizes = {"pi": list(self._hidden), "vf": self.net_arch["vf"]}  # type: ignore[call-overload]
        return {
            **super()._get_constructor_parameters(),
            **self._modular,
            "network_kwargs": self._network_kwargs,
            "net_arch": sizes,
        }


def _check_layout(layout: dict[str, slice] | None, shape: tuple[int, ...], n: int) -> None:
    """Refuse a layout whose parts have the wrong length in an observation of this shape."""
    wanted = {"s": 2 * n, "R": n, "T_a": n * n}
    for name, part in (layout or {}).items():
        inside = range(*part.indices(shape[0])) if len(shape) == 1 else range(0)
        if name in wanted and (len(inside) != wanted[name] or (part.stop or 0) > shape[0]):
            raise ValueError(
                f"layout: {name!r} needs {wanted[name]} numbers for {n} actions, got {part} of an "
                f"observation of shape {shape}"
            )


def _normalisation(policy: nn.Module) -> Any:
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


class Normalised:
    """A `ModularPolicy` behind VecNormalize: pi((s - mean) / std), s clipped, as it acts in a loop.

    Its slopes are 1/std times as large, and vanish where VecNormalize clips.

    Args:
        policy: what sees the normalised signals.
        scales: the VecNormalize, whose present mean and variance count.
    """

    def __init__(self, policy: ModularPolicy, scales: Any) -> None:
        if set(policy.layout) != {"s"}:
            raise ValueError("VecNormalize scales T_a and R as well: the policy sees wrong ones")
        self.n, self.layout, self.normalise = policy.n, policy.layout, policy.normalise
        self.integral, self.u0, self.R = policy.integral, policy.u0.numpy(), policy.R.numpy()
        self.network = copy.deepcopy(policy.network).double()
        part, shape = policy.layout["s"], (self.n, 2)
        self.mean = scales.obs_rms.mean[part].reshape(shape)
        self.std = np.sqrt(scales.obs_rms.var[part] + scales.epsilon).reshape(shape)
        self.clip = float(scales.clip_obs)
        self.bounds = policy.slope_bounds()

    def pi(self, s: Array) -> Array:
        """The network on the signals as it sees them, (..., n, 2) to (..., n)."""
        seen = np.clip((s - self.mean) / self.std, -self.clip, self.clip)
        seen = seen * [1.0, float(self.integral)]
        like = next(self.network.parameters())
        return np.asarray(self.network(like.new_tensor(seen)).detach().numpy())

    def slope_bounds(self) -> tuple[Array, Array]:
        """From 0, where it is clipped, to the network's over std, (n, 2) each."""
        return 0.0 * self.bounds[0], self.bounds[1] / self.std


class ContractingPolicy(_ModularActorCritic):
    """One positive network per dimension: the slopes have the signs that contraction asks for."""

    def make_network(self, n: int, hidden: Sequence[int], **kwargs: Any) -> nn.Module:
        """Build a `PositiveNetwork`."""
        return PositiveNetwork(n, hidden=hidden, **kwargs)


class IndependentPolicy(_ModularActorCritic):
    """One unconstrained network per dimension: the baseline that differs in the signs only."""

    def make_network(self, n: int, hidden: Sequence[int], **kwargs: Any) -> nn.Module:
        """Build an `IndependentNetwork`."""
        return IndependentNetwork(n, hidden=hidden, **kwargs)


class ConvexGradientPolicy(_ModularActorCritic):
    """P and I terms as gradients of convex networks (arXiv 2305.17777)."""

    def make_network(self, n: int, hidden: Sequence[int], **kwargs: Any) -> nn.Module:
        """Build a `ConvexGradientNetwork` of `hidden[0]` units."""
        return ConvexGradientNetwork(n, hidden=hidden[0], **kwargs)


class BatchedVecEnv(VecEnv):
    """A natively batched Gymnasium vector environment as a Stable-Baselines3 one.

    Args:
        env: a vector environment that restarts in the same step.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                "wanted a vector environment that restarts in the same step (autoreset_mode="
                f"AutoresetMode.SAME_STEP), as Stable-Baselines3 expects; got {mode}"
            )
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._seed: int | None = None
        self._actions: Any = None
        self._return, self._length = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Use `seed` at the next reset."""
        self._seed = seed
        return [seed] * self.num_envs

    def reset(self) -> Any:
        """Start all trajectories."""
        observation, _ = self.env.reset(seed=self._seed)
        self._seed = None
        self._return[:], self._length[:] = 0.0, 0
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step; what ended reports its last observation and its return ("episode")."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        done = terminated | truncated
        self._return += reward
        self._length += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "episode": {"r": float(self._return[index]), "l": int(self._length[index])},
            }
        self._return[done], self._length[done] = 0.0, 0
        return observation, np.asarray(reward, dtype=np.float32), done, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the batched environment's attribute, once for each trajectory asked for."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: trajectories of a batch share their attributes."""
        raise NotImplementedError("trajectories of a batch share their attributes")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Refuse: trajectories of a batch share their methods."""
        raise NotImplementedError("trajectories of a batch share their methods")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No trajectory of a batch is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
