"""A trajectory of any MuJoCo model as a scene that plays.

The scene is drawn once; the poses of moving bodies are stored as float32 world poses per frame, and
what changes its shape (flexes, tendons) as corners per frame. Not drawn: sites without a material,
lights, skyboxes. What cannot be drawn at all is left out and named in a warning.
"""

from __future__ import annotations

import itertools
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from IPython.display import HTML, IFrame
from numpy.typing import ArrayLike, NDArray

from cmc.store import write_atomic
from cmc.view.playback.cameras import Camera, presets
from cmc.view.playback.live import LiveView
from cmc.view.playback.motion import Motion, skins
from cmc.view.playback.page import page
from cmc.view.playback.shapes import body_paths, draw, visible
from cmc.view.playback.textures import Array

_STATES = (mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.mjtState.mjSTATE_INTEGRATION)

# Okabe-Ito, readable with every kind of color vision
_TRAIL, _ARROW, _MARKERS = 0x0072B2, 0xD55E00, (0xE69F00, 0x009E73, 0xCC79A7)


@dataclass(frozen=True)
class Marker:
    """A see-through ball of a radius, m, at (T, 3) or (3,), m; rows of NaN hide it."""

    points: ArrayLike
    radius: float = 0.002


@dataclass(frozen=True)
class Arrow:
    """A vector (T, 3), drawn from `points`, (T, 3) or (3,), in m, `scale` metres long per unit.

    `radius` of the shaft in m. Vectors shorter than 1e-3, in any unit (N for a force), are hidden.
    """

    points: ArrayLike
    vectors: ArrayLike
    scale: float = 0.005
    radius: float = 0.0006


class Playable:
    """What can be saved as a page or shown in a notebook: `scenes`, from left to right."""

    def __init__(self, *scenes: Recording) -> None:
        self.scenes = scenes

    def html(self) -> str:
        """The whole page as text: viewer, scenes and motion, nothing loaded from elsewhere."""
        return page(self.scenes)

    def save(self, path: str | Path) -> Path:
        """Write the page to `path` (a half-written page never appears) and return the path."""
        return write_atomic(path, lambda file: file.write(self.html().encode()))

    def show(self, path: str | Path | None = None, height: int = 480) -> Any:
        """The page for a notebook to display: saved to `path`, or embedded without one.

        A saved page keeps the notebook small, but needs a server that delivers it (JupyterLab).
        In VS Code, Colab and voila, or with CMC_EMBED=1 (for exported HTML), it is embedded all
        the same, which takes 1 MB. `height` in pixels. A path that is absolute or leads upwards is
        refused: no server would deliver it.
        """
        return framed(self.html(), path, height)


def framed(text: str, path: str | Path | None = None, height: int = 480) -> Any:
    """A page in a frame: from a file at `path`, which is written, or held by the notebook."""
    serverless = (  # no server here would deliver a file beside the notebook
        os.environ.get("CMC_EMBED", "0") not in ("", "0")
        or "VSCODE_PID" in os.environ
        or "google.colab" in sys.modules
        or os.environ.get("SERVER_SOFTWARE", "").startswith("voila")
    )
    if path is None or serverless:  # a frame with no rights but to run its scripts
        style = f"width:100%;height:{height}px;border:0"
        look = f'sandbox="allow-scripts" title="3D playback" style="{style}"'
        return HTML(f'<div><iframe srcdoc="{escape(text)}" {look}></iframe></div>')
    path = Path(path)
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"path must be relative and below the notebook, got {path}")
    write_atomic(path, lambda file: file.write(text.encode()))
    return IFrame(path.as_posix(), width="100%", height=height)


@dataclass(frozen=True)
class Recording(Playable):
    """A scene and what moves in it, made by `record`; saved, shown or served from here.

    Attributes:
        times: (T,) seconds, increasing.
        bodies: paths in the scene of the bodies that move.
        poses: (T, len(bodies), 7) float32 world poses: position in m, quaternion with w first.
        commands: meshcat commands that draw the scene at the first frame.
        cloths: flexes and tendons, see `motion.Motion`.
        skins: see `motion.skins`; the `body` of their bones counts in `bodies`.
        overlays: trails, markers, arrows, labels, with points (T, 3).
        readouts: named values (T,).
        cameras: presets by name, the first one is used on opening.
    """

    title: str
    times: Array
    bodies: Sequence[str]
    poses: NDArray[np.float32]
    commands: Sequence[bytes]
    cloths: Sequence[dict[str, Any]]
    skins: Sequence[dict[str, Any]]
    overlays: Sequence[dict[str, Any]]
    readouts: Mapping[str, Array]
    cameras: Mapping[str, Camera]

    @property  # type: ignore[override]
    def scenes(self) -> tuple[Recording, ...]:  # type: ignore[override]
        """This scene alone."""
        return (self,)

    def serve(self, timeout: float = 600.0) -> LiveView:
        """Serve the scene live on the loopback interface instead; see `live.LiveView`."""
        return LiveView(self, timeout=timeout)


def beside(*recordings: Recording) -> Playable:
    """Recordings side by side: one time slider, and cameras of the same name together."""
    if not recordings:
        raise ValueError("wanted at least one recording, got none")
    return Playable(*recordings)


