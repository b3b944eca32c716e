"""Depth from two or more cameras under projected texture, at the pixels of the camera of the capture.

Each other camera is matched with the camera of the capture (stereo_pair.py) in rectified images; the disparity at a pixel of the camera,
lens distortion undone, gives its depth. Where several cameras see a place, their depths are averaged by their variances.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.pattern_frames import NoiseModel
from service.depth.base.epipolar import UNSEEN, VIEW, Contradiction, settled, view_facts
from service.depth.base.solution import DepthSolution, statistics
from service.depth.base.triangulation_check import check_perspective
from service.depth.patterns.readings import full_scale
from service.depth.stereo.camera_doubts import (
    ENOUGH,
    SAID_PX,
    UNEXPLAINED_PX,
    as_camera,
    as_projector,
    by_chance,
    contradicted,
    sentence,
    unexplained_px,
    widened,
)
from service.depth.stereo.rectification import Rectification, RectifiedFrames, pose_of, rectified_frames, rectify
from service.depth.stereo.stereo_pair import (
    LEAST_PLACES,
    MOST_LABELS,
    SURE_LEAD,
    Disparity,
    Places,
    match,
    range_of,
    shifted_rows,
    unique_places,
)
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture.camera import OtherCamera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Frame
from stage.capture.projector import Projector
from stage.errors import ManifestError
from stage.stack.correction import Correction
from stage.stack.planes import Planes

BEHIND_SHARE = 0.5
"""Share of unique places behind the cameras from which the images are taken to be swapped."""
AGREEMENT_SIGMAS = 4.0
"""Depths from two cameras agree when they differ by no more standard deviations."""
ROWS_AT_ONCE = 256
"""Rows of the camera that are triangulated at one time."""
REFUSED_SHARE = 0.5
"""Share of refused pixels from which the capture as a whole is doubted."""
CHANCE_SHARE = 0.03
"""Share of the pixels with texture that must have a depth for any to be believed. Images that have nothing to do with each other leave one
in a hundred by chance."""
FEW = 0.3
"""Share of the places with texture that match below which anything is tried that a calibration could have wrong, mirrored images and poses
the other way round among it: a camera that was turned by a degree leaves a seventh to a half, right ones two thirds and more."""
DOUBTED = 0.1
"""Factor of the confidence of depths that are not believed."""
ENOUGH_TEXTURED = 200
"""Pixels with texture from which their share tells something."""
ADVICE = {
    Status.LOW_MODULATION: "the texture is not seen there: more light, a longer exposure, or a coarser pattern",
    Status.UNDECIDED: "the texture repeats itself or is too noisy: project random dots in place of a grid, or several different patterns",
    Status.OCCLUDED: "one camera sees no such place: move the cameras closer together, or check camera_from_other",
    Status.OUT_OF_RANGE: "the disparities reach the end of the range: check --near-m and --far-m",
    Status.UNSURE: "the two images differ too much: check the focus, the calibration, and that both images are of the same moment",
}
"""The most frequent cause of each status, and what to do about it."""


class PairDepth(NamedTuple):
    """Depths at the pixels of the camera, from one other camera."""

    depth: np.ndarray  # [rows, cols] float32 metres, 0 where there is none
    sigma: np.ndarray  # [rows, cols] float32 metres
    sure: np.ndarray  # [rows, cols] float32, 0…1
    contrast: np.ndarray  # [rows, cols] float32
    status: np.ndarray  # [rows, cols] uint8


class Matched(NamedTuple):
    """What matches in the images of two cameras."""

    geometry: Rectification
    span: tuple[float, float]
    """The least and the largest disparity that was considered, between columns of the rectified images."""
    disparity: Disparity


class Measured(NamedTuple):
    """What one other camera tells."""

    depth: PairDepth
    facts: dict[str, Any]
    """Facts for the report."""
    warnings: list[str]


def solve_stereo(capture: Capture, mask: np.ndarray, request: DepthRequest, device: str, timings: Timings) -> DepthSolution:
    """Match the frames under texture and triangulate them; depths outside the request's span are OUT_OF_RANGE."""
    check_perspective(capture)
    frames = [frame for frame in capture.manifest.frames if frame.stereo is not None]
    pairs = [_measured(capture, frames, index, request, device, timings) for index in range(len(capture.manifest.other_cameras))]
    solution = _joined([pair.depth for pair in pairs], frames, capture, mask)
    solution.facts |= {"frames": len(frames), "cameras": [pair.facts for pair in pairs]}
    solution.warnings += [said for pair in pairs for said in pair.warnings]
    if request.least_confidence is None:
        solution.warnings += _chance(solution, mask)
    solution.warnings += _doubts(solution, mask)
    return solution


