"""Training runs of the peg-touch study: configuration, policies kept on the way, loading them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from cmc import store
from cmc.envs.peg_touch import PegTouchVectorEnv
from cmc.envs.peg_touch_config import PegTouchConfig
from cmc.learning.ppo import PPO, PPOConfig
from cmc.studies.peg_touch_evaluation import TestConfig
from cmc.studies.peg_touch_methods import METHODS, method
from cmc.theory.sampled import largest_slope

NAME = "peg_touch"
Callback = Callable[[dict[str, Any]], object]


@dataclass(frozen=True)
class PegTouchStudy:
    """Everything a run depends on. Defaults are the shipped runs."""

    task: PegTouchConfig = field(default_factory=PegTouchConfig)
    """The environment in training. Paper where it says, else our choice."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """PPO in the ordinary setting. Our choice."""
    stress: PPOConfig = field(
        default_factory=lambda: PPOConfig(learning_rate=3e-3, epochs=10, log_std_floor=-20.0)
    )
    """PPO in the stress setting. Our choice."""
    episodes: int = 15_000
    """Training episodes of each seed. Paper: tests start at episode 5000, the end is not given."""
    episodes_per_update: int = 16
    """Trajectories of each seed in an update. Our choice."""
    snapshot_every: int = 1000
    """Episodes between two kept policies. Paper, fig:1 b."""
    stiffness_reference: float = 16.0
    """Stiffness to which the scaled arms refer [N/m]: the middle of the range. Our choice."""
    worst_lag: float = 0.5
    """Caps are designed for lags this factor shorter. Paper's shift of tau, -50 %."""
    worst_stiffness: float = 2.0
    """Caps are designed for surfaces this factor stiffer. Paper's shift of K_sur, +100 %."""
    test: TestConfig = field(default_factory=TestConfig)
    """Tests. Paper: 8000 trajectories for each checkpoint."""

    def __post_init__(self) -> None:
        for name in ("episodes", "episodes_per_update", "snapshot_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: wanted at least 1, got {getattr(self, name)}")


def task_of(name: str, study: PegTouchStudy | None = None) -> PegTouchConfig:
    """The environment as a method sees it."""
    study, arm = study or PegTouchStudy(), method(name)
    scale = study.stiffness_reference if arm.scaled else None
    return replace(study.task, interface=arm.interface, stiffness_reference=scale)


def slope_limit(name: str, study: PegTouchStudy | None = None) -> np.ndarray:
    """What k1 + (h/2) k2 must stay below for the worst plant of the design, (2,)."""
    study, task = study or PegTouchStudy(), task_of(name, study)
    stiffest = task.K_sur[1] if task.stiffness_reference is None else task.stiffness_reference
    tau = study.worst_lag * np.array([task.tau_x, task.tau_z])
    return largest_slope(tau, np.array([1.0, study.worst_stiffness * stiffest]), task.h)


def build(
    name: str, seeds: Sequence[int] | None = None, study: PegTouchStudy | None = None
) -> nn.Module:
    """The untrained policy of a method, with a leading axis of seeds if given.

    Raises:
        ValueError: for an unknown method, or no seed.
    """
    if seeds is not None and len(seeds) == 0:
        raise ValueError("seeds: wanted at least one, got none")
    study = study or PegTouchStudy()
    return method(name).build(seeds, slope_limit(name, study), study.task.h)


