"""Depth from laser frames: the spot of each ray and the stripe of each plane, put together in one map.

Source: Steger, "An unbiased detector of curvilinear structures", PAMI 1998 (stripes).
"""

from collections import Counter
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from service.depth.base.solution import HALF_SURE, DepthSolution
from service.depth.base.triangulation_check import check_perspective
from service.depth.laser.missed_planes import missed_sentence, missteps, widen_missed
from service.depth.laser.spot import find_spot, nearest_points
from service.depth.laser.steady import Moves
from service.depth.laser.stripe_curves import WHOLE
from service.depth.laser.stripe_map import StripeSamples, concordance, contradicted, stripe_map
from service.depth.laser.stripes import CLEAR_SIGMAS, Sweep, along_of, compare_sweeps, measure_stripe, stripe_signal, unconfirmed
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.light import LaserPlane, LaserRay
from stage.capture.manifest import FILE_NAME, Frame
from stage.errors import ManifestError
from stage.patterns.base import UniformPattern
from stage.stack.correction import Correction

MAX_GAP = 0.02
"""Distance between the laser's ray and the line of sight over the distance of the spot, above which the spot is not that ray's."""
LEAST_FOR_AMBIENT = 3
"""Number of laser frames from which on their least value at each pixel is taken for ambient light, if there is no frame of it."""
DOUBLED = 0.1
"""Part of the lines of a frame with two stripes of comparable brightness, from which the frame is named."""
CURVES_OF_A_FRAME = 1_000_000
"""More curves than the stripes of one frame can be, so that numbers of different frames differ."""
AGAINST = -0.3
"""Concordance of stripes and planes below which the planes are taken for declared in reverse."""
SECOND_PLANE = 0.3
"""Part of the frames with two such stripes, from which a second plane is taken to move with the first: then no frame is trusted."""
LEAST_PART, OF_PERCENTILE = 0.03, 95.0
"""A line whose peak is below this fraction of the brightest lines' peaks over all frames (their 95th percentile) sees the stripe's light by
way of other surfaces, as in the laser's shadow or when the stripe has left the image; or it sees a surface thirty times darker."""


class _Spot(NamedTuple):
    point: np.ndarray  # [3] metres, camera frame
    row: int
    col: int
    sigma: float
    amplitude: float
    gap: float


