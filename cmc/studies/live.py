"""What a live page needs of a peg study: the task, test starts, and policies as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor, nn

from cmc import store
from cmc.robot.panda import scene_spec
from cmc.studies.runner import find, load, marks_of
from cmc.studies.study import Study
from cmc.studies.two_level import start_joints
from cmc.studies.two_level_tests import TEST_SEED

CHOICE = ("ctd3", "frozen", "td3_corrected", "control")
"""Methods that a live page offers beside those it was asked for."""


def playable(study: Study) -> list[str]:
    """Shipped methods of `CHOICE`.

    Raises:
        ValueError: for a study without an arm.
    """
    if not hasattr(study.config, "task_class"):
        raise ValueError(f"{study.name} has no arm to play live; wanted peg_maze or peg_push")
    return [name for name in CHOICE if name in study.methods and find(study, name).is_file()]


def live_task(study: Study, starts: int = 5) -> dict[str, Any]:
    """Scene, control law, limits and test starts of a study's task; SI units throughout."""
    c, latent = study.config.task, study.config.task.gains.latent
    spec = scene_spec(c.scene, c.peg, c.timestep)
    spec.compile()
    task = study.config.make(starts)
    task.seed([TEST_SEED + k for k in range(starts)])
    obs = task.reset()
    goals, planning = obs[:, task.layout["goal"]], study.config.planning()
    sizes = {name: part.stop - part.start for name, part in task.layout.items()}

    def row(table: Any, name: str, default: float) -> list[float]:
        return np.broadcast_to(table.get(name, default), (sizes[name],)).astype(float).tolist()

    law = c.law
    return {
        "xml": spec.to_xml(),
        "substeps": round(c.tick / c.timestep),
        "compliant": c.peg.stiffness > 0,
        "K_p": latent.K_p.tolist(),
        "K_d": latent.K_d.tolist(),
        "K1": latent.K1.tolist(),
        "K2": latent.K2.tolist(),
        "integrates": [1.0] * 3 + [0.0] * 3,
        **{name: getattr(law, name) for name in ("form", "split", "error_limit", "pivot_floor")},
        **{name: getattr(law, name) for name in ("posture_stiffness", "posture_damping")},
        "posture": start_joints(c).tolist(),
        **{name: getattr(c, name) for name in ("tick", "horizon", "ticks", "increments")},
        **{name: getattr(c, name) for name in ("tilt_limit", "u_limit")},
        **{f"subgoal_{end}": getattr(c, f"subgoal_{end}") for end in ("low", "high")},
        **{f"workspace_{end}": getattr(c, f"workspace_{end}") for end in ("low", "high")},
        "planning": [
            {
                "name": name,
                "shift": row(planning.shift, name, 0.0),
                "scale": row(planning.scale, name, 1.0),
            }
            for name in planning.fields or task.high_level
        ],
        "starts": [
            {"qpos": task.worlds.qpos[k].tolist(), "goal": goals[k].tolist()} for k in range(starts)
        ],
    }


def live_policies(
    study: Study, methods: Sequence[str], steps: Sequence[int] | None = None
) -> list[dict[str, Any]]:
    """Planner and low level of every method, kept policy and seed, as nested lists of arrays.

    Args:
        study: configuration.
        methods: names; those with a low level of the tip, or none.
        steps: which kept policies; the last one of each method if None.
    """
    found = []
    for name in methods:
        kept = []
        if study.config_of(name).task.command != "pose":
            raise ValueError(f"{name} moves joints; a live page plays methods that move the tip")
        marks = marks_of(store.load_checkpoint(find(study, name))[0])
        for step in marks[-1:] if steps is None else [m for m in marks if m in steps][-3:]:
            loaded = load(study, name, step)
            planner, low = loaded.policy
            actor = getattr(low, "actor", None)
            policies = [
                {"planner": _layers(planner.network.mlp, k, 1)[0], "low": _low(actor, k)}
                for k in range(len(loaded.seeds))
            ]
            kept.append({"step": step, "seeds": loaded.seeds, "policies": policies})
        found.append({"name": name, "title": study.method(name).title, "kept": kept})
    return found


def _low(actor: nn.Module | None, seed: int) -> dict[str, Any]:
    if actor is None:
        return {"kind": "none"}
    net: Any = actor.network
    if not hasattr(net, "mlp"):  # the same gain for y and its integral
        return {"kind": "gain", "gain": net.gains[:, 0].numpy()}
    weights = net.positive_weights() if hasattr(net, "positive_weights") else None
    return {"kind": "networks", "networks": _layers(net.mlp, seed, net.n, weights)}


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
