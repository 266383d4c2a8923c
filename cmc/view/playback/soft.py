"""What changes its shape: flexes, skins and spatial tendons, as triangles whose corners move."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from cmc.view.playback.geometry import Rgba, shown_rgba
from cmc.view.playback.scene import Bone, Skin

Array = NDArray[np.float64]
_SIDES = 6  # of a tube around an edge or a tendon


@dataclass(frozen=True)
class Soft:
    """Triangles with moving corners.

    Attributes:
        name: kind and number, for the page.
        faces: corners of each triangle, (F, 3).
        rgba: color.
        corners: from MuJoCo's data, with kinematics done, to corners (V, 3) in the world, m.
    """

    name: str
    faces: NDArray[np.integer]
    rgba: Rgba
    corners: Callable[[mujoco.MjData], Array]


def soft_parts(model: mujoco.MjModel, groups: Sequence[int]) -> list[Soft]:
    """All visible flexes and spatial tendons of a model."""
    parts = [*_flexes(model, groups), *_tendons(model, groups)]
    return [part for part in parts if part.rgba[3] > 0 and len(part.faces)]


def _flexes(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[Soft]:
    for i in range(model.nflex):
        if model.flex_group[i] not in groups:
            continue
        rows = slice(model.flex_vertadr[i], model.flex_vertadr[i] + model.flex_vertnum[i])
        dim = int(model.flex_dim[i])
        if dim == 3:  # of a body only its skin is seen
            first, count, width = model.flex_shelldataadr[i], model.flex_shellnum[i], 3
            elements = model.flex_shell[first : first + 3 * count].reshape(-1, 3)
        else:
            first, count, width = model.flex_elemdataadr[i], model.flex_elemnum[i], dim + 1
            elements = model.flex_elem[first : first + width * count].reshape(-1, width)
        rgba = shown_rgba(model, model.flex_rgba[i], int(model.flex_matid[i]))
        if dim > 1:

            def places(d: mujoco.MjData, r: slice = rows) -> Array:
                return d.flexvert_xpos[r].copy()

            yield Soft(f"flex {i}", elements, rgba, places)
            continue
        radius, ends = float(model.flex_radius[i]), elements

        def corners(d: mujoco.MjData, r: slice = rows, e: Array = ends, s: float = radius) -> Array:
            return tube(d.flexvert_xpos[r][e[:, 0]], d.flexvert_xpos[r][e[:, 1]], s)

        yield Soft(f"flex {i}", tube_faces(len(ends)), rgba, corners)


def skins(model: mujoco.MjModel, groups: Sequence[int]) -> list[Skin]:
    """All visible skins of a model."""
    found = []
    for i in np.flatnonzero(np.isin(model.skin_group, groups)):
        first, face = model.skin_vertadr[i], model.skin_faceadr[i]
        bones = []
        for b in range(model.skin_boneadr[i], model.skin_boneadr[i] + model.skin_bonenum[i]):
            start = model.skin_bonevertadr[b]
            rows = slice(start, start + model.skin_bonevertnum[b])
            pose = np.concatenate([model.skin_bonebindpos[b], model.skin_bonebindquat[b]])
            index, weight = model.skin_bonevertid[rows], model.skin_bonevertweight[rows]
            bones.append(Bone(int(model.skin_bonebodyid[b]), pose, index, weight))
        rgba = shown_rgba(model, model.skin_rgba[i], int(model.skin_matid[i]))
        faces = model.skin_face[face : face + model.skin_facenum[i]]
        rest = model.skin_vert[first : first + model.skin_vertnum[i]]
        found.append(Skin(f"skin {i}", faces, rgba, rest, tuple(bones)))
    return [skin for skin in found if skin.rgba[3] > 0]


def _tendons(model: mujoco.MjModel, groups: Sequence[int]) -> Iterator[Soft]:
    spatial = [
        i
        for i in range(model.ntendon)
        if model.wrap_type[model.tendon_adr[i]] != mujoco.mjtWrap.mjWRAP_JOINT
        and model.tendon_group[i] in groups
    ]
    for i in spatial:
        most, radius = 2 * int(model.tendon_num[i]), float(model.tendon_width[i])

        def corners(d: mujoco.MjData, i: int = i, most: int = most, r: float = radius) -> Array:
            rows = slice(d.ten_wrapadr[i], d.ten_wrapadr[i] + d.ten_wrapnum[i])
            points, thing = d.wrap_xpos.reshape(-1, 3)[rows], d.wrap_obj.ravel()[rows]
            joined = np.flatnonzero((thing[:-1] != -2) & (thing[1:] != -2))  # -2: a pulley
            ends = np.full((2, most, 3), points[0])
            ends[0, : len(joined)], ends[1, : len(joined)] = points[joined], points[joined + 1]
            return tube(ends[0], ends[1], r)

        rgba = shown_rgba(model, model.tendon_rgba[i], int(model.tendon_matid[i]))
        yield Soft(f"tendon {i}", tube_faces(most), rgba, corners)


def tube(a: Array, b: Array, radius: float) -> Array:
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


def tube_faces(count: int) -> NDArray[np.integer]:
    """Triangles (count * 12, 3) of `count` tubes."""
    k = np.arange(_SIDES)
    n = (k + 1) % _SIDES
    one = np.concatenate([np.c_[k, n, k + _SIDES], np.c_[n, n + _SIDES, k + _SIDES]])
    return (one + 2 * _SIDES * np.arange(count)[:, None, None]).reshape(-1, 3)
