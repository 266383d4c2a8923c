"""Two levels at two rates: a planner sets sub-goals, a low level pursues them.

The planner acts once a segment (`horizon` ticks) and learns by TD3 from (observation, sub-goal,
mean reward of the segment, next observation). The low level acts at every tick; its integral starts
anew with every sub-goal. All worlds of all seeds move in step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from cmc.envs.panda_task import PandaTask
from cmc.learning.hiro import OffPolicyCorrection
from cmc.learning.low_level import LowLevel, evaluate, rollout
from cmc.learning.planning import Planning
from cmc.learning.state import Arrays, Resumable, State, under
from cmc.learning.td3 import TD3, Replay
from cmc.theory.arrays import Array


@dataclass(frozen=True)
class HierarchyConfig:
    """Rates and sizes of the two levels; our choice where no table is named.

    Steps are environment steps of a seed. Updates are spread evenly over the segments. An entry of
    a sub-goal is drawn anew with a probability (`redraw`) that falls linearly from the first to the
    second value, and with another one (`burst`) a world begins `burst_segments` uniform sub-goals
    in a row.
    """

    worlds: int = 8  # of each seed
    samples: int = 1024  # steps between rounds of updates, `tab:para`
    high_updates: int = 100  # of the planner in a round, `tab:para`
    low_updates: int = 100  # of the low level in a round
    low_updates_late: int | None = None  # the same from `low_late` on, or None if they stay
    low_late: int = 60_000  # environment steps of a seed
    high_noise: float = 0.3  # standard deviation of the planner's noise, in half-ranges
    high_noise_end: float | None = None  # what it falls to, linearly, or None if it stays
    redraw: tuple[float, float] = (0.0, 0.0)
    burst: tuple[float, float] = (0.0, 0.0)
    burst_segments: int = 3
    noise_steps: int = 500_000  # until noise, redraws and bursts have fallen
    rate_steps: tuple[int, int] | None = None  # between which the planner's rates fall to a tenth
    warm_up: int = 10_000  # steps with random sub-goals, from which the low level alone learns
    reward_scale: float = 1.0  # factor on the mean reward of a segment
    capacity: int = 65536  # segments that the planner remembers, `tab:para`

    def __post_init__(self) -> None:
        if min(self.worlds, self.samples, self.capacity, self.noise_steps) < 1:
            raise ValueError(f"worlds, samples, capacity, noise_steps: wanted 1 or more: {self}")
        noise = (self.high_noise, self.high_noise_end or 0.0)
        if min(self.high_updates, self.low_updates, self.warm_up, *noise) < 0:
            raise ValueError(f"updates, warm_up and noise: wanted 0 or more: {self}")
        if not all(0 <= share <= 1 for share in (*self.redraw, *self.burst)):
            raise ValueError(f"redraw and burst: wanted probabilities, got {self}")
        if self.rate_steps is not None and not 0 <= self.rate_steps[0] < self.rate_steps[1]:
            raise ValueError(f"rate_steps: wanted two rising step counts, got {self.rate_steps}")

    def exploration(self, steps: int) -> tuple[float, float, float]:
        """Noise in half-ranges, and probabilities of a redraw and of a burst, after `steps`."""
        done = min(steps / self.noise_steps, 1.0)
        end = self.high_noise if self.high_noise_end is None else self.high_noise_end
        pairs = ((self.high_noise, end), self.redraw, self.burst)
        noise, redraw, burst = (first + done * (last - first) for first, last in pairs)
        return noise, redraw, burst

    def rate(self, steps: int) -> float:
        """Factor on the planner's Adam rates after `steps`."""
        if self.rate_steps is None:
            return 1.0
        start, end = self.rate_steps
        return 1.0 - 0.9 * min(max((steps - start) / (end - start), 0.0), 1.0)

    def updates(self, steps: int) -> tuple[int, int]:
        """Updates of the planner and of the low level that are due after `steps`, in all."""
        done = max(steps - self.warm_up, 0) / self.samples
        early = min(steps, self.low_late) / self.samples
        rest = self.low_updates if self.low_updates_late is None else self.low_updates_late
        late = steps / self.samples - early
        return int(done * self.high_updates), int(early * self.low_updates + late * rest)


