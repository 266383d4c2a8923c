"""The policies of this package as Stable-Baselines3 policy classes (extra `cmc[sb3]`).

    model = PPO(ContractingPolicy, env)
    model = TD3(ContractingTD3Policy, env)

is the whole change to a training with Stable-Baselines3: the (mean) action becomes `ModularPolicy`,
with one positive network per dimension; the critic, the noise and the algorithm stay. `save` and
`load` are Stable-Baselines3's own (read with pickle: load only files that you trust); without
pickle, `cmc.store.save_checkpoint` keeps `model.policy.state_dict()`.
"""

from __future__ import annotations

import copy
import gc
import sys
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

try:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.td3.policies import Actor, TD3Policy
except ImportError as error:
    raise ImportError("cmc.sb3 needs Stable-Baselines3: pip install 'cmc[sb3]'") from error

from cmc.policies import ConvexGradientNetwork, IndependentNetwork, ModularPolicy, PositiveNetwork
from cmc.theory.arrays import Array, count


class _Modular(BasePolicy):
    """What the policy classes share: an action that is a `ModularPolicy` on the observation.

    The observation is s, the flat (n, 2) array of (z_i, integral of z_i), or holds it where
    `layout` says; n is the size of the action. Both spaces are a Box of one axis. `network_kwargs`
    are for the network, such as `slope_min`, `slope_max` and `joint_cap`; `layout`, `R`,
    `normalise` and `integral` for `ModularPolicy`; `net_arch` holds hidden layers by key: of the
    networks ("pi") and of the critic ("vf" or "qf"); the rest is for Stable-Baselines3.
    """

    _where: ClassVar[str]  # for which algorithms the class is
    _strange: ClassVar[str]  # an argument that tells another algorithm
    _hidden: ClassVar[dict[str, tuple[int, ...]]]  # layers where net_arch says nothing
    _theirs: ClassVar[dict[str, Any]] = {}  # and those that Stable-Baselines3 builds otherwise
    _options: ClassVar[tuple[str, ...]] = ("layout", "R", "normalise", "integral")
    _action: ClassVar[Any]  # where the `ModularPolicy` is

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Any = None,
        *,
        network_kwargs: dict[str, Any] | None = None,
        net_arch: Any = None,
        **kwargs: Any,
    ) -> None:
        if not callable(lr_schedule) or self._strange in kwargs:
            raise TypeError(f"{type(self).__name__} {self._where}")
        if not isinstance(network_kwargs, dict | None):
            raise ValueError(f"network_kwargs: wanted a dictionary, got {network_kwargs!r}")
        self._modular = {name: kwargs.pop(name) for name in self._options if name in kwargs}
        for name in {"normalise", "integral"} & set(self._modular):
            if not isinstance(self._modular[name], bool):
                raise ValueError(f"{name}: wanted True or False, got {self._modular[name]!r}")
        sizes, both = self._layers(net_arch), (observation_space, action_space)
        self._asked = {**self._modular, "network_kwargs": network_kwargs or {}, "net_arch": sizes}
        super().__init__(*both, lr_schedule, sizes | self._theirs, **kwargs)  # type: ignore[call-arg]

    def _layers(self, asked: Any) -> dict[str, list[int]]:
        """Hidden layers by key; as in Stable-Baselines3, a dictionary without a key means none."""
        given = self._hidden if asked is None else asked
        given = given if isinstance(given, dict) else dict.fromkeys(self._hidden, given)
        lists = all(isinstance(layers, list | tuple) for layers in given.values())
        if not lists or not set(given) <= set(self._hidden):
            raise ValueError(f"net_arch: wanted sizes for {', '.join(self._hidden)}, got {asked!r}")
        return {key: [count("net_arch", n) for n in given.get(key, ())] for key in self._hidden}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._asked}  # type: ignore[misc]

    def _policy(self, kind: Any, **options: Any) -> ModularPolicy:
        """The action by networks of a kind, where spaces and layout hold what they need."""
        seen, action = self.observation_space, self.action_space
        if not isinstance(action, spaces.Box) or len(action.shape) != 1:
            raise ValueError(f"wanted actions in a Box of one axis; got {action}")
        n, shape = action.shape[0], tuple(seen.shape or ())
        laid_out = self._modular.get("layout") is not None
        if not isinstance(seen, spaces.Box) or (len(shape) != 1 if laid_out else shape != (2 * n,)):
            raise ValueError(
                f"wanted observations of shape ({2 * n},), (z_i, integral of z_i) for each of "
                f"{n} actions, or a layout; got {shape or seen}"
            )
        hidden, kwargs = self._asked["net_arch"]["pi"], self._asked["network_kwargs"]
        hidden = (hidden or [0])[0] if kind is ConvexGradientNetwork else hidden
        policy = ModularPolicy(kind(n, hidden=hidden, **kwargs), **self._modular, **options)
        wanted = {"s": 2 * n, "z": n, "integral": n, "R": n, "T_a": n * n}
        for name, part in policy.layout.items():
            if len(range(*part.indices(*shape))) != wanted[name] or (part.stop or 0) > shape[0]:
                raise ValueError(
                    f"layout: {name!r} needs {wanted[name]} numbers for {n} actions, got {part} of "
                    f"an observation of shape {shape}"
                )
        return policy

    def jacobian(self, s: torch.Tensor) -> torch.Tensor:
        """Slopes of the network, before sign rule and any tanh: s (..., n, 2) to (..., n, 2)."""
        return self._action(self).jacobian(s)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Interval of the slopes' magnitude in the action by the plain s, (n, 2) each."""
        return self.on_signals().slope_bounds()  # type: ignore[operator]

    def _normalisation(self) -> Any:
        """VecNormalize of the algorithm that holds this, if it scales observations; else None."""
        holders = gc.get_referrers(self)
        for part in [part for part in holders if isinstance(part, dict)]:  # attributes of something
            holders += [x for x in gc.get_referrers(part) if getattr(x, "__dict__", None) is part]
        found = [x.get_vec_normalize_env() for x in holders if isinstance(x, BaseAlgorithm)]
        return next((env for env in found if env is not None and env.norm_obs), None)


