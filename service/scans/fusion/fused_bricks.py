"""The phases of a fusion: scans are looked at, compared with each other, and fused brick by brick; each phase in pieces that are kept.

A piece reads the scans that it needs alone, so that memory is bounded whatever the number of scans and the size of the site, and several
workers can do the pieces of one fusion.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.fusion.bricks import BRICK_VOXELS
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.register import FuseRequest, Misplaced
from service.scans.duplicates import distinct
from service.scans.fusion.fused_surface import VERTEX, BrickSurface, Tally, fuse_brick, origin_of, places_near
from service.scans.fusion.misplaced import LEAST_COMMON, Placing, Readings, Sample, elsewhere, place_scans, reach_of, readings_of
from service.scans.fusion.other_readings import LEAST_SCANS, Moved, common_scale, in_another_order, meant_otherwise
from service.scans.fusion.pose_drift import pose_drift
from service.scans.fusion.prepared_scans import PreparedScans, ScanSummary
from service.scans.fusion.range_images import WIDTHS, PreparedScan
from service.scans.fusion.shared_error import shared_sigma
from service.scans.pieces import FolderPieces, SharedPieces, stamps
from service.sharing.sharing import digest, kind_of_worker
from stage.files import temporary_folder
from stage.formats.npy import packed, unpacked
from stage.sets.scan_set import read_scan_set

SAID_PAIRS = 3
"""Pairs of scans that contradict each other that are said, the worst first."""
MOST_STEP = 0.1
"""Voxels between neighbouring floats of 32 bits where the scans are, in which the mesh is written: a vertex is good to some hundredths of
a voxel."""


class FusedBricks(NamedTuple):
    """Results of the finished phases."""

    summaries: list[ScanSummary]
    placings: list[Placing]
    used: list[int]
    """The scans that were fused."""
    names: tuple[str, ...]  # the layers of all scans
    voxel: float  # metres
    places: np.ndarray  # [n, 3] int64 of each brick, in bricks from the origin, in ascending order
    shared_sigma: float | None
    """Standard deviation, metres, of what each scan errs as a whole at a place, which is in the σ of the bricks; None: it is not known."""
    brick: Callable[[int], BrickSurface]
    """Returns the surface of the brick of a number; its tallies are those of `used`."""
    scan: Callable[[int], PreparedScan]
    """Returns the scan of a place in `used`."""
    warnings: list[str]

    def bricks(self) -> Iterator[BrickSurface]:
        """Yield the surfaces of the bricks in their order."""
        return (self.brick(number) for number in range(len(self.places)))


@contextmanager
def fused_bricks(request: FuseRequest, timings: Timings, sharing: SharedPieces | None = None) -> Iterator[FusedBricks]:
    """Fuse the scans of a set brick by brick. What is kept of scans and bricks lies on the disk until the context ends."""
    file, whole = read_scan_set(request.scan_set)
    alone = distinct(file, whole)
    scan_set = alone.scans
    with ExitStack() as held:
        work = held.enter_context(temporary_folder("fuse"))
        pieces = sharing or SharedPieces(FolderPieces(request.cache or work / "pieces"))
        device = devices.resolve(request.device)
        places = [file.parent / path for entry in scan_set.scans for path in (entry.path, entry.maps) if path is not None]
        pieces.identify(scan_set.model_dump_json(), stamps(places, timed=sharing is None), kind_of_worker(device))
        (work / "scans").mkdir()
        fused = _phases(request, file, PreparedScans(file, scan_set, work / "scans", request.voxel_m, device=device),
                        pieces, timings, device)
        yield fused._replace(warnings=alone.warnings() + fused.warnings)


def _phases(request: FuseRequest, file: Path, scans: PreparedScans, pieces: SharedPieces, timings: Timings, device: str) -> FusedBricks:
    numbers = [f"{number:05d}" for number in range(len(scans))]
    threads = request.threads or os.cpu_count() or 1
    timings.stage("read", len(scans))
    content = pieces.do("read", numbers, lambda piece: scans.summary(int(piece)).packed(), follows_from=request.voxel_m,
                        threads=threads, advance=timings.advance)
    summaries = [ScanSummary.unpacked(content(piece)) for piece in numbers]
    names = tuple(name for name in WIDTHS if any(name in summary.names for summary in summaries))
    voxel = request.voxel_m or _voxel(summaries)
    far = max(float(np.abs(summary.centre).max()) for summary in summaries)
    if (step := float(np.spacing(np.float32(far)))) > MOST_STEP * voxel:
        raise RequestError(f"{file}: scans[].scan_to_world: scans lie {far:.3g} m from the origin, where the floats of a mesh hold places "
                           f"to {step:.2g} m only: subtract one place from the translations of all poses")
    known = digest([np.frombuffer(summary.packed(), dtype=np.uint8) for summary in summaries])

    timings.stage("compare", len(scans))
    samples = [summary.sample for summary in summaries]
    reach = reach_of(samples, voxel)

    def read(name: str, samples: list[Sample], moved: Callable[[int, PreparedScan], PreparedScan]) -> list[Readings]:
        content = pieces.do(name, numbers, lambda piece: scans.of(int(piece), lambda scan: packed(readings_of(
            moved(int(piece), scan), int(piece), samples, reach, device=device)._asdict())), follows_from=(known, reach),
            advance=timings.advance)
        return [Readings(**unpacked(content(piece))) for piece in numbers]

    readings = read("compare", samples, lambda _, scan: scan)
    placings = place_scans(samples, readings, voxel) if len(scans) > 1 else [Placing(0, 0.0, 0.0, 0.0, False)]
    scan_names = [summary.name for summary in summaries]
    warnings = [*placing_warnings(scan_names, placings, request.misplaced), *_pair_warnings(scan_names, elsewhere(samples, readings).pairs)]
    words, poses, drift = None, scans.poses(), None
    doubtful = [number for number, placing in enumerate(placings) if placing.misplaced or placing.compared < LEAST_COMMON]

    def otherwise(at: list[Sample], moved: Moved) -> list[Readings]:
        return read("otherwise", at, moved.scan)

    if poses is not None and (meant := meant_otherwise(samples, readings, poses, otherwise)):
        words = f"scans[].scan_to_world: {meant}"
    elif (scale := _scale_that_fits(summaries, placings, readings, voxel)) is not None:
        words = (f"several scans lie beside the others, and all fit if their coordinates are multiplied by {scale:.4f}, or the "
                 f"translations of their poses by {1 / scale:.4f}: the unit or the calibration of one of the two is wrong")
    elif poses is not None and any(placing.misplaced for placing in placings) and (
            order := in_another_order(samples, readings, poses, scan_names, doubtful, otherwise)):
        words = f"scans[].scan_to_world: {order}"
    elif (drift := pose_drift(samples, readings)) is not None:
        if drift.displacement_m > voxel / 2 or any(placing.misplaced for placing in placings):
            words = drift.words(poses)
        else:
            warnings.append(f"{drift.words(poses)}; the standard deviations hold it")
    if words is not None:
        if request.misplaced is Misplaced.LEAVE_OUT:
            raise RequestError(f"{file}: {words}; --misplaced keep fuses them as they are")
        warnings = [words]
    used = [number for number, placing in enumerate(placings) if not (placing.misplaced and request.misplaced is Misplaced.LEAVE_OUT)]
    if len(scans) > 1 and request.misplaced is Misplaced.LEAVE_OUT and all(placing.compared < LEAST_COMMON for placing in placings):
        raise RequestError(f"{file}: scans[].scan_to_world: no two of the {len(scans)} scans have a surface in common: look whether "
                           "lengths are in metres and poses scan_to_world; --misplaced keep fuses scans of several things")
    confirmed = sum(placings[number].compared >= LEAST_COMMON for number in used)
    if len(used) < len(scans) and 2 * confirmed <= len(scans):
        raise RequestError(f"{file}: " + "; ".join(warnings) + ": the poses contradict each other: run relit register first")

    timings.stage("bricks", len(used))
    origin = origin_of(np.stack([summaries[number].centre for number in used]), voxel)
    content = pieces.do("bricks", [numbers[number] for number in used],
                        lambda piece: scans.of(int(piece), lambda scan: packed({"places": places_near(scan, origin, voxel)})),
                        follows_from=(known, voxel, tuple(used)), threads=threads, advance=timings.advance)
    near = np.unique(np.concatenate([unpacked(content(numbers[number]))["places"] for number in used]), axis=0)
    places, of_brick = np.unique(near // BRICK_VOXELS, axis=0, return_inverse=True)
    outlines = [summaries[number].outline() for number in used]

    def fused(piece: str) -> bytes:
        return packed_brick(fuse_brick(near[of_brick.ravel() == int(piece)], outlines, lambda place: scans.with_layers(used[place], names),
                                       names, voxel, origin, device=device))

    timings.stage("fuse", max(len(places), 1))
    content = pieces.do("fuse", [f"{number:06d}" for number in range(len(places))], fused, follows_from=(known, voxel, tuple(used), near),
                        advance=timings.advance)
    shared = shared_sigma(samples, readings, used, float(np.median([summaries[number].pitch for number in used])))
    if drift is not None:
        shared = float(np.hypot(shared or 0.0, drift.displacement_m / np.sqrt(2)))  # each of two scans has its part
    if shared is None and len(used) > 1:
        warnings.append("the scans have too little in common to tell what each errs as a whole, by its pose or its calibration: σ of the "
                        "surface holds their noise alone")

    def brick(number: int) -> BrickSurface:
        found = unpacked_brick(content(f"{number:06d}"))
        return found._replace(sigma=np.hypot(found.sigma, (shared or 0.0) / np.sqrt(np.maximum(found.seen, 1))).astype(np.float32))

    return FusedBricks(summaries, placings, used, names, voxel, places, shared, brick,
                       lambda place: scans.with_layers(used[place], names), warnings)


def _scale_that_fits(summaries: list[ScanSummary], placings: list[Placing], readings: list[Readings], voxel: float) -> float | None:
    """Return the factor of all depths at which no scan is misplaced, where several are; None: there is none."""
    if len(summaries) < LEAST_SCANS or sum(placing.misplaced and not placing.through for placing in placings) < 2:
        return None
    samples = [summary.sample for summary in summaries]
    scanners = np.array([np.linalg.inv(summary.camera_from_world)[:3, 3] for summary in summaries])
    scale, fitting = common_scale(samples, readings, scanners)
    return None if any(placing.misplaced for placing in place_scans(samples, fitting, voxel)) else scale


def _voxel(summaries: list[ScanSummary]) -> float:
    """Return half the median distance between neighbouring pixels on the surface, or the median noise where that is larger, metres."""
    pitch, noise = ([getattr(summary, name) for summary in summaries] for name in ("pitch", "noise"))
    return float(f"{max(np.median(pitch) / 2, np.median(noise)):.3g}")


def placing_warnings(names: list[str], placings: list[Placing], choice: Misplaced) -> Iterator[str]:
    """Yield which scans lie beside the others, by what becomes of these, and which have nothing in common with any."""
    end = "was left out" if choice is Misplaced.LEAVE_OUT else "was fused all the same, and the surface is doubled there"
    for name, placing in zip(names, placings, strict=True):
        others = " and ".join(names[other] for other in placing.against)
        if placing.through:
            yield (f"scan {name}: it has surface where several other scans saw through, or they where it did (up to "
                   f"{placing.through:.0%} of the points of two scans): its pose is wrong, and it {end}")
        elif placing.misplaced:
            yield (f"scan {name}: lies {1e3 * placing.displacement_m:.3g} mm beside the surface of {others or 'the others'}, whose noise "
                   f"explains {1e3 * placing.sigma_m:.2g} mm: " + (
                       f"one of their poses is wrong, no other scan tells which, and each {end}" if others else
                       f"its pose is wrong, and it {end}"))
        elif placing.compared < LEAST_COMMON and len(names) > 1:
            rest = "those that remain" if any(each.misplaced for each in placings) else "the others"
            yield f"scan {name}: has next to no surface in common with {rest}, so that nothing tells whether its pose is right"


def _pair_warnings(names: list[str], pairs: list[tuple[int, int, float]]) -> Iterator[str]:
    """Yield which scans contradict each other where nothing tells which of them lies elsewhere."""
    for one, two, part in sorted(pairs, key=lambda pair: -pair[2])[:SAID_PAIRS]:
        yield (f"scans {names[one]} and {names[two]}: {part:.0%} of the points that both see lie where the other of them saw through: one "
               "of their poses is wrong, or what they see has moved")


def packed_brick(surface: BrickSurface) -> bytes:
    """Return the surface of a brick as bytes."""
    arrays = {name: getattr(surface, name) for name in (*VERTEX, "edge", "faces", "blocks")}
    numbers = np.array(list(surface.tallies), dtype=np.int64)
    return packed(arrays | {"scans": numbers, "tallies": np.array(list(surface.tallies.values()), dtype=np.float64)})


def unpacked_brick(content: bytes) -> BrickSurface:
    """Return the surface of `packed_brick`."""
    found = unpacked(content)
    tallies = dict(zip(map(int, found.pop("scans")), found.pop("tallies"), strict=True))
    blocks = int(found.pop("blocks"))
    return BrickSurface(**found, tallies=tallies, blocks=blocks)


SEEN_BY = (1, 2, 3, 5)
"""Numbers of scans for which reports say what share of the area so many see."""


def scan_facts(fused: FusedBricks, tallies: list[Tally]) -> list[dict[str, Any]]:
    """Return what the report says of each scan."""
    of_scan = dict(zip(fused.used, tallies, strict=True))
    return [{"name": scan.name, "fused": number in of_scan, "photometric_normals": scan.photometric, "square_px": scan.square_px,
             "compared_pixels": fused.placings[number].compared, "displacement_m": short(fused.placings[number].displacement_m),
             **(_tally(of_scan[number]) if number in of_scan else {})} for number, scan in enumerate(fused.summaries)]


def _tally(tally: Tally) -> dict[str, Any]:
    pixels = max(tally.pixels, 1)
    return {"pixels": tally.pixels, "fused_share": round(tally.fused / pixels, 5), "seen_through_share": round(tally.refused / pixels, 5),
            "lost_share": round(tally.lost / pixels, 5), "residual_rms_m": short(tally.rms_m),
            "residual_median_sigmas": round(tally.median_sigmas, 3)}


def short(value: Any) -> float:
    """Return a number as reports have it, with four digits."""
    return float(f"{float(value):.4g}")
