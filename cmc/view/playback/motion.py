"""Where everything of a model is along a trajectory, flexes, skins and tendons among it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.shapes import hexadecimal, own_rgba, shown_rgba, visible
from cmc.view.playback.textures import Array, texture, texture_address

_Soft = tuple[dict[str, Any], Callable[[mujoco.MjData], Array]]
_SAMPLED = 24  # frames at which the extent of a motion is looked at


class Motion:
    """Where everything of a model is at every frame; `data` is left at the first.

    Attributes:
        poses: positions, m, and quaternions (T, nbody, 7) of the bodies; `sites` (T, nsite, 3).
        eyes: positions (T, ncam, 3) of the model's cameras; their rotations `axes` (T, ncam, 3, 3).
        low: lower corners (frames, things, 3), m, of boxes around all that is seen but planes, at
            some frames, the first among them; the upper ones are `high`, the things' bodies are
            `owner` (things,), -1 for what is soft.
        cloths: flexes and tendons: color, `corners` (T, V, 3), and `faces`; or, of cables and
            tendons, the `radius` of tubes, each between two of the corners.
    """

    def __init__(
        self, model: mujoco.MjModel, rows: Array, spec: int | None, groups: Sequence[int]
    ) -> None:
        self.model, self.data, frames = model, mujoco.MjData(model), len(rows)
        data, soft = self.data, [*_flexes(model, groups), *_tendons(model, groups)]
        soft = [(look, place) for look, place in soft if look["opacity"] > 0]
        parts = [part for seen in visible(model, groups).values() for part in seen]
        flat = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        solid = [i for what, i in parts if what == "geom" and not flat[i]]
        sampled = set(np.linspace(0, frames - 1, _SAMPLED).round().astype(int).tolist())
        found, boxes = [], []
        for k in range(frames - 1, -1, -1):
            if spec is None:
                data.qpos[:] = rows[k]
            else:
                mujoco.mj_setState(model, data, rows[k], spec)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            mujoco.mj_flex(model, data)
            mujoco.mj_tendon(model, data)
            poses = np.c_[data.xpos, data.xquat].astype(np.float32)
            cameras = data.cam_xpos.copy(), data.cam_xmat.reshape(-1, 3, 3).copy()
            corners = [place(data) for _, place in soft]
            found.append((poses, data.site_xpos.copy(), *cameras, *corners))
            if k in sampled:
                boxes.append(_boxes(model, data, solid, corners))
        paths = [np.array(path[::-1]) for path in zip(*found, strict=True)]
        self.poses, self.sites, self.eyes, self.axes = paths[:4]
        self.low, self.high = np.swapaxes(boxes[::-1], 0, 1)
        self.owner = np.array([*model.geom_bodyid[solid], *[-1 for _ in soft]], dtype=int)
        self.cloths = [
            {**look, "corners": path.astype(np.float32)}
            for (look, _), path in zip(soft, paths[4:], strict=True)
        ]

    def point(self, name: str) -> Array:
        """Path (T, 3) of a site, or else a body."""
        kinds = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY
        for paths, kind in zip((self.sites, self.poses), kinds, strict=True):
            index = mujoco.mj_name2id(self.model, kind, name)
            if index >= 0:
                return paths[:, index, :3].astype(float)
        raise ValueError(f"the model has no site and no body named {name!r}")


def _boxes(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], soft: Sequence[Array]
) -> Array:
    """Lower and upper corners (2, things, 3) of boxes along the world's axes, m."""
    turn, box = data.geom_xmat[geoms].reshape(-1, 3, 3), model.geom_aabb[geoms]
    middle = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turn, box[:, :3])
    half = np.einsum("gij,gj->gi", np.abs(turn), box[:, 3:])
    ends = [[corners.min(axis=0), corners.max(axis=0)] for corners in soft]
    solid = np.stack([middle - half, middle + half], axis=1)
    return np.vstack([solid, np.reshape(ends, (-1, 2, 3))]).swapaxes(0, 1)


