"""A model at one pose as meshcat commands: one three.js object for each geom and site.

Colors, transparency and sizes are MuJoCo's. Textures are mapped onto planes, boxes, height fields
and meshes with texture coordinates; elsewhere a texture becomes its mean color. three.js's
cylinders and capsules have their axis along y, MuJoCo's along z: both are turned about x.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import umsgpack
from numpy.typing import NDArray

from cmc.view.playback.textures import Array, box, plane, texture, texture_address

_Triangles = tuple[Array, NDArray[np.integer], Array | None]  # vertices, faces, texture coordinates

_G = mujoco.mjtGeom
_Y_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_MESHES = (_G.mjGEOM_MESH, _G.mjGEOM_SDF)
_OPEN = (_G.mjGEOM_PLANE, _G.mjGEOM_HFIELD)  # seen from both sides; MuJoCo hides meshes' insides
_STAND_IN = "data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA="  # of a texture sent before


def draw(model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[int]) -> list[bytes]:
    """Draw the visible geoms, and sites with a material, of the groups at the pose `data` holds.

    What has no counterpart is left out and named in a warning.
    """
    commands: list[bytes] = []
    known: dict[str, str] = {}
    paths = body_paths(model)

    def send(kind: str, path: str, **more: Any) -> None:
        commands.append(umsgpack.packb({"type": kind, "path": f"/meshcat/{path}", **more}))

    for body, seen in visible(model, groups).items():
        place = transform(data.xpos[body], data.xquat[body])
        send("set_transform", paths[body], matrix=place.T.ravel().tolist())
        for what, index in seen:
            try:
                drawn, place = _three_object(model, what, index, known)
            except ValueError as error:
                name = getattr(model, what)(index).name or f"number {index}"
                warnings.warn(f"left out: {what} {name}, {error}", stacklevel=3)
                continue
            path = f"{paths[body]}/{what}{index}"
            send("set_object", path, object=drawn)
            send("set_transform", path, matrix=place.T.ravel().tolist())
    return commands


def body_paths(model: mujoco.MjModel) -> list[str]:
    """Names of the bodies in the scene: their own without slashes, or numbers; no two alike."""
    paths: list[str] = []
    for body in range(model.nbody):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body)
        path = name.replace("/", "|") if name else f"body{body}"
        while path in paths:
            path += f" ({body})"
        paths.append(path)
    return paths


def visible(model: mujoco.MjModel, groups: Sequence[int]) -> dict[int, list[tuple[str, int]]]:
    """For each body, what is seen of the groups: geoms with any opacity, sites with a material."""
    found: dict[int, list[tuple[str, int]]] = {}
    for g in np.flatnonzero(np.isin(model.geom_group, groups)).tolist():
        if shown_rgba(model, model.geom_rgba[g], int(model.geom_matid[g]))[3] > 0.0:
            found.setdefault(int(model.geom_bodyid[g]), []).append(("geom", g))
    for s in np.flatnonzero(np.isin(model.site_group, groups) & (model.site_matid >= 0)).tolist():
        found.setdefault(int(model.site_bodyid[s]), []).append(("site", s))
    return dict(sorted(found.items()))


def transform(position: Array, quaternion: Array) -> Array:
    """Homogeneous 4x4 matrix of a position (3,) in metres and a MuJoCo quaternion (4,), w first."""
    matrix, rotation = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, dtype=float))
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), position
    return matrix


def own_rgba(model: mujoco.MjModel, rgba: Array, material: int) -> Array:
    """The own color, or the material's where that is the default; a texture is multiplied by it."""
    default = material >= 0 and tuple(rgba) == _DEFAULT_RGBA
    return np.clip(model.mat_rgba[material] if default else rgba, 0.0, 1.0)


