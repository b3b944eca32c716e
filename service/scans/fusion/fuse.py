"""Fuse the scans of a set into one surface: mesh.ply, report.json, and a textured asset."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.fusion.bricks import MEMORY_BOUND
from kernels.fusion.gather import gather
from kernels.fusion.rasterise import rasterise
from kernels.fusion.views import upload_views
from service.asset.content.mesh import SurfaceMesh
from service.asset.content.tangent import vertex_tangents
from service.asset.content.textures import BakedImages, TangentNormals
from service.asset.content.uv_unwrap import textured_mesh, unwrapper
from service.errors import RequestError
from service.export.writers import WRITERS
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.register import Closing, FuseRequest
from service.scans.fusion.boxes import boxes
from service.scans.fusion.closing import close_holes, close_pinholes
from service.scans.fusion.fused_bricks import SEEN_BY, FusedBricks, fused_bricks, scan_facts, short
from service.scans.fusion.fused_surface import Surface, joined_surface, triangle_mesh, upload_layers
from service.scans.fusion.holes import Holes, find_holes
from service.scans.fusion.joined_normals import join_normals
from service.scans.fusion.range_images import ALBEDO, COLOUR, NORMAL, ROUGHNESS, SPECULAR, PreparedScan, channels
from service.scans.fusion.tiles import write_tiles
from service.scans.pieces import SharedPieces
from stage.capture.camera import Camera
from stage.files import write_text
from stage.results.maps import SurfaceMaps
from stage.sets.scan_set import ScanSet, read_scan_set, rotation_warnings
from stage.stack.fingerprint import digest

SLACK_VOXELS = 3.0
"""Distance, in voxels, by which the simplified mesh may lie off the surface that a view measured and still show it."""
MESH_FILE, ASSET_FILE = "mesh.ply", "asset.usdc"
PINHOLE_VOXELS = 2.0
"""Width, in voxels, up to which a hole is closed as one: thinner parts are lost and narrower gaps filled by the voxels themselves."""
MEMBRANE_VOXELS = 2.0
"""Length, in voxels, of the edges of membranes."""
LISTED_HOLES = 50
"""Holes that the report lists, the longest first."""
LOST_SHARE = 0.05
"""Share of the pixels of a scan that may lie at no fused surface before it is said."""
LEAST_THROUGH = 0.01
"""Share of the pixels of a scan whose places others saw to be empty from which on its pose may be why; of right poses some at edges are."""
MANY_CONTRADICTED = 0.25
"""Part of the vertices with photometric normals at which these may contradict the depth before it is said."""
FAR_SIGMAS = 1.5
"""Median distance of the pixels of a scan from the fused surface, in their standard deviations, above which it is said: .67 is expected."""
NORMAL_SIGMA = float(np.radians(1.0))
"""Standard deviation of photometric normals whose maps do not say it."""
MOST_CONTRADICTED = 0.5
"""Part of the vertices with photometric normals at which these may contradict the depth before both are refused as not of one surface."""


class FuseResult(NamedTuple):
    """The files of a fusion, and what its user should know."""

    mesh_path: Path | None  # None: tiles were asked for
    asset_path: Path | None  # None: neither a texture nor tiles were asked for
    report_path: Path
    facts: dict[str, Any]
    warnings: tuple[str, ...]


def fuse(request: FuseRequest, progress: Progress | None = None, sharing: SharedPieces | None = None) -> FuseResult:
    """Fuse the scans of a set.

    Args:
        sharing: the part of this worker in a fusion that others help with; None: there are no others.

    Raises:
        AssetError: xatlas is not installed, and a texture is asked for.
        RequestError: a scan has no pose or no lines of sight, too few scans remain, or their poses contradict each other.
        ManifestError, ResultError, ImageError: the scan set or a file of it cannot be used.
        StorageError: a file cannot be read or written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    file, scan_set = read_scan_set(request.scan_set)
    if request.texture and not request.tiles:
        unwrapper()
    with fused_bricks(request, timings, sharing) as fused:
        inputs = digest(file)
        provenance = metadata(request, capture=scan_set.name, inputs=inputs)
        made = (_tiles(request, scan_set, file, fused, provenance, timings) if request.tiles else
                _whole(request, scan_set, file, fused, provenance, timings, device))
    facts = made.facts
    warnings = [*rotation_warnings(scan_set), *fused.warnings, *_fusion_warnings(facts)]
    report_path = request.out / REPORT_FILE
    write_text(report_path, report(request, inputs={"name": scan_set.name, "scan_set": inputs},
                                   device=devices.describe(device), timings_s=timings.close(), **facts, warnings=warnings))
    return FuseResult(made.mesh_path, made.asset_path, report_path, facts, tuple(warnings))


