"""Where everything of a model is along a trajectory; flexes, skins and tendons as triangles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.shapes import hexadecimal, shown_rgba, visible
from cmc.view.playback.textures import Array

_Soft = tuple[dict[str, Any], Callable[[mujoco.MjData], Array]]
_SAMPLED = 24  # frames at which the extent of a motion is looked at
_SIDES = 6  # of a tube around an edge or a tendon


class Motion:
    """Where everything of a model is at every frame; `data` is left at the first.

    Attributes:
        poses: positions, m, and quaternions (T, nbody, 7) of the bodies; `sites` (T, nsite, 3).
        eyes: positions (T, ncam, 3) of the model's cameras; their rotations `axes` (T, ncam, 3, 3).
        low: lower corners (frames, things, 3), m, of boxes around all that is seen but planes, at
            some frames, the first among them; the upper ones are `high`, the things' bodies are
            `owner` (things,), -1 for what is soft.
        cloths: flexes and tendons: faces, color, and `corners` (T, V, 3).
    """

    def __init__(
        self, model: mujoco.MjModel, rows: Array, spec: int | None, groups: Sequence[int]
    ) -> None:
        self.model, self.data, frames = model, mujoco.MjData(model), len(rows)
        data, soft = self.data, [*_flexes(model, groups), *_tendons(model, groups)]
        soft = [(look, place) for look, place in soft if look["opacity"] > 0 and len(look["faces"])]
        self.poses = np.empty((frames, model.nbody, 7), dtype=np.float32)
        self.sites = np.empty((frames, model.nsite, 3))
        self.eyes = np.empty((frames, model.ncam, 3))
        self.axes = np.empty((frames, model.ncam, 3, 3))
        parts = [part for seen in visible(model, groups).values() for part in seen]
        flat = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        solid = [i for what, i in parts if what == "geom" and not flat[i]]
        sampled = set(np.linspace(0, frames - 1, _SAMPLED).round().astype(int).tolist())
        boxes: list[Array] = []
        corners: list[list[Array]] = [[] for _ in soft]
        for k in range(frames - 1, -1, -1):
            if spec is None:
                data.qpos[:] = rows[k]
            else:
                mujoco.mj_setState(model, data, rows[k], spec)
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
            for (_, place), found in zip(soft, corners, strict=True):
                found.append(place(data))
            if k in sampled:
                boxes.append(_boxes(model, data, solid, [found[-1] for found in corners]))
        self.low, self.high = np.swapaxes(boxes[::-1], 0, 1)
        self.owner = np.array([*model.geom_bodyid[solid], *[-1 for _ in soft]], dtype=int)
        self.cloths = [
            {**look, "corners": np.array(found[::-1], dtype=np.float32)}
            for (look, _), found in zip(soft, corners, strict=True)
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
    `body`, its pose `rest` (7,), and `index` and `weight` of the corners that it moves.
    """
    found = []
    for i in np.flatnonzero(np.isin(model.skin_group, groups)):
        first, face, bone = (
            int(getattr(model, f"skin_{n}adr")[i]) for n in ("vert", "face", "bone")
        )
        bones = []
        for b in range(bone, bone + int(model.skin_bonenum[i])):
            start = model.skin_bonevertadr[b]
            rows = slice(start, start + model.skin_bonevertnum[b])
            pose = np.r_[model.skin_bonebindpos[b], model.skin_bonebindquat[b]].astype(float)
            index = model.skin_bonevertid[rows].astype(np.uint32)
            weight = model.skin_bonevertweight[rows].astype(np.float32)
            placed = {"body": int(model.skin_bonebodyid[b]), "rest": pose.tolist()}
            bones.append({**placed, "index": index, "weight": weight})
        look = _surface(model, "skin", int(i), model.skin_face[face : face + model.skin_facenum[i]])
        rest = model.skin_vert[first : first + model.skin_vertnum[i]].astype(np.float32)
        found.append({**look, "corners": rest, "bones": bones})
    return [skin for skin in found if skin["opacity"] > 0]


