"""PPO: environment steps per CPU-second against Stable-Baselines3, everything else alike.

Both train on the natively batched peg-touch environment, 16 trajectories a seed, with the same
networks, the same hyperparameters and a critic that sees the observation alone.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc.envs.peg_touch import PegTouchEnv, PegTouchVectorEnv
from cmc.learning.ppo import PPO, PPOConfig
from cmc.policies import JointNetwork, ModularPolicy, PositiveNetwork

WARM_UP, UPDATES, REPEATS = 2, 15, 4
TRAJECTORIES, STEPS = 16, 50
HIDDEN, CRITIC = (32, 32), (64, 64)


class _Plain(PegTouchVectorEnv):
    """The critic sees the observation alone, as it does in Stable-Baselines3."""

    def reset(self, **kwargs: Any) -> Any:
        return super().reset(**kwargs)[0], {}

    def step(self, actions: Any) -> Any:
        *result, info = super().step(actions)
        return *result, {"final_obs": info["final_obs"]} if "final_obs" in info else {}


def _ours(network: type[nn.Module], seeds: int) -> PPO:
    numbers = list(range(seeds))
    policy = ModularPolicy(network(2, seeds=numbers, hidden=HIDDEN))
    config = PPOConfig(steps=STEPS, critic_hidden=CRITIC)
    return PPO(_Plain(num_envs=TRAJECTORIES * seeds), policy, numbers, config)


def _theirs(policy: Any, batched: bool = True) -> Any:
    from stable_baselines3 import PPO as SB3PPO
    from stable_baselines3.common.env_util import make_vec_env

    from cmc.sb3 import BatchedVecEnv

    env: Any = (
        BatchedVecEnv(PegTouchVectorEnv(num_envs=TRAJECTORIES))
        if batched
        else make_vec_env(PegTouchEnv, TRAJECTORIES)
    )
    c = PPOConfig()
    arch = {"pi": list(HIDDEN), "vf": list(CRITIC)}
    return SB3PPO(
        policy,
        env,
        n_steps=STEPS,
        batch_size=TRAJECTORIES * STEPS // c.minibatches,
        n_epochs=c.epochs,
        learning_rate=c.learning_rate,
        policy_kwargs={"net_arch": arch, "log_std_init": c.log_std_start},
        seed=0,
        device="cpu",
    )


def _learner(trainer: Any) -> tuple[Callable[[int], None], Callable[[], float]]:
    """How to do some updates more, and the mean return of the last of them."""
    if isinstance(trainer, PPO):
        last: list[float] = []
        more = trainer.train
        return (
            lambda n: more(
                trainer.updates + n, lambda row: last.append(float(np.mean(row["episode_return"])))
            ),
            lambda: float(np.mean(last[-10:])),
        )
    return (
        lambda n: trainer.learn(n * TRAJECTORIES * STEPS, reset_num_timesteps=False),
        lambda: float(np.mean([episode["r"] for episode in trainer.ep_info_buffer])),
    )


def _measure(trainers: dict[str, tuple[Any, int]]) -> dict[str, dict[str, float]]:
    """Steps per CPU-second, best of interleaved repeats, and the return they reached."""
    learners = {name: _learner(trainer) for name, (trainer, _) in trainers.items()}
    best = dict.fromkeys(trainers, 0.0)
    for learn, _ in learners.values():
        learn(WARM_UP)
    for _ in range(REPEATS):
        for name, (learn, _) in learners.items():
            start = time.process_time()
            learn(UPDATES)
            spent = time.process_time() - start
            steps = UPDATES * TRAJECTORIES * STEPS * trainers[name][1]
            best[name] = max(best[name], steps / spent)
    return {
        name: {"steps_per_cpu_second": round(best[name]), "return": round(score(), 1)}
        for name, (_, score) in learners.items()
    }


def run() -> Iterator[dict[str, Any]]:
    """Yield one row for each comparison."""
    warnings.filterwarnings("ignore", module="stable_baselines3")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        from cmc.sb3 import ContractingPolicy

        found = _measure(
            {
                "sb3 joint": (_theirs("MlpPolicy"), 1),
                "sb3 joint, one environment at a time": (_theirs("MlpPolicy", False), 1),
                "sb3 contracting": (_theirs(ContractingPolicy), 1),
                "joint, 1 seed": (_ours(JointNetwork, 1), 1),
                "joint, 5 seeds": (_ours(JointNetwork, 5), 5),
                "contracting, 1 seed": (_ours(PositiveNetwork, 1), 1),
                "contracting, 5 seeds": (_ours(PositiveNetwork, 5), 5),
            }
        )
    finally:
        torch.set_num_threads(threads)
    for ours, theirs in (
        ("joint, 1 seed", "sb3 joint"),
        ("joint, 5 seeds", "sb3 joint"),
        ("joint, 5 seeds", "sb3 joint, one environment at a time"),
        ("contracting, 1 seed", "sb3 contracting"),
        ("contracting, 5 seeds", "sb3 contracting"),
        ("contracting, 5 seeds", "sb3 joint"),
    ):
        speed, other = (found[name]["steps_per_cpu_second"] for name in (ours, theirs))
        yield {
            "name": f"PPO {ours} / {theirs}",
            "ratio": round(speed / other, 2),
            "steps_per_cpu_second": speed,
            "sb3_steps_per_cpu_second": other,
            "return": found[ours]["return"],
            "sb3_return": found[theirs]["return"],
        }