def help_fuse(request: FuseRequest, progress: Progress, sharing: SharedPieces) -> None:
    """Do pieces of a fusion that another worker leads, and write no result."""
    with fused_bricks(request, Timings(progress), sharing):
        pass


class _Made(NamedTuple):
    mesh_path: Path | None
    asset_path: Path | None
    facts: dict[str, Any]


def _whole(request: FuseRequest, scan_set: ScanSet, file: Path, fused: FusedBricks, provenance: dict[str, str], timings: Timings,
           device: str) -> _Made:
    """Write one mesh, and the asset with its textures."""
    timings.stage("join", 1)
    surface = joined_surface(fused.bricks(), len(fused.used))
    _require_surface(file, len(surface.faces), fused.voxel)
    closed: dict[str, float] = {}
    if request.close is not Closing.NONE:
        pinholes = close_pinholes(surface.points, surface.faces, PINHOLE_VOXELS * fused.voxel)
        surface, closed["pinholes"] = surface.closed_by(pinholes, invented=False), pinholes.holes
    joined = None
    if request.join_normals:
        if not surface.photometric.any():
            raise RequestError(f"--join-normals: no scan of {file} has photometric normals: name results of relit solve as maps of the "
                               "scans")
        timings.stage("normals", 1)
        surface, joined = with_joined_normals(surface, fused, str(file))
    timings.stage("holes", 1)
    holes = find_holes(surface.points, surface.faces)
    facts = _facts(fused, surface, holes) | ({} if joined is None else {"joined_normals": joined})
    if request.close is Closing.ALL:
        membranes = close_holes(surface.points, surface.faces, MEMBRANE_VOXELS * fused.voxel)
        before, surface = len(surface.points), surface.closed_by(membranes, invented=True)
        left = find_holes(surface.points, surface.faces)
        closed |= {"holes": membranes.holes, "vertices": len(surface.points) - before, "area_m2": short(left.area_m2 - holes.area_m2)}
        facts |= {"vertices": len(surface.points), "faces": len(surface.faces), "watertight": left.open_edges == left.shared_edges == 0}
    facts["holes"]["closed"] = closed
    baked = None
    if request.texture:
        timings.stage("unwrap", 1)
        textured = textured_mesh(surface.points, surface.faces, most_faces=request.texture_faces, texture_px=request.texture_px)
        timings.stage("texture", 1)
        scans = [fused.scan(place) for place in range(len(fused.used))]
        baked = textured, bake(textured.mesh, scans, fused.names, fused.voxel, request.texture_px, device=device)
    timings.stage("write", 1)
    mesh = triangle_mesh(surface, fused.names)
    asset_path = None
    if baked is not None:
        asset_path = request.out / ASSET_FILE
        facts["texture"] = {"vertices": int(baked[0].place.max()) + 1, "faces": len(baked[0].mesh.triangles),
                            "seen_share": round(baked[1].seen_share, 4)}
        WRITERS[asset_path.suffix].fused(baked[0], baked[1], asset_path, name=scan_set.name, provenance=provenance,
                                         progress=timings)
        timings.stage("mesh", 1)
    mesh_path = request.out / MESH_FILE
    WRITERS[mesh_path.suffix].mesh(mesh, mesh_path, comments=(f"made by relit fuse from {scan_set.name}", "coordinates in metres"))
    return _Made(mesh_path, asset_path, facts)


def _tiles(request: FuseRequest, scan_set: ScanSet, file: Path, fused: FusedBricks, provenance: dict[str, str], timings: Timings
           ) -> _Made:
    """Write one mesh for each brick, and a layer that refers to all."""
    timings.stage("tiles", max(len(fused.places), 1))
    written = write_tiles(fused, request.out, name=scan_set.name, provenance=provenance, advance=timings.advance)
    _require_surface(file, written.facts["faces"], fused.voxel)
    return _Made(None, written.path, written.facts | {"scans": scan_facts(fused, written.tallies)})


def _require_surface(file: Path, faces: int, voxel: float) -> None:
    if faces == 0:
        raise RequestError(f"{file}: no surface is left at voxels of {1e3 * voxel:.4g} mm: give a larger --voxel-m, of the order of "
                           "the distance between pixels")


