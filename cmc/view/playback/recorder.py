"""A trajectory of any MuJoCo model as a scene that plays.

The scene is drawn once; the poses of moving bodies are stored as float32 world poses per frame, and
what changes its shape (flexes, skins, tendons) as corners per frame. Not drawn: sites without a
material, lights, skyboxes. What cannot be drawn at all is left out and named in a warning.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmc.store import write_atomic
from cmc.view.playback import notebook
from cmc.view.playback.cameras import Camera
from cmc.view.playback.drawing import draw, drawn_bodies
from cmc.view.playback.live import LiveView
from cmc.view.playback.motion import Motion
from cmc.view.playback.overlays import Arrow, Label, Overlay, as_overlays, rows_of, trail
from cmc.view.playback.page import page
from cmc.view.playback.scene import Cloth, Scene, Skin, body_paths
from cmc.view.playback.soft import skins

Array = NDArray[np.float64]
_STATES = (mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.mjtState.mjSTATE_INTEGRATION)


class Playable:
    """What can be saved as a page or shown in a notebook."""

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """The scenes, from left to right."""
        raise NotImplementedError

    def html(self, *, slider: bool = True) -> str:
        """The whole page as text: viewer, scenes and motion, nothing loaded from elsewhere."""
        return page(self.scenes, slider=slider)

    def save(self, path: str | Path) -> Path:
        """Write the page to `path` (a half-written page never appears) and return the path."""
        text = self.html().encode()
        return write_atomic(path, lambda file: file.write(text))

    def show(self, path: str | Path | None = None, height: int = 480, slider: Any = None) -> Any:
        """The page for a notebook to display: saved to `path`, or embedded without one.

        A saved page keeps the notebook small, but needs a server that delivers it (JupyterLab).
        In VS Code, Colab and voila, or with CMC_EMBED=1 (for exported HTML), the page is embedded
        all the same, which takes 1 MB.

        Args:
            path: where to save, relative to the notebook.
            height: height of the frame in pixels.
            slider: an ipywidgets slider in seconds that moves the scene in place of the page's own.
        """
        return notebook.show(self.scenes, path, height=height, slider=slider)


@dataclass(frozen=True)
class Recording(Playable, Scene):
    """A scene made by `record`; saved, shown or served from here."""

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """This scene alone."""
        return (self,)

    def serve(self, timeout: float = 600.0) -> LiveView:
        """Serve the scene live on the loopback interface instead; see `live.LiveView`."""
        return LiveView(self, timeout=timeout)


@dataclass(frozen=True)
class Beside(Playable):
    """Scenes side by side under one time slider, such as a success beside a failure."""

    recordings: tuple[Scene, ...]

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """The scenes, from left to right."""
        return self.recordings


def beside(*recordings: Scene) -> Beside:
    """Show recordings side by side: one time slider, and cameras of the same name together."""
    if not recordings:
        raise ValueError("wanted at least one recording, got none")
    return Beside(recordings)


def record(
    model: mujoco.MjModel,
    states: ArrayLike | Sequence[ArrayLike],
    times: ArrayLike,
    *,
    title: str = "Playback",
    trails: Sequence[str] = (),
    markers: Mapping[str, ArrayLike] | None = None,
    arrows: Mapping[str, Arrow] | None = None,
    labels: Mapping[str, str | ArrayLike] | None = None,
    readouts: Mapping[str, ArrayLike] | None = None,
    cameras: Mapping[str, Camera] | None = None,
    mocap: tuple[ArrayLike, ArrayLike] | None = None,
    groups: Sequence[int] = (0, 1, 2),
    tail: float | None = None,
) -> Recording:
    """Record a motion of a MuJoCo model.

    Args:
        model: the compiled model.
        states: (T, nq) joint positions, or (T, size) full states as `mj_getState` returns them for
            FULLPHYSICS or INTEGRATION, as an array or a list of vectors.
        times: (T,) times in seconds, strictly increasing.
        title: heading of the page.
        trails: sites or bodies that leave a trail.
        markers: points to show, (3,) or (T, 3) in m; a row of NaN hides the marker.
        arrows: vectors to show, for example a contact force.
        labels: word to the site or body that it stands beside, or to a point (3,) or (T, 3), m.
        readouts: values (T,) printed beside the scene, such as {"force [N]": f}.
        cameras: presets; left out, they frame what moves and the scene, and are the model's own.
        mocap: positions (T, nmocap, 3) and quaternions (T, nmocap, 4) of mocap bodies, where the
            states do not hold them.
        groups: geom, site, tendon, flex and skin groups that are drawn.
        tail: seconds kept after the last motion; everything is kept by default.

    Raises:
        ValueError: for states, times or overlays of the wrong shape, not finite, or out of order,
            and for trails, labels or cameras that name no site or body.
    """
    time, rows, spec = _checked(model, states, times)
    motion = Motion(model, rows, spec, mocap, groups)
    tracks = {name: motion.point(name) for name in trails}
    drawn = drawn_bodies(model, groups)
    worn = skins(model, groups)
    bones = {bone.body for skin in worn for bone in skin.bones}
    known = sorted({*drawn, *bones})
    moving = [b for b in known if b in bones or np.ptp(motion.poses[:, b], axis=0).max() > 0.0]
    presets = cameras or motion.cameras(moving, groups, tracks)
    presets = {
        name: camera.along(tracks.get(camera.follow, motion.point(camera.follow)))
        if camera.follow
        else camera
        for name, camera in presets.items()
    }
    words = {
        word: motion.point(at) if isinstance(at, str) else rows_of(word, at, len(time))
        for word, at in (labels or {}).items()
    }
    over: list[Overlay] = [trail(name, track) for name, track in tracks.items()]
    over += as_overlays(len(time), markers or {}, arrows or {})
    over += [Label(word, points) for word, points in words.items()]
    paths = body_paths(model)
    whole = Recording(
        title=title,
        times=time,
        bodies=tuple(paths[b] for b in moving),
        poses=np.ascontiguousarray(motion.poses[:, moving]),
        commands=tuple(draw(model, motion.data, groups).commands),
        cloths=motion.cloths,
        skins=tuple(_with_bodies(skin, moving) for skin in worn),
        overlays=tuple(over),
        readouts={name: _values(name, v, len(time)) for name, v in (readouts or {}).items()},
        cameras=presets,
    )
    if not (drawn or whole.cloths or worn):
        there = sorted(set(map(int, model.geom_group)))
        warnings.warn(f"nothing of groups {tuple(groups)} is seen; geoms: {there}", stacklevel=2)
    return whole if tail is None else _until_rest(whole, tail)


def _with_bodies(skin: Skin, moving: Sequence[int]) -> Skin:
    """The skin with bones that count in the bodies whose poses are stored."""
    bones = tuple(replace(bone, body=moving.index(bone.body)) for bone in skin.bones)
    return replace(skin, bones=bones)


def _until_rest(whole: Recording, tail: float) -> Recording:
    """The recording up to `tail` seconds after the last frame away from the final poses.

    Away is farther than a hundredth of the largest distance (in m, and turns in rad / 10).
    """
    apart = np.abs(whole.poses - whole.poses[-1]) * [1, 1, 1, 0.2, 0.2, 0.2, 0.2]
    away = apart.reshape(len(apart), -1).max(axis=1, initial=0.0)
    moved = np.flatnonzero(away > 0.01 * away.max())
    end = whole.times[moved[-1]] + tail if len(moved) else whole.times[0] + tail
    return cut(whole, int(np.searchsorted(whole.times, end, side="right")))


def cut(whole: Recording, frames: int) -> Recording:
    """The first `frames` frames of a recording."""
    count = len(whole.times)

    def rows(array: Any) -> Any:
        return array[:frames] if np.ndim(array) == 2 and len(array) == count else array

    cameras = {
        n: Camera(rows(c.position), rows(c.target), c.follow, rows(c.up), c.field_of_view)
        for n, c in whole.cameras.items()
    }
    cloths = [Cloth(c.name, c.faces, c.rgba, c.corners[:frames]) for c in whole.cloths]
    overlays = [type(o)(**{k: rows(v) for k, v in vars(o).items()}) for o in whole.overlays]
    return Recording(
        title=whole.title,
        times=whole.times[:frames],
        bodies=whole.bodies,
        poses=whole.poses[:frames],
        commands=whole.commands,
        cloths=tuple(cloths),
        skins=whole.skins,
        overlays=tuple(overlays),
        readouts={name: v[:frames] for name, v in whole.readouts.items()},
        cameras=cameras,
    )


def _checked(
    model: mujoco.MjModel, states: Any, times: ArrayLike
) -> tuple[Array, Array, int | None]:
    """Times, rows of states, and the `mjtState` they follow (None: joint positions)."""
    time, rows = np.asarray(times, dtype=float), np.asarray(states, dtype=float)
    sizes = {int(mujoco.mj_stateSize(model, s)): int(s) for s in reversed(_STATES)}
    if rows.ndim != 2 or (rows.shape[1] != model.nq and rows.shape[1] not in sizes):
        raise ValueError(
            f"states must have shape (T, {model.nq}) for joint positions or (T, n) with n in "
            f"{sorted(sizes)} for full states, got {rows.shape}"
        )
    if time.shape != (len(rows),) or len(rows) == 0:
        raise ValueError(f"times must have shape ({len(rows)},) and one frame, got {time.shape}")
    if not (np.isfinite(time).all() and np.isfinite(rows).all()):
        raise ValueError("states and times must be finite")
    if np.any(np.diff(time) <= 0.0):
        raise ValueError("times must increase strictly")
    return time, rows, None if rows.shape[1] == model.nq else sizes[rows.shape[1]]


def _values(name: str, values: ArrayLike, frames: int) -> Array:
    array = np.asarray(values, dtype=float)
    if array.shape != (frames,):
        raise ValueError(f"readout {name!r} must have shape ({frames},), got {array.shape}")
    return array
