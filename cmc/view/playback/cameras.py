"""Camera presets: from where to look at what, in the coordinates of the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
FIELD_OF_VIEW = 40.0  # vertical, degrees, unless a camera has its own


@dataclass(frozen=True)
class Camera:
    """A camera at `position` that looks at `target`, both (3,) or (T, 3) in m, z up.

    Attributes:
        position: where it stands; a row a frame if it moves.
        target: what it looks at.
        follow: name of a trail, site or body that it moves along with, beside its own motion.
        up: direction that is up in the picture, (3,) or (T, 3).
        field_of_view: vertical, degrees.
    """

    position: ArrayLike
    target: ArrayLike
    follow: str | None = None
    up: ArrayLike = (0.0, 0.0, 1.0)
    field_of_view: float = FIELD_OF_VIEW

    def along(self, track: Array) -> Camera:
        """The same camera carried along a track (T, 3), from where it stands at the first frame."""
        shift = track - track[0]
        position, target = np.asarray(self.position) + shift, np.asarray(self.target) + shift
        return Camera(position, target, None, self.up, self.field_of_view)


def around(
    center: ArrayLike,
    radius: float,
    azimuth: float = -50.0,
    elevation: float = 25.0,
    follow: str | None = None,
) -> Camera:
    """Camera that frames a ball: `radius` in m, seen from `azimuth` and `elevation` in degrees.

    Azimuth 0 looks from +x towards the center, 90 from +y.

    Raises:
        ValueError: for a center that is not three finite numbers, or a radius that is not positive.
    """
    middle = np.asarray(center, dtype=float)
    if middle.shape != (3,) or not np.isfinite(middle).all():
        raise ValueError(f"center must be three finite numbers, got {center!r}")
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius must be positive, got {radius}")
    a, e = np.deg2rad([azimuth, elevation])
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    position = middle + direction * radius / np.sin(np.deg2rad(FIELD_OF_VIEW / 2))
    return Camera(tuple(map(float, position)), tuple(map(float, middle)), follow)


def ball(low: Array, high: Array) -> tuple[Array, float]:
    """Center and radius of a ball around boxes with corners low and high, both (..., 3)."""
    if not low.size:
        return np.zeros(3), 1.0
    low, high = low.reshape(-1, 3).min(axis=0), high.reshape(-1, 3).max(axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low) / 2), 1e-3)


def default_cameras(
    everything: tuple[Array, float],
    subject: tuple[Array, float],
    track: Array,
    trails: Mapping[str, Array],
) -> dict[str, Camera]:
    """Presets: each trail from near, from the side and moving along, the whole, and what moves.

    Args:
        everything: ball around all that is drawn, over the whole motion.
        subject: ball around what moves, at the first frame.
        track: where the middle of what moves is, (T, 3).
        trails: points by name, (T, 3).
    """
    presets = {}
    for name, points in trails.items():
        low, high = points.min(axis=0), points.max(axis=0)
        radius = max(0.75 * float(np.linalg.norm(high - low)), 0.04 * everything[1])
        middle = (low + high) / 2
        presets[f"{name}: near"] = around(middle, radius, elevation=40.0)
        presets[f"{name}: side"] = around(middle, radius, azimuth=-90.0, elevation=8.0)
        presets[f"{name}: follow"] = around(points[0], radius, elevation=40.0).along(points)
    presets["whole scene"] = around(*everything)
    if subject[1] < 0.5 * everything[1]:
        follow = {"follow": around(*subject).along(track)}
        # What is a dot in the whole scene is followed from the start.
        dot = subject[1] < 0.2 * everything[1] and not trails
        presets = follow | presets if dot else presets | follow
    return presets


def model_cameras(model: mujoco.MjModel, place: Array, axes: Array, focus: Array) -> dict:
    """The model's own cameras with their motion, roll and field of view.

    Args:
        model: the compiled model.
        place: positions (T, ncam, 3).
        axes: rotations (T, ncam, 3, 3).
        focus: the point (3,) or (T, 3) at whose depth the camera's target is put.
    """
    presets: dict[str, Camera] = {}
    for c in range(model.ncam):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_CAMERA, c) or f"camera {c}"
        ahead, position, up = -axes[:, c, :, 2], place[:, c], axes[:, c, :, 1]
        depth = np.maximum(((focus - position) * ahead).sum(axis=1, keepdims=True), 0.01)
        field = float(model.cam_fovy[c])
        if model.cam_sensorsize[c, 1] > 0:  # a lens in place of an angle
            half = model.cam_sensorsize[c, 1] / 2 / model.cam_intrinsic[c, 1]
            field = float(np.rad2deg(2 * np.arctan(half)))
        if model.cam_projection[c]:  # no perspective: from as far as shows as much
            depth = np.full_like(depth, field / 2 / np.tan(np.deg2rad(FIELD_OF_VIEW / 2)))
            position, field = position + ahead * (depth[0] - depth), FIELD_OF_VIEW
        presets[name] = Camera(position, position + depth * ahead, None, up, field)
    return presets