def _measured(capture: Capture, frames: list[Frame], index: int, request: DepthRequest, device: str, timings: Timings) -> Measured:
    """Measure depths with one other camera, and judge its calibration by what matches."""
    other = capture.manifest.other_cameras[index]
    given = as_projector(other, pose_of(other, where=f"{capture.folder / FILE_NAME}: other_cameras[{index}]"))

    def measure(view: Projector, before: Contradiction | None) -> tuple[Matched, Contradiction | None]:
        matched = _matched(capture, frames, index, as_camera(view, other.name), request, device, timings)
        return matched, contradicted(matched.disparity.offsets, matched.geometry, view, before)

    view, (geometry, span, disparity), contradiction = settled(given, measure, refine=request.refine_projector)
    offsets = disparity.offsets
    facts: dict[str, Any] = {
        "name": other.name, "baseline_m": _short(geometry.baseline_m), "rectified": [geometry.left.width, geometry.left.height],
        "disparity_px": [_short(end + geometry.offset_px) for end in span],
        "sigma_px": statistics(disparity.sigma[disparity.status == Status.OK])}
    if len(offsets.offset) >= ENOUGH:
        facts["row_offset_px"] = statistics(offsets.offset)
    pair = _triangulated(disparity, geometry, capture, request)
    warnings: list[str] = []
    textured = ~np.isin(disparity.status, (Status.UNSOLVED, Status.LOW_MODULATION))
    if (disparity.status == Status.OK).sum() < FEW * textured.sum():  # perhaps because of what no turn explains
        anything = contradicted(offsets, geometry, view, free=VIEW)
        contradiction = anything if anything is not None and not anything.plausible else contradiction
    believed = contradiction is None or contradiction.plausible
    if believed and by_chance(offsets):
        believed = False
        warnings.append(f"frames: the places that match in the images of {other.name} lie in neighbouring rows at random, as in images "
                        "that have nothing to do with each other: no depth is trusted")
    elif contradiction is not None:
        facts["contradiction_px"] = _short(contradiction.size_px)
        if view is not given:
            facts["refined"] = view_facts(view, "camera_from_other", view.camera_from_projector)
        warnings.append(sentence(f"other_cameras[{index}], {other.name}", contradiction, given, capture.camera))
        pair = pair._replace(sigma=widened(pair.depth, pair.sigma, capture.camera, contradiction, given))
    elif len(offsets.offset) >= ENOUGH and (unexplained := unexplained_px(offsets)) > UNEXPLAINED_PX:
        facts["unexplained_px"] = _short(unexplained)
        if unexplained > SAID_PX:
            warnings.append(f"other_cameras[{index}], {other.name}: the rows of places that both cameras see lie {unexplained:.2g} px "
                            "apart over whole parts of the image, which no turn and no focal length explains: check distortion and "
                            "principal_px of both cameras, and whether they are those of these images; the standard deviations hold as "
                            "much along the rows")
        aside = UNSEEN * unexplained * pair.depth**2 / (geometry.focal_px * geometry.baseline_m)  # what lines do not show may be as far off
        pair = pair._replace(sigma=np.asarray(np.hypot(pair.sigma, aside), np.float32))
    if not believed and request.least_confidence is None:
        pair = pair._replace(status=np.where(np.isin(pair.status, SOLVED), np.uint8(Status.UNSURE), pair.status))
    return Measured(pair, facts, warnings)


def _matched(capture: Capture, frames: list[Frame], index: int, other: OtherCamera, request: DepthRequest, device: str,
             timings: Timings) -> Matched:
    """Rectify the images of the camera and of another one, find the range of their disparities, and match them."""
    where = f"{capture.folder / FILE_NAME}: other_cameras[{index}]"
    geometry = rectify(capture.camera, other, where=where)
    timings.stage("frames", len(frames))
    with rectified_frames(capture, frames, index, geometry, cache=request.cache, progress=timings.advance) as images:
        full = full_scale(Planes(images.left[:, :, None], None), capture, frames)
        noise = NoiseModel(request.read_noise * full, request.photon_gain * full)
        timings.stage("range", 1)
        places = unique_places(images, device)
        _check_rows(images, places, geometry, where, other.name, device)
        _check_order(places, geometry, where, other.name)
        span = _span(places, geometry, request, where, other.name)
        timings.stage("match", images.left.shape[1])
        for rows, found in match(images, *span, noise, device):
            timings.advance(rows)
            disparity = found
    return Matched(geometry, span, disparity)