class _ActorCritic(_Modular, ActorCriticPolicy):
    """Gaussian policy whose mean is a `ModularPolicy`; takes its `u0`, the center, as well."""

    _where = "is for PPO, A2C and their like; for TD3 and DDPG there is ContractingTD3Policy"
    _strange, _action = "n_critics", attrgetter("action_net")
    _options = (*_Modular._options, "u0")
    _hidden: ClassVar = {"pi": (32, 32), "vf": (64, 64)}
    _theirs: ClassVar = {"pi": []}  # the mean sees the observation
    network: ClassVar[Any]
    # what other algorithms ask their policies for
    _foreign = ("critic", "critic_target", "actor_target", "q_net", "lstm_actor", "quantile_net")

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = self._policy(self.network)
        options: Any = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **options)  # a module is new

    @property
    def actor(self) -> ModularPolicy:
        """The mean as a policy of this package."""
        return self.action_net  # type: ignore[return-value]

    def on_signals(self) -> Any:
        """The mean as a function of the plain s: behind the algorithm's VecNormalize, if any."""
        found = self._normalisation()
        return self.actor if found is None else _OnSignals(self.actor, found)

    def __getattr__(self, name: str) -> Any:
        if name in self._foreign:
            raise AttributeError(f"{type(self).__name__} {self._where}: it has no {name!r}")
        return super().__getattr__(name)


class ContractingPolicy(_ActorCritic):
    """One positive network per dimension: the slopes have the signs that contraction asks for."""

    network = PositiveNetwork


class IndependentPolicy(_ActorCritic):
    """One unconstrained network per dimension: the baseline that differs in the signs only."""

    network = IndependentNetwork


class ConvexGradientPolicy(_ActorCritic):
    """P and I terms as gradients of convex networks (arXiv 2305.17777); one size of "pi" counts."""

    network = ConvexGradientNetwork


