"""One HTML file with a Panda that lives in the browser: MuJoCo, control law, policies, no kernel.

The physics is MuJoCo's official WebAssembly build; `world.js` holds the control law, the latent
signals and the networks once more. A test plays whole episodes there and in Python and compares
joints. The page loads nothing; it works from disk and inside sandboxed frames.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from cmc.store import asset, write_atomic
from cmc.view.playback.drawing import draw, drawn_bodies
from cmc.view.playback.page import viewer_source
from cmc.view.playback.scene import body_paths

GROUPS = (0, 1, 2)


def live_page(
    task: Mapping[str, Any],
    policies: Sequence[Mapping[str, Any]],
    *,
    title: str,
    arms: Sequence[Mapping[str, int]] = ({"method": 0, "kept": 0, "seed": 0},),
    plan: bool = True,
    target: Sequence[float] | None = None,
    camera: Mapping[str, Sequence[float]] | None = None,
) -> str:
    """The page as text.

    Args:
        task: scene, control law, limits and starts (`cmc.studies.live.live_task`).
        policies: what can be chosen: name, title, color, and the kept policies of every seed
            (`cmc.studies.live.live_policies`).
        title: heading.
        arms: one or two arms side by side, each the indices of a method, kept policy and seed.
        plan: whether the planner sets the sub-goals at first, or the reader.
        target: the first sub-goal where the reader sets it, (3,), m.
        camera: position and target in m; by default near the first goal.

    Raises:
        ValueError: for no arm or more than two, or an arm that names no policy.
    """
    if not 1 <= len(arms) <= 2:
        raise ValueError(f"arms: wanted one or two, got {len(arms)}")
    for arm in arms:
        try:
            policies[arm["method"]]["kept"][arm["kept"]]["policies"][arm["seed"]]
        except (IndexError, KeyError) as error:
            raise ValueError(f"arms: no policy {dict(arm)}") from error
    model = mujoco.MjModel.from_xml_string(task["xml"])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    paths = body_paths(model)
    goal = np.array(task["starts"][0]["goal"])
    view = camera or {"position": (goal + [0.06, -0.09, 0.06]).tolist(), "target": goal.tolist()}
    content = {
        "title": title,
        "task": task,
        "policies": _packed(policies),
        "arms": [dict(arm) for arm in arms],
        "plan": plan,
        "target": list(target) if target is not None else (goal + [0, 0, 0.02]).tolist(),
        "camera": view,
        "ball": 0.0012,
        "commands": [_text(command) for command in draw(model, data, GROUPS).commands],
        "bodies": [{"path": paths[b], "id": b} for b in drawn_bodies(model, GROUPS)],
    }
    parts = {
        "TITLE": html.escape(title),
        "VIEWER": viewer_source(),
        "ENGINE": _engine(),
        "WASM": _text(asset("mujoco", "mujoco.wasm.gz").read_bytes()),
        "PAGE": json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
        "APP": _own("app.js"),
    }
    head, *rest = _own("page.html").split("@@")
    return head + "".join(parts.get(part, part) for part in rest)


def save_live_page(path: str | Path, *args: Any, **options: Any) -> Path:
    """Write `live_page(...)` to a file (a half-written page never appears) and return its path."""
    text = live_page(*args, **options).encode()
    return write_atomic(path, lambda file: file.write(text))


def _engine() -> str:
    """MuJoCo's loader as a classic script, the world and the worker, without a closing tag."""
    loader = asset("mujoco", "mujoco.js").read_text("utf-8")
    loader = loader.replace("export default loadMujoco;", "").replace(
        "import.meta.url", "'file:///'"
    )
    source = "\n".join([loader, _own("world.js"), _own("worker.js")])
    if "</script" in source:
        raise RuntimeError("the engine cannot be inlined: it contains a closing script tag")
    return source


def _packed(value: Any) -> Any:
    """Arrays become base64 of little-endian float32; matrices say their sizes beside them."""
    if isinstance(value, np.ndarray):
        return _text(np.ascontiguousarray(value, dtype="<f4").tobytes())
    if isinstance(value, Mapping):
        sizes = {}
        if isinstance(value.get("w"), np.ndarray):
            sizes = {"inputs": value["w"].shape[0], "outputs": value["w"].shape[1]}
        return {key: _packed(item) for key, item in value.items()} | sizes
    return [_packed(item) for item in value] if isinstance(value, (list, tuple)) else value


def _own(name: str) -> str:
    return resources.files("cmc.view.simulator").joinpath(name).read_text("utf-8")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
