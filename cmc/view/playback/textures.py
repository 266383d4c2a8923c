"""Textures of MuJoCo's materials: their pixels, and where they lie on planes and boxes."""

from __future__ import annotations

import io
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
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


def png(model: mujoco.MjModel, material: int) -> bytes:
    """A material's texture as a PNG file; many geoms may share one, so that it is made once."""
    pixels = texture(model, material)
    assert pixels is not None
    return _png(pixels.tobytes(), pixels.shape)


@lru_cache(maxsize=64)
def _png(data: bytes, shape: tuple[int, ...]) -> bytes:
    from PIL import Image

    rows = np.frombuffer(data, np.uint8).reshape(shape)[::-1]  # three.js counts them upwards
    image, stream = Image.fromarray(np.ascontiguousarray(rows)), io.BytesIO()
    share = min(1.0, _LARGEST / image.width)
    image = image.resize((max(1, round(image.width * share)), max(1, round(image.height * share))))
    image.save(stream, "PNG")
    return stream.getvalue()


def flat_uv(
    corners: Array, half: Array, repeat: Array, uniform: bool, infinite: ArrayLike
) -> Array:
    """Texture coordinates of a texture laid flat on a plane or a box, as MuJoCo lays it.

    Args:
        corners: places (V, 2) in units of the half-sizes.
        half: half-sizes (2,) in m; zero where the plane has no bounds.
        repeat: how often the picture is repeated over the shape, or in two metres.
        uniform: in two metres.
        infinite: half-sizes at which a plane without bounds is drawn, m.
    """
    if not half.all():
        return corners * np.asarray(infinite) * [1, -1] * repeat / 2 + 0.5
    return (corners * [1, -1] + 1) * (repeat * half if uniform else repeat) / 2


def box_triangles() -> tuple[Array, NDArray[np.integer]]:
    """Vertices (24, 3) and faces (12, 3) of the box from -1 to 1, four vertices a side."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    vertices, faces = np.empty((6, 4, 3)), np.empty((6, 2, 3), dtype=int)
    for side in range(6):
        axis, sign = side // 2, 1 - 2 * (side % 2)
        vertices[side][:, axis] = sign
        vertices[side][:, [k for k in range(3) if k != axis]] = corners
        outwards = np.linalg.det(vertices[side, :3]) > 0
        order = [[0, 1, 2], [0, 2, 3]] if outwards else [[0, 2, 1], [0, 3, 2]]
        faces[side] = np.array(order) + 4 * side
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def cube_uv(vertices: Array) -> Array:
    """Texture coordinates of `box_triangles` in a cube's texture, as OpenGL's cube map has them."""
    uv = np.empty((6, 4, 2))
    for side, points in enumerate(vertices.reshape(6, 4, 3)):
        sign = 1 - 2 * (side % 2)
        x, y, z = points.T
        s, t = ((-sign * z, -y), (x, sign * z), (sign * x, -y))[side // 2]
        uv[side] = np.stack([(s + 1) / 2, (side + (0.998 * t + 1) / 2) / 6], axis=1)
    return uv.reshape(-1, 2)
