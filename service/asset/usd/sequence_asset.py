"""Writes a sequence of surfaces or points as one time-sampled USD asset, a step at a time, so that memory holds one step.

A mesh has points, faces, normals and colours at each time code: the part of a subject that the camera sees changes, and with it the faces.
The values without a time are those of the first step, for readers that know no time.

Source: OpenUSD, UsdGeomMesh ("Topology, varying"), UsdGeomPointBased, time codes in UsdStage; crate files take time samples one save after
another.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.usd import layers
from service.asset.usd.files import write_layer
from service.asset.usd.layers import CAMERA_FRAME, Description, define_root, describe_root, pose_matrix, prim_name, set_extents_hint
from service.asset.usd.materials import define_display_color_material
from service.asset.usd.scene import define_cameras, distinct
from service.errors import AssetError
from service.requests.export import TIME_SAMPLED

TIME_DIGITS = 6
"""Decimals of a time code."""


class Faces(NamedTuple):
    """The faces of a mesh."""

    counts: np.ndarray  # [faces] int32, corners of each
    indices: np.ndarray  # [corners] int32, vertex numbers


class Moment(NamedTuple):
    """The surface or the points of one step, in the camera frame and scene units."""

    time_code: float
    points: np.ndarray  # [n, 3] float32
    colours: np.ndarray  # [n, 3] float32 scene-linear Rec.709
    normals: np.ndarray | None  # [n, 3] float32, unit; None: not known
    faces: Faces | None  # None: points alone
    widths: np.ndarray | None  # [n] float32, of points


class SequenceSizes(NamedTuple):
    """Numbers of steps, vertices and faces that were written."""

    steps: int
    vertices: int
    """Vertices of the step that has most."""
    faces: int


def write_sequence_asset(moments: Iterator[Moment], target: Path, description: Description, *,
                         frames_per_second: float) -> SequenceSizes:
    """Write the steps of a sequence as time samples, whole or not at all.
    `moments`: in the order of time, one step or more, all with faces or none; each is held only while it is written. `description`: goes
    into the root prim and the layer; it has a camera. `frames_per_second`: time codes a second. Raises AssetError for another suffix, no
    step, or a step without a vertex. Raises StorageError if the disk refuses; what was there before is left as it was."""
    if target.suffix.lower().removeprefix(".") not in TIME_SAMPLED:
        raise AssetError(f"{target} cannot hold a sequence: its suffix must be .usdc or .usdz, which take one step after another")
    sizes: list[SequenceSizes] = []

    def define(usd_stage: Usd.Stage) -> None:
        sizes.append(_define(usd_stage, moments, target, description, frames_per_second))

    write_layer(target, define)
    return sizes[0]


def _define(usd_stage: Usd.Stage, moments: Iterator[Moment], target: Path, description: Description,
            frames_per_second: float) -> SequenceSizes:
    assert description.camera is not None
    root = define_root(
        usd_stage, Sdf.Path.absoluteRootPath.AppendChild(prim_name(description.name)), unit_m=description.unit_m,
        provenance={**description.provenance, "relit:camera": description.camera.model_dump_json()},
        documentation=f"{description.name}: a measured sequence, exported by Relit. {CAMERA_FRAME}")
    describe_root(root, name=description.name, identifier=target.name, version=description.version, provenance=description.provenance)
    if description.camera.world_from_camera is not None:
        root.AddTransformOp().Set(pose_matrix(description.camera.world_from_camera, description.unit_m))
    steps = vertices = faces = 0
    low, high, first, last = np.full(3, np.inf), np.full(3, -np.inf), 0.0, 0.0
    for moment in moments:
        if not len(moment.points):
            raise AssetError(f"{target}: the step at time code {moment.time_code:g} has no vertex: there is nothing to show")
        time = round(moment.time_code, TIME_DIGITS)
        if steps == 0:
            first = time
            prim = _define_geometry(usd_stage, root.GetPath(), moment)
            _set(prim, moment, Usd.TimeCode.Default())
        _set(prim, moment, Usd.TimeCode(time))
        low, high, last = np.minimum(low, moment.points.min(axis=0)), np.maximum(high, moment.points.max(axis=0)), time
        steps, vertices = steps + 1, max(vertices, len(moment.points))
        faces = max(faces, 0 if moment.faces is None else len(moment.faces.counts))
        usd_stage.Save()  # what is saved leaves the memory
    if steps == 0:
        raise AssetError(f"{target}: the sequence has no step")
    layers.set_time_range(usd_stage, first, last, frames_per_second)
    extent = np.stack([low, high])
    define_cameras(usd_stage, root.GetPath(), description.camera, extent)
    set_extents_hint(root.GetPrim())
    return SequenceSizes(steps, vertices, faces)


def _define_geometry(usd_stage: Usd.Stage, root: Sdf.Path, moment: Moment) -> Any:
    """Define the mesh or points, without values, with a material that shows their colours."""
    geom = UsdGeom.Scope.Define(usd_stage, root.AppendChild("Geom")).GetPath()
    prim: Any
    if moment.faces is None:
        prim = UsdGeom.Points.Define(usd_stage, geom.AppendChild("Points"))
        prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    else:
        prim = UsdGeom.Mesh.Define(usd_stage, geom.AppendChild("Mesh"))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
    UsdGeom.PrimvarsAPI(prim).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
    if moment.normals is not None:
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    looks = UsdGeom.Scope.Define(usd_stage, root.AppendChild("Looks")).GetPath()
    material = define_display_color_material(usd_stage, looks.AppendChild("Material"))
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    return prim


def _set(prim: Any, moment: Moment, time: Usd.TimeCode) -> None:
    prim.CreatePointsAttr().Set(_vectors(moment.points), time)
    if moment.faces is not None:
        prim.CreateFaceVertexCountsAttr().Set(Vt.IntArray.FromNumpy(np.ascontiguousarray(moment.faces.counts, dtype=np.int32)), time)
        prim.CreateFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(np.ascontiguousarray(moment.faces.indices, dtype=np.int32)), time)
        prim.CreateExtentAttr().Set(_vectors(np.stack([moment.points.min(axis=0), moment.points.max(axis=0)])), time)
    if moment.widths is not None:
        widths = Vt.FloatArray.FromNumpy(np.ascontiguousarray(moment.widths, dtype=np.float32))
        prim.CreateWidthsAttr().Set(widths, time)
        prim.CreateExtentAttr().Set(UsdGeom.Points.ComputeExtent(_vectors(moment.points), widths), time)
    if moment.normals is not None:
        prim.CreateNormalsAttr().Set(_vectors(moment.normals), time)
    first, index = distinct(moment.colours)  # always with indices: whether values repeat differs from step to step
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor")
    primvar.Set(_vectors(moment.colours[first]), time)
    primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)), time)


def _vectors(values: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))


