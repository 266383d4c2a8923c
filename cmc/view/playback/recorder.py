"""A trajectory of any MuJoCo model as meshcat commands and packed poses, without a server.

meshcat talks to a window object; `CommandLog` stands in for it and only keeps what it is sent.
The scene is drawn once, the poses of moving bodies are stored as float32 world poses per frame,
and the page (`page.py`) or the live server (`live.py`) takes both from the `Recording`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import meshcat
import mujoco
import numpy as np
import umsgpack
from numpy.typing import ArrayLike, NDArray

from cmc.view.playback.cameras import Camera, default_cameras, scene_ball
from cmc.view.playback.geometry import color, geom_mesh, site_mesh, transform
from cmc.view.playback.overlays import Arrow, Overlay, as_overlays, trail

if TYPE_CHECKING:
    from cmc.view.playback.live import LiveView

Array = NDArray[np.float64]
_STATES = (mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.mjtState.mjSTATE_INTEGRATION)


class CommandLog:
    """Stands in for meshcat's window: keeps every command as the bytes meshcat's viewer reads."""

    def __init__(self) -> None:
        self.commands: list[bytes] = []

    def send(self, command: Any) -> None:
        """Keep one meshcat command."""
        self.commands.append(umsgpack.packb(command.lower()))


@dataclass(frozen=True)
class Recording:
    """A scene and what moves in it. Made by `record`; saved, shown or served from here.

    Attributes:
        title: shown above the scene and as the page's title.
        times: (T,) seconds, increasing.
        bodies: paths in the scene of the bodies that move.
        poses: (T, len(bodies), 7) float32 world poses: position in m, quaternion with w first.
        commands: meshcat commands that draw the scene at the first frame.
        overlays: trails, markers, arrows.
        readouts: named values (T,) printed while playing; a unit may follow in the name.
        cameras: presets by name, the first one is used on opening.
    """

    title: str
    times: Array
    bodies: tuple[str, ...]
    poses: NDArray[np.float32]
    commands: tuple[bytes, ...]
    overlays: tuple[Overlay, ...] = ()
    readouts: Mapping[str, Array] = field(default_factory=dict)
    cameras: Mapping[str, Camera] = field(default_factory=dict)

    def html(self) -> str:
        """The whole page as text: viewer, scene and motion, nothing loaded from elsewhere."""
        from cmc.view.playback.page import page

        return page(self)

    def save(self, path: str | Path) -> Path:
        """Write the page to `path` (a half-written page never appears) and return the path."""
        from cmc.store import write_atomic

        text = self.html().encode()
        return write_atomic(path, lambda file: file.write(text))

    def show(
        self, path: str | Path, height: int = 480, slider: Any = None, live: bool = False
    ) -> Any:
        """Save to `path` and show the file in a notebook, or, `live`, a page served from here.

        Returns the slider under the scene, or the `LiveView`; see `notebook.show` and `show_live`.
        """
        from cmc.view.playback import notebook

        if live:
            return notebook.show_live(self, height=height)
        return notebook.show(self, path, height=height, slider=slider)

    def serve(self, timeout: float = 600.0) -> LiveView:
        """Serve the scene live on the loopback interface instead; see `live.LiveView`."""
        from cmc.view.playback.live import LiveView

        return LiveView(self, timeout=timeout)


def draw(model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[int]) -> CommandLog:
    """Draw the visible geoms, and sites with a material, of the groups at the pose `data` holds."""
    log = CommandLog()
    scene = meshcat.Visualizer(window=log)  # type: ignore[no-untyped-call]
    for body in drawn_bodies(model, groups):
        node = scene[body_path(model, body)]
        node.set_transform(transform(data.xpos[body], data.xquat[body]))
        for geom in _visible_geoms(model, body, groups):
            mesh, local = geom_mesh(model, geom)
            node[f"geom{geom}"].set_object(mesh)
            node[f"geom{geom}"].set_transform(local)
        for site in _visible_sites(model, body, groups):
            mesh, local = site_mesh(model, site)
            node[f"site{site}"].set_object(mesh)
            node[f"site{site}"].set_transform(local)
    return log


def drawn_bodies(model: mujoco.MjModel, groups: Sequence[int]) -> list[int]:
    """Bodies that own at least one visible geom or site."""
    return [
        b
        for b in range(model.nbody)
        if _visible_geoms(model, b, groups) or _visible_sites(model, b, groups)
    ]


def body_path(model: mujoco.MjModel, body: int) -> str:
    """Name of a body in the scene: its own, without slashes, or its number."""
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
    return name.replace("/", "|") if name else f"body{body}"


def record(
    model: mujoco.MjModel,
    states: ArrayLike | Sequence[ArrayLike],
    times: ArrayLike,
    *,
    title: str = "Playback",
    trails: Sequence[str] = (),
    markers: Mapping[str, ArrayLike] | None = None,
    arrows: Mapping[str, Arrow] | None = None,
    readouts: Mapping[str, ArrayLike] | None = None,
    cameras: Mapping[str, Camera] | None = None,
    mocap: tuple[ArrayLike, ArrayLike] | None = None,
    groups: Sequence[int] = (0, 1, 2),
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
        readouts: values (T,) printed beside the scene, such as {"force [N]": f}.
        cameras: presets; left out, they frame the scene and, if there is a trail, its end.
        mocap: positions (T, nmocap, 3) and quaternions (T, nmocap, 4) of mocap bodies, where the
            states do not hold them.
        groups: geom and site groups that are drawn; of the sites, those with a material.

    Raises:
        ValueError: for states, times or overlays of the wrong shape, not finite, or out of order,
            and for trails that name no site or body.
    """
    time, rows, spec = _checked(model, states, times)
    drawn = drawn_bodies(model, groups)
    points = [_locator(model, name) for name in trails]
    data = mujoco.MjData(model)
    poses, sites = _replay(model, data, rows, spec, mocap)
    tracks = {
        name: sites[:, index] if is_site else poses[:, index, :3].astype(float)
        for name, (is_site, index) in zip(trails, points, strict=True)
    }
    poses = poses[:, drawn]
    moving = np.flatnonzero(np.ptp(poses, axis=0).max(axis=-1) > 0.0)
    over = as_overlays(len(time), markers or {}, arrows or {})
    return Recording(
        title=title,
        times=time,
        bodies=tuple(body_path(model, drawn[i]) for i in moving),
        poses=np.ascontiguousarray(poses[:, moving]),
        commands=tuple(draw(model, data, groups).commands),
        overlays=(*(trail(name, track) for name, track in tracks.items()), *over),
        readouts={name: _values(name, v, len(time)) for name, v in (readouts or {}).items()},
        cameras=dict(cameras or default_cameras(model, data, _ball(model, data, groups), tracks)),
    )