def _facts(fused: FusedBricks, surface: Surface, holes: Holes) -> dict[str, Any]:
    area = holes.face_areas_m2
    least = surface.seen[surface.faces].min(axis=1)
    missing = sum(hole.area_m2 for hole in holes.holes)
    return {
        "voxel_m": fused.voxel,
        "bricks": surface.bricks, "blocks": surface.blocks, "brick_memory_bound_bytes": MEMORY_BOUND,
        "vertices": len(surface.points), "faces": len(surface.faces),
        "shared_sigma_m": None if fused.shared_sigma is None else short(fused.shared_sigma),
        "sigma_m": {"median": short(np.median(surface.sigma)), "p95": short(np.percentile(surface.sigma, 95))},
        "area_m2": short(holes.area_m2),
        "area_share_seen_by": {str(count): round(float(area[least >= count].sum() / holes.area_m2), 4) for count in SEEN_BY},
        "holes": {"count": len(holes.holes), "open_edges": holes.open_edges, "open_length_m": short(holes.open_length_m),
                  "area_m2": short(missing), "closed_share": round(holes.area_m2 / (holes.area_m2 + missing), 4),
                  "edges_of_more_than_two_faces": holes.shared_edges,
                  "longest": [{"length_m": short(hole.length_m), "area_m2": short(hole.area_m2), "edges": hole.edges,
                               "centre_m": [round(float(x), 6) for x in hole.centre], "closed": hole.closed}
                              for hole in holes.holes[:LISTED_HOLES]]},
        "scans": scan_facts(fused, surface.tallies)}


def _fusion_warnings(facts: dict[str, Any]) -> Iterator[str]:
    """Yield what the residuals of the scans against the fused surface say, and the normals that were joined with it."""
    if (normals := facts.get("joined_normals")) is not None and normals["contradicted_share"] > MANY_CONTRADICTED:
        yield (f"normals: at {normals['contradicted_share']:.0%} of the vertices the photometric normals contradict the depth, which "
               "decides there: the maps may be of other scans, or the σ of the depth too small")
    for scan in facts["scans"]:
        if not scan["fused"]:
            continue
        if (share := scan["lost_share"] + scan["seen_through_share"]) > LOST_SHARE:
            through = scan["seen_through_share"]
            yield f"scan {scan['name']}: {share:.0%} of its pixels are not on the fused surface" + (
                f" ({through:.0%} because other scans saw their places to be empty): a part may be thinner than two voxels, or the pose "
                "wrong"
                if through > LEAST_THROUGH else ": they lie at borders and holes of what it measured, or on parts thinner than two voxels")
        if scan["residual_median_sigmas"] > FAR_SIGMAS:
            yield (f"scan {scan['name']}: its pixels lie {scan['residual_median_sigmas']:.2g} of their σ from the fused surface in the "
                   "median, where 0.67 is expected: its σ is too small, its pose wrong, or the voxels too large for what it shows")


def with_joined_normals(surface: Surface, fused: FusedBricks, where: str) -> tuple[Surface, dict[str, Any]]:
    """Return a surface that has the photometric normals of its views, and what the report says of it."""
    summaries = [fused.summaries[number] for number in fused.used]
    told = [summary.normal_sigma for summary in summaries if summary.normal_sigma > 0]
    tilt = float(np.median(told)) if told else NORMAL_SIGMA
    found = join_normals(surface.points, surface.faces, surface.sigma, surface.normals, np.where(surface.photometric, tilt, np.inf),
                         pixel_m=float(np.median([summary.pitch for summary in summaries])))
    contradicted = found.contradicted / max(int(found.used.sum()), 1)
    if contradicted > MOST_CONTRADICTED:
        raise RequestError(f"{where}: the photometric normals contradict the depth at {contradicted:.0%} of the vertices: the maps are of "
                           "other scans, their axes are flipped, or the σ of the depth is too small: leave out --join-normals")
    moved = float(np.sqrt(np.mean(found.moved[found.used].astype(np.float64) ** 2))) if found.used.any() else 0.0
    facts = {"vertices_share": round(float(found.used.mean()), 4), "moved_rms_m": float(f"{moved:.4g}"),
             "normal_sigma_degrees": float(f"{np.degrees(tilt):.4g}"), "normal_drift_degrees": float(f"{found.drift_degrees:.4g}"),
             "contradicted_vertices": found.contradicted,
             "contradicted_share": round(contradicted, 4)}
    return surface._replace(points=found.points, normals=found.normals.astype(np.float32)), facts


