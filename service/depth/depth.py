"""Measure the depth of a capture and write depth.exr, points.ply and report.json.

The way of the data: the kind of the capture's frames chooses a row of `KINDS`, whose `solve` makes a DepthSolution of them: patterns.py
(with codes.py and decoders.py), laser.py, tof.py or stereo.py (with stereo_pair.py); or a DecodedSolution, where patterns cannot be
triangulated. points.py makes the cloud of a depth, and the files are written here.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.status import Status, refuse_unsure
from service.depth.base.solution import DepthSolution, point_cloud
from service.depth.laser.laser import solve_laser
from service.depth.patterns.coordinates import DecodedSolution
from service.depth.patterns.patterns import solve_patterns
from service.depth.stereo.stereo import solve_stereo
from service.depth.stereo.two_cameras import solve_two_cameras
from service.depth.tof.tof import solve_tof
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.depth import DepthRequest, Ranging
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Frame
from stage.capture.projector import Projector
from stage.colour.radiance import clipping_sentences
from stage.errors import ManifestError, storage
from stage.files import write_text
from stage.formats.ply import POINTS_FILE, write_ply
from stage.patterns.base import UniformPattern
from stage.results.depth_maps import CALIBRATION_SIGMA, DEPTH_FILE, CoordinateMaps, DepthMaps
from stage.stack.fingerprint import Fingerprints, digest
from stage.stack.ingest import CACHE_FOLDER

PLAUSIBLE_M = 0.005, 500.0
"""Median depths that are plausible for a projector or a laser; beyond them the units of the calibration are wrong."""


class Kind(NamedTuple):
    """One kind of frames that depth is measured with."""

    holds: Callable[[Frame], bool]
    """Tells whether a frame is of this kind. Black and white frames go with any kind."""
    solve: Callable[[Capture, np.ndarray, DepthRequest, str, Timings], DepthSolution | DecodedSolution]
    """Measures the depth of a capture, from its mask, the request, the device and the timings to tell of."""
    lengths: str | None
    """The field of the manifest whose unit is wrong if the depths are not plausible; None if depths of any size are plausible."""


KINDS: dict[Ranging, Kind] = {
    Ranging.PATTERN: Kind(lambda frame: frame.pattern is not None and not isinstance(frame.pattern, UniformPattern), solve_patterns,
                          "projector.camera_from_projector"),
    Ranging.LASER: Kind(lambda frame: frame.laser is not None, solve_laser, "frames[].laser"),
    Ranging.TOF: Kind(lambda frame: frame.tof is not None,
                      lambda capture, mask, request, device, timings: solve_tof(
                          capture, request.tof, near_m=request.near_m, far_m=request.far_m, device=device, timings=timings),
                      None),
    Ranging.STEREO: Kind(lambda frame: frame.stereo is not None, solve_stereo, "other_cameras[].camera_from_other"),
}
"""The function that measures depth with each kind of frames."""


class DepthResult(NamedTuple):
    """The files and numbers of a depth that was written."""

    maps: DepthMaps | CoordinateMaps
    """CoordinateMaps where the patterns were decoded and could not be triangulated."""
    depth_path: Path
    points_path: Path | None
    """The file of points; None where there is no depth."""
    report_path: Path
    method: str
    points: int
    counts: dict[str, int]
    """Number of pixels of the mask with each status."""
    warnings: tuple[str, ...]
    """A sentence for each thing that does not fit on the whole scene."""


def depth(request: DepthRequest, progress: Progress | None = None) -> DepthResult:
    """Measure the depth of a capture.

    Raises:
        StageError, KernelError: bad input; nothing is written.
        StorageError: the results cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    capture = Capture.open(request.capture, request.pixels)
    using = _ranging(capture, request.using)
    if request.normals and capture.camera.projection != "perspective":
        raise RequestError("--normals: needs a perspective camera, that of the capture is orthographic")
    mask = capture.mask()
    if request.beside is not None and using is not Ranging.PATTERN:
        raise RequestError(f"--beside {request.beside}: is for projected patterns, and {using} frames are measured")
    if request.refine_projector and using not in (Ranging.PATTERN, Ranging.STEREO):
        raise RequestError(f"--refine-projector: is for projected patterns and two cameras, and {using} frames are measured")
    solution = (KINDS[using].solve(capture, mask, request, device, timings) if request.beside is None else
                solve_two_cameras(capture, request.beside, mask, request, device, timings))
    least = solution.least_confidence if request.least_confidence is None else request.least_confidence
    content = content_of(capture)
    calibration = request.tof.calibration
    sources = metadata(request, capture=capture.name, inputs=content, method=solution.method,
                       contents={} if calibration is None else {"tof_calibration": digest(calibration)})
    depth_path, points_path, report_path = (request.out / name for name in (DEPTH_FILE, POINTS_FILE, REPORT_FILE))
    if isinstance(solution, DecodedSolution):
        if not solution.estimated.any():
            declared = [sentence for sentence in solution.warnings if sentence.startswith("frames:")]
            raise ManifestError(f"{capture.folder}: no pixel is decoded ({_reasons(solution)}): "
                                f"{'; '.join(declared) or _advice(solution.counts(mask), using)}")
        refuse_unsure(solution.status, None, solution.confidence_map(), max_sigma=None, least_confidence=least)
        cloud = None
    else:
        refuse_unsure(solution.status, solution.sigma, solution.confidence_map(), max_sigma=request.max_sigma, least_confidence=least)
        _check_plausible(solution, capture, request, using)
        _tell_shared_error(solution, capture, using)
        if (shared := solution.facts.get("calibration_sigma_m", 0.0)) > 0:
            sources[CALIBRATION_SIGMA] = f"{shared:g}"
        if capture.camera.projection == "orthographic" and capture.camera.pixel_size_m is None:
            solution.warnings.append(f"camera.pixel_size_m is missing: x and y of {POINTS_FILE} are in pixels, and its z in metres")
        timings.stage("points", 1)
        cloud = point_cloud(solution, capture.camera, color_space=capture.manifest.color_space, normals=request.normals)
    timings.stage("write", len(mask))
    maps = solution.maps(capture.camera, sources)
    maps.write(depth_path, timings.advance)
    if cloud is None:
        with storage("remove", points_path):
            points_path.unlink(missing_ok=True)  # of an earlier run: there are no points beside this file
    else:
        write_ply(cloud, points_path, comments=tuple(f"{key} {value}" for key, value in sources.items()))
    solution.warnings += [*capture.doubts, *clipping_sentences(capture.clipped)]
    points = 0 if cloud is None else len(cloud.points)
    counts = solution.counts(mask)
    write_text(report_path, report(
        request,
        inputs={"capture": str(request.capture), "name": capture.name, "content": content, "frames": len(capture.manifest.frames),
                "resolution": list(capture.camera.resolution), "color_space": capture.manifest.color_space},
        method=solution.method,
        found=solution.facts,
        warnings=solution.warnings,
        device=devices.describe(device),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        points=points,
        **solution.statistics(),
    ))
    return DepthResult(maps, depth_path, None if cloud is None else points_path, report_path, solution.method, points, counts,
                       tuple(solution.warnings))