def _replay(
    model: mujoco.MjModel, data: mujoco.MjData, rows: Array, spec: int | None, mocap: Any
) -> tuple[NDArray[np.float32], Array]:
    """World poses (T, nbody, 7) and site positions (T, nsite, 3); `data` is left at frame 0."""
    poses = np.empty((len(rows), model.nbody, 7), dtype=np.float32)
    sites = np.empty((len(rows), model.nsite, 3))
    qpos, xpos, xquat, site_xpos = data.qpos, data.xpos, data.xquat, data.site_xpos  # live views
    for k in range(len(rows) - 1, -1, -1):
        if spec is None:
            qpos[:] = rows[k]
        else:
            mujoco.mj_setState(model, data, rows[k], spec)
        if mocap is not None:
            data.mocap_pos[:], data.mocap_quat[:] = mocap[0][k], mocap[1][k]
        mujoco.mj_kinematics(model, data)
        poses[k, :, :3], poses[k, :, 3:], sites[k] = xpos, xquat, site_xpos
    return poses, sites


def _ball(model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[int]) -> tuple[Array, float]:
    geoms = [g for b in range(model.nbody) for g in _visible_geoms(model, b, groups)]
    return scene_ball(model, data, geoms)


def _visible_geoms(model: mujoco.MjModel, body: int, groups: Sequence[int]) -> list[int]:
    first = model.body_geomadr[body]
    return [
        g
        for g in range(first, first + model.body_geomnum[body])
        if model.geom_group[g] in groups and color(model, g)[3] > 0.0
    ]


def _visible_sites(model: mujoco.MjModel, body: int, groups: Sequence[int]) -> list[int]:
    shown = (
        (model.site_bodyid == body) & (model.site_matid >= 0) & np.isin(model.site_group, groups)
    )
    return [int(site) for site in np.flatnonzero(shown)]


def _locator(model: mujoco.MjModel, name: str) -> tuple[bool, int]:
    """Whether `name` is a site (else a body), and its index."""
    for is_site, kind in ((True, mujoco.mjtObj.mjOBJ_SITE), (False, mujoco.mjtObj.mjOBJ_BODY)):
        index = mujoco.mj_name2id(model, kind, name)
        if index >= 0:
            return is_site, index
    raise ValueError(f"the model has no site and no body named {name!r}")


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