def solve_laser(capture: Capture, mask: np.ndarray, request: DepthRequest, device: str, timings: Timings) -> DepthSolution:
    """Measure every laser frame; `off` or `black` frames are the ambient light, and depths outside the request's span are OUT_OF_RANGE."""
    _check_laser(capture)
    near_m, far_m = request.near_m or 0.0, request.far_m or np.inf
    frames = [frame for frame in capture.manifest.frames if frame.laser is not None]
    correction = Correction.of(capture)
    background, source = ambient_light(capture, correction, frames, timings)
    camera, shape = capture.camera, mask.shape
    sweeps = _sweeps(frames, correction, background, mask, timings)
    samples: dict[str, list[StripeSamples]] = {"row": [], "column": []}
    curves: dict[str, list[np.ndarray]] = {"row": [], "column": []}
    doubled: list[str] = []
    spots: list[_Spot] = []
    seen: Counter[str] = Counter()
    brightest = np.zeros(shape, np.float32)
    moves = Moves(background if correction.ambient is None else correction.ambient, mask)
    timings.stage("laser", len(frames))
    for number, frame in enumerate(frames):
        radiance = correction.apply(frame).pixels - background
        signal = stripe_signal(radiance, mask)
        np.maximum(brightest, np.where(mask, radiance[..., signal.channel], 0), out=brightest)
        if isinstance(frame.laser, LaserRay):
            spot, status = _measure_spot(np.where(mask, radiance[..., signal.channel], np.nan), frame.laser, camera, near_m, far_m)
            seen[status.name.lower()] += 1
            if spot is not None:
                spots.append(spot)
        elif isinstance(frame.laser, LaserPlane):
            along = along_of(frame.laser)
            moves.add(radiance, signal)
            found = measure_stripe(signal, mask, frame.laser, sweeps[along], camera, device=device, near_m=near_m, far_m=far_m)
            samples[along].append(found.samples)
            curves[along].append(np.where(found.curve >= 0, found.curve + number * CURVES_OF_A_FRAME, -1))
            lines = int(np.isin(found.samples.status, (Status.OK, Status.MULTIPATH)).sum())
            if found.doubled > DOUBLED * lines or found.second > WHOLE * lines:
                doubled.append(frame.image)
        timings.advance(number + 1)
    moved = moves.clear()
    if moved is not None:
        stripes = [along_of(frame.laser) for frame in frames if isinstance(frame.laser, LaserPlane)]
        for along in samples:
            own = moved[np.array(stripes) == along]
            samples[along] = [part.widened(part.depth_change(plane, camera, along=along, across=across, down=down))
                              for part, plane, (across, down) in zip(samples[along], _planes(capture, along), own, strict=True)]
    said = []
    for along in samples:
        steps = missteps(samples[along], planes := _planes(capture, along), camera, along=along)
        if steps:
            samples[along] = widen_missed(samples[along], planes, steps, camera, along=along)
            said.append(missed_sentence(steps, [frame.image for frame in frames
                                                if isinstance(frame.laser, LaserPlane) and along_of(frame.laser) == along]))
    kept = {along: StripeSamples.joined(parts) for along, parts in samples.items() if parts}
    one_sweep = [sentence for along in kept if (sentence := unconfirmed(samples[along], _planes(capture, along), camera, along=along))]
    for along, part in kept.items():
        _check_order(capture, part, [len(one.line) for one in samples[along]], along)
    _refuse_faint(kept)
    for along, part in kept.items():
        part.status[contradicted(part, np.concatenate(curves[along]), camera, doubled=bool(doubled))] = Status.MULTIPATH
    if doubled and len(doubled) >= SECOND_PLANE * sum(len(parts) for parts in samples.values()):
        for part in kept.values():  # where one stripe of a frame is seen, it may be that of the second plane as well
            part.status[part.status == Status.OK] = Status.MULTIPATH
    for part in kept.values():
        numbers = np.bincount(part.status)
        seen.update({Status(code).name.lower(): int(numbers[code]) for code in np.flatnonzero(numbers)})
    if not spots and not any((part.status == Status.OK).any() for part in kept.values()):
        advice = _second_stripes(doubled, len(frames)) if doubled else (
            "check that the laser is seen, that origin_m, point_m and directions are in metres in the camera frame, and --near-m and "
            "--far-m")
        words = ", ".join(f"{count} {name}" for name, count in seen.items()) or "none was seen"
        raise ManifestError(f"{capture.folder}: no laser frame has a depth ({words}): {advice}")
    timings.stage("map", 1)
    solution = _combine(capture, shape, kept, spots, brightest, {"laser_frames": len(frames), "ambient": source, "found": dict(seen)})
    if "sweeps_differ_m" not in solution.facts and any(plane.accuracy_deg is None for along in kept for plane in _planes(capture, along)):
        solution.warnings += one_sweep[:1]
    solution.warnings += said
    if moved is not None:
        size = float(np.hypot(*moved.T).max())
        solution.facts["image_shift_px"] = float(f"{size:.3g}")
        solution.warnings.append(f"frames[].laser: what the camera sees under ambient light moves by up to {size:.2g} px between the "
                                 "frames, as where the camera or the scene has moved during the sweep: the standard deviations hold about "
                                 "what that makes; keep both still")
    if doubled:
        solution.warnings.append(_second_stripes(doubled, len(frames)))
    return solution


def _planes(capture: Capture, along: str) -> list[LaserPlane]:
    """Return the planes whose stripes cross the rows, or the columns, in the order of their frames."""
    return [frame.laser for frame in capture.manifest.frames if isinstance(frame.laser, LaserPlane) and along_of(frame.laser) == along]


def _check_order(capture: Capture, samples: StripeSamples, counts: list[int], along: str) -> None:
    """Refuse planes whose stripes move the other way, as those of a sweep that is declared in reverse order do."""
    found = concordance(samples, np.repeat(np.arange(len(counts)), counts), _planes(capture, along), capture.camera, along=along)
    if found < AGAINST:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].laser: {50 * (1 - found):.0f} % of the stripes move against the order "
                            "of their planes: the planes look declared in reverse order; check point_m and normal, or image, of the frames")


