"""Exports maps.exr, depth.exr or the results of a sequence as a USD or glTF asset."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from service.asset.content.card import find_frames
from service.asset.content.depth import GREY, colour_image, depth_mesh, measured_points
from service.asset.content.mesh import height_mesh
from service.asset.content.metallic import metallic_look
from service.asset.content.repair import repair_heights
from service.asset.content.surface import unit_in_metres
from service.asset.usd.layers import Description
from service.asset.usd.sequence_asset import Faces, Moment, SequenceSizes, write_sequence_asset
from service.asset.usd.surroundings import Surroundings
from service.errors import AssetError, RequestError, SurfaceError
from service.export.writers import WRITERS, Writer
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import export_metadata, other_manifest
from service.requests.export import AssetFormat, ExportRequest, Geometry, TextureFormat
from service.solve.base.solution import doubtful_normals
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.capture.sequence import SEQUENCE_FILE, Sequence, TimeStep, read_sequence
from stage.colour.colour import convert
from stage.colour.environment_maps import check_environment, multiplied_sentences, outside_sentences
from stage.colour.radiance import clipping_sentences
from stage.errors import ResultError
from stage.folders import advice
from stage.formats.images import read_header
from stage.formats.ply import POINTS_FILE, PointCloud, read_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import MAPS_FILE, SurfaceMaps, capture_as_solved
from stage.stack.fingerprint import combined, digest

OPTIONS = ("rig", "environment", "card")
"""Options of what an asset brings along."""
BLACK = 1e-3
"""Sum of diffuse albedo and F0 below which a surface looks black: an image of 8 bits has three codes up to it."""
EXPORTED_LAYERS = ("normal", "diffuse_albedo", "specular", "roughness", "regime", "height", "part", "status")
"""The layers that an asset needs and what tells whether normals are sure, half of those that `svbrdf` writes: at 4096 by 4096 pixels the
rest takes 0.6 GiB."""
LINEAR = "lin_rec709_scene"
OF_ONE_STEP = ("relit:capture", "relit:inputs")
"""Provenance that steps do not share; the asset has a hash of the results of all."""


class Exported(NamedTuple):
    """An asset and what its user should know of it."""

    path: Path
    warnings: tuple[str, ...]
    """Sentences."""
    sizes: dict[str, tuple[int, int]]
    """Vertices and faces of each mesh by its name; empty for a depth."""
    lights: tuple[Path, ...] = ()
    """Layers of lights beside the asset."""


def export(request: ExportRequest, progress: Progress | None = None) -> Exported:
    """Write an asset from solved maps, or from a depth where there are no maps.
    Raises ResultError if the maps are missing or incomplete. Raises RequestError if a geometry is asked for solved maps, or levels of
    detail, lights or frames of a depth or in a .glb. Raises ManifestError or ImageError if the capture of the rig, the environment or the
    frames of the card cannot be used. Raises AssetError if an unknown suffix, EXR textures in a .usdz or .glb, no height, a height that
    contradicts its normals, or no face. Raises StorageError if the asset cannot be written; nothing is left half-written."""
    suffix = request.out.suffix.lower()
    if suffix.removeprefix(".") not in get_args(AssetFormat):
        raise AssetError(f"{request.out} cannot be written as an asset: its suffix must be .usda, .usdc or .usdz for USD, or .glb for glTF")
    writer, timings = WRITERS[suffix], Timings(progress)
    if is_result_sequence(request.maps):
        _refuse_surroundings(request)
        written, told = export_sequence(request, timings)
        timings.close()
        return Exported(request.out, told, {f"{written.steps} steps": (written.vertices, written.faces)})
    timings.stage("read", 1)
    path = request.maps / MAPS_FILE if request.maps.is_dir() else request.maps
    depth = request.maps / DEPTH_FILE if request.maps.is_dir() else request.maps
    of_depth = depth.name == DEPTH_FILE and depth.exists() and (request.geometry is not None or not path.exists() or path == depth)
    if not of_depth and not path.exists():
        raise ResultError(f"{path}: is not there: {advice(request.maps, 'run `relit solve` or `relit depth` first', of_result=True)}")
    if of_depth or not writer.variants:
        _refuse_surroundings(request)
    if of_depth:
        if request.levels:
            raise RequestError(f"--levels {request.levels}: is for solved maps, {depth} holds a depth: leave the option out")
        exported = _export_depth(depth, request, writer.depth, timings)
    else:
        if request.geometry is not None:
            raise RequestError(f"--geometry {request.geometry}: is for a depth, {path} holds solved maps: they become a mesh")
        if request.levels and not writer.variants:
            raise RequestError(f"--levels {request.levels}: a .glb holds one mesh: name a .usdz, .usda or .usdc, or leave the option out")
        exported = _export_maps(path, request, writer, timings)
    timings.close()
    return exported


def _export_maps(path: Path, request: ExportRequest, writer: Writer, timings: Timings) -> Exported:
    maps = SurfaceMaps.read(path, layers=EXPORTED_LAYERS)
    around = _open_surroundings(request, maps, path)
    contents = {path.stem: digest(path), **_content_hashes(around)}
    maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, contents)})
    timings.stage("repair", 1)
    with _named(path):
        maps, _, repairs = repair_heights(maps)
    more = {"levels": request.levels, "surroundings": around} if writer.variants else {}
    with _named(path):
        report = writer.surface(maps, request.out, name=_name(request, maps.provenance.get("relit:capture")), version=request.version,
                                textures=request.textures, progress=timings, **more)
    warnings = [*repairs, *clipping_sentences({**(around.clipped or {}), **(around.rig.clipped if around.rig is not None else {})}),
                *outside_sentences(around.outside or {}, "light", "Rec.709", "assets have lights in no wider space"),
                *(around.encodings or {}).values(), *report.warnings]
    if around.environment is not None:
        warnings += multiplied_sentences({around.environment.name: read_header(around.environment).multiplied})
    if (plain := _plain(maps)) is not None:
        warnings.append(plain)
    if request.maps.is_dir() and (depth := request.maps / DEPTH_FILE).exists():
        warnings.append(f"{request.maps}: holds a depth too, and the asset is of {MAPS_FILE}: name {depth} for an asset of the depth")
    if around.rig is not None and (doubt := other_manifest(maps.camera, maps.provenance, around.rig, path)) is not None:
        warnings.append(doubt)
    if maps.status is not None and (doubtful := doubtful_normals(maps.status)) is not None:
        warnings.append(doubtful)
    if maps.diffuse_albedo is None:
        warnings.append("the maps have no diffuse_albedo, so the asset is grey: solve with a method that gives it")
    warnings += [f"{layer}: {count} pixels have a value outside 0…1, which the texture cannot hold: they are clipped"
                 for layer, count in report.clipped_pixels.items() if count]
    return Exported(request.out, tuple(warnings), report.sizes, report.lights)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the file of results in an error about what it holds."""
    try:
        yield
    except SurfaceError as error:
        raise SurfaceError(f"{path}: {error}") from error