# The textures of a fused surface: what the views show at each texel, blended from those that see it best.

def bake(mesh: SurfaceMesh, scans: list[PreparedScan], names: tuple[str, ...], voxel: float, px: int, *, device: str) -> BakedImages:
    """Blend the layers (`names`) of the scans that were fused over the texture of a mesh with texture coordinates, in the world frame."""
    texels = np.stack([mesh.st[:, 0], 1 - mesh.st[:, 1]], axis=-1).astype(np.float64) * px
    face, weights = rasterise(texels, mesh.triangles, px, px, device=device)
    covered = face >= 0
    corners = mesh.triangles[face[covered]]

    def between(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkx->nx", weights, values[corners])

    points, normals = between(mesh.points.astype(np.float64)), _unit(between(mesh.normals))
    values, known = _gathered(points, normals, scans, names, voxel, device)
    place = channels(names)

    def image(name: str) -> tuple[np.ndarray, np.ndarray]:
        columns, alpha = values[:, place[name]], values[:, place[name].stop]
        there = known & (alpha > 0)
        picture, mask = np.zeros((px, px, columns.shape[1]), dtype=np.float32), np.zeros((px, px), dtype=bool)
        picture[covered] = np.where(there[:, None], columns / np.where(there, alpha, 1)[:, None], 0)
        mask[covered] = there
        return picture, mask

    base = ALBEDO if ALBEDO in names else COLOUR
    layers = {name: image(name) for name in (base, SPECULAR, ROUGHNESS) if name in names}
    mask = layers[base][1] if base in layers else np.zeros((px, px), dtype=bool)
    maps = SurfaceMaps(
        camera=Camera(projection="orthographic", resolution=(px, px), pixel_size_m=1.0), mask=mask,
        diffuse_albedo=layers[base][0] if base in layers else None, specular=layers[SPECULAR][0] if SPECULAR in layers else None,
        roughness=layers[ROUGHNESS][0][..., 0] if ROUGHNESS in layers else None)
    shown = values[:, place[NORMAL]]
    known &= np.linalg.norm(shown, axis=1) > 0
    tangent = between(vertex_tangents(mesh))
    tangent = _unit(tangent - normals * np.einsum("nx,nx->n", tangent, normals)[:, None])
    a, b, c = (mesh.st[corners[:, k]].astype(np.float64) for k in range(3))
    turn = np.sign((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])  # −1 in a mirrored chart
    bitangent = np.cross(normals, tangent) * turn[:, None]
    unit = _unit(np.where(known[:, None], shown, normals))
    local = np.stack([np.einsum("nx,nx->n", axis, unit) for axis in (tangent, bitangent, normals)], axis=-1)
    normal, normal_known = np.zeros((px, px, 3), dtype=np.float32), np.zeros((px, px), dtype=bool)
    normal[covered] = local / 2 + 0.5
    normal_known[covered] = known & tangent.any(axis=1)
    return BakedImages(maps, TangentNormals(normal, normal_known), float(known.mean()) if len(known) else 0.0)


def _gathered(points: np.ndarray, normals: np.ndarray, scans: list[PreparedScan], names: tuple[str, ...], voxel: float,
              device: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the blended layers [n, C] at points, and where a view shows one, box by box."""
    width = channels(names)[names[-1]].stop + (names[-1] != NORMAL)
    values, known = np.zeros((len(points), width), dtype=np.float32), np.zeros(len(points), dtype=bool)
    for box in boxes(np.floor(points / voxel).astype(np.int64), scans, voxel, np.zeros(3)):
        low = np.array(box.corner) * voxel
        views = upload_views([scan.image.cropped(*window) for _, scan, window in box.watching], low, device=device)
        layers, feathers = upload_layers(box.watching, device)
        shown = gather(views, layers, feathers, wp.array((points[box.chosen] - low).astype(np.float32), dtype=wp.vec3, device=device),
                       wp.array(normals[box.chosen].astype(np.float32), dtype=wp.vec3, device=device),
                       wp.zeros(len(box.chosen), dtype=float, device=device), vectors=3, slack=SLACK_VOXELS * voxel, device=device)
        values[box.chosen], known[box.chosen] = to_numpy(shown.values), to_numpy(shown.weight) > 0
        for each in box.watching:
            each.scan.release()
    return values, known


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
