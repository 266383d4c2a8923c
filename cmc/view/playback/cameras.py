"""Camera presets: from where to look at what, in the coordinates of the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from cmc.view.playback.motion import Motion
from cmc.view.playback.textures import Array

FIELD_OF_VIEW = 40.0  # vertical, degrees, unless a camera has its own
_Ball = tuple[Array, float]  # center (3,) and radius, m


@dataclass(frozen=True)
class Camera:
    """A camera at `position` that looks at `target`, both (3,) or (T, 3) in m.

    `up` is the direction, (3,) or (T, 3), that is up in the picture; `field_of_view` is vertical,
    in degrees.
    """

    position: ArrayLike
    target: ArrayLike
    up: ArrayLike = (0.0, 0.0, 1.0)
    field_of_view: float = FIELD_OF_VIEW

    def along(self, track: Array) -> Camera:
        """The same camera carried along a track (T, 3), from where it stands at the first frame."""
        shift = track - track[0]
        position, target = np.asarray(self.position) + shift, np.asarray(self.target) + shift
        return replace(self, position=position, target=target)


def around(
    center: ArrayLike, radius: float, azimuth: float = -50.0, elevation: float = 25.0
) -> Camera:
    """Camera that frames a ball: `radius` in m, seen from `azimuth` and `elevation` in degrees.

    Azimuth 0 looks from +x towards the center, 90 from +y.
    """
    middle = np.asarray(center, dtype=float)
    if middle.shape != (3,) or not np.isfinite(middle).all():
        raise ValueError(f"center must be three finite numbers, got {center!r}")
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be positive, got {radius}")
    a, e = np.deg2rad([azimuth, elevation])
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    position = middle + direction * radius / np.sin(np.deg2rad(FIELD_OF_VIEW / 2))
    return Camera(position, middle)


def presets(
    motion: Motion, moving: Sequence[int], trails: Mapping[str, Array]
) -> dict[str, Camera]:
    """Presets that frame the trails and what moves, over the whole motion, and the model's own.

    `moving` are numbers of bodies, `trails` points (T, 3) by name.
    """
    goes = np.isin(motion.owner, [*moving, -1])  # what is soft moves, too
    everything = _ball(motion.low, motion.high)
    subject = _ball(motion.low[0, goes], motion.high[0, goes]) if goes.any() else everything
    places = motion.poses[:, moving, :3].astype(float)
    if not moving:
        soft = [cloth["corners"].mean(axis=1) for cloth in motion.cloths]
        places = np.stack(soft or [np.zeros((len(places), 3))], axis=1)
    # the median, as one body that falls for ever shall not take the camera along
    track = np.median(places, axis=1)
    focus = subject[0] + track - track[0]
    found = _framed(everything, subject, track, trails)
    for k in range(motion.model.ncam):
        name = mujoco.mj_id2name(motion.model, mujoco.mjtObj.mjOBJ_CAMERA, k) or f"camera {k}"
        found[name] = _own(motion, k, focus)
    return found


def _framed(
    everything: _Ball, subject: _Ball, track: Array, trails: Mapping[str, Array]
) -> dict[str, Camera]:
    """Each trail from near, from the side and moving along, the whole, and what moves."""
    found = {}
    for name, points in trails.items():
        low, high = points.min(axis=0), points.max(axis=0)
        radius = max(0.75 * float(np.linalg.norm(high - low)), 0.04 * everything[1])
        middle = (low + high) / 2
        found[f"{name}: near"] = around(middle, radius, elevation=40.0)
        found[f"{name}: side"] = around(middle, radius, azimuth=-90.0, elevation=8.0)
        found[f"{name}: follow"] = around(points[0], radius, elevation=40.0).along(points)
    found["whole scene"] = around(*everything)
    if subject[1] < 0.5 * everything[1]:
        follow = {"follow": around(*subject).along(track)}
        # What is a dot in the whole scene is followed from the start.
        dot = subject[1] < 0.2 * everything[1] and not trails
        found = follow | found if dot else found | follow
    return found


def _own(motion: Motion, k: int, focus: Array) -> Camera:
    """A camera of the model with its motion, roll and field of view; it looks as far as `focus`."""
    model, position, axes = motion.model, motion.eyes[:, k], motion.axes[:, k]
    ahead, up = -axes[..., 2], axes[..., 1]
    depth = np.maximum(((focus - position) * ahead).sum(axis=1, keepdims=True), 0.01)
    field = float(model.cam_fovy[k])
    if model.cam_sensorsize[k, 1] > 0:  # a lens in place of an angle
        half = model.cam_sensorsize[k, 1] / 2 / model.cam_intrinsic[k, 1]
        field = float(np.rad2deg(2 * np.arctan(half)))
    if model.cam_projection[k]:  # no perspective: from as far as shows as much
        depth = np.full_like(depth, field / 2 / np.tan(np.deg2rad(FIELD_OF_VIEW / 2)))
        position, field = position + ahead * (depth[0] - depth), FIELD_OF_VIEW
    return Camera(position, position + depth * ahead, up, field)


def _ball(low: Array, high: Array) -> _Ball:
    """A ball around boxes with corners low and high, both (..., 3)."""
    if not low.size:
        return np.zeros(3), 1.0
    low, high = low.reshape(-1, 3).min(axis=0), high.reshape(-1, 3).max(axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low) / 2), 1e-3)