def train(
    name: str,
    seeds: Sequence[int] = range(5),
    *,
    episodes: int | None = None,
    out: str | Path | None = None,
    study: PegTouchStudy | None = None,
    callback: Callback | None = None,
) -> Path:
    """Train a method and keep its policies; a run that was stopped goes on where it was.

    Args:
        name: one of `METHODS`.
        seeds: one training for each, all in one batch of networks.
        episodes: training episodes, in place of the study's.
        out: folder of the run, by default `runs/peg_touch`.
        study: configuration.
        callback: called with PPO's report after each update.

    Returns:
        The checkpoint file with all kept policies, which `load` reads.

    Raises:
        ValueError: for an unknown method, a method without training, or no seed.
        CheckpointError: if the folder holds a run of another configuration.
    """
    study, arm = study or PegTouchStudy(), method(name)
    study = study if episodes is None else replace(study, episodes=episodes)
    if not arm.trained:
        raise ValueError(f"{name!r} has fixed gains: there is nothing to train")
    policy = build(name, list(seeds), study)
    folder = Path(out) if out is not None else Path("runs") / NAME
    packed = folder / f"{NAME}_{name}.safetensors"
    state = folder / f"{name}_state.safetensors"
    envs = PegTouchVectorEnv(len(seeds) * study.episodes_per_update, task_of(name, study))
    trainer = PPO(envs, policy, list(seeds), study.stress if arm.stress else study.ppo)
    record = _record(name, seeds, study)
    kept: dict[str, np.ndarray] = {}
    if state.is_file() and packed.is_file():
        kept, found = store.load_checkpoint(packed, study=NAME, method=name)
        if found["configuration"] != record["configuration"] or found["seeds"] != list(seeds):
            raise store.CheckpointError(f"{packed} is a run of another configuration or seeds")
    returns = list(kept.pop("returns", []))

    def pack() -> None:
        curve = {"returns": np.array(returns, dtype=np.float32)} if returns else {}
        store.save_checkpoint(packed, kept | curve, record)

    def keep(report: dict[str, Any]) -> None:
        del returns[report["update"] - 1 :]
        returns.append(report["episode_return"])
        episode, size = report["episodes"], study.episodes_per_update
        last = report["update"] == report["total_updates"]
        if last or episode // study.snapshot_every > (episode - size) // study.snapshot_every:
            label = study.snapshot_every * (episode // study.snapshot_every) or episode
            for key, tensor in _weights(policy).items():
                kept[f"{label:06d}.{key}"] = tensor.numpy().copy()
            pack()  # before the state: a kill in between repeats updates and loses none
            trainer.save(state, record)
        if callback is not None:
            callback(report)

    updates = -(-study.episodes // study.episodes_per_update)
    try:
        trainer.train(updates, keep, checkpoint=state, every=updates, record=record)
    except KeyboardInterrupt:
        pack()
        raise
    return packed


def _record(name: str, seeds: Sequence[int], study: PegTouchStudy) -> dict[str, Any]:
    command = f"python -m cmc train {NAME} --method {name} --seeds {len(seeds)}"
    configuration = {
        "task": asdict(task_of(name, study)),
        "ppo": asdict(study.stress if METHODS[name].stress else study.ppo),
        "episodes": study.episodes,
        "episodes_per_update": study.episodes_per_update,
        "snapshot_every": study.snapshot_every,
        "slope_limit": slope_limit(name, study).tolist(),
    }
    plain = _plain(configuration)
    made = store.provenance(command, [int(seed) for seed in seeds])
    return {"study": NAME, "method": name, "configuration": plain, **made}


def _plain(value: Any) -> Any:
    """What JSON makes of a value: tuples become lists."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value


def checkpoint_path(name: str) -> Path:
    """The shipped checkpoints of a method.

    Raises:
        ValueError: for an unknown method.
        FileNotFoundError: if none are shipped.
    """
    method(name)
    return store.asset("checkpoints", f"{NAME}_{name}.safetensors")


def contents(name: str, path: str | Path | None = None) -> tuple[list[int], dict[str, Any]]:
    """The episodes of which policies are kept, and the record of the run."""
    tensors, record = store.load_checkpoint(path or checkpoint_path(name), study=NAME, method=name)
    marks = {match[1] for key in tensors if (match := re.match(r"(\d+)\.", key))}
    return sorted(int(mark) for mark in marks), record


def learning_curve(name: str, path: str | Path | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Episodes (updates,) and mean return of each update (updates, seeds)."""
    tensors, record = store.load_checkpoint(path or checkpoint_path(name), study=NAME, method=name)
    size = record["configuration"]["episodes_per_update"]
    returns = tensors["returns"]
    return size * np.arange(1, len(returns) + 1), returns


def load(
    name: str,
    episode: int | None = None,
    *,
    seed: int | None = None,
    path: str | Path | None = None,
) -> nn.Module:
    """A trained policy.

    Args:
        name: one of `METHODS`; hand-tuned ones need no file.
        episode: which of the kept policies; the last one if None.
        seed: position of one seed, for a policy without the leading axis; None for all seeds.
        path: checkpoint file; the shipped one if None.

    Raises:
        ValueError: for an unknown method, episode or seed.
        CheckpointError: if the file is missing, damaged, foreign or of another method.
    """
    if not method(name).trained:
        return build(name)
    path = path or checkpoint_path(name)
    tensors, record = store.load_checkpoint(path, study=NAME, method=name)
    marks, _ = contents(name, path)
    mark = marks[-1] if episode is None else episode
    if mark not in marks:
        raise ValueError(f"episode: wanted one of {marks}, got {episode}")
    seeds = record["seeds"]
    if seed is not None and not 0 <= seed < len(seeds):
        raise ValueError(f"seed: wanted a position from 0 to {len(seeds) - 1}, got {seed}")
    prefix = f"{mark:06d}."
    state = {key[len(prefix) :]: t for key, t in tensors.items() if key.startswith(prefix)}
    policy = build(name, seeds if seed is None else None)
    wanted = _weights(policy)
    if set(wanted) != set(state):
        raise store.CheckpointError(f"{path}: wanted tensors {sorted(wanted)}, got {sorted(state)}")
    fitted: dict[str, torch.Tensor] = {}
    for key, target in wanted.items():
        tensor = torch.from_numpy(state[key])
        if tensor.shape != target.shape:  # the stack of all seeds: take one seed's share
            if seed is None or tensor.shape[0] != target.shape[0] * len(seeds):
                shapes = f"wanted {tuple(target.shape)}, got {tuple(tensor.shape)}"
                raise store.CheckpointError(f"{path}: shape of {key}: {shapes}")
            tensor = tensor.reshape(len(seeds), *target.shape)[seed]
        fitted[key] = tensor
    policy.load_state_dict(fitted, strict=False)  # limits and other constants are not in the file
    return policy.eval()


def _weights(policy: nn.Module) -> dict[str, torch.Tensor]:
    """What was learned; constants such as slope limits follow from the configuration."""
    learned = {name for name, _ in policy.named_parameters()}
    return {key: tensor for key, tensor in policy.state_dict().items() if key in learned}
