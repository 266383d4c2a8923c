"""Where everything of a model is along a trajectory, and the cameras that follow from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.cameras import Camera, ball, default_cameras, model_cameras
from cmc.view.playback.drawing import visible_geoms
from cmc.view.playback.scene import Cloth
from cmc.view.playback.soft import soft_parts

Array = NDArray[np.float64]
_SAMPLED = 24  # frames at which the extent of a motion is looked at


class Motion:
    """Where everything of a model is at every frame; `data` is left at the first."""

    def __init__(
        self,
        model: mujoco.MjModel,
        rows: Array,
        spec: int | None,
        mocap: Any,
        groups: Sequence[int],
    ) -> None:
        self.model, self.data, frames = model, mujoco.MjData(model), len(rows)
        data, soft = self.data, soft_parts(model, groups)
        self.poses = np.empty((frames, model.nbody, 7), dtype=np.float32)
        self.sites = np.empty((frames, model.nsite, 3))
        self.eyes = np.empty((frames, model.ncam, 3))
        self.axes = np.empty((frames, model.ncam, 3, 3))
        corners: list[list[Array]] = [[] for _ in soft]
        for k in range(frames - 1, -1, -1):
            if spec is None:
                data.qpos[:] = rows[k]
            else:
                mujoco.mj_setState(model, data, rows[k], spec)
            if mocap is not None:
                data.mocap_pos[:], data.mocap_quat[:] = mocap[0][k], mocap[1][k]
            mujoco.mj_kinematics(model, data)
            self.poses[k, :, :3], self.poses[k, :, 3:] = data.xpos, data.xquat
            self.sites[k] = data.site_xpos
            if model.ncam or soft:
                mujoco.mj_comPos(model, data)
                mujoco.mj_camlight(model, data)
                self.eyes[k], self.axes[k] = data.cam_xpos, data.cam_xmat.reshape(-1, 3, 3)
            if soft:
                mujoco.mj_flex(model, data)
                mujoco.mj_tendon(model, data)
            for part, found in zip(soft, corners, strict=True):
                found.append(part.corners(data))
        self.cloths = tuple(
            Cloth(part.name, part.faces, part.rgba, np.array(found[::-1], dtype=np.float32))
            for part, found in zip(soft, corners, strict=True)
        )

    def point(self, name: str) -> Array:
        """Path (T, 3) of a site, or else a body.

        Raises:
            ValueError: if the model has neither.
        """
        for paths, kind in (
            (self.sites, mujoco.mjtObj.mjOBJ_SITE),
            (self.poses, mujoco.mjtObj.mjOBJ_BODY),
        ):
            index = mujoco.mj_name2id(self.model, kind, name)
            if index >= 0:
                return paths[:, index, :3].astype(float)
        raise ValueError(f"the model has no site and no body named {name!r}")

    def cameras(
        self, moving: Sequence[int], groups: Sequence[int], tracks: Mapping[str, Array]
    ) -> dict[str, Camera]:
        """Presets that frame what moves, over the whole motion, and the model's own."""
        frames = np.unique(np.linspace(0, len(self.poses) - 1, _SAMPLED).round().astype(int))
        low, high, bodies = self._boxes(frames, groups)
        soft = [c.corners[frames] for c in self.cloths]
        low = np.concatenate([low, *[c.min(axis=1)[:, None] for c in soft]], axis=1)
        high = np.concatenate([high, *[c.max(axis=1)[:, None] for c in soft]], axis=1)
        goes = np.concatenate([np.isin(bodies, moving), np.ones(len(soft), bool)])
        subject = ball(low[0, goes], high[0, goes]) if goes.any() else ball(low, high)
        if moving:  # the median, as one body that falls for ever shall not take the camera along
            track = np.median(self.poses[:, moving, :3].astype(float), axis=1)
        else:
            track = np.zeros((len(self.poses), 3))
            track += sum(c.corners.mean(axis=1) for c in self.cloths) / max(len(soft), 1)
        focus = subject[0] + track - track[0]
        presets = default_cameras(ball(low, high), subject, track, tracks)
        return presets | model_cameras(self.model, self.eyes, self.axes, focus)

    def _boxes(
        self, frames: NDArray[np.integer], groups: Sequence[int]
    ) -> tuple[Array, Array, Array]:
        """Corners (frames, geoms, 3) of the boxes around all geoms but planes, and their bodies."""
        model, flat = self.model, mujoco.mjtGeom.mjGEOM_PLANE
        geoms = [g for b in range(model.nbody) for g in visible_geoms(model, b, groups)]
        geoms = [g for g in geoms if model.geom_type[g] != flat]
        body, box = model.geom_bodyid[geoms], model.geom_aabb[geoms]
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = box[:, None, :3] + signs * box[:, None, 3:]
        turn = _rotations(model.geom_quat[geoms])
        corners = np.einsum("gij,gcj->gci", turn, corners) + model.geom_pos[geoms][:, None]
        poses = self.poses[frames][:, body].astype(float)
        world = np.einsum("fgij,gcj->fgci", _rotations(poses[..., 3:]), corners)
        world += poses[:, :, None, :3]
        return world.min(axis=2), world.max(axis=2), body


def _rotations(quaternions: Array) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w first."""
    w, x, y, z = np.moveaxis(np.asarray(quaternions, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
