"""What is recorded of a scene: meshcat commands that draw it, and packed poses that move it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import umsgpack
from numpy.typing import NDArray

from cmc.view.playback.cameras import Camera
from cmc.view.playback.geometry import Rgba
from cmc.view.playback.overlays import Overlay

Array = NDArray[np.float64]


class CommandLog:
    """Stands in for meshcat's window: keeps every command as the bytes meshcat's viewer reads."""

    def __init__(self) -> None:
        self.commands: list[bytes] = []

    def send(self, command: Any) -> None:
        """Keep one meshcat command."""
        self.commands.append(umsgpack.packb(command.lower()))


@dataclass(frozen=True)
class Cloth:
    """Triangles (F, 3) whose corners (T, V, 3) move: a flex or a tendon."""

    name: str
    faces: NDArray[np.integer]
    rgba: Rgba
    corners: NDArray[np.float32]


@dataclass(frozen=True)
class Bone:
    """What a body does to a skin: `body`, its pose (7,) at rest, and the corners that it moves."""

    body: int
    rest: Array
    index: NDArray[np.integer]
    weight: Array


@dataclass(frozen=True)
class Skin:
    """Triangles (F, 3) whose corners, (V, 3) at rest, go along with bodies; the page computes it.

    A corner is the weighted mean of where each of its bones alone would take it.
    """

    name: str
    faces: NDArray[np.integer]
    rgba: Rgba
    corners: Array
    bones: tuple[Bone, ...]


@dataclass(frozen=True)
class Scene:
    """A scene and what moves in it.

    Attributes:
        title: shown above the scene and as the page's title.
        times: (T,) seconds, increasing.
        bodies: paths in the scene of the bodies that move.
        poses: (T, len(bodies), 7) float32 world poses: position in m, quaternion with w first.
        commands: meshcat commands that draw the scene at the first frame.
        cloths: flexes and tendons.
        skins: skins; the `body` of their bones counts in `bodies`.
        overlays: trails, markers, arrows, labels.
        readouts: named values (T,) printed while playing; a unit may follow in the name.
        cameras: presets by name, the first one is used on opening.
    """

    title: str
    times: Array
    bodies: tuple[str, ...]
    poses: NDArray[np.float32]
    commands: tuple[bytes, ...]
    cloths: tuple[Cloth, ...] = ()
    skins: tuple[Skin, ...] = ()
    overlays: tuple[Overlay, ...] = ()
    readouts: Mapping[str, Array] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)


def body_paths(model: mujoco.MjModel) -> list[str]:
    """Names of the bodies in the scene: their own without slashes, or numbers; no two alike."""
    paths: list[str] = []
    for body in range(model.nbody):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
        path = name.replace("/", "|") if name else f"body{body}"
        while path in paths:
            path += f" ({body})"
        paths.append(path)
    return paths