def _check_rows(images: RectifiedFrames, places: Places, geometry: Rectification, where: str, name: str, device: str) -> None:
    """Refuse images whose rows lie so far apart that hardly any place matches."""
    found = shifted_rows(images, places, device)
    if found is not None:
        rows, matched = found
        angle = np.degrees(np.arctan(abs(rows) / geometry.focal_px))
        way = "lower" if rows > 0 else "higher"
        raise ManifestError(f"{where}: {len(places.disparity)} of {places.compared} places match between the camera and {name}, and "
                            f"{matched} do where its rows lie {abs(rows)} px {way}: its calibration is wrong, as if it were turned by "
                            f"{angle:.2f}° across the baseline; calibrate the cameras again (relit calibrate stereo)")


def _check_order(places: Places, geometry: Rectification, where: str, name: str) -> None:
    """Refuse images that match behind the cameras."""
    behind = int((places.disparity + geometry.offset_px < 0).sum())
    if behind >= LEAST_PLACES and behind > BEHIND_SHARE * len(places.disparity):
        raise ManifestError(f"{where}: {behind} of {len(places.disparity)} places that match have a negative disparity, as if they lay "
                            f"behind the cameras: the images of the camera and of {name} are swapped, or camera_from_other is the inverse "
                            "of the pose")


def _span(places: Places, geometry: Rectification, request: DepthRequest, where: str, name: str) -> tuple[float, float]:
    """Return the least and the largest disparity to consider, between columns of the rectified images."""
    reach = geometry.focal_px * geometry.baseline_m
    _, _, ahead = geometry.positions(slice(0, geometry.reference.height))
    ends = [None if metres is None else reach / (metres * float(z)) - geometry.offset_px
            for metres, z in ((request.far_m, ahead.max()), (request.near_m, ahead.min()))]
    found = range_of(Places(places.disparity[places.disparity + geometry.offset_px > 0], places.compared))
    if found is None and None in ends:
        raise ManifestError(f"{where}: only {len(places.disparity)} of {places.compared} places match between the camera and {name}: the "
                            "images show no texture that both see, are not of one moment, or the calibration is wrong (a repeating pattern "
                            "does not tell depth either); --near-m and --far-m give the range of depths if there is one")
    least = ends[0] if ends[0] is not None else max(found[0], -geometry.offset_px) if found is not None else 0.0
    most = ends[1] if ends[1] is not None else found[1] if found is not None else 0.0
    if most - least < 1:
        most = least + 1
    if most - least > MOST_LABELS:
        raise ManifestError(f"{where}: the disparities span {most - least:.0f} px, more than {MOST_LABELS}: --near-m says how near the "
                            "scene begins")
    return least, most


def _triangulated(found: Disparity, geometry: Rectification, capture: Capture, request: DepthRequest) -> PairDepth:
    """Return depth at the pixels of the camera, each from the nearest pixel of the rectified image and its slopes."""
    height, width = capture.camera.height, capture.camera.width
    blank = np.zeros((height, width), np.float32)
    result = PairDepth(blank, blank.copy(), blank.copy(), blank.copy(), np.zeros((height, width), np.uint8))
    reach = geometry.focal_px * geometry.baseline_m
    for first in range(0, height, ROWS_AT_ONCE):
        rows = slice(first, min(first + ROWS_AT_ONCE, height))
        x, y, ahead = geometry.positions(rows)
        col, row = (np.clip(np.rint(at), 0, size - 1).astype(int) for at, size in
                    ((x, found.status.shape[1]), (y, found.status.shape[0])))
        status = found.status[row, col]
        disparity = found.disparity[row, col] + found.slope_x[row, col] * (x - col) + found.slope_y[row, col] * (y - row)
        whole = disparity + geometry.offset_px
        kept = (found.sigma[row, col] > 0) & (whole > 0)
        depth = np.where(kept, reach / (np.where(kept, whole, 1.0) * ahead), 0)
        lost = np.isin(status, ESTIMATED) & ~kept & (found.sigma[row, col] > 0)
        beyond = kept & ((depth < (request.near_m or 0)) | (depth > (request.far_m or np.inf)))
        status = np.where(beyond | lost, int(Status.OUT_OF_RANGE), status)
        depth = np.where(beyond, 0, depth)
        result.depth[rows] = depth
        result.sigma[rows] = np.where(depth > 0, depth * found.sigma[row, col] / np.where(kept, whole, 1.0), 0)
        result.sure[rows] = np.where(depth > 0, np.clip(found.lead[row, col] / SURE_LEAD, 0, 1), 0)
        result.contrast[rows] = found.contrast[row, col]
        result.status[rows] = status
    return result