def _surface(model: mujoco.MjModel, what: str, i: int, faces: NDArray[Any]) -> dict[str, Any]:
    """Name, color and triangles of something soft."""
    material = int(getattr(model, f"{what}_matid")[i])
    rgba = shown_rgba(model, getattr(model, f"{what}_rgba")[i], material)
    look = {"name": f"{what} {i}", "color": hexadecimal(rgba), "opacity": rgba[3]}
    return {**look, "faces": faces.astype(np.uint32)}


def _flexes(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[_Soft]:
    """Flexes: the surface of cloths and bodies, and tubes around the edges of cables."""
    for i in np.flatnonzero(np.isin(model.flex_group, groups)):
        first, dim = model.flex_vertadr[i], int(model.flex_dim[i])
        rows = slice(first, first + model.flex_vertnum[i])
        if dim == 3:  # of a body only its skin is seen
            first, count, width = model.flex_shelldataadr[i], model.flex_shellnum[i], 3
            elements = model.flex_shell[first : first + 3 * count].reshape(-1, 3)
        else:
            first, count, width = model.flex_elemdataadr[i], model.flex_elemnum[i], dim + 1
            elements = model.flex_elem[first : first + width * count].reshape(-1, width)
        radius = float(model.flex_radius[i]) if dim == 1 else None
        faces = elements if dim > 1 else _tube_faces(len(elements))
        yield _surface(model, "flex", int(i), faces), partial(_flex, rows, elements.T, radius)


def _flex(rows: slice, ends: Any, radius: float | None, data: mujoco.MjData) -> Array:
    corners = data.flexvert_xpos[rows].copy()
    return corners if radius is None else _tube(corners[ends[0]], corners[ends[1]], radius)


def _tendons(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[_Soft]:
    """Spatial tendons as tubes, from where they are fixed over what they wrap."""
    spatial = model.wrap_type[model.tendon_adr] != mujoco.mjtWrap.mjWRAP_JOINT
    for i in np.flatnonzero(spatial & np.isin(model.tendon_group, groups)):
        most, radius = 2 * int(model.tendon_num[i]), float(model.tendon_width[i])
        yield (
            _surface(model, "tendon", int(i), _tube_faces(most)),
            partial(_tendon, int(i), most, radius),
        )


def _tendon(i: int, most: int, radius: float, data: mujoco.MjData) -> Array:
    rows = slice(data.ten_wrapadr[i], data.ten_wrapadr[i] + data.ten_wrapnum[i])
    points, thing = data.wrap_xpos.reshape(-1, 3)[rows], data.wrap_obj.ravel()[rows]
    joined = np.flatnonzero((thing[:-1] != -2) & (thing[1:] != -2))  # -2: a pulley
    ends = np.full((2, most, 3), points[0])
    ends[0, : len(joined)], ends[1, : len(joined)] = points[joined], points[joined + 1]
    return _tube(ends[0], ends[1], radius)


def _tube(a: Array, b: Array, radius: float) -> Array:
    """Corners (S * 12, 3) of six-sided tubes around the edges from a to b, both (S, 3)."""
    along = b - a
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.tile([0.0, 0, 1], (len(a), 1)), where=length > 0)
    helper = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    across = np.cross(along, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angle)[:, None] * across[:, None]
    ring = radius * (ring + np.sin(angle)[:, None] * np.cross(along, across)[:, None])
    return np.concatenate([a[:, None] + ring, b[:, None] + ring], axis=1).reshape(-1, 3)


def _tube_faces(count: int) -> NDArray[np.integer]:
    """Triangles (count * 12, 3) of `count` tubes."""
    k = np.arange(_SIDES)
    n = (k + 1) % _SIDES
    one = np.concatenate([np.c_[k, n, k + _SIDES], np.c_[n, n + _SIDES, k + _SIDES]])
    return (one + 2 * _SIDES * np.arange(count)[:, None, None]).reshape(-1, 3)