def record(
    model: mujoco.MjModel,
    states: ArrayLike | Sequence[ArrayLike],
    times: ArrayLike,
    *,
    title: str = "Playback",
    trails: Sequence[str] = (),
    markers: Mapping[str, ArrayLike | Marker] | None = None,
    arrows: Mapping[str, Arrow] | None = None,
    labels: Mapping[str, str | ArrayLike] | None = None,
    readouts: Mapping[str, ArrayLike] | None = None,
    cameras: Mapping[str, Camera] | None = None,
    groups: Sequence[int] = (0, 1, 2),
) -> Recording:
    """Record a motion of a MuJoCo model.

    Args:
        model: the compiled model.
        states: (T, nq) joint positions, or (T, size) full states as `mj_getState` returns them for
            FULLPHYSICS or INTEGRATION (which holds mocap bodies), as an array or a list of vectors.
        times: (T,) times in seconds, strictly increasing.
        title: heading of the page.
        trails: sites or bodies that leave a trail.
        markers: points to show, (3,) or (T, 3) in m; a row of NaN hides the marker.
        arrows: vectors to show, for example a contact force.
        labels: word to the site or body that it stands beside, or to a point (3,) or (T, 3), m.
        readouts: values (T,) printed beside the scene, such as {"force [N]": f}.
        cameras: presets; left out, they frame what moves and the scene, and are the model's own.
        groups: geom, site, tendon, flex and skin groups that are drawn.

    Raises:
        ValueError: for states, times or overlays of the wrong shape, not finite, or out of order,
            and for trails or labels that name no site or body.
    """
    time, rows, spec = _checked(model, states, times)
    motion, worn = Motion(model, rows, spec, groups), skins(model, groups)
    tracks = {name: motion.point(name) for name in trails}
    drawn, bones = list(visible(model, groups)), [bone for skin in worn for bone in skin["bones"]]
    if not (drawn or motion.cloths or worn):
        there = sorted(set(map(int, model.geom_group)))
        warnings.warn(f"nothing of groups {tuple(groups)} is seen; geoms: {there}", stacklevel=2)
    goes = set(np.flatnonzero(np.ptp(motion.poses, axis=0).max(axis=1) > 0.0).tolist())
    moving = sorted(goes.intersection(drawn).union(bone["body"] for bone in bones))
    for bone in bones:
        bone["body"] = moving.index(bone["body"])
    words = {
        word: motion.point(at) if isinstance(at, str) else at for word, at in (labels or {}).items()
    }
    paths = body_paths(model)
    return Recording(
        title=title,
        times=time,
        bodies=[paths[b] for b in moving],
        poses=np.ascontiguousarray(motion.poses[:, moving]),
        commands=draw(model, motion.data, groups),
        cloths=motion.cloths,
        skins=worn,
        overlays=list(_overlays(len(time), tracks, markers or {}, arrows or {}, words)),
        readouts={name: _fit(name, v, time.shape) for name, v in (readouts or {}).items()},
        cameras=cameras or presets(motion, moving, tracks),
    )


def _overlays(
    frames: int,
    tracks: Mapping[str, Array],
    markers: Mapping[str, ArrayLike | Marker],
    arrows: Mapping[str, Arrow],
    words: Mapping[str, ArrayLike],
) -> Iterator[dict[str, Any]]:
    """What is drawn over the scene, as the player reads it, every array (frames, 3)."""
    shapes = (3,), (frames, 3)
    for name, points in tracks.items():  # a tube as thin as the path is small
        size = float(np.linalg.norm(np.ptp(points, axis=0)))
        look = {"color": _TRAIL, "radius": float(np.clip(0.004 * size, 1e-4, 4e-3))}
        yield {"kind": "Trail", "name": name, "points": points, **look}
    for (name, given), color in zip(markers.items(), itertools.cycle(_MARKERS), strict=False):
        marker = given if isinstance(given, Marker) else Marker(given)
        look = {"color": color, "radius": marker.radius}
        yield {"kind": "Marker", "name": name, "points": _fit(name, marker.points, *shapes), **look}
    for name, arrow in arrows.items():
        rows = {key: _fit(name, getattr(arrow, key), *shapes) for key in ("points", "vectors")}
        if not all(np.isfinite(array).all() for array in rows.values()):
            raise ValueError(f"arrow {name!r} must be finite")
        look = {"scale": arrow.scale, "radius": arrow.radius, "color": _ARROW, "threshold": 1e-3}
        yield {"kind": "Arrow", "name": name, **rows, **look}
    for word, at in words.items():
        yield {"kind": "Label", "name": word, "points": _fit(word, at, *shapes)}


def _fit(name: str, array: ArrayLike, *shapes: tuple[int, ...]) -> Array:
    """An array of one of the shapes, broadcast to the last."""
    rows = np.asarray(array, dtype=float)
    if rows.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise ValueError(f"{name!r} must have shape {wanted}, got {rows.shape}")
    return np.broadcast_to(rows, shapes[-1])


def _checked(
    model: mujoco.MjModel, states: Any, times: ArrayLike
) -> tuple[Array, Array, int | None]:
    """Times, rows of states, and the `mjtState` they follow (None: joint positions)."""
    time, rows = np.asarray(times, dtype=float), np.asarray(states, dtype=float)
    if not (np.isfinite(time).all() and np.isfinite(rows).all()):
        raise ValueError("states and times must be finite")
    if time.ndim != 1 or len(time) == 0 or np.any(np.diff(time) <= 0.0):
        raise ValueError(f"times must be at least one, and increase strictly, got {time}")
    full = {int(mujoco.mj_stateSize(model, s)): int(s) for s in reversed(_STATES)}
    specs: dict[int, int | None] = {**full, model.nq: None}
    if rows.ndim != 2 or len(rows) != len(time) or rows.shape[1] not in specs:
        raise ValueError(
            f"states must have shape ({len(time)}, n), a row for each time, with n = {model.nq} "
            f"for joint positions or in {sorted(full)} for full states, got {rows.shape}"
        )
    return time, rows, specs[rows.shape[1]]
