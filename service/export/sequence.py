"""Exports the results of a sequence as one time-sampled USD asset."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from service.asset.content.camera import unit_in_metres
from service.asset.content.depth import GREY, colour_image, depth_mesh, measured_points
from service.asset.content.mesh import height_mesh
from service.asset.content.metallic import metallic_look
from service.asset.content.repair import repair_heights
from service.asset.usd.layers import Description
from service.asset.usd.sequence_asset import Faces, Moment, SequenceSizes, write_sequence_asset
from service.errors import AssetError, RequestError
from service.reporting.progress import Timings
from service.reporting.provenance import export_metadata
from service.requests.export import ExportRequest, Geometry, TextureFormat
from stage.capture.camera import Camera
from stage.capture.sequence import SEQUENCE_FILE, Sequence, TimeStep, read_sequence
from stage.colour.colour import convert
from stage.errors import ResultError
from stage.formats.ply import POINTS_FILE, read_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.stack.fingerprint import combined, digest

LINEAR = "lin_rec709_scene"
OF_ONE_STEP = ("relit:capture", "relit:inputs")
"""Provenance that steps do not share; the asset has a hash of the results of all."""
LAYERS = ("normal", "diffuse_albedo", "specular", "roughness", "height", "part")


def is_result_sequence(path: Path) -> bool:
    """Return whether a path is the result of a sequence: its sequence.json, or the folder that holds it and no result itself."""
    if path.is_file():
        return path.name == SEQUENCE_FILE
    return (path / SEQUENCE_FILE).is_file() and not any((path / name).exists() for name in (MAPS_FILE, DEPTH_FILE))


def export_sequence(request: ExportRequest, timings: Timings) -> tuple[SequenceSizes, tuple[str, ...]]:
    """Write the asset, one step after another, and return its sizes and what its user should know."""
    for name, given in (("--levels", request.levels != 0), ("--textures", request.textures is not TextureFormat.PNG16)):
        if given:
            raise RequestError(f"{name}: the asset of a sequence has colours at its vertices, in one level of detail: leave the option out")
    sequence = read_sequence(request.maps)
    files = [_result(step) for step in sequence.steps]
    of_depth = files[0].name == DEPTH_FILE
    for file in files:
        if file.name != files[0].name:
            raise ResultError(f"{file}: the step before has a {files[0].name}: the steps of a sequence are of one kind")
    if request.geometry is not None and not of_depth:
        raise RequestError(f"--geometry {request.geometry}: is for depths, {request.maps} holds solved maps: they become a mesh")
    first = _camera(files[0])
    warnings: list[str] = []
    of_all = {name: value for name, value in first.provenance.items() if name not in OF_ONE_STEP}
    provenance = {**of_all, **export_metadata(request, {"steps": combined(map(digest, files))})}
    description = Description(request.name or request.out.name.split(".")[0], first.camera, provenance, unit_in_metres(first.camera),
                              request.version)
    timings.stage("steps", len(files))
    sizes = write_sequence_asset(_moments(request, sequence, files, first.camera, warnings, timings), request.out, description,
                                 frames_per_second=sequence.frames_per_second)
    return sizes, tuple(warnings)


def _result(step: TimeStep) -> Path:
    for name in (MAPS_FILE, DEPTH_FILE):
        if (step.folder / name).is_file():
            return step.folder / name
    raise ResultError(f"{step.folder}: holds neither {MAPS_FILE} nor {DEPTH_FILE}: run `relit solve` or `relit depth` on the sequence")


def _camera(file: Path) -> SurfaceMaps | DepthMaps:
    return DepthMaps.read(file) if file.name == DEPTH_FILE else SurfaceMaps.read(file, layers=())


def _moments(request: ExportRequest, sequence: Sequence, files: list[Path], camera: Camera, warnings: list[str],
             timings: Timings) -> Iterator[Moment]:
    """Yield the steps, each read when it is asked for."""
    for number, (step, file) in enumerate(zip(sequence.steps, files, strict=True), start=1):
        time_code = step.time_s * sequence.frames_per_second
        try:
            moment, told, seen = (_of_depth(file, time_code, request.geometry or Geometry.MESH) if file.name == DEPTH_FILE
                                  else _of_maps(file, time_code))
        except AssetError as error:
            raise AssetError(f"{file}: {error}") from error
        if seen != camera:
            raise ResultError(f"{file}: its camera is not that of {sequence.steps[0].name}: the steps of a sequence are of one camera")
        warnings += [f"{step.name}: {sentence}" for sentence in told]
        yield moment
        timings.advance(number)


def _of_maps(file: Path, time_code: float) -> tuple[Moment, list[str], Camera]:
    """Return the surface of solved maps, with their normals, and the base colour of the metallic workflow."""
    maps, _, repairs = repair_heights(SurfaceMaps.read(file, layers=LAYERS))
    mesh = height_mesh(maps)
    normals = mesh.normals
    if maps.normal is not None:
        solved = maps.normal[mesh.rows, mesh.cols]
        normals = np.where((solved != 0).any(axis=-1, keepdims=True), solved, normals)
    colours = np.broadcast_to(GREY, mesh.points.shape)
    if maps.diffuse_albedo is not None:
        base = metallic_look(maps).base_color[mesh.rows, mesh.cols]
        colours = convert(base[None].astype(np.float32), maps.color_space, LINEAR)[0]
    return Moment(time_code, mesh.points, colours, normals, Faces(mesh.face_counts, mesh.face_indices), None), list(repairs), maps.camera


def _of_depth(file: Path, time_code: float, geometry: Geometry) -> tuple[Moment, list[str], Camera]:
    """Return the surface or the points of a depth, with the colours of points.ply where it lies beside it."""
    maps = DepthMaps.read(file)
    beside = file.parent / POINTS_FILE
    measured = measured_points(maps, read_ply(beside) if beside.exists() else None)
    if geometry is Geometry.POINTS:
        colours = np.broadcast_to(GREY, measured.points.shape) if measured.colours is None else measured.colours
        widths = measured.widths(maps.camera).astype(np.float32)
        return Moment(time_code, measured.points, colours, measured.normals, None, widths), [], maps.camera
    mesh = depth_mesh(maps)
    image = colour_image(measured, maps.mask)
    colours = np.broadcast_to(GREY, mesh.points.shape) if image is None else image[mesh.rows, mesh.cols]
    return Moment(time_code, mesh.points, colours, mesh.normals, Faces(mesh.face_counts, mesh.face_indices), None), [], maps.camera