class TwoLevel(Resumable):
    """Trains a planner and a low level on one task, several seeds side by side.

    The task has len(seeds) * config.worlds worlds, those of a seed side by side; the planner is TD3
    on observations that `planning` normalizes; `relabeller` may change the sub-goals it samples.
    """

    kept = ("steps", "burst", "streams", "planner", "replay", "low", "relabeller")

    def __init__(
        self,
        task: PandaTask,
        seeds: Sequence[int],
        planner: TD3,
        low: LowLevel,
        planning: Planning,
        config: HierarchyConfig,
        relabeller: OffPolicyCorrection | None = None,
    ) -> None:
        if task.num != len(seeds) * config.worlds:
            raise ValueError(f"wanted {len(seeds)} x {config.worlds} worlds, got {task.num}")
        if task.config.ticks % task.config.horizon:
            raise ValueError("an episode must hold a whole number of segments")
        self.task, self.seeds, self.config = task, tuple(seeds), config
        self.planner, self.low, self.planning = planner, low, planning
        self.relabeller = relabeller
        self.shape = (len(seeds), config.worlds)
        self.steps = 0  # environment steps of each seed
        self.success = np.full(len(seeds), np.nan)  # share of the last episodes that succeeded
        self.streams = [np.random.default_rng([seed, 1, 17]) for seed in seeds]
        task.seed([1_000_003 * seed + k for seed in seeds for k in range(config.worlds)])
        self._obs = task.reset()
        self.burst = np.zeros(self.shape, dtype=int)  # segments left of a burst
        size = planning.observe(task, self._obs).shape[-1]
        extra = relabeller.size if relabeller else 0
        self.replay = Replay(seeds, size, len(planning.low), config.capacity, 1, extra)

    @property
    def stride(self) -> int:
        """Environment steps of each seed in a segment."""
        return self.task.config.horizon * self.config.worlds

    def segment(self) -> Array:
        """One sub-goal, its ticks, and the updates that are due; mean rewards (seeds,)."""
        task, planning = self.task, self.planning
        seen = self._split(planning.observe(task, self._obs))
        action = self._choose(seen)
        obs = task.set_subgoal(planning.subgoal(action.reshape(task.num, -1)))
        last: dict[str, Any] = {}
        segment, reward, self._obs, over = rollout(
            task, self.low, obs, self.shape, explore=True, watch=last.update
        )
        following = self._split(planning.observe(task, self._obs))
        gain = self.config.reward_scale * reward
        # An episode ends by its time limit only: the next value always counts.
        parts = (seen, action, gain, following, np.ones_like(gain))
        self.replay.add(*parts, self.relabeller.pack(segment) if self.relabeller else None)
        self.low.record(segment)
        before = self.steps
        self.steps += self.stride
        self._learn(before)
        if over:
            self.success[:] = self._split(last["success"]).mean(1)
            self._obs = task.reset()
        return reward.mean(1)

    def _choose(self, seen: Array) -> Array:
        """The planner's action with noise, or a random one at first; (seeds, worlds, size)."""
        count = (self.config.worlds, len(self.planning.low))
        if self.steps < self.config.warm_up:
            middle = self.planning.direction(self.task, self._obs)
            drawn = np.stack([g.uniform(-1.0, 1.0, count) for g in self.streams])
            middle = self._split(middle) if middle.ndim else middle
            return np.clip(middle + drawn, -1.0, 1.0)
        noise, redraw, burst = self.config.exploration(self.steps)
        action = evaluate(self.planner.actor, seen)
        for seed, g in enumerate(self.streams):
            noisy = action[seed] + noise * g.standard_normal(count)
            begins = (g.random(count[0]) < burst) & (self.burst[seed] == 0)
            self.burst[seed, begins] = self.config.burst_segments
            drawn = (g.random(count) < redraw) | (self.burst[seed] > 0)[:, None]
            action[seed] = np.where(drawn, g.uniform(-1.0, 1.0, count), noisy)
        self.burst -= self.burst > 0
        return np.clip(action, -1.0, 1.0)

    def _learn(self, before: int) -> None:
        """Updates that fell due between two step counts, both levels."""
        earlier, due = self.config.updates(before), self.config.updates(self.steps)
        self.planner.set_rates(self.config.rate(self.steps))
        for _ in range(due[0] - earlier[0]):
            batch = self.replay.sample(self.planner.config.batch)
            self.planner.update(self.relabeller.relabel(batch) if self.relabeller else batch)
        for _ in range(due[1] - earlier[1]):
            self.low.update()

    def _split(self, array: Array) -> Array:
        return array.reshape(*self.shape, *array.shape[1:])

    def actors(self) -> dict[str, nn.Module]:
        """The networks that act: "planner" and, where it has one, "low"."""
        low = self.low.actor
        return {"planner": self.planner.acting} | ({} if low is None else {"low": low})

    def acting(self) -> tuple[nn.Module, LowLevel]:
        """Planner and low level as they are now."""
        return self.planner.acting.eval(), self.low

    def state(self) -> State:
        """Both levels, memory, physics, random streams."""
        arrays, record = super().state()
        world = self.task.snapshot()
        record["worlds"] = world.pop("streams")
        return {**{f"task/{name}": value for name, value in world.items()}, **arrays}, record

    def restore(self, arrays: Arrays, record: dict[str, Any]) -> None:
        """Continue from `state`."""
        super().restore(arrays, record)
        self._obs = self.task.restore({**under(arrays, "task/"), "streams": record["worlds"]})


def play(
    task: PandaTask,
    planning: Planning,
    planner: nn.Module,
    low: LowLevel,
    seeds: int,
    keep: Sequence[str],
    ticks: int | None = None,
) -> dict[str, Array]:
    """One episode of every world without exploration, and what is kept of every tick.

    The task has S * M worlds, those of a seed side by side, and its random streams decide the
    starts; the planner maps (S, M, size) to sub-goals in [-1, 1]; `seeds` is S. `keep` are names of
    what `task.step` tells (`reward`, `observation`, `success`, `contact_force`, ...), `distance` to
    the goal (m), and the worlds' `tip`, `target` (the sub-goal), `qpos` and `force` (3,). `ticks`
    replace the whole episode, in whole segments. Returns arrays (T, S, M, ...) by name.
    """
    kept: dict[str, list[Array]] = {name: [] for name in keep}
    shape = (seeds, task.num // seeds)

    def watch(found: dict[str, Any]) -> None:
        worlds, obs = task.worlds, found["observation"]
        missing = obs[:, task.layout["goal"]] - obs[:, task.layout["position"]]
        found |= {"distance": np.sqrt((missing**2).sum(-1)), "target": task.target}
        found |= {"tip": worlds.tip, "qpos": worlds.qpos, "force": worlds.force}
        for name, rows in kept.items():
            rows.append(np.array(found[name]).reshape(*shape, *np.shape(found[name])[1:]))

    obs = task.reset()
    for _ in range((ticks or task.config.ticks) // task.config.horizon):
        aim = planning.subgoal(evaluate(planner, planning.observe(task, obs).reshape(*shape, -1)))
        obs = task.set_subgoal(aim.reshape(task.num, -1))
        *_, obs, _ = rollout(task, low, obs, shape, explore=False, watch=watch)
    return {name: np.stack(rows) for name, rows in kept.items()}