def _joined(found: list[PairDepth], frames: list[Frame], capture: Capture, mask: np.ndarray) -> DepthSolution:
    """Return one depth a pixel from those of all cameras."""
    best = found[0]
    depth, sigma, sure, status = (array.copy() for array in (best.depth, best.sigma, best.sure, best.status))
    for other in found[1:]:
        both = np.isin(status, SOLVED) & np.isin(other.status, SOLVED)
        agree = both & (np.abs(depth - other.depth) <= AGREEMENT_SIGMAS * np.hypot(sigma, other.sigma))
        one, two = (1 / np.maximum(each, 1e-12) ** 2 for each in (sigma, other.sigma))
        mean, spread = (one * depth + two * other.depth) / (one + two), 1 / np.sqrt(one + two)
        taken = np.isin(other.status, SOLVED) & ~np.isin(status, SOLVED)
        taken |= (status != Status.UNSURE) & (other.status == Status.UNSURE) & ~np.isin(status, SOLVED)
        depth, sigma = (np.where(agree, joint, np.where(taken, theirs, ours)).astype(np.float32) for joint, theirs, ours in
                        ((mean, other.depth, depth), (spread, other.sigma, sigma)))
        sure = np.where(agree, np.maximum(sure, other.sure), np.where(taken, other.sure, sure))
        status = np.where(taken, other.status, np.where(both & ~agree, np.uint8(Status.UNSURE), status))
    status = np.where(mask, status, np.uint8(Status.UNSOLVED)).astype(np.uint8)
    kept, correction = np.isin(status, ESTIMATED), Correction.of(capture)
    solution = DepthSolution(method="stereo", depth=np.where(kept, depth, 0).astype(np.float32), status=status,
                             sigma=np.where(kept, sigma, 0).astype(np.float32), amplitude=best.contrast,
                             colour=np.asarray(sum(correction.apply(frame).pixels for frame in frames) / len(frames)))
    confidence = solution.confidence_map()
    assert confidence is not None  # it follows from sigma
    solution.confidence = (confidence * np.where(status == Status.UNSURE, DOUBTED, 1.0) * sure).astype(np.float32)
    return solution


def _chance(solution: DepthSolution, mask: np.ndarray) -> list[str]:
    """Believe no depth where hardly any of the pixels with texture has one, and say so."""
    textured = mask & ~np.isin(solution.status, (Status.UNSOLVED, Status.LOW_MODULATION))
    solved, count = mask & solution.solved, int(textured.sum())
    if not solved.any() or count < ENOUGH_TEXTURED or solved.sum() >= CHANCE_SHARE * count:
        return []
    assert solution.confidence is not None  # `_joined` sets it
    solution.status[solved] = Status.UNSURE
    solution.confidence[solved] *= DOUBTED
    return [f"frames: only {100 * solved.sum() / count:.1f} % of the {count} pixels with texture match, as in images that have nothing to "
            "do with each other, or whose rows a wrong calibration leaves apart: no depth is trusted"]


def _doubts(solution: DepthSolution, mask: np.ndarray) -> list[str]:
    """Return a sentence where most pixels of the mask are refused, with what most often is the cause."""
    refused = mask & ~solution.solved
    if refused.sum() <= REFUSED_SHARE * mask.sum():
        return []
    codes = np.bincount(solution.status[refused], minlength=max(Status) + 1)
    most = max(ADVICE, key=lambda status: int(codes[status]))
    return [f"frames: {100 * refused.sum() / mask.sum():.0f} % of the pixels have no depth that can be trusted; most of them are "
            f"{most.name.lower().replace('_', ' ')}: {ADVICE[most]}"]


def _short(value: float) -> float:
    return float(f"{value:.6g}")