def _ranging(capture: Capture, wanted: Ranging | None) -> Ranging:
    """Return the kind of frames to measure with: the one that was asked for, else the only one that there is."""
    found = [using for using, kind in KINDS.items() if any(kind.holds(frame) for frame in capture.manifest.frames)]
    where = f"{capture.folder / FILE_NAME}: frames"
    listed = " and ".join(found)
    if not found:
        raise ManifestError(f"{where}: none has a pattern with a code, a laser, tof or stereo: relit depth needs such frames, "
                            "relit solve takes light frames")
    if wanted is not None:
        if wanted not in found:
            raise ManifestError(f"{where}: none has a {wanted}, which --using asks for: there are {listed} frames")
        return wanted
    if len(found) > 1:
        raise ManifestError(f"{where}: there are {listed} frames: --using says which to take")
    return found[0]


def _check_plausible(solution: DepthSolution, capture: Capture, request: DepthRequest, using: Ranging) -> None:
    """Refuse a solution without any depth, or with depths that cannot be in metres; warn where every depth is unsure."""
    estimated = solution.estimated
    if not solution.solved.any():
        text = _reasons(solution)
        if not estimated.any():
            counts = solution.counts(np.ones_like(estimated))
            ranges_m = {"--near-m": request.near_m, "--far-m": request.far_m}
            asked = " and ".join(f"{option} {range_m:g}" for option, range_m in ranges_m.items() if range_m is not None)
            if asked and max(counts, key=lambda name: counts[name]) == Status.OUT_OF_RANGE.name.lower():
                raise ManifestError(f"{capture.folder}: no pixel has a depth ({text}) within {asked}: "
                                    "give the metres between which the scene lies")
            raise ManifestError(f"{capture.folder}: no pixel has a depth ({text}): "
                                f"{'; '.join(solution.warnings) or _advice(counts, using)}")
        alone = "" if request.max_sigma is None else "without --max-sigma, "
        solution.warnings.append(f"no depth is sure enough to count as solved ({text}): depth.exr keeps the values outside the mask; "
                                 f"{alone}--least-confidence 0 counts unsure ones as solved")
    middle = float(np.median(solution.depth[estimated]))
    field = KINDS[using].lengths if request.beside is None else "camera.world_from_camera"
    if field is not None and not PLAUSIBLE_M[0] <= middle <= PLAUSIBLE_M[1]:
        raise ManifestError(f"{capture.folder / FILE_NAME}: {field}: the median depth comes out as {middle:.3g} m: give lengths in metres")