def shown_rgba(model: mujoco.MjModel, rgba: Array, material: int) -> Array:
    """The same times the texture's mean, for what no texture is mapped on."""
    pixels, rgba = texture(model, material), own_rgba(model, rgba, material)
    if pixels is None:
        return rgba
    step = max(1, pixels.shape[1] // 128)
    return rgba * [*(pixels[::step, ::step].mean(axis=(0, 1)) / 255), 1]


def hexadecimal(rgba: Array) -> int:
    """A color as 0xRRGGBB."""
    return int.from_bytes(round(255 * float(c)) for c in rgba[:3])


def _three_object(
    model: mujoco.MjModel, what: str, index: int, known: dict[str, str]
) -> tuple[dict[str, Any], Array]:
    """A geom or site as three.js reads it from JSON, and its transform in its body's frame.

    Textures are mapped on geoms. Of a mesh or texture in `known` only the uuid is sent. The uuids
    are made of names, so that the same recording is the same file. A type without a counterpart is
    refused.
    """

    def get(field: str) -> Any:
        return getattr(model, f"{what}_{field}")[index]

    name, kind, size = f"{what}{index}", _G(get("type")), get("size")
    material, data = (int(get("matid")), int(get("dataid"))) if what == "geom" else (-1, -1)
    found, scale = _triangles(model, kind, size, material, data), [1.0, 1.0, 1.0]
    mapped = found is not None and found[2] is not None
    rgba = (own_rgba if mapped else shown_rgba)(model, get("rgba"), get("matid"))
    place = transform(get("pos"), get("quat"))
    shared = found is not None and kind in _MESHES and not mapped
    uuid = f"mesh{data}" if shared else f"shape {name}"
    if found is None:
        shape, scale = _solid(kind, size.tolist())
    elif uuid in known:
        shape = {"type": "BoxGeometry", "width": 0, "height": 0, "depth": 0}
    else:
        shape = _buffer(*found)
    known |= {uuid: uuid} if shared else {}
    if kind in (_G.mjGEOM_CYLINDER, _G.mjGEOM_CAPSULE):
        place = place @ _Y_TO_Z
    look = {"uuid": f"mat {name}", **_material(kind, rgba, sides=2 if kind in _OPEN else 0)}
    ids = {"uuid": f"mesh {name}", "geometry": uuid, "material": look["uuid"]}
    matrix = np.diag([*scale, 1.0]).ravel().tolist()
    whole: dict[str, Any] = {
        "metadata": {"version": 4.5, "type": "Object"},
        "geometries": [{"uuid": uuid, **shape}],
        "materials": [look],
        "object": {**ids, "type": "Mesh", "matrix": matrix},
    }
    if mapped:
        url, image = texture_address(model, material), f"image {name}"
        look["map"] = known.setdefault(url, f"map {name}")
        wrap = {"wrap": [1000, 1000], "repeat": [1, 1]}
        whole["textures"] = [{"uuid": look["map"], **wrap, "image": image}]
        sent = url if look["map"] == f"map {name}" else _STAND_IN
        whole["images"] = [{"uuid": image, "url": sent}]
    return whole, place


def _material(kind: mujoco.mjtGeom, rgba: Array, sides: int) -> dict[str, Any]:
    """A three.js material; `sides` is 2 for both sides of open shapes."""
    opacity = float(rgba[3])
    return {
        "type": "MeshPhongMaterial",
        "color": hexadecimal(rgba),
        "opacity": opacity,
        "transparent": opacity < 1.0,
        "side": sides,
        "shininess": 35,
        "specular": 0x2A2A2A,
        "flatShading": kind in (*_MESHES, _G.mjGEOM_BOX),
        "depthWrite": opacity == 1.0,  # what lies behind a see-through wall is seen from every side
        "polygonOffset": kind == _G.mjGEOM_PLANE,  # lines drawn on a floor stay visible
        "polygonOffsetFactor": 0,
        "polygonOffsetUnits": 4,
    }


def _solid(kind: mujoco.mjtGeom, size: list[float]) -> tuple[dict[str, Any], list[float]]:
    """A solid shape, and the factors by which its axes are stretched."""
    (x, y, z), plain = size, [1.0, 1.0, 1.0]
    if kind in (_G.mjGEOM_SPHERE, _G.mjGEOM_ELLIPSOID):
        ball = {"type": "SphereGeometry", "radius": 1.0, "widthSegments": 32, "heightSegments": 24}
        return ball, [x, x, x] if kind == _G.mjGEOM_SPHERE else size
    if kind == _G.mjGEOM_BOX:
        return {"type": "BoxGeometry", "width": 2 * x, "height": 2 * y, "depth": 2 * z}, plain
    if kind == _G.mjGEOM_CYLINDER:
        round_ = {"radiusTop": x, "radiusBottom": x, "radialSegments": 50}
        return {"type": "CylinderGeometry", "height": 2 * y, **round_}, plain
    if kind == _G.mjGEOM_CAPSULE:
        points = [{"x": max(a, 0.0), "y": b} for a, b in _meridian(x, y).tolist()]
        return {"type": "LatheGeometry", "points": points, "segments": 32}, plain
    raise ValueError(f"a {kind.name} without a counterpart")


def _meridian(radius: float, half: float) -> Array:
    """Half an outline (N, 2) of a capsule along y, which three.js turns about y."""
    angles = np.linspace(0.0, np.pi / 2, 13)
    cap = np.stack([radius * np.cos(angles), half + radius * np.sin(angles)], axis=1)
    # a second ring close to the seam keeps the shading of the cap off the straight part
    seam = [[radius, half * (1.0 - min(0.02 * radius / max(half, 1e-9), 0.5))]]
    upper = np.concatenate([seam, cap])
    return np.concatenate([upper[::-1] * [1, -1], upper])


def _triangles(
    model: mujoco.MjModel, kind: mujoco.mjtGeom, size: Array, material: int, data: int
) -> _Triangles | None:
    """The triangles of a plane, height field or mesh, or of a box with a texture; else None."""
    pixels, cube, repeat, uniform = texture(model, material), False, np.ones(2), False
    if pixels is not None:
        cube = len(pixels) >= 6 * pixels.shape[1]
        repeat, uniform = model.mat_texrepeat[material], bool(model.mat_texuniform[material])
    if kind == _G.mjGEOM_PLANE:
        vertices, faces, uv = plane(size[:2], repeat, uniform)
        return vertices, faces, None if pixels is None or cube else uv
    if kind == _G.mjGEOM_HFIELD:
        vertices, faces = _height_field(model, data)
        width = 2 if uniform else 2 * model.hfield_size[data, :2]
        uv = vertices[:, :2] * [1, -1] * repeat / width + 0.5
        return vertices, faces, None if pixels is None else uv
    if kind == _G.mjGEOM_BOX and pixels is not None:
        return box(size, repeat, uniform, cube)
    if kind not in _MESHES or data < 0:
        return None
    first, face = model.mesh_vertadr[data], model.mesh_faceadr[data]
    rows = slice(face, face + model.mesh_facenum[data])
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[data]]
    faces, count = model.mesh_face[rows], model.mesh_texcoordnum[data]
    if kind != _G.mjGEOM_MESH or pixels is None or count == 0:
        return vertices, faces, None
    # a corner of the mesh is one vertex for each texture coordinate that its faces give it
    first, corners = model.mesh_texcoordadr[data], model.mesh_facetexcoord[rows]
    pairs, index = np.unique([faces.ravel(), corners.ravel()], axis=1, return_inverse=True)
    uv = model.mesh_texcoord[first : first + count] * repeat
    return vertices[pairs[0]], index.reshape(-1, 3), uv[pairs[1]]


def _height_field(model: mujoco.MjModel, field: int) -> tuple[Array, NDArray[np.integer]]:
    """The surface of a height field; MuJoCo's base below it is not drawn."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x, y, top, _ = model.hfield_size[field]
    first = model.hfield_adr[field]
    height = top * model.hfield_data[first : first + rows * columns]
    X, Y = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    faces = np.concatenate([np.c_[corner, right, above + 1], np.c_[corner, above + 1, above]])
    return np.c_[X.ravel(), Y.ravel(), height], faces


def _buffer(vertices: Array, faces: NDArray[np.integer], uv: Array | None) -> dict[str, Any]:
    """Triangles as a three.js geometry; numbers travel as extensions of msgpack."""

    def pack(array: Any, kind: str, code: int) -> dict[str, Any]:
        data = umsgpack.Ext(code, np.ascontiguousarray(array, kind.lower()).tobytes())
        return {"itemSize": array.shape[1], "type": f"{kind}Array", "array": data}

    attributes = {"position": pack(vertices, "Float32", 0x17)}
    if uv is not None:
        attributes["uv"] = pack(uv, "Float32", 0x17)
    index = pack(faces, "Uint32", 0x16)
    return {"type": "BufferGeometry", "data": {"attributes": attributes, "index": index}}
