"""Fuse the scans of a set into one surface: mesh.ply, report.json, and a textured asset."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.fusion.bricks import MEMORY_BOUND
from service.asset.unwrap import textured_mesh, unwrapper
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.fuse import FuseRequest, Misplaced
from service.scans.bake import bake
from service.scans.misplaced import LEAST_COMMON, Placing, place_scans
from service.scans.range_images import COLOUR, WIDTHS, PreparedScan, channels, prepare_scan, with_layers
from service.scans.read import read_scan
from service.scans.surface import Surface, fuse_surface
from service.usd.fused_asset import write_fused
from stage.colour import convert
from stage.files import write_text
from stage.fingerprint import digest
from stage.meshes.holes import Holes, face_areas, find_holes
from stage.meshes.mesh import TriangleMesh, write_mesh_ply
from stage.scans.records import ScanSet, read_scan_set

MESH_FILE, ASSET_FILE = "mesh.ply", "asset.usdc"
LISTED_HOLES = 50
"""Holes that the report lists, the longest first."""
LOST_SHARE = 0.05
"""Share of the pixels of a scan that may lie at no fused surface before it is said."""
FAR_SIGMAS = 1.5
"""Median distance of the pixels of a scan from the fused surface, in their standard deviations, above which it is said: .67 is expected."""
LEAST_PIXELS = 100
"""Fewest pixels in cells that a scan must have."""


class FuseResult(NamedTuple):
    """The files of a fusion, and what its user should know."""

    mesh_path: Path
    asset_path: Path | None  # None: no texture was asked for
    report_path: Path
    facts: dict[str, Any]
    warnings: tuple[str, ...]


def fuse(request: FuseRequest, progress: Progress | None = None) -> FuseResult:
    """Fuse the scans of a set.

    Args:
        request: the scan set, and the folder of the results.
        progress: told of every stage.

    Raises:
        AssetError: xatlas is not installed, and a texture is asked for.
        RequestError: a scan has no pose or is no range image, too few scans remain, or their poses contradict each other.
        ManifestError, ResultError, ImageError: the scan set or a file of it cannot be used.
        StorageError: a file cannot be read or written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    file, scan_set = read_scan_set(request.scan_set)
    warnings: list[str] = []
    if request.texture:
        unwrapper()
    with tempfile.TemporaryDirectory(prefix="relit-fuse-") as work:
        timings.stage("read", len(scan_set.scans))
        scans, names = _prepared(file, scan_set, Path(work), timings)
        voxel = request.voxel_m or _voxel(scans)
        timings.stage("compare", 1)
        placings = place_scans(scans, voxel, device=device) if len(scans) > 1 else [Placing(0, 0.0, 0.0, 0.0, False)]
        warnings += _placing_warnings(scans, placings, request.misplaced)
        used = [number for number, placing in enumerate(placings)
                if not (placing.misplaced and request.misplaced is Misplaced.LEAVE_OUT)]
        if 2 * len(used) < len(scans) + (len(scans) == 2) or not used:
            raise RequestError(f"{file}: " + "; ".join(warnings) + ": the poses contradict each other: run relit register first")
        timings.stage("fuse", 100)
        done = 0

        def advance(part: float) -> None:
            nonlocal done
            timings.advance(int(100 * part) - done)
            done = int(100 * part)

        fusing = [scans[number] for number in used]
        surface = fuse_surface(fusing, names, voxel, device=device, progress=advance)
        if len(surface.faces) == 0:
            raise RequestError(f"{file}: no surface is left at voxels of {1e3 * voxel:.4g} mm: give a larger --voxel-m, of the order of "
                               "the distance between pixels")
        baked = None
        if request.texture:
            timings.stage("texture", 1)
            textured = textured_mesh(surface.points, surface.faces, most_faces=request.texture_faces, texture_px=request.texture_px)
            baked = textured, bake(textured.mesh, fusing, names, voxel, request.texture_px, device=device)
    timings.stage("holes", 1)
    holes = find_holes(surface.points, surface.faces)
    facts = _facts(scans, used, placings, surface, holes, voxel)
    warnings += _fusion_warnings(facts)
    timings.stage("write", 1)
    mesh = triangle_mesh(surface, names)
    contents = {"scan_set": digest(file)}
    asset_path = None
    if baked is not None:
        asset_path = request.out / ASSET_FILE
        facts["texture"] = {"vertices": int(baked[0].place.max()) + 1, "faces": len(baked[0].mesh.triangles),
                            "seen_share": round(baked[1].seen_share, 4)}
        write_fused(baked[0], baked[1], asset_path, name=scan_set.name,
                    provenance=metadata(request, capture=scan_set.name, inputs=contents["scan_set"]))
    write_mesh_ply(mesh, request.out / MESH_FILE, comments=(f"made by relit fuse from {scan_set.name}", "coordinates in metres"))
    report_path = request.out / REPORT_FILE
    write_text(report_path, report(request, inputs={"scan_set": str(file), "name": scan_set.name, **contents},
                                   device=devices.describe(device), timings_s=timings.close(), **facts, warnings=warnings))
    return FuseResult(request.out / MESH_FILE, asset_path, report_path, facts, tuple(warnings))