def skins(model: mujoco.MjModel, groups: Sequence[int]) -> list[dict[str, Any]]:
    """All visible skins: corners (V, 3) at rest, and what bodies do to them; the page computes it.

    A corner is the weighted mean of where each of its bones alone would take it. A bone is a
    `body`, its pose `rest` (7,), and `index` and `weight` of the corners that it moves. A skin with
    texture coordinates `uv` (V, 2) has the address of its texture as `map`.
    """
    found = []
    for i in np.flatnonzero(np.isin(model.skin_group, groups)).tolist():
        first, count, bones = model.skin_vertadr[i], model.skin_vertnum[i], []
        for b in range(model.skin_boneadr[i], model.skin_boneadr[i] + model.skin_bonenum[i]):
            start = model.skin_bonevertadr[b]
            rows = slice(start, start + model.skin_bonevertnum[b])
            pose = np.r_[model.skin_bonebindpos[b], model.skin_bonebindquat[b]].astype(float)
            index = model.skin_bonevertid[rows].astype(np.uint32)
            weight = model.skin_bonevertweight[rows].astype(np.float32)
            placed = {"body": int(model.skin_bonebodyid[b]), "rest": pose.tolist()}
            bones.append({**placed, "index": index, "weight": weight})
        faces = model.skin_face[model.skin_faceadr[i] :][: model.skin_facenum[i]]
        look = {**_look(model, "skin", i), "faces": faces.astype(np.uint32)}
        material, start = int(model.skin_matid[i]), int(model.skin_texcoordadr[i])
        if start >= 0 and texture(model, material) is not None:
            color = hexadecimal(own_rgba(model, model.skin_rgba[i], material))
            uv = model.skin_texcoord[start : start + count].astype(np.float32)
            look |= {"color": color, "uv": uv, "map": texture_address(model, material)}
        rest = model.skin_vert[first : first + count].astype(np.float32)
        found.append({**look, "corners": rest, "bones": bones})
    return [skin for skin in found if skin["opacity"] > 0]


def _look(model: mujoco.MjModel, what: str, i: int) -> dict[str, Any]:
    """Name and color of something soft."""
    material = int(getattr(model, f"{what}_matid")[i])
    rgba = shown_rgba(model, getattr(model, f"{what}_rgba")[i], material)
    return {"name": f"{what} {i}", "color": hexadecimal(rgba), "opacity": float(rgba[3])}


def _flexes(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[_Soft]:
    """Flexes: the surface of cloths and bodies, and the edges of cables."""
    for i in np.flatnonzero(np.isin(model.flex_group, groups)).tolist():
        dim = int(model.flex_dim[i])
        if dim == 3:  # of a body only its skin is seen
            first, count, width = model.flex_shelldataadr[i], model.flex_shellnum[i], 3
            elements = model.flex_shell[first : first + 3 * count].reshape(-1, 3)
        else:
            first, count, width = model.flex_elemdataadr[i], model.flex_elemnum[i], dim + 1
            elements = model.flex_elem[first : first + width * count].reshape(-1, width)
        look, index = _look(model, "flex", i), elements.ravel()
        if dim > 1:
            look["faces"], index = elements.astype(np.uint32), np.arange(model.flex_vertnum[i])
        else:
            look["radius"] = float(model.flex_radius[i])
        yield look, partial(_flex, model.flex_vertadr[i] + index)


def _flex(rows: NDArray[np.integer], data: mujoco.MjData) -> Array:
    return data.flexvert_xpos[rows]


def _tendons(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[_Soft]:
    """Spatial tendons, from where they are fixed over what they wrap."""
    spatial = model.wrap_type[model.tendon_adr] != mujoco.mjtWrap.mjWRAP_JOINT
    for i in np.flatnonzero(spatial & np.isin(model.tendon_group, groups)).tolist():
        look = {**_look(model, "tendon", i), "radius": float(model.tendon_width[i])}
        yield look, partial(_tendon, i, 2 * int(model.tendon_num[i]))


def _tendon(i: int, most: int, data: mujoco.MjData) -> Array:
    """Both ends of at most so many straight pieces, (2 most, 3); absent pieces have no length."""
    rows = slice(data.ten_wrapadr[i], data.ten_wrapadr[i] + data.ten_wrapnum[i])
    points, thing = data.wrap_xpos.reshape(-1, 3)[rows], data.wrap_obj.ravel()[rows]
    joined = np.flatnonzero((thing[:-1] != -2) & (thing[1:] != -2))  # -2: a pulley
    ends = np.tile(points[0], (most, 2, 1))
    ends[: len(joined)] = np.stack([points[joined], points[joined + 1]], axis=1)
    return ends.reshape(-1, 3)
