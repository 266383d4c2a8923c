"""MuJoCo geoms as meshcat objects: one geometry, one material and one local transform per geom.

Textures are not mapped; colors, transparency and sizes are. meshcat's cylinders (and the capsules
built here) have their axis along y, MuJoCo's along z, so both are turned by a quarter about x.
"""

from __future__ import annotations

import mujoco
import numpy as np
from meshcat import geometry as mg
from numpy.typing import NDArray

Array = NDArray[np.float64]

_Y_TO_Z = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
Rgba = tuple[float, float, float, float]
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_INFINITE = 30.0  # half-size in metres at which a plane without bounds is drawn


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
        return {
            "uuid": self.uuid,
            "type": "LatheGeometry",
            "points": [{"x": max(float(x), 0.0), "y": float(y)} for x, y in self.profile],
            "segments": 32,
        }


class RoundEllipsoid(mg.Ellipsoid):
    """meshcat's ellipsoid with a finer grid: a unit sphere and a scaling matrix."""

    def lower(self, object_data: dict) -> dict:
        """The geometry as three.js reads it from JSON."""
        return super().lower(object_data) | {"widthSegments": 32, "heightSegments": 24}


def transform(position: Array, quaternion: Array) -> Array:
    """Homogeneous 4x4 matrix of a position (3,) in metres and a MuJoCo quaternion (4,), w first."""
    matrix, rotation = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, dtype=float))
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), position
    return matrix


def color(model: mujoco.MjModel, geom: int) -> Rgba:
    """Color MuJoCo shows: the geom's own unless it is the default grey and a material is set."""
    return _rgba(model, model.geom_rgba[geom], int(model.geom_matid[geom]))


def geom_mesh(model: mujoco.MjModel, geom: int) -> tuple[mg.Mesh, Array]:
    """Meshcat object of one geom and its 4x4 transform in the frame of its body.

    Raises:
        ValueError: for height fields, signed-distance geoms and other types without a counterpart.
    """
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        geometry, turned = _mesh(model, int(model.geom_dataid[geom])), False
    else:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
        geometry, turned = _shape(f"geom {name}", kind, model.geom_size[geom])
    mesh = _dressed(geometry, kind, color(model, geom), f"geom{geom}")
    local = transform(model.geom_pos[geom], model.geom_quat[geom])
    return mesh, local @ _Y_TO_Z if turned else local


def site_mesh(model: mujoco.MjModel, site: int) -> tuple[mg.Mesh, Array]:
    """Meshcat object of one site, such as a goal zone, and its transform in its body's frame."""
    kind = mujoco.mjtGeom(model.site_type[site])
    geometry, turned = _shape(f"site number {site}", kind, model.site_size[site])
    rgba = _rgba(model, model.site_rgba[site], int(model.site_matid[site]))
    local = transform(model.site_pos[site], model.site_quat[site])
    mesh = _dressed(geometry, kind, rgba, f"site{site}")
    return mesh, local @ _Y_TO_Z if turned else local


def _rgba(model: mujoco.MjModel, rgba: Array, material: int) -> Rgba:
    if material >= 0 and np.allclose(rgba, _DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    r, g, b, a = (float(c) for c in np.clip(rgba, 0.0, 1.0))
    return r, g, b, a


def _dressed(geometry: mg.Geometry, kind: mujoco.mjtGeom, rgba: Rgba, name: str) -> mg.Mesh:
    """A geometry with its material; three.js sees both sides of open shapes only."""
    r, g, b, a = rgba
    plane, triangles = kind == mujoco.mjtGeom.mjGEOM_PLANE, kind == mujoco.mjtGeom.mjGEOM_MESH
    material = mg.MeshPhongMaterial(
        color=(round(255 * r) << 16) + (round(255 * g) << 8) + round(255 * b),
        opacity=a,
        side=2 if plane or triangles else 0,
        shininess=35,
        specular=0x2A2A2A,
        flatShading=triangles,
        depthWrite=a == 1.0,  # what lies behind a see-through wall is seen from every side
        polygonOffset=plane,  # lines drawn on a floor stay visible
        polygonOffsetFactor=1,
        polygonOffsetUnits=1,
    )
    mesh = mg.Mesh(geometry, material)
    # meshcat draws random uuids; fixed ones make the same recording the same file
    mesh.uuid, geometry.uuid, material.uuid = (
        f"{part} {name}" for part in ("mesh", "shape", "mat")
    )
    return mesh


def _mesh(model: mujoco.MjModel, mesh: int) -> mg.Geometry:
    first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return mg.TriangularMeshGeometry(
        vertices, model.mesh_face[face : face + model.mesh_facenum[mesh]]
    )


def _shape(what: str, kind: mujoco.mjtGeom, sizes: Array) -> tuple[mg.Geometry, bool]:
    """A primitive, and whether its axis is y and must be turned to MuJoCo's z."""
    size = [float(s) for s in sizes]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return RoundEllipsoid([size[0]] * 3), False
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return RoundEllipsoid(size), False
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return mg.Box([2 * s for s in size]), False
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return mg.Cylinder(2 * size[1], size[0]), True
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return Capsule(size[0], size[1]), True
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        x, y = (s if s > 0 else _INFINITE for s in size[:2])
        corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
        return mg.TriangularMeshGeometry(corners, np.array([[0, 1, 2], [0, 2, 3]])), False
    raise ValueError(
        f"{what} is a {kind.name}; drawn are spheres, ellipsoids, boxes, cylinders, capsules, "
        "planes and meshes"
    )
