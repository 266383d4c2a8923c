"""The contracting actor for TD3 and DDPG of Stable-Baselines3: the paper's C-TD3."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import Tensor

from cmc.policies import ModularPolicy, PositiveNetwork
from cmc.sb3.signals import Array, OnSignals, check_spaces, hidden_layers, normalisation

ACTOR_HIDDEN, CRITIC_HIDDEN = (32, 32), (256, 256)


class _ModularActor(Actor):
    """An actor whose `mu` is a `ModularPolicy` with a tanh at its end: actions in [-1, 1]."""

    def __init__(self, network_kwargs: dict[str, Any], modular: dict[str, Any], **kw: Any) -> None:
        super().__init__(**kw)
        n = self.action_space.shape[0]  # type: ignore[index]
        network = PositiveNetwork(n, hidden=tuple(kw["net_arch"]), **network_kwargs)
        self.mu = ModularPolicy(network, squash=True, **modular)  # type: ignore[assignment]


class ContractingTD3Policy(TD3Policy):
    """TD3 and DDPG with one positive network per dimension: a_i = -sign(R_ii) tanh(pi_i).

    Stable-Baselines3 scales actions from [-1, 1] to the action space. The tanh saturates, so slopes
    have the right sign and a cap but no floor: `certify` answers in a region.

    Args:
        observation_space: a Box of one axis: s (n, 2) flat, or what `layout` says.
        action_space: a Box of one axis, n entries.
        lr_schedule: of the optimisers, given by the algorithm.
        network_kwargs: for `PositiveNetwork`, such as `slope_max`.
        layout: see `ModularPolicy`, as are `R`, `normalise` and `integral`.
        R: diagonal of R where the observation does not hold it.
        normalise: divide by |R_ii| in place of taking the sign alone.
        integral: False hides the integrals.
        net_arch: `{"pi": sizes, "qf": sizes}`, hidden layers of the networks and of the critics.
        **kwargs: for `TD3Policy`.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Any = None,
        *,
        network_kwargs: dict[str, Any] | None = None,
        layout: dict[str, slice] | None = None,
        R: Any = 1.0,
        normalise: bool = False,
        integral: bool = True,
        net_arch: Any = None,
        **kwargs: Any,
    ) -> None:
        if lr_schedule is None or "use_sde" in kwargs:
            raise TypeError(
                f"{type(self).__name__} is for TD3 and DDPG, whose actions have no distribution of "
                "their own; for PPO and A2C there is ContractingPolicy"
            )
        check_spaces(observation_space, action_space, layout)
        sizes = hidden_layers(net_arch, pi=ACTOR_HIDDEN, qf=CRITIC_HIDDEN)
        self._network_kwargs = dict(network_kwargs or {})
        self._modular = {"layout": layout, "R": R, "normalise": normalise, "integral": integral}
        sizes = {name: list(layers) for name, layers in sizes.items()}
        super().__init__(observation_space, action_space, lr_schedule, sizes, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """Build the actor, or its slow copy."""
        found = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return _ModularActor(self._network_kwargs, self._modular, **found).to(self.device)

    def on_signals(self) -> OnSignals:
        """The actor as a function of the plain s, scaled to the action space.

        Raises:
            ValueError: if VecNormalize also scales T_a or R on their way to the policy.
        """
        assert isinstance(self.actor.mu, ModularPolicy)
        assert isinstance(self.action_space, spaces.Box)
        return OnSignals(self.actor.mu, normalisation(self), self.action_space)

    def jacobian(self, s: Tensor) -> Tensor:
        """Slopes of the network, before tanh and sign rule: s (..., n, 2) to (..., n, 2)."""
        assert isinstance(self.actor.mu, ModularPolicy)
        return self.actor.mu.jacobian(s)

    def slope_bounds(self) -> tuple[Array, Array]:
        """Interval of the slopes' magnitude in the scaled action, (n, 2) each, from 0."""
        return self.on_signals().slope_bounds()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            **self._modular,
            "network_kwargs": self._network_kwargs,
        }