def _plain(maps: SurfaceMaps) -> str | None:
    """Return the sentence for an asset that is black or white all over, or None."""
    layers = [layer[maps.mask] for layer in (maps.diffuse_albedo, maps.specular) if layer is not None]
    if maps.diffuse_albedo is None or not maps.mask.any():
        return None
    shade = next((name for name, found in (("black", np.percentile(sum(layers), 99) < BLACK),
                                           ("white", np.percentile(maps.diffuse_albedo[maps.mask], 10) >= 1)) if found), None)
    return None if shade is None else (f"the asset is {shade} all over: check the irradiance or intensity of the lights of the capture, "
                                       "and --albedo-scale of the solve")


def _export_depth(path: Path, request: ExportRequest, write: Callable[..., tuple[str, ...]], timings: Timings) -> Exported:
    maps = DepthMaps.read(path)
    _require_scale(path, maps.camera)
    beside = path.parent / POINTS_FILE
    cloud: PointCloud | None = read_ply(beside) if beside.exists() else None
    contents = {file.stem: digest(file) for file in (path, beside) if file.exists()}
    maps = replace(maps, provenance={**maps.provenance, **export_metadata(request, contents)})
    timings.stage("mesh", 1)
    with _named(path):
        warnings = write(maps, cloud, request.out, name=_name(request, maps.provenance.get("relit:capture")),
                         geometry=request.geometry or Geometry.MESH, version=request.version, textures=request.textures, progress=timings)
    return Exported(request.out, warnings, {})


def _require_scale(path: Path, camera: Camera) -> None:
    """Refuse a depth, which is in metres, whose pixels have no size: its surface would be metres deep and pixels wide."""
    if camera.projection == "orthographic" and camera.pixel_size_m is None:
        raise AssetError(f"{path}: camera.pixel_size_m is missing: the depth is in metres, and nothing says how wide a pixel is: give it "
                         "in the capture.json, and run `relit depth` again")


def _refuse_surroundings(request: ExportRequest) -> None:
    """Refuse the options where an asset has no place for what they ask for."""
    given = " and ".join(f"--{name}" for name in OPTIONS if getattr(request, name) is not None)
    if given:
        raise RequestError(f"{given}: lights and frames go with solved maps, into a .usdz, .usda or .usdc: leave the option out")


def _open_surroundings(request: ExportRequest, maps: SurfaceMaps, path: Path) -> Surroundings:
    """Open and check what the asset brings along, of which the rig is the capture as its maps at this path were solved."""
    camera = maps.camera
    rig = None if request.rig is None else capture_as_solved(Capture.open(request.rig, request.pixels), path)
    if rig is not None and rig.camera != camera:
        differs = [name for name, value in rig.camera if value != getattr(camera, name)]
        raise RequestError(f"--rig {request.rig}: its camera differs from that of the maps in {', '.join(differs)}: "
                           "name the capture that was solved")
    if request.environment is not None:
        check_environment(request.environment)
    card = None if request.card is None else find_frames(request.card, camera)
    return Surroundings(rig, request.environment, card, {} if request.clip_negative else None, {}, {})


def _content_hashes(surroundings: Surroundings) -> dict[str, str]:
    found = {}
    if surroundings.rig is not None:
        found["rig"] = digest(surroundings.rig.folder / FILE_NAME)
    if surroundings.environment is not None:
        found["environment"] = digest(surroundings.environment)
    if surroundings.card is not None:
        found["card"] = combined(digest(frame) for frame in surroundings.card.values())
    return found


def _name(request: ExportRequest, capture: str | None) -> str:
    return request.name or capture or re.sub(r"\..*", "", request.out.name)


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
    if of_depth:
        _require_scale(files[0], first.camera)
    description = Description(request.name or request.out.name.split(".")[0], first.camera, provenance,
                              1.0 if of_depth else unit_in_metres(first.camera), request.version)
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
    maps, _, repairs = repair_heights(SurfaceMaps.read(file, layers=EXPORTED_LAYERS))
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
