"""One HTML file with a Panda that lives in the browser: MuJoCo, control law, policies, no kernel.

The physics is MuJoCo's official WebAssembly build; `world.js` holds the control law, the latent
signals and the networks once more. A test plays whole episodes there and in Python and compares
joints. The page loads nothing; it works from disk and inside sandboxed frames.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import mujoco
import numpy as np

from cmc.store import asset
from cmc.view.playback.page import base64_text, filled, to_json, viewer_source
from cmc.view.playback.shapes import body_paths, draw, visible
from cmc.view.style import METHOD_COLORS

_ROOM, _GROUPS = resources.files("cmc.view.simulator"), (0, 1, 2)


def live_page(
    task: Mapping[str, Any],
    policies: Sequence[Mapping[str, Any]],
    *,
    title: str,
    arms: int = 1,
    seed: int = 0,
) -> str:
    """The page as text.

    Args:
        task: scene, control law, limits and starts (`cmc.studies.live.live_task`); SI units.
        policies: what can be chosen (`cmc.studies.live.live_policies`).
        title: heading.
        arms: one, whose planner sets the sub-goals at first, or two side by side, with the first
            two policies, for which the reader sets them.
        seed: number of the seed in the last kept policy of each.
    """
    if arms not in (1, 2) or arms > len(policies):
        raise ValueError(f"arms: wanted 1 or 2, each with a policy of {len(policies)}, got {arms}")
    for policy in policies[:arms]:
        last = len(policy["kept"][-1]["seeds"]) - 1
        if not 0 <= seed <= last:
            raise ValueError(f"seed: wanted 0 to {last} for {policy['name']}, got {seed}")
    model = mujoco.MjModel.from_xml_string(task["xml"])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    paths = body_paths(model)
    goal, far = np.array(task["starts"][0]["goal"]), 1.6 if arms == 2 else 1.0
    content = {
        "title": title,
        "task": task,
        "policies": [{"color": METHOD_COLORS[p["name"]], **_packed(p)} for p in policies],
        "arms": [
            {"method": k, "kept": len(p["kept"]) - 1, "seed": seed}
            for k, p in enumerate(policies[:arms])
        ],
        "plan": arms == 1,
        "target": (goal + [0, 0, 0.02]).tolist(),
        "camera": {
            "position": (goal + far * np.array([0.06, -0.09, 0.06])).tolist(),
            "target": goal.tolist(),
        },
        "ball": 0.0012,
        "commands": draw(model, data, _GROUPS),
        "bodies": [{"path": paths[b], "id": b} for b in visible(model, _GROUPS)],
    }
    parts = {
        "TITLE": html.escape(title),
        "VIEWER": viewer_source(),
        "ENGINE": _engine(),
        "WASM": base64_text(asset("mujoco", "mujoco.wasm.gz").read_bytes()),
        "PAGE": to_json(content),
        "APP": _ROOM.joinpath("app.js").read_text("utf-8"),
    }
    return filled(_ROOM.joinpath("page.html").read_text("utf-8"), parts)


def _engine() -> str:
    """MuJoCo's loader as a classic script, the world and the worker, without a closing tag."""
    files = asset("mujoco", "mujoco.js"), _ROOM.joinpath("world.js"), _ROOM.joinpath("worker.js")
    source = "\n".join(file.read_text("utf-8") for file in files)
    source = source.replace("export default loadMujoco;", "").replace(
        "import.meta.url", "'file:///'"
    )
    if "</script" in source:
        raise RuntimeError("the engine cannot be inlined: it contains a closing script tag")
    return source


def _packed(value: Any) -> Any:
    """Arrays become float32; matrices say their sizes beside them."""
    if isinstance(value, np.ndarray):
        return value.astype("f4")
    if isinstance(value, Mapping):
        sizes = zip(("inputs", "outputs"), value["w"].shape, strict=True) if "w" in value else ()
        return {key: _packed(item) for key, item in value.items()} | dict(sizes)
    return [_packed(item) for item in value] if isinstance(value, (list, tuple)) else value