def _prepared(file: Path, scan_set: ScanSet, work: Path, timings: Timings) -> tuple[list[PreparedScan], tuple[str, ...]]:
    """Return the scans as range images, whose arrays lie in files of a folder, and the layers that any of them has."""
    scans = []
    for number in range(len(scan_set.scans)):
        folder = work / str(number)
        folder.mkdir()
        scan = read_scan(file, scan_set, number)
        if scan.pose is None:
            raise RequestError(f"{file}: scans[{number}] ({scan.name}): scan_to_world is missing: run relit register first, and fuse the "
                               "scan-set.json that it writes")
        prepared = prepare_scan(scan, folder, f"{file}: scans[{number}] ({scan.name})")
        if np.count_nonzero(prepared.image.cell) < LEAST_PIXELS:
            raise RequestError(f"{file}: scans[{number}] ({scan.name}): has {np.count_nonzero(prepared.image.cell)} pixels whose "
                               "neighbours show the same surface: its pixels are too far apart or too noisy to be fused")
        scans.append(prepared)
        timings.advance(1)
    names = tuple(name for name in WIDTHS if any(name in scan.names for scan in scans))
    return [with_layers(scan, names, work / str(number)) for number, scan in enumerate(scans)], names


def _voxel(scans: list[PreparedScan]) -> float:
    """Return half the median distance between neighbouring pixels on the surface, or the median noise where that is larger, metres."""
    pitch, noise = [], []
    for scan in scans:
        cell = np.asarray(scan.image.cell)
        depth = np.asarray(scan.image.depth)[cell]
        pitch.append(float(np.median(depth)) / min(scan.image.focal))
        noise.append(float(np.median(np.asarray(scan.image.sigma)[cell])))
    return float(f"{max(np.median(pitch) / 2, np.median(noise)):.3g}")


def triangle_mesh(surface: Surface, names: tuple[str, ...]) -> TriangleMesh:
    """Return a surface as a mesh with the colours of its vertices, where any scan has some."""
    colours = None
    if COLOUR in names:
        first = channels(names)[COLOUR].start - 3  # behind the normal
        values, weight = surface.values[:, first:first + 3], surface.values[:, first + 3:first + 4]
        linear = np.where(weight > 0, values / np.where(weight > 0, weight, 1), 0).astype(np.float32)
        display = convert(linear[None], "lin_rec709_scene", "srgb_rec709_scene")[0] if len(linear) else linear
        colours = np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)
    return TriangleMesh(surface.points.astype(np.float32), surface.normals, surface.sigma, surface.seen, colours, surface.faces)


