"""Textures of MuJoCo's materials: their pixels, and where they lie on planes and boxes."""

from __future__ import annotations

import base64
import io
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]
_Triangles = tuple[Array, NDArray[np.integer], Array]  # vertices, faces, texture coordinates
_INFINITE = 60.0  # half-size in metres at which a plane without bounds is drawn
_SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
_LARGEST = 512  # pixels across a texture; larger ones are made smaller


def texture(model: mujoco.MjModel, material: int) -> NDArray[np.uint8] | None:
    """Pixels (rows, columns, 3) of a material's color texture, or None.

    A cube's texture holds one square a face below each other: x, -x, y, -y, z, -z.
    """
    if material < 0:
        return None
    roles = (mujoco.mjtTextureRole.mjTEXROLE_RGB, mujoco.mjtTextureRole.mjTEXROLE_RGBA)
    index = max(int(model.mat_texid[material, int(role)]) for role in roles)
    if index < 0:
        return None
    rows, columns = int(model.tex_height[index]), int(model.tex_width[index])
    channels, first = int(model.tex_nchannel[index]), int(model.tex_adr[index])
    pixels = model.tex_data[first : first + rows * columns * channels]
    pixels = pixels.reshape(rows, columns, channels)
    return np.repeat(pixels, 3, axis=-1)[..., :3] if channels < 3 else pixels[..., :3]


def texture_address(model: mujoco.MjModel, material: int) -> str:
    """A material's texture as the address of a PNG file; many geoms may share one."""
    pixels = texture(model, material)
    assert pixels is not None
    return _encoded(pixels.tobytes(), pixels.shape)


@lru_cache(maxsize=64)
def _encoded(data: bytes, shape: tuple[int, ...]) -> str:
    rows = np.frombuffer(data, np.uint8).reshape(shape)[::-1]  # three.js counts them upwards
    image, stream = Image.fromarray(np.ascontiguousarray(rows)), io.BytesIO()
    share = min(1.0, _LARGEST / image.width)
    image = image.resize((max(1, round(image.width * share)), max(1, round(image.height * share))))
    image.save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _flat_uv(corners: Array, half: Array, repeat: Array, uniform: bool) -> Array:
    """Texture coordinates of a texture laid flat on a plane or a box, as MuJoCo lays it.

    `corners` (V, 2) in units of the half-sizes (2,), m, which are zero where the plane has no
    bounds; `repeat` counts pictures over the shape, or, if `uniform`, in two metres.
    """
    if not half.all():
        return corners * _INFINITE * [1, -1] * repeat / 2 + 0.5
    return (corners * [1, -1] + 1) * (repeat * half if uniform else repeat) / 2


def plane(half: Array, repeat: Array, uniform: bool) -> _Triangles:
    """A plane of half-sizes (2,), m, and its texture coordinates."""
    corners = np.c_[_SQUARE * np.where(half > 0, half, _INFINITE), np.zeros(4)]
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), _flat_uv(_SQUARE, half, repeat, uniform)


def box(half: Array, repeat: Array, uniform: bool, cube: bool) -> _Triangles:
    """A box of half-sizes (3,), m, with four vertices a side, and its texture coordinates.

    A texture lies flat across all sides, or is that of a cube, as in OpenGL's cube map.
    """
    vertices, faces, uv = np.empty((6, 4, 3)), np.empty((6, 2, 3), dtype=int), np.empty((6, 4, 2))
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        vertices[side] = np.insert(_SQUARE, axis, sign, axis=1)
        outwards = np.linalg.det(vertices[side, :3]) > 0
        order = [[0, 1, 2], [0, 2, 3]] if outwards else [[0, 2, 1], [0, 3, 2]]
        faces[side] = np.array(order) + 4 * side
        x, y, z = vertices[side].T
        s, t = ((-sign * z, -y), (x, sign * z), (sign * x, -y))[axis]
        uv[side] = np.stack([(s + 1) / 2, (side + (0.998 * t + 1) / 2) / 6], axis=1)
    corners = vertices.reshape(-1, 3)
    flat = _flat_uv(corners[:, :2], half[:2], repeat, uniform)
    return corners * half, faces.reshape(-1, 3), uv.reshape(-1, 2) if cube else flat