def _second_stripes(doubled: list[str], frames: int) -> str:
    return (f"frames[].laser: {len(doubled)} of {frames} frames, {doubled[0]} the first of them, show a second stripe beside the "
            "first, as of two planes at a time, which the manifest does not declare, a reflection, or surfaces one behind the other that "
            "one plane meets; their doubtful points have the status multipath")


def _sweeps(frames: list[Frame], correction: Correction, background: np.ndarray, mask: np.ndarray, timings: Timings) -> dict[str, Sweep]:
    """Return what the sweep of planes across the rows, and across the columns, tells of the albedo."""
    sweeps = {"row": Sweep(), "column": Sweep()}
    planes = [(frame, frame.laser) for frame in frames if isinstance(frame.laser, LaserPlane)]
    if len(planes) < LEAST_FOR_AMBIENT:
        return sweeps
    timings.stage("albedo", len(planes))
    for number, (frame, laser) in enumerate(planes, start=1):
        sweeps[along_of(laser)].add(stripe_signal(correction.apply(frame).pixels - background, mask))
        timings.advance(number)
    for sweep in sweeps.values():
        sweep.close()
    return sweeps


def ambient_light(capture: Capture, correction: Correction, frames: list[Frame], timings: Timings) -> tuple[np.ndarray, str]:
    """Return the ambient light to take off each laser frame, [rows, cols, 3] float32, and in words where it comes from."""
    dark = [frame for frame in capture.manifest.frames if isinstance(frame.pattern, UniformPattern) and frame.pattern.code == "black"]
    shape = (capture.camera.height, capture.camera.width, 3)
    if dark:
        total = np.zeros(shape, np.float32)
        for frame in dark:
            total += correction.apply(frame).pixels
        return total / len(dark), "black frames"
    if correction.ambient is not None:
        return np.zeros(shape, np.float32), "off frames"
    if len(frames) < LEAST_FOR_AMBIENT:
        return np.zeros(shape, np.float32), "none"
    timings.stage("ambient", len(frames))
    least = np.full(shape, np.inf, np.float32)
    for number, frame in enumerate(frames, start=1):
        np.minimum(least, correction.apply(frame).pixels, out=least)
        timings.advance(number)
    return least, "least value over the laser frames"


def _measure_spot(signal: np.ndarray, laser: LaserRay, camera: Camera, near_m: float, far_m: float) -> tuple[_Spot | None, Status]:
    spot = find_spot(signal)
    if spot.status != Status.OK:
        return None, Status(spot.status)
    x, y = camera.plane_at(np.array([spot.u]), np.array([spot.v]))
    ray = np.stack([x, y, -np.ones(1)], axis=-1)
    met = nearest_points(np.zeros(3), ray, np.array(laser.origin_m), np.array([laser.direction]))
    point, gap = met.point[0], float(met.gap[0])
    if not np.isfinite(point).all():
        return None, Status.ILL_POSED
    depth = -float(point[2])
    if met.along_a[0] <= 0 or met.along_b[0] <= 0 or gap > MAX_GAP * met.along_a[0] or not near_m <= depth <= far_m:
        return None, Status.OUT_OF_RANGE
    assert camera.focal_px is not None  # perspective: the caller saw to it
    across = spot.sigma_px / min(camera.focal_px) * float(met.along_a[0])
    return _Spot(point, int(spot.v), int(spot.u), across / float(np.tan(met.angle[0])) + across, spot.amplitude, gap), Status.OK


def _refuse_faint(kept: dict[str, StripeSamples]) -> None:
    """Mark stripes that are too faint beside the others to be the laser's own light."""
    found = np.concatenate([part.amplitude[part.status == Status.OK] for part in kept.values()]) if kept else np.zeros(0)
    if len(found):
        least = LEAST_PART * float(np.percentile(found, OF_PERCENTILE))
        for part in kept.values():
            part.status[np.isin(part.status, (Status.OK, Status.MULTIPATH)) & (part.amplitude < least)] = Status.LOW_MODULATION