def _tell_shared_error(solution: DepthSolution, capture: Capture, using: Ranging) -> None:
    """Say how much the calibration leaves open of all depths together, which no standard deviation of a pixel holds."""
    manifest, part = capture.manifest, 0.0
    if using is Ranging.PATTERN and isinstance(manifest.projector, Projector):
        part = manifest.projector.depth_sigma or 0.0
    elif using is Ranging.STEREO:
        part = max(other.depth_sigma or 0.0 for other in manifest.other_cameras)
    solved = solution.solved
    if solution.sigma is None or not solved.any():
        return
    middle, own = float(np.median(solution.depth[solved])), float(np.median(solution.sigma[solved]))
    if part:
        solution.facts["calibration_sigma_m"] = float(f"{part * middle:.3g}")
    shared = solution.facts.get("calibration_sigma_m", 0.0)
    if shared > own:
        field = {Ranging.PATTERN: "projector.depth_sigma", Ranging.STEREO: "other_cameras[].depth_sigma"}.get(using, "--tof-calibration")
        solution.warnings.append(f"{field}: the calibration leaves {100 * shared / middle:.2g} % of depths open, {shared:.3g} m at the "
                                 f"median: {shared / own:.2g} standard deviations of a pixel, which do not hold what all pixels share")


def _reasons(solution: DepthSolution | DecodedSolution) -> str:
    counts = solution.counts(np.ones_like(solution.estimated))
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count and name != "unsolved") or "nothing is inside the mask"


def _advice(counts: dict[str, int], using: Ranging) -> str:
    """Return what most often is the cause of the commonest status."""
    most = max((name for name in counts if name != "unsolved"), key=lambda name: counts[name])
    if most == Status.ILL_POSED.name.lower():
        return "the projected coordinate does not change with depth: project columns from beside the camera, rows from above it"
    if most == Status.OUT_OF_RANGE.name.lower():
        return "check the pose of the projector and its units, and --near-m and --far-m"
    if most in (Status.LOW_MODULATION.name.lower(), Status.SHADOWED.name.lower()):
        return "the projected light is not seen in the images"
    return f"check the {using} frames"


def content_of(capture: Capture) -> str:
    """Return the content hashes of every file that the capture names, combined."""
    names = sorted({name for _, name in capture.files()})
    hashes = Fingerprints(capture.folder, capture.folder / CACHE_FOLDER / "files.json").of(names)
    combined = hashlib.blake2b(digest_size=16)
    for name in names:
        combined.update(f"{name}\0{hashes[name]}\0".encode())
    return combined.hexdigest()
