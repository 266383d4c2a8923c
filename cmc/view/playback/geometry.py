"""MuJoCo geoms as meshcat objects: one geometry, one material and one local transform per geom.

Colors, transparency and sizes are MuJoCo's. Textures are mapped onto planes, boxes and meshes with
texture coordinates; elsewhere a texture becomes its mean color. meshcat's cylinders (and the
capsules built here) have their axis along y, MuJoCo's along z: both are turned about x.
"""

from __future__ import annotations

import mujoco
import numpy as np
from meshcat import geometry as mg
from numpy.typing import NDArray

from cmc.view.playback.textures import box_triangles, cube_uv, flat_uv, png, texture

Array = NDArray[np.float64]
Rgba = tuple[float, float, float, float]
G = mujoco.mjtGeom

_Y_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_INFINITE = 60.0  # half-size in metres at which a plane without bounds is drawn
_TRIANGLES = (G.mjGEOM_MESH, G.mjGEOM_SDF)


class Capsule(mg.Geometry):
    """Capsule along y: a meridian turned by three.js, as meshcat has no class for it.

    Args:
        radius: radius, m.
        half_length: half the distance between the centers of the two caps, m.
    """

    def __init__(self, radius: float, half_length: float, arc_points: int = 13):
        super().__init__()
        angles = np.linspace(0.0, np.pi / 2, arc_points)
        cap = np.stack([radius * np.cos(angles), half_length + radius * np.sin(angles)], axis=1)
        # a second ring close to the seam keeps the shading of the cap off the straight part
        seam = [[radius, half_length * (1.0 - min(0.02 * radius / max(half_length, 1e-9), 0.5))]]
        half = np.concatenate([seam, cap])
        self.profile = np.concatenate([half[::-1] * [1, -1], half])

    def lower(self, object_data: dict) -> dict:
        """The geometry as three.js reads it from JSON."""
        points = [{"x": max(float(x), 0.0), "y": float(y)} for x, y in self.profile]
        return {"uuid": self.uuid, "type": "LatheGeometry", "points": points, "segments": 32}


class RoundEllipsoid(mg.Ellipsoid):
    """meshcat's ellipsoid with a finer grid: a unit sphere and a scaling matrix."""

    def lower(self, object_data: dict) -> dict:
        """The geometry as three.js reads it from JSON."""
        return super().lower(object_data) | {"widthSegments": 32, "heightSegments": 24}


class Triangles(mg.TriangularMeshGeometry):
    """Vertices (V, 3), faces (F, 3), and texture coordinates (V, 2) whose v counts rows down."""

    def __init__(self, vertices: Array, faces: NDArray[np.integer], uv: Array | None = None):
        super().__init__(vertices, faces)
        self.uv = uv

    def lower(self, object_data: dict) -> dict:
        """The geometry as three.js reads it from JSON."""
        data = super().lower(object_data)
        if self.uv is not None:
            packed = mg.pack_numpy_array(np.asarray(self.uv, np.float32).T)
            data["data"]["attributes"]["uv"] = packed
        return data


class Known(mg.Geometry):
    """Stands for a geometry of the same uuid that the page already holds."""

    def lower(self, object_data: dict) -> dict:
        """A point of a geometry, which the page replaces."""
        return {"uuid": self.uuid, "type": "BoxGeometry", "width": 0, "height": 0, "depth": 0}


def transform(position: Array, quaternion: Array) -> Array:
    """Homogeneous 4x4 matrix of a position (3,) in metres and a MuJoCo quaternion (4,), w first."""
    matrix, rotation = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, dtype=float))
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), position
    return matrix


def color(model: mujoco.MjModel, geom: int) -> Rgba:
    """Color MuJoCo shows: the geom's own unless it is the default grey and a material is set."""
    return shown_rgba(model, model.geom_rgba[geom], int(model.geom_matid[geom]))


