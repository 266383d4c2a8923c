"""A model at one pose as meshcat commands."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import meshcat
import mujoco
import numpy as np

from cmc.view.playback.geometry import geom_mesh, own_rgba, site_mesh, transform
from cmc.view.playback.scene import CommandLog, body_paths


def draw(model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[int]) -> CommandLog:
    """Draw the visible geoms, and sites with a material, of the groups at the pose `data` holds.

    What has no counterpart is left out and named in a warning.
    """
    log, paths = CommandLog(), body_paths(model)
    scene = meshcat.Visualizer(window=log)  # type: ignore[no-untyped-call]
    known: set[str] = set()
    for body in drawn_bodies(model, groups):
        node = scene[paths[body]]
        node.set_transform(transform(data.xpos[body], data.xquat[body]))
        for geom in visible_geoms(model, body, groups):
            try:
                mesh, local = geom_mesh(model, geom, known)
            except ValueError as error:
                warnings.warn(f"left out: {error}", stacklevel=3)
                continue
            node[f"geom{geom}"].set_object(mesh)
            node[f"geom{geom}"].set_transform(local)
        for site in visible_sites(model, body, groups):
            mesh, local = site_mesh(model, site)
            node[f"site{site}"].set_object(mesh)
            node[f"site{site}"].set_transform(local)
    return log


def drawn_bodies(model: mujoco.MjModel, groups: Sequence[int]) -> list[int]:
    """Bodies that own at least one visible geom or site."""
    return [
        b
        for b in range(model.nbody)
        if visible_geoms(model, b, groups) or visible_sites(model, b, groups)
    ]


def visible_geoms(model: mujoco.MjModel, body: int, groups: Sequence[int]) -> list[int]:
    """Geoms of a body that are of the groups and not wholly transparent."""
    first = model.body_geomadr[body]
    return [
        g
        for g in range(first, first + model.body_geomnum[body])
        if model.geom_group[g] in groups
        and own_rgba(model, model.geom_rgba[g], int(model.geom_matid[g]))[3] > 0.0
    ]


def visible_sites(model: mujoco.MjModel, body: int, groups: Sequence[int]) -> list[int]:
    """Sites of a body that are of the groups and have a material."""
    shown = (
        (model.site_bodyid == body) & (model.site_matid >= 0) & np.isin(model.site_group, groups)
    )
    return [int(site) for site in np.flatnonzero(shown)]
