"""Depth from laser frames: the spot of each ray and the stripe of each plane, put together in one map.

Source: Steger, "An unbiased detector of curvilinear structures", PAMI 1998 (stripes).
"""

from collections import Counter
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from kernels.structured.spot import find_spot, nearest_points
from kernels.structured.stripe import find_stripe, plane_depths
from service.depth.solution import DepthSolution
from service.depth.stripe_map import StripeSamples, stripe_map
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.camera import Camera
from stage.capture import Capture
from stage.correction import Correction
from stage.errors import ManifestError
from stage.manifest import FILE_NAME, Frame
from stage.patterns.base import UniformPattern
from stage.ranging import LaserPlane, LaserRay
from stage.triangulation_check import check_perspective

MAX_GAP = 0.02
"""Distance between the laser's ray and the line of sight over the distance of the spot, above which the spot is not that ray's."""
LEAST_FOR_AMBIENT = 3
"""Number of laser frames from which on their least value at each pixel is taken for ambient light, if there is no frame of it."""
LEAST_PART, OF_PERCENTILE = 0.03, 95.0
"""A line whose peak is below this fraction of the brightest lines' peaks over all frames (their 95th percentile) sees the stripe's light by
way of other surfaces, as in the laser's shadow or when the stripe has left the image; or it sees a surface thirty times darker."""
NOISE_SAMPLE = 200_000
"""Number of pixels from which the noise of a frame is estimated."""


class _Spot(NamedTuple):
    """The point that one laser ray lights."""

    point: np.ndarray  # [3] metres, camera frame
    row: int
    col: int
    sigma: float
    amplitude: float
    gap: float


def solve_laser(capture: Capture, mask: np.ndarray, request: DepthRequest, device: str, timings: Timings) -> DepthSolution:
    """Measure every laser frame.

    Args:
        capture: with laser frames; `off` or `black` frames of it are its ambient light.
        mask: [rows, cols] bool.
        request: its span of depths; depths outside are OUT_OF_RANGE.
        device: where to run.
        timings: told of every stage.

    Raises:
        StageError: a laser stands where it cannot, a frame is unreadable, or no frame shows a spot or stripe.
    """
    check_laser(capture)
    near_m, far_m = request.near_m or 0.0, request.far_m or np.inf
    frames = [frame for frame in capture.manifest.frames if frame.laser is not None]
    correction = Correction.of(capture)
    background, source = _background(capture, correction, frames, timings)
    camera, shape = capture.camera, mask.shape
    samples: dict[str, list[StripeSamples]] = {"row": [], "column": []}
    spots: list[_Spot] = []
    seen: Counter[str] = Counter()
    brightest = np.zeros(shape, np.float32)
    timings.stage("laser", len(frames))
    for number, frame in enumerate(frames):
        radiance = correction.apply(frame).pixels - background
        channel = int(np.argmax(np.where(mask[..., None], radiance, 0).max(axis=(0, 1))))
        signal = np.where(mask, radiance[..., channel], 0)
        np.maximum(brightest, signal, out=brightest)
        if isinstance(frame.laser, LaserRay):
            spot, status = _measure_spot(np.where(mask, signal, np.nan), frame.laser, camera, near_m, far_m)
            seen[status.name.lower()] += 1
            if spot is not None:
                spots.append(spot)
        elif isinstance(frame.laser, LaserPlane):
            along = "row" if abs(frame.laser.normal[0]) >= abs(frame.laser.normal[1]) else "column"
            found = _measure_stripe(signal, mask, frame.laser, along, camera, device, near_m, far_m)
            samples[along].append(found)
        timings.advance(number + 1)
    kept = {along: StripeSamples.joined(parts) for along, parts in samples.items() if parts}
    _refuse_faint(kept)
    for part in kept.values():
        numbers = np.bincount(part.status)
        seen.update({Status(code).name.lower(): int(numbers[code]) for code in np.flatnonzero(numbers)})
    if not spots and not any((part.status == Status.OK).any() for part in kept.values()):
        raise ManifestError(f"{capture.folder}: no laser frame has a depth ({_words(seen)}): check that the laser is seen, that "
                            "origin_m, point_m and directions are in metres in the camera frame, and --near-m and --far-m")
    timings.stage("map", 1)
    return _combine(capture, shape, kept, spots, brightest, {"laser_frames": len(frames), "ambient": source, "found": dict(seen)})


