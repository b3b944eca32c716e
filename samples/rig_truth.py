"""Ground truth of the rig: depth and projector coordinates by geometry, and which pixels are lit, mixed, shadowed or in the groove."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import capture_files
import numpy as np
import rig_scene
import rig_transport
from rig_scene import Rig

SUBSAMPLES = 13  # rays per pixel side, edges included, that look for edges
JUMP_M = 0.002  # between neighbouring rays that hit different objects
OBLIQUE_COLUMNS = 3.0  # a pixel that spans more of the projector has no one column


class Truth(NamedTuple):
    """The ground truth of the rig, [rows, cols] each."""

    depth: np.ndarray  # float64 metres, z-depth at the pixel centre
    u: np.ndarray  # float64, continuous projector column at the pixel centre, whether light gets there or not
    v: np.ndarray  # float64
    lit: np.ndarray  # bool, seen by the projector at the pixel centre
    shadow: np.ndarray  # bool, no part is lit, though it is within the projector's panel
    mixed: np.ndarray  # bool, crossed by an edge of depth or shadow, or too oblique
    groove: np.ndarray  # bool, on the walls of the groove


class _Hits(NamedTuple):
    depth: np.ndarray
    u: np.ndarray
    v: np.ndarray
    lit: np.ndarray
    panel: np.ndarray
    shape: np.ndarray


def _cast(mi, scene, rig: Rig, shapes: dict, u: np.ndarray, v: np.ndarray) -> _Hits:
    """Return the surface that rays through continuous image coordinates hit."""
    import drjit as dr

    grid = u.shape
    si = scene.ray_intersect(rig_transport.camera_rays(mi, rig, u.ravel(), v.ravel()))
    shape = np.zeros(u.size, int)
    for number, item in enumerate(shapes.values()):
        shape[np.array(si.shape == mi.ShapePtr(item))] = number
    to_projector = mi.Point3f(rig_scene.PROJECTOR_POSITION_M) - si.p
    free = ~scene.ray_test(si.spawn_ray_to(mi.Point3f(rig_scene.PROJECTOR_POSITION_M)))
    facing = dr.dot(si.n, to_projector) > 0
    # The point from the ray in float64: float32 of the renderer is good to 1e-7 of the distance, its position is less so.
    x, y = rig.camera.plane_at(u, v)
    depth = -np.array(si.p.z, dtype=np.float64).reshape(grid)
    point = np.stack([x * depth, y * depth, -depth], axis=-1)
    column, row = rig_scene.project(rig.projector, point)
    width, height = rig.projector.resolution
    panel = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    lit = (np.array(free) & np.array(facing)).reshape(grid) & panel
    return _Hits(depth, column, row, lit, panel, shape.reshape(grid))


def trace_truth(mi, shapes: dict[str, Any], rig: Rig) -> Truth:
    """Trace the truth at pixel centres, and the edges over whole pixels."""
    scene = mi.load_dict({"type": "scene", **shapes})
    rows, cols = rig.camera.height, rig.camera.width
    row, column = np.mgrid[:rows, :cols]
    centre = _cast(mi, scene, rig, shapes, column + 0.5, row + 0.5)
    at = np.linspace(0, 1, SUBSAMPLES)
    dv, du = np.meshgrid(at, at, indexing="ij")
    sub = _cast(mi, scene, rig, shapes, column[..., None, None] + du, row[..., None, None] + dv)  # [rows, cols, sub, sub]
    edge = np.zeros((rows, cols), bool)
    for axis in (2, 3):
        jump = (np.abs(np.diff(sub.depth, axis=axis)) > JUMP_M) & (np.diff(sub.shape, axis=axis) != 0)
        edge |= jump.any(axis=(2, 3))
    some, every = sub.lit.any(axis=(2, 3)), sub.lit.all(axis=(2, 3))
    extent = np.ptp(sub.u, axis=(2, 3))
    walls = [i for i, name in enumerate(shapes) if name.startswith("groove")]
    return Truth(
        depth=centre.depth,
        u=centre.u,
        v=centre.v,
        lit=centre.lit,
        shadow=~some & sub.panel.all(axis=(2, 3)),
        mixed=edge | (some & ~every) | (extent > OBLIQUE_COLUMNS),
        groove=np.isin(sub.shape, walls).all(axis=(2, 3)),
    )


def write_truth(path: Path, truth: Truth) -> None:
    """Write truth.exr."""
    channels = {"depth.Z": truth.depth, "projector.U": truth.u, "projector.V": truth.v}
    masks = {"mask.Y": truth.lit, "shadow.Y": truth.shadow, "mixed.Y": truth.mixed, "groove.Y": truth.groove}
    layers = {name: values.astype(np.float32) for name, values in channels.items()}
    layers |= {name: values.astype(np.float16) for name, values in masks.items()}
    capture_files.write_exr(path, layers, note="ground truth at pixel centres, by geometry")