def geom_mesh(
    model: mujoco.MjModel, geom: int, known: set[str] | None = None
) -> tuple[mg.Mesh, Array]:
    """Meshcat object of one geom and its 4x4 transform in the frame of its body.

    Args:
        model: the compiled model.
        geom: its number.
        known: geometries drawn before, by uuid; what is drawn here is added, and not sent again.

    Raises:
        ValueError: for a type without a counterpart.
    """
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
    kind, size = G(model.geom_type[geom]), model.geom_size[geom]
    material, dataid = int(model.geom_matid[geom]), int(model.geom_dataid[geom])
    geometry, mapped = _textured(model, kind, size, material, dataid)
    turned = False
    if geometry is None:
        geometry, turned = _shape(f"geom {name}", model, kind, size, dataid)
    mesh = _dressed(model, geometry, kind, color(model, geom), material if mapped else -1)
    _name(mesh, f"geom{geom}")
    if kind in _TRIANGLES and not mapped:
        geometry.uuid = f"mesh{dataid}"
        if known is not None and geometry.uuid in known:
            mesh.geometry, uuid = Known(), geometry.uuid
            mesh.geometry.uuid = uuid
        (set() if known is None else known).add(geometry.uuid)
    local = transform(model.geom_pos[geom], model.geom_quat[geom])
    return mesh, local @ _Y_TO_Z if turned else local


def site_mesh(model: mujoco.MjModel, site: int) -> tuple[mg.Mesh, Array]:
    """Meshcat object of one site, such as a goal zone, and its transform in its body's frame."""
    kind = G(model.site_type[site])
    geometry, turned = _shape(f"site number {site}", model, kind, model.site_size[site], -1)
    rgba = shown_rgba(model, model.site_rgba[site], int(model.site_matid[site]))
    local = transform(model.site_pos[site], model.site_quat[site])
    mesh = _dressed(model, geometry, kind, rgba, -1)
    _name(mesh, f"site{site}")
    return mesh, local @ _Y_TO_Z if turned else local


def own_rgba(model: mujoco.MjModel, rgba: Array, material: int) -> Array:
    """The own color (4,), or the material's where that is the default."""
    unset = material >= 0 and tuple(rgba) == _DEFAULT_RGBA
    return model.mat_rgba[material] if unset else rgba