class ContractingTD3Policy(_Modular, TD3Policy):
    """TD3 and DDPG with one positive network per dimension: a_i = -sign(R_ii) tanh(pi_i).

    Stable-Baselines3 scales actions from [-1, 1] to the action space. The tanh saturates, so slopes
    have the right sign and a cap but no floor: `certify` answers in a region.
    """

    _where = "is for TD3 and DDPG; for PPO and A2C there is ContractingPolicy"
    _strange, _action = "use_sde", attrgetter("actor.mu")
    _hidden: ClassVar = {"pi": (32, 32), "qf": (256, 256)}

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Build the actor, or its slow copy."""
        actor = super().make_actor(features_extractor)
        actor.mu = self._policy(PositiveNetwork, squash=True)  # type: ignore[assignment]
        return actor.to(self.device)

    def on_signals(self) -> _OnSignals:
        """The actor as a function of the plain s, scaled to the action space."""
        return _OnSignals(self._action(self), self._normalisation(), self.action_space)


class _OnSignals:
    """A `ModularPolicy` as it acts in a loop: w pi((s - mean) / std), or w tanh(pi(...)).

    VecNormalize (`scales`) gives mean and std and clips: its slopes are 1/std times as large, and
    vanish where it clips. An off-policy algorithm scales actions from [-1, 1] to the action space
    (`box`): w is half its width, its middle joins `u0`.
    """

    def __init__(self, policy: ModularPolicy, scales: Any, box: Any = None) -> None:
        if scales is not None and set(policy.layout) != {"s"}:
            raise ValueError("VecNormalize scales T_a and R as well: the policy sees wrong ones")
        policy = copy.deepcopy(policy).cpu()
        self.layout, self.normalise, self.R = policy.layout, policy.normalise, policy.R.numpy()
        self.squash, self.integral = policy.squash, policy.integral
        low, high = (-1.0, 1.0) if box is None else (box.low.astype(float), box.high.astype(float))
        self.half, self.u0 = (high - low) / 2, (high + low) / 2 + policy.u0.numpy()
        self.mean, self.std, self.clip = 0.0, np.ones((policy.n, 2)), np.inf
        if scales is not None:
            seen = (scales.obs_rms.mean, np.sqrt(scales.obs_rms.var + scales.epsilon))
            self.mean, self.std = (x[policy.layout["s"]].reshape(policy.n, 2) for x in seen)
            self.clip = float(scales.clip_obs)
        self.bounds, self.network = policy.slope_bounds(), policy.network.double()

    def pi(self, s: Array) -> Array:
        """The action before the sign rule, on the plain signals, (..., n, 2) to (..., n)."""
        seen = np.clip((s - self.mean) / self.std, -self.clip, self.clip)
        value = self.network(torch.from_numpy(seen * [1.0, float(self.integral)])).detach().numpy()
        return np.asarray(self.half * (np.tanh(value) if self.squash else value))

    def slope_bounds(self) -> tuple[Array, Array]:
        """Slopes' magnitude, (n, 2) each; from 0 where something clips or saturates."""
        low, high = (np.asarray(self.half)[..., None] * b / self.std for b in self.bounds)
        return low * (np.isinf(self.clip) and not self.squash), high


class BatchedVecEnv(VecEnv):
    """A batched Gymnasium vector environment, one that restarts in the same step, as a `VecEnv`."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(env, VectorEnv):
            raise ValueError(f"env: wanted a vector environment of Gymnasium, got {env!r}")
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if mode != AutoresetMode.SAME_STEP:
            wanted = "autoreset_mode=AutoresetMode.SAME_STEP, as Stable-Baselines3 expects"
            raise ValueError(f"env: wanted a restart in the same step, {wanted}; got {mode}")
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._return, self._length = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int)

    def reset(self) -> Any:
        """Start all trajectories."""
        observation, _ = self.env.reset(seed=self._seeds[0])  # as `seed` has set them
        self._reset_seeds()
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
        """The batched environment's attribute, once for each trajectory asked for."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError("trajectories of a batch share their attributes and methods")

    set_attr = env_method = _refuse

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No trajectory of a batch is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


for _name in ("actor_critic", "td3"):  # modules that files name which an earlier version saved
    sys.modules.setdefault(f"{__name__}.{_name}", sys.modules[__name__])
