"""Gaussian policies for PPO, A2C and their like."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from cmc.policies import ConvexGradientNetwork, IndependentNetwork, ModularPolicy, PositiveNetwork
from cmc.sb3.signals import Array, OnSignals, check_spaces, hidden_layers, normalisation

ACTOR_HIDDEN, CRITIC_HIDDEN = (32, 32), (64, 64)

_WHERE = (
    "is for PPO, A2C and their like, which ask a policy for a Gaussian action and a value; "
    "for TD3 and DDPG there is ContractingTD3Policy"
)
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
        check_spaces(observation_space, action_space, layout)
        sizes = hidden_layers(net_arch, pi=ACTOR_HIDDEN, vf=CRITIC_HIDDEN)
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
        found = normalisation(self)
        return self.actor if found is None else OnSignals(self.actor, found)

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