def shown_rgba(model: mujoco.MjModel, rgba: Array, material: int) -> Rgba:
    """The own color, or the material's where that is the default, times the texture's mean."""
    rgba = own_rgba(model, rgba, material)
    pixels = texture(model, material)
    if pixels is not None:
        step = max(1, pixels.shape[1] // 128)
        rgba = rgba * [*(pixels[::step, ::step].mean(axis=(0, 1)) / 255), 1]
    r, g, b, a = (float(c) for c in np.clip(rgba, 0.0, 1.0))
    return r, g, b, a


def _textured(
    model: mujoco.MjModel, kind: mujoco.mjtGeom, size: Array, material: int, dataid: int
) -> tuple[mg.Geometry | None, bool]:
    """Triangles with texture coordinates, where the material's texture can be mapped."""
    pixels = texture(model, material)
    if pixels is None:
        return None, False
    repeat, uniform = model.mat_texrepeat[material], bool(model.mat_texuniform[material])
    square = len(pixels) // pixels.shape[1]
    if kind == G.mjGEOM_PLANE and square < 6:
        half = np.where(size[:2] > 0, size[:2], _INFINITE)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        uv = flat_uv(corners, size[:2], repeat, uniform, _INFINITE)
        vertices = np.c_[corners * half, np.zeros(4)]
        return Triangles(vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv), True
    if kind == G.mjGEOM_HFIELD:
        surface = _height_field(model, dataid)
        half = model.hfield_size[dataid, :2]
        surface.uv = flat_uv(surface.vertices[:, :2] / half, 0 * half, repeat, True, half)
        if not uniform:
            surface.uv = (surface.uv - 0.5) / half + 0.5
        return surface, True
    if kind == G.mjGEOM_BOX:
        vertices, faces = box_triangles()
        if square == 6:
            return Triangles(vertices * size, faces, cube_uv(vertices)), True
        uv = flat_uv(vertices[:, :2], size[:2], repeat, uniform, _INFINITE)
        return Triangles(vertices * size, faces, uv), True
    if kind == G.mjGEOM_MESH and model.mesh_texcoordnum[dataid] > 0:
        vertices, faces, uv_faces = _mesh_arrays(model, dataid)
        first = model.mesh_texcoordadr[dataid]
        uv = model.mesh_texcoord[first : first + model.mesh_texcoordnum[dataid]] * repeat
        pairs, index = np.unique(
            np.stack([faces.ravel(), uv_faces.ravel()]), axis=1, return_inverse=True
        )
        return Triangles(vertices[pairs[0]], index.reshape(-1, 3), uv[pairs[1]]), True
    return None, False


def _dressed(
    model: mujoco.MjModel, geometry: mg.Geometry, kind: mujoco.mjtGeom, rgba: Rgba, material: int
) -> mg.Mesh:
    """A geometry with its material; three.js sees both sides of open shapes only."""
    plane, open_ = kind == G.mjGEOM_PLANE, isinstance(geometry, mg.TriangularMeshGeometry)
    image, (r, g, b, a) = None, rgba
    if material >= 0:
        r, g, b = (float(c) for c in model.mat_rgba[material, :3])
        image = mg.ImageTexture(mg.PngImage(png(model, material)), wrap=[1000, 1000])
    dressed = mg.MeshPhongMaterial(
        color=(round(255 * r) << 16) + (round(255 * g) << 8) + round(255 * b),
        map=image,
        opacity=a,
        side=2 if open_ else 0,
        shininess=35,
        specular=0x2A2A2A,
        flatShading=kind in _TRIANGLES or kind == G.mjGEOM_BOX,
        depthWrite=a == 1.0,  # what lies behind a see-through wall is seen from every side
        polygonOffset=plane,  # lines drawn on a floor stay visible
        polygonOffsetFactor=0,
        polygonOffsetUnits=4,
    )
    return mg.Mesh(geometry, dressed)


def _name(mesh: mg.Mesh, name: str) -> None:
    """Replace meshcat's random uuids, so that the same recording is the same file."""
    parts = {"mesh": mesh, "shape": mesh.geometry, "mat": mesh.material}
    if mesh.material.map is not None:
        parts |= {"map": mesh.material.map, "image": mesh.material.map.image}
    for part, element in parts.items():
        element.uuid = f"{part} {name}"


def _mesh_arrays(
    model: mujoco.MjModel, mesh: int
) -> tuple[Array, NDArray[np.integer], NDArray[np.integer]]:
    first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    rows = slice(face, face + model.mesh_facenum[mesh])
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return vertices, model.mesh_face[rows], model.mesh_facetexcoord[rows]


def _height_field(model: mujoco.MjModel, field: int) -> Triangles:
    """The surface of a height field; MuJoCo's base below it is not drawn."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    x, y, top, _ = model.hfield_size[field]
    first = model.hfield_adr[field]
    height = top * model.hfield_data[first : first + rows * columns]
    X, Y = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    right, above = corner + 1, corner + columns
    faces = np.concatenate([np.c_[corner, right, above + 1], np.c_[corner, above + 1, above]])
    return Triangles(np.c_[X.ravel(), Y.ravel(), height], faces)


def _shape(
    what: str, model: mujoco.MjModel, kind: mujoco.mjtGeom, sizes: Array, dataid: int
) -> tuple[mg.Geometry, bool]:
    """A plain shape, and whether its axis is y and must be turned to MuJoCo's z."""
    size = [float(s) for s in sizes]
    if kind in _TRIANGLES and dataid >= 0:
        return Triangles(*_mesh_arrays(model, dataid)[:2]), False
    if kind == G.mjGEOM_HFIELD:
        return _height_field(model, dataid), False
    if kind == G.mjGEOM_SPHERE:
        return RoundEllipsoid([size[0]] * 3), False
    if kind == G.mjGEOM_ELLIPSOID:
        return RoundEllipsoid(size), False
    if kind == G.mjGEOM_BOX:
        return mg.Box([2 * s for s in size]), False
    if kind == G.mjGEOM_CYLINDER:
        return mg.Cylinder(2 * size[1], size[0]), True
    if kind == G.mjGEOM_CAPSULE:
        return Capsule(size[0], size[1]), True
    if kind == G.mjGEOM_PLANE:
        x, y = (s if s > 0 else _INFINITE for s in size[:2])
        corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
        return Triangles(corners, np.array([[0, 1, 2], [0, 2, 3]])), False
    raise ValueError(f"{what} is a {kind.name}, which has no counterpart")
