"""The policies of this package as Stable-Baselines3 policy classes (extra `cmc[sb3]`).

    model = PPO(ContractingPolicy, env)
    model = TD3(ContractingTD3Policy, env)

is the whole change to a training with Stable-Baselines3: the (mean) action becomes `ModularPolicy`,
with one positive network per dimension; the critic, the noise and the algorithm stay. `save` and
`load` are Stable-Baselines3's own (a zip file that it reads with pickle: load only files that you
trust); to keep weights without pickle, store `model.policy.state_dict()` with
`cmc.store.save_checkpoint`.
"""

from __future__ import annotations

try:
    import stable_baselines3  # noqa: F401
except ImportError as error:
    raise ImportError("cmc.sb3 needs Stable-Baselines3: pip install 'cmc[sb3]'") from error

from cmc.sb3.actor_critic import ContractingPolicy, ConvexGradientPolicy, IndependentPolicy
from cmc.sb3.batched import BatchedVecEnv
from cmc.sb3.td3 import ContractingTD3Policy

__all__ = [
    "BatchedVecEnv",
    "ContractingPolicy",
    "ContractingTD3Policy",
    "ConvexGradientPolicy",
    "IndependentPolicy",
]
