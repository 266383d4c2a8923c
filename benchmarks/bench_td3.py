"""TD3 against Stable-Baselines3's, update for update, and what a two-level training costs in all.

An update draws a batch from a full memory and moves both critics; every second one moves the actor
and the targets too. Sizes of observation and action are those of the planner of peg push, and both
programs hold the same random transitions. Stable-Baselines3 has tanh networks as ours are, and once
more its own choice, ReLU. The last rows are whole trainings of five seeds: physics, both levels,
memory and updates. There `ratio` is the aim of 0.6 ms for a step of a seed over what was measured.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import nn

from benchmarks import best
from cmc.learning.td3 import TD3, Replay, TD3Config
from cmc.policies import DirectPolicy, JointNetwork
from cmc.studies import peg_maze, peg_push
from cmc.studies.study import Study

PAPER, SMALL = (400, 300), (128, 128)
ROWS, BATCH, PERIOD = 65_536, 128, 2
REPEATS = 7
CASES = [(peg_maze.STUDY, "ctd3"), (peg_maze.STUDY, "td3_corrected"), (peg_push.STUDY, "ctd3")]
SEEDS, AIM_MS = 5, 0.6
FIRST, STEPS, BLOCKS = 1_600, 800, 5
"""Environment steps of a seed with random sub-goals, then in each timed block, and blocks."""

Call = Callable[[], object]


def _sizes() -> tuple[int, int]:
    """Sizes of what the planner of peg push sees and does."""
    config, planning = peg_push.STUDY.config, peg_push.STUDY.config.planning()
    task = config.make(1)
    return planning.observe(task, task.reset()).shape[-1], len(planning.low)


def _data(observation: int, action: int) -> list[np.ndarray]:
    """Random transitions: observation, action, reward, next observation."""
    rng = np.random.default_rng(0)
    seen, following = rng.standard_normal((2, ROWS, observation), dtype=np.float32)
    done = rng.uniform(-1.0, 1.0, (ROWS, action)).astype(np.float32)
    return [seen, done, rng.standard_normal(ROWS, dtype=np.float32), following]


def _ours(data: list[np.ndarray], hidden: tuple[int, ...], seeds: int) -> Call:
    inputs, outputs = data[0].shape[-1], data[1].shape[-1]
    numbers = list(range(seeds))
    replay = Replay(numbers, inputs, outputs, ROWS)
    tiled = [np.broadcast_to(part, (seeds, *part.shape)) for part in data]
    replay.add(*tiled, np.ones((seeds, ROWS)))  # type: ignore[call-arg]
    config = TD3Config(critic_hidden=hidden, batch=BATCH, actor_period=PERIOD, target_period=PERIOD)
    network = JointNetwork(outputs, inputs=inputs, hidden=hidden, seeds=numbers, last=1.0)
    actor = DirectPolicy(network, squash=True)
    agent = TD3(actor, numbers, inputs, outputs, config)
    return lambda: agent.update(replay.sample(BATCH))


def _theirs(data: list[np.ndarray], hidden: tuple[int, ...], unit: type[nn.Module]) -> Any:
    """Stable-Baselines3's TD3 with a full memory."""
    from stable_baselines3 import TD3 as SB3TD3
    from stable_baselines3.common.logger import Logger

    inputs, outputs = data[0].shape[-1], data[1].shape[-1]
    c = TD3Config()
    model = SB3TD3(
        "MlpPolicy",
        _Spaces(inputs, outputs),
        learning_rate=c.critic_rate,
        buffer_size=ROWS,
        batch_size=BATCH,
        tau=c.target_rate,
        gamma=c.discount,
        policy_delay=PERIOD,
        target_policy_noise=c.target_noise,
        target_noise_clip=c.target_noise_clip,
        policy_kwargs={"net_arch": list(hidden), "activation_fn": unit},
        seed=0,
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    memory = model.replay_buffer
    assert memory is not None
    parts = (memory.observations, memory.actions, memory.rewards, memory.next_observations)
    for part, values in zip(parts, data, strict=True):
        part[:] = values.reshape(part.shape)
    memory.full = True
    return model


class _Spaces(gym.Env):  # type: ignore[type-arg]
    """Tells Stable-Baselines3 the sizes; never stepped."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (inputs,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (outputs,), np.float32)


def _often(call: Call, count: int) -> None:
    for _ in range(count):
        call()


def _updates() -> Iterator[dict[str, Any]]:
    data = _data(*_sizes())
    for hidden, seeds, count in ((PAPER, 1, 60), (SMALL, SEEDS, 150)):
        ours = _ours(data, hidden, seeds)
        others = {
            name: _theirs(data, hidden, unit)
            for name, unit in (("tanh", nn.Tanh), ("ReLU", nn.ReLU))
        }
        runs: dict[str, Call] = {"ours": partial(_often, ours, count)}
        runs |= {name: partial(model.train, count) for name, model in others.items()}
        for run in runs.values():
            run()
        ms = {name: 1e3 * cost / count for name, cost in best(runs, repeats=REPEATS).items()}
        for name in others:
            yield {
                "name": f"TD3 update, {hidden}, {seeds} seed(s) / sb3 with {name}, per seed",
                "ratio": round(ms[name] * seeds / ms["ours"], 2),
                "ms": round(ms["ours"] / seeds, 3),
                "sb3_ms": round(ms[name], 3),
            }


def _trainer(study: Study, method: str) -> Any:
    """Five seeds of a training, just past its warm-up, with all updates on."""
    config = study.config
    short = replace(
        config,
        hierarchy=replace(config.hierarchy, warm_up=FIRST),
        low=replace(config.low, critic_head_start=0),
    )
    trainer: Any = replace(study, config=short).build(method, list(range(SEEDS)))
    while trainer.steps < FIRST + trainer.stride:
        trainer.segment()
    return trainer


def _trainings() -> Iterator[dict[str, Any]]:
    trainers = {f"{study.name} {method}": _trainer(study, method) for study, method in CASES}
    lowest = dict.fromkeys(trainers, np.inf)
    for _ in range(BLOCKS):
        for name, trainer in trainers.items():
            before, start = trainer.steps, time.process_time()
            while trainer.steps < before + STEPS:
                trainer.segment()
            spent = 1e3 * (time.process_time() - start) / (SEEDS * (trainer.steps - before))
            lowest[name] = min(lowest[name], spent)
    for name, ms in lowest.items():
        yield {
            "name": f"{name}, {SEEDS} seeds: {AIM_MS} ms / all-in CPU of a step and seed",
            "ratio": round(AIM_MS / ms, 2),
            "ms": round(ms, 3),
        }


def run() -> Iterator[dict[str, Any]]:
    """Yield one row for each comparison."""
    warnings.filterwarnings("ignore", module="stable_baselines3")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield from _updates()
        yield from _trainings()
    finally:
        torch.set_num_threads(threads)
