"""One HTML file that holds meshcat's viewer, one or more recorded scenes and their motion.

Nothing is loaded from elsewhere, and the page's own security policy forbids it: the file plays from
disk, from a notebook server, or from an e-mail attachment. Poses travel as base64 of little-endian
float32; the player (`player.js`) interpolates between frames and is exact at them.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.cameras import Camera
from cmc.view.playback.scene import Cloth, Scene, Skin

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)


def page(scenes: Sequence[Scene], *, live: bool = False, slider: bool = True) -> str:
    """The page of scenes side by side as text.

    Args:
        scenes: what to show, under one time slider.
        live: the page also listens to the server that it came from.
        slider: without it the page has no time slider: one beside the page moves it.
    """
    policy = _POLICY + ("; connect-src ws://127.0.0.1:* ws://localhost:*" if live else "")
    content = {
        "id": page_id(scenes),
        "live": live,
        "slider": slider,
        "scenes": [scene_data(scene, live) for scene in scenes],
    }
    parts = {
        "POLICY": policy,
        "TITLE": html.escape(" | ".join(scene.title for scene in scenes)),
        "VIEWER": viewer_source(),
        # a name such as </script> stays text
        "CONTENT": json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
        "PLAYER": _own("player.js"),
    }
    head, *rest = _own("page.html").split("@@")
    return head + "".join(parts.get(part, part) for part in rest)


def scene_data(scene: Scene, live: bool = False) -> dict[str, Any]:
    """What the player reads: everything of a scene, arrays packed as base64 text."""
    return {
        "title": scene.title,
        "commands": [] if live else [_text(c) for c in scene.commands],
        "times": _pack(scene.times, "<f8"),
        "bodies": scene.bodies,
        "poses": _pack(scene.poses, "<f4"),
        "skins": [_skin(skin) for skin in scene.skins],
        "cloths": [_cloth(cloth) for cloth in scene.cloths],
        "overlays": [_overlay(overlay) for overlay in scene.overlays],
        "readouts": [
            {"name": name, "values": _pack(v, "<f8")} for name, v in scene.readouts.items()
        ],
        "cameras": [_camera(name, camera) for name, camera in scene.cameras.items()],
    }


def page_id(scenes: Sequence[Scene]) -> str:
    """Short name of a page made of its contents; messages to it carry it."""
    digest = hashlib.sha256()
    for scene in scenes:
        digest.update(scene.title.encode())
        for part in (scene.times, scene.poses, *scene.commands):
            digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:16]


@cache
def viewer_source() -> str:
    """Meshcat's bundled viewer, three.js included, about 0.9 MB of JavaScript."""
    source = resources.files("meshcat").joinpath("viewer/dist/main.min.js").read_text("utf-8")
    if "</script" in source:
        raise RuntimeError("meshcat's viewer cannot be inlined: it contains a closing script tag")
    return source


def _overlay(overlay: Any) -> dict[str, Any]:
    arrays = {k: _pack(v, "<f4") for k, v in vars(overlay).items() if isinstance(v, np.ndarray)}
    return {"kind": type(overlay).__name__} | vars(overlay) | arrays


def _camera(name: str, camera: Camera) -> dict[str, Any]:
    """Rows (T, 3) where a camera moves, one row where it stands."""
    rows = {}
    for key in ("position", "target", "up"):
        array = np.atleast_2d(np.asarray(getattr(camera, key), dtype=float))
        rows[key] = _pack(array[:1] if (array == array[:1]).all() else array, "<f4")
    return {"name": name, "field_of_view": camera.field_of_view} | rows


def _cloth(cloth: Cloth) -> dict[str, Any]:
    """Corners as 16-bit shares of the box that holds them: 1/65535 of its side is not seen."""
    low = cloth.corners.min(axis=(0, 1))
    side = np.maximum(cloth.corners.max(axis=(0, 1)) - low, 1e-9)
    still = (cloth.corners == cloth.corners[:1]).all()
    shares = np.round((cloth.corners[: 1 if still else None] - low) / side * 65535)
    return _surface(cloth) | {
        "count": cloth.corners.shape[1],
        "low": low.tolist(),
        "side": side.tolist(),
        "shares": _pack(shares, "<u2"),
    }


def _skin(skin: Skin) -> dict[str, Any]:
    bones = [
        {
            "body": bone.body,
            "rest": bone.rest.astype(float).tolist(),
            "index": _pack(bone.index, "<u4"),
            "weight": _pack(bone.weight, "<f4"),
        }
        for bone in skin.bones
    ]
    return _surface(skin) | {"corners": _pack(skin.corners, "<f4"), "bones": bones}


def _surface(thing: Cloth | Skin) -> dict[str, Any]:
    r, g, b, a = thing.rgba
    return {
        "name": thing.name,
        "color": (round(255 * r) << 16) + (round(255 * g) << 8) + round(255 * b),
        "opacity": a,
        "faces": _pack(thing.faces, "<u4"),
    }


def _own(name: str) -> str:
    return resources.files("cmc.view.playback").joinpath(name).read_text("utf-8")


def _pack(array: NDArray[Any], kind: str) -> str:
    return _text(np.ascontiguousarray(array, dtype=kind).tobytes())


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