def _background(capture: Capture, correction: Correction, frames: list[Frame], timings: Timings) -> tuple[np.ndarray, str]:
    """Return the ambient light to take off each frame, [rows, cols, 3] float32, and in words where it comes from."""
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


def _measure_stripe(signal: np.ndarray, mask: np.ndarray, laser: LaserPlane, along: str, camera: Camera, device: str,
                    near_m: float, far_m: float) -> StripeSamples:
    inside = signal[mask]
    few = inside[:: max(1, len(inside) // NOISE_SAMPLE)]
    middle = float(np.median(few))
    noise = max(1.4826 * float(np.median(np.abs(few - middle))), 1e-6 * float(inside.max()), 1e-12)
    found = find_stripe(np.where(mask, signal - middle, 0), along=along, noise=noise, device=device)
    centre, sigma, amplitude, status = (array.numpy() for array in found)
    lines = np.arange(len(centre))
    status = status.copy()
    status[~mask.any(axis=1 if along == "row" else 0)] = Status.UNSOLVED
    u, v = (centre.astype(np.float64), lines + 0.5) if along == "row" else (lines + 0.5, centre.astype(np.float64))
    x, y = camera.plane_at(u, v)
    met = plane_depths(x, y, np.array(laser.point_m), np.array(laser.normal), along=along)
    assert camera.focal_px is not None
    ok = status == Status.OK
    with np.errstate(invalid="ignore"):
        near = np.isfinite(met.depth) & (met.depth >= near_m) & (met.depth <= far_m)
    status[ok & ~near] = Status.OUT_OF_RANGE
    spread = sigma * met.per_pixel / camera.focal_px[0 if along == "row" else 1]
    return StripeSamples(lines, centre, np.nan_to_num(met.depth), np.nan_to_num(spread), amplitude, status)


def _refuse_faint(kept: dict[str, StripeSamples]) -> None:
    """Mark stripes that are too faint beside the others to be the laser's own light."""
    found = np.concatenate([part.amplitude[part.status == Status.OK] for part in kept.values()]) if kept else np.zeros(0)
    if len(found):
        least = LEAST_PART * float(np.percentile(found, OF_PERCENTILE))
        for part in kept.values():
            part.status[(part.status == Status.OK) & (part.amplitude < least)] = Status.LOW_MODULATION


def _combine(capture: Capture, shape: tuple[int, ...], kept: dict[str, StripeSamples], spots: list[_Spot], brightest: np.ndarray,
             facts: dict[str, object]) -> DepthSolution:
    """Put stripes of either direction and spots into one map: of several at one pixel the surest."""
    camera = capture.camera
    maps = [stripe_map(part, shape if along == "row" else shape[::-1], camera, along=along)
            for along, part in kept.items()]
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
    x, y = camera.plane_coordinates()
    along_ray = (depth * np.sqrt(x * x + y * y + 1)).astype(np.float32)
    kind = "laser stripe" if kept and not spots else "laser spot" if spots and not kept else "laser spot and stripe"
    return DepthSolution(
        method=kind, depth=depth, status=np.where(solved, int(Status.OK), int(Status.UNSOLVED)).astype(np.uint8),
        sigma=np.where(solved, sigma, 0), range_m=along_ray, amplitude=amplitude,
        colour=np.repeat(brightest[..., None], 3, axis=-1), points=np.concatenate(points), pixels=np.concatenate(pixels), facts=facts)


def _words(seen: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in seen.items()) or "none was seen"


def check_laser(capture: Capture) -> None:
    """Refuse lasers that stand where the camera sees no depth.

    Raises:
        ManifestError: names the frame, or the camera when it is orthographic.
    """
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
