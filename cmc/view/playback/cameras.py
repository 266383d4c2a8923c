"""Camera presets: from where to look at what, in the coordinates of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
FIELD_OF_VIEW = 40.0  # vertical, degrees; the page's camera uses the same


@dataclass(frozen=True)
class Camera:
    """A camera at `position` that looks at `target`, both (x, y, z) in m, z up.

    With `follow` set to the name of a trail the camera moves along with it.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    follow: str | None = None


def around(
    center: ArrayLike,
    radius: float,
    azimuth: float = -50.0,
    elevation: float = 25.0,
    follow: str | None = None,
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
    return Camera(_triple(position), _triple(middle), follow)


def scene_ball(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int]
) -> tuple[Array, float]:
    """Center and radius of a ball around the listed geoms, planes left out; needs kinematics."""
    solid = [g for g in geoms if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_PLANE]
    if not solid:
        return np.zeros(3), 1.0
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    boxes = model.geom_aabb[solid]
    local = boxes[:, None, :3] + corners * boxes[:, None, 3:]
    frames = data.geom_xmat[solid].reshape(-1, 3, 3)
    world = np.einsum("gij,gcj->gci", frames, local) + data.geom_xpos[solid][:, None]
    low, high = world.min(axis=(0, 1)), world.max(axis=(0, 1))
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def default_cameras(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    ball: tuple[Array, float],
    trails: dict[str, Array],
) -> dict[str, Camera]:
    """Presets: the whole scene, the model's own fixed cameras, and views of each trail.

    A trail is seen from near, from above, from the side, and moving along with it.
    """
    presets = {"whole scene": around(*ball)}
    focus = next(iter(trails.values())).mean(axis=0) if trails else ball[0]
    mujoco.mj_camlight(model, data)
    still = model.body_weldid[model.cam_bodyid] == 0
    for camera in np.flatnonzero(still & (model.cam_mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED)):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_CAMERA, int(camera))
        position, ahead = data.cam_xpos[camera], -data.cam_xmat[camera].reshape(3, 3)[:, 2]
        reach = max(float((focus - position) @ ahead), 0.01)
        preset = Camera(_triple(position), _triple(position + reach * ahead))
        presets[name or f"camera {camera}"] = preset
    for name, points in trails.items():
        low, high = points.min(axis=0), points.max(axis=0)
        radius = max(0.75 * float(np.linalg.norm(high - low)), 0.04 * ball[1])
        middle = (low + high) / 2
        presets[f"{name}: near"] = around(middle, radius, elevation=40.0)
        presets[f"{name}: above"] = around(middle, radius, azimuth=-90.0, elevation=88.0)
        presets[f"{name}: side"] = around(middle, radius, azimuth=-90.0, elevation=8.0)
        presets[f"{name}: follow"] = around(points[0], radius, elevation=40.0, follow=name)
    return presets


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = (float(c) for c in vector)
    return x, y, z
