"""What a live page needs of a peg study: the task, test starts, and policies as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor, nn

from cmc import store
from cmc.robot.panda import scene_spec
from cmc.studies.runner import find, load, marks_of
from cmc.studies.study import Study, checked_methods, checked_study
from cmc.studies.two_level import start_joints
from cmc.studies.two_level_tests import TEST_SEED
from cmc.theory.arrays import count

CHOICE = ("ctd3", "frozen", "td3_corrected", "control")
"""Methods that a live page offers beside those it was asked for."""


def playable(study: Study, first: Sequence[str] = ()) -> list[str]:
    """The methods `first`, then the shipped ones of `CHOICE`; a ValueError without an arm."""
    first = checked_methods("first", _arm(study), first)
    rest = [name for name in CHOICE if name in study.methods and find(study, name).is_file()]
    return list(dict.fromkeys([*first, *rest]))


def _arm(study: Study) -> Study:
    """A study with an arm, or a ValueError."""
    if not hasattr(checked_study(study).config, "task_class"):
        raise ValueError(f"{study.name} has no arm to play live; wanted peg_maze or peg_push")
    return study


def live_task(study: Study, starts: int = 5) -> dict[str, Any]:
    """Scene, control law, limits and test starts of a study's task; SI units throughout."""
    c, latent = _arm(study).config.task, study.config.task.gains.latent
    spec = scene_spec(c.scene, c.peg, c.timestep)
    spec.compile()
    task = study.config.make(count("starts", starts))
    task.seed([TEST_SEED + k for k in range(starts)])
    obs = task.reset()
    goals, planning = obs[:, task.layout["goal"]], study.config.planning()
    sizes = {name: part.stop - part.start for name, part in task.layout.items()}

    def row(table: Any, name: str, default: float) -> list[float]:
        return np.broadcast_to(table.get(name, default), (sizes[name],)).astype(float).tolist()

    gains = {name: getattr(latent, name).tolist() for name in ("K_p", "K_d", "K1", "K2")}
    law = ("form", "split", "error_limit", "pivot_floor", "posture_stiffness", "posture_damping")
    own = ("tick", "horizon", "ticks", "increments", "tilt_limit", "u_limit")
    ends = [f"{of}_{end}" for of in ("subgoal", "workspace") for end in ("low", "high")]
    each = zip(task.worlds.qpos, goals, strict=True)
    return {
        "xml": spec.to_xml(),
        "substeps": round(c.tick / c.timestep),
        "compliant": c.peg.stiffness > 0,
        **gains,
        "integrates": [1.0] * 3 + [0.0] * 3,
        **{name: getattr(c.law, name) for name in law},
        "posture": start_joints(c).tolist(),
        **{name: getattr(c, name) for name in (*own, *ends)},
        "planning": [
            {
                "name": name,
                "shift": row(planning.shift, name, 0.0),
                "scale": row(planning.scale, name, 1.0),
            }
            for name in planning.fields or task.high_level
        ],
        "starts": [{"qpos": qpos.tolist(), "goal": goal.tolist()} for qpos, goal in each],
    }


def live_policies(study: Study, methods: Sequence[str]) -> list[dict[str, Any]]:
    """Planner and low level of every shipped policy and seed of methods, as nested lists."""
    found = []
    for name in checked_methods("methods", _arm(study), methods, least=1):
        if study.config_of(name).task.command != "pose":
            raise ValueError(f"{name} moves joints; a live page plays methods that move the tip")
        kept = []
        for mark in marks_of(store.load_checkpoint(find(study, name))[0]):
            (planner, low), step, seeds, _ = load(study, name, mark)
            policies = [
                {"planner": _layers(planner.network.mlp, k, 1)[0], "low": _low(low.actor, k)}
                for k in range(len(seeds))
            ]
            kept.append({"step": step, "seeds": seeds, "policies": policies})
        found.append({"name": name, "title": study.method(name).title, "kept": kept})
    return found


def _low(actor: nn.Module | None, seed: int) -> dict[str, Any]:
    if actor is None:
        return {"kind": "none"}
    net: Any = actor.network
    if not hasattr(net, "mlp"):  # the same gain for y and its integral
        return {"kind": "gain", "gain": net.gains[:, 0].numpy()}
    return {"kind": "networks", "networks": _layers(net.mlp, seed, net.n, net.used_weights())}


def _layers(
    mlp: Any, seed: int, copies: int, weights: Sequence[Tensor] | None = None
) -> list[list[dict[str, Any]]]:
    """The networks of one seed in a stack: for each copy, layers with w (in, out) and b (out,)."""
    used = [w.detach().numpy() for w in (mlp.weights if weights is None else weights)]
    shift = [b.detach().numpy() for b in mlp.biases] or [None] * len(used)
    return [
        [{"w": w[k], "b": None if b is None else b[k, 0]} for w, b in zip(used, shift, strict=True)]
        for k in range(seed * copies, (seed + 1) * copies)
    ]