def _combine(capture: Capture, shape: tuple[int, ...], kept: dict[str, StripeSamples], spots: list[_Spot], brightest: np.ndarray,
             facts: dict[str, object]) -> DepthSolution:
    """Put stripes of either direction and spots into one map: of several at one pixel the surest."""
    camera = capture.camera
    maps = [stripe_map(part, shape if along == "row" else shape[::-1], camera, along=along)
            for along, part in kept.items()]
    doubtful = [stripe_map(part._replace(status=np.where(part.status == Status.MULTIPATH, Status.OK, Status.UNSOLVED)),
                           shape if along == "row" else shape[::-1], camera, along=along) for along, part in kept.items()]
    warnings = []
    differ = compare_sweeps(*maps) if len(maps) > 1 else None
    if differ is not None:
        facts["sweeps_differ_m"] = float(f"{differ[0]:.3g}")
        if differ[1] > CLEAR_SIGMAS:
            warnings.append(f"frames[].laser: the stripes across the rows and those across the columns differ by {1000 * differ[0]:.3g} "
                            f"mm, {differ[1]:.2g} standard deviations: planes of one sweep are off; check point_m and normal, and their "
                            "order; the standard deviations hold this difference")
            maps = [found._replace(sigma=np.hypot(found.sigma, differ[0])) for found in maps]
    depth, sigma, amplitude = np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32)
    for found in maps:
        better = found.solved & (found.sigma < sigma)
        depth[better], sigma[better], amplitude[better] = found.depth[better], found.sigma[better], found.amplitude[better]
    points, pixels = [found.points for found in maps], [found.pixels for found in maps]
    for spot in spots:
        if spot.sigma < sigma[spot.row, spot.col]:
            depth[spot.row, spot.col], sigma[spot.row, spot.col] = -spot.point[2], spot.sigma
            amplitude[spot.row, spot.col] = spot.amplitude
    if spots:
        points.append(np.stack([spot.point for spot in spots]))
        pixels.append(np.array([(spot.row, spot.col) for spot in spots]))
        gaps = np.array([spot.gap for spot in spots])
        facts["residual_m"] = {"median": float(f"{np.median(gaps):.4g}"), "most": float(f"{gaps.max():.4g}")}
    solved = np.isfinite(sigma)
    status = np.where(solved, int(Status.OK), int(Status.UNSOLVED)).astype(np.uint8)
    for found in doubtful:
        only = found.solved & (status == Status.UNSOLVED)
        depth[only], sigma[only], amplitude[only] = found.depth[only], found.sigma[only], found.amplitude[only]
        status[only] = Status.MULTIPATH
    sigma = np.where(status == Status.UNSOLVED, 0, sigma)
    likely = np.where(status == Status.MULTIPATH, 0.5, 1.0)  # the other stripe may as well be the laser's
    with np.errstate(divide="ignore", invalid="ignore"):
        confidence = np.where(status == Status.UNSOLVED, 0, likely / (1 + sigma / (HALF_SURE * depth))).astype(np.float32)
    x, y = camera.plane_coordinates()
    along_ray = (depth * np.sqrt(x * x + y * y + 1)).astype(np.float32)
    kind = "laser stripe" if kept and not spots else "laser spot" if spots and not kept else "laser spot and stripe"
    return DepthSolution(
        method=kind, depth=depth, status=status, sigma=sigma, confidence=confidence, range_m=along_ray, amplitude=amplitude,
        colour=np.repeat(brightest[..., None], 3, axis=-1), points=np.concatenate(points), pixels=np.concatenate(pixels), facts=facts,
        warnings=warnings)


def _check_laser(capture: Capture) -> None:
    """Refuse lasers that stand where the camera sees no depth."""
    check_perspective(capture)
    for index, frame in enumerate(capture.manifest.frames):
        where = f"{capture.folder / FILE_NAME}: frames[{index}].laser"
        if isinstance(frame.laser, LaserPlane):
            distance = abs(float(np.dot(frame.laser.point_m, frame.laser.normal)))
            if distance < 1e-6:
                raise ManifestError(f"{where}: its plane goes through the camera's centre, which then sees no depth in it: "
                                    "the laser must stand beside the camera")
        elif isinstance(frame.laser, LaserRay) and not any(frame.laser.origin_m):
            raise ManifestError(f"{where}.origin_m: is the camera's centre, which then sees no depth: "
                                "the laser must stand beside the camera")