def _facts(scans: list[PreparedScan], used: list[int], placings: list[Placing], surface: Surface, holes: Holes,
           voxel: float) -> dict[str, Any]:
    """Return what the report says."""
    tallies = dict(zip(used, surface.tallies, strict=True))
    area = face_areas(surface.points, surface.faces)
    least = surface.seen[surface.faces].min(axis=1)
    missing = sum(hole.area_m2 for hole in holes.holes)
    return {
        "voxel_m": voxel,
        "bricks": surface.bricks, "blocks": surface.blocks, "brick_memory_bound_bytes": MEMORY_BOUND,
        "vertices": len(surface.points), "faces": len(surface.faces),
        "sigma_m": {"median": _short(np.median(surface.sigma)), "p95": _short(np.percentile(surface.sigma, 95))},
        "area_m2": _short(holes.area_m2),
        "area_share_seen_by": {str(count): round(float(area[least >= count].sum() / holes.area_m2), 4) for count in (1, 2, 3, 5)},
        "holes": {"count": len(holes.holes), "open_edges": holes.open_edges, "open_length_m": _short(holes.open_length_m),
                  "area_m2": _short(missing), "closed_share": round(holes.area_m2 / (holes.area_m2 + missing), 4),
                  "edges_of_more_than_two_faces": holes.shared_edges,
                  "longest": [{"length_m": _short(hole.length_m), "area_m2": _short(hole.area_m2), "edges": hole.edges,
                               "centre_m": [round(float(x), 6) for x in hole.centre], "closed": hole.closed}
                              for hole in holes.holes[:LISTED_HOLES]]},
        "scans": [{"name": scan.name, "fused": number in tallies, "photometric_normals": scan.photometric,
                   "compared_pixels": placings[number].compared, "displacement_m": _short(placings[number].displacement_m),
                   **(_tally(tallies[number]) if number in tallies else {})} for number, scan in enumerate(scans)],
    }


def _tally(tally: Any) -> dict[str, Any]:
    pixels = max(tally.pixels, 1)
    return {"pixels": tally.pixels, "fused_share": round(tally.fused / pixels, 5), "seen_through_share": round(tally.refused / pixels, 5),
            "lost_share": round(tally.lost / pixels, 5), "residual_rms_m": _short(tally.rms_m),
            "residual_median_sigmas": round(tally.median_sigmas, 3)}


def _short(value: Any) -> float:
    return float(f"{float(value):.4g}")


def _placing_warnings(scans: list[PreparedScan], placings: list[Placing], choice: Misplaced) -> Iterator[str]:
    """Yield which scans lie beside the others, and which have nothing in common with any."""
    for scan, placing in zip(scans, placings, strict=True):
        if placing.misplaced:
            end = "it was left out" if choice is Misplaced.LEAVE_OUT else "it was fused all the same, and the surface is doubled there"
            yield (f"scan {scan.name}: lies {1e3 * placing.displacement_m:.3g} mm beside the surface of the others, whose noise explains "
                   f"{1e3 * placing.sigma_m:.2g} mm: its pose is wrong, and {end}")
        elif placing.compared < LEAST_COMMON and len(scans) > 1:
            yield f"scan {scan.name}: has next to no surface in common with the others, so that nothing tells whether its pose is right"


def _fusion_warnings(facts: dict[str, Any]) -> Iterator[str]:
    """Yield what the residuals of the scans against the fused surface say."""
    for scan in facts["scans"]:
        if not scan["fused"]:
            continue
        if (share := scan["lost_share"] + scan["seen_through_share"]) > LOST_SHARE:
            yield (f"scan {scan['name']}: {share:.0%} of its pixels are not on the fused surface ({scan['seen_through_share']:.0%} because "
                   "other scans saw their places to be empty): a part may be thinner than two voxels, or the pose wrong")
        if scan["residual_median_sigmas"] > FAR_SIGMAS:
            yield (f"scan {scan['name']}: its pixels lie {scan['residual_median_sigmas']:.2g} of their σ from the fused surface in the "
                   "median, where 0.67 is expected: its σ is too small, or its pose wrong")
