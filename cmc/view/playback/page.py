"""One HTML file that holds meshcat's viewer, recorded scenes and their motion.

Nothing is loaded from elsewhere, and the page's own security policy forbids it: the file plays from
disk, from a notebook server, or from an e-mail attachment. Arrays travel as base64 of their bytes;
the player (`player.js`) interpolates between frames and is exact at them. A page around it moves it
by `postMessage({cmcPlayback: page_id, seek: seconds})`.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

_ROOM = resources.files("cmc.view.playback")


def page(scenes: Sequence[Any], *, live: bool = False) -> str:
    """The page of scenes side by side, under one time slider, as text.

    A `live` page also listens to the server that it came from.
    """
    content = {
        "id": page_id(scenes),
        "live": live,
        "scenes": [_scene(s) | ({"commands": []} if live else {}) for s in scenes],
    }
    parts = {
        "LIVE": "; connect-src ws://127.0.0.1:* ws://localhost:*" if live else "",
        "TITLE": html.escape(" | ".join(scene.title for scene in scenes)),
        "VIEWER": viewer_source(),
        "CONTENT": to_json(content),
        "PLAYER": _ROOM.joinpath("player.js").read_text("utf-8"),
    }
    return filled(_ROOM.joinpath("page.html").read_text("utf-8"), parts)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """A page whose `@@NAME@@` are replaced."""
    head, *rest = template.split("@@")
    return head + "".join(parts.get(part, part) for part in rest)


def _scene(scene: Any) -> dict[str, Any]:
    """What the player reads of a scene."""
    return {
        **{name: getattr(scene, name) for name in ("title", "times", "bodies", "poses", "skins")},
        "commands": list(scene.commands),
        "cloths": [_shares(cloth) for cloth in scene.cloths],
        "overlays": [_float32(overlay) for overlay in scene.overlays],
        "readouts": [{"name": name, "values": v} for name, v in scene.readouts.items()],
        "cameras": [
            {"name": name, "field_of_view": camera.field_of_view}
            | _float32({key: _rows(getattr(camera, key)) for key in ("position", "target", "up")})
            for name, camera in scene.cameras.items()
        ],
    }


def page_id(scenes: Sequence[Any]) -> str:
    """Short name of a page made of its contents; messages to it carry it."""
    return hashlib.sha256(to_json([_scene(s) for s in scenes]).encode()).hexdigest()[:16]


@cache
def viewer_source() -> str:
    """Meshcat's bundled viewer, three.js included, about 0.9 MB of JavaScript."""
    source = resources.files("meshcat").joinpath("viewer/dist/main.min.js").read_text("utf-8")
    if "</script" in source:
        raise RuntimeError("meshcat's viewer cannot be inlined: it contains a closing script tag")
    return source


def _rows(given: Any) -> np.ndarray:
    """Rows (T, 3) of what moves, one row (1, 3) of what stands."""
    rows = np.atleast_2d(np.asarray(given, dtype=float))
    return rows[:1] if (rows == rows[:1]).all() else rows


def _shares(cloth: dict[str, Any]) -> dict[str, Any]:
    """Corners as 16-bit shares of the box that holds them: 1/65535 of its side is not seen."""
    corners = cloth["corners"]
    low = corners.min(axis=(0, 1))
    side = np.maximum(corners.max(axis=(0, 1)) - low, 1e-9)
    still = (corners == corners[:1]).all()
    shares = np.round((corners[: 1 if still else None] - low) / side * 65535)
    placed = {"count": corners.shape[1], "low": low.tolist(), "side": side.tolist()}
    rest = {key: value for key, value in cloth.items() if key != "corners"}
    return {**rest, **placed, "shares": shares.astype(np.uint16)}


def _float32(item: dict[str, Any]) -> dict[str, Any]:
    return {k: v.astype("f4") if isinstance(v, np.ndarray) else v for k, v in item.items()}


def to_json(content: Any) -> str:
    """JSON in which bytes and arrays (little-endian) are base64 text; a `</script>` stays text."""
    text = json.dumps(content, separators=(",", ":"), default=base64_text)
    return text.replace("<", "\\u003c")


def base64_text(value: bytes | np.ndarray) -> str:
    """The bytes as base64."""
    if isinstance(value, np.ndarray):
        value = np.ascontiguousarray(value, value.dtype.newbyteorder("<")).tobytes()
    return base64.b64encode(value).decode("ascii")
