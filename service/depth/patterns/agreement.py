"""Doubts that only the whole image raises: pixels that contradict their neighbours, other points or the epipolar geometry."""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import uniform_filter

from kernels.device import to_numpy
from kernels.status import SOLVED, Status
from kernels.structured.opaque_surface import check_surface
from service.depth.base.epipolar import Contradiction, contradiction, difference, places_aside, view_facts
from service.depth.base.solution import DepthSolution
from service.depth.patterns.coordinates import AxisMaps, DecodedSolution, stands_alone
from service.requests.depth import DepthRequest
from stage.capture.camera import Camera
from stage.capture.projector import Projector

LIKELY = 0.5
"""Least probability of being right of a depth that counts as solved, unless the request names a least confidence."""
DOUBTED = 0.1
"""Probability of being right of a depth that contradicts its neighbours or other points."""
CONFIDENT = {Status.UNDECIDED: 0.4, Status.MULTIPATH: 0.1}
"""Probability of being right of a depth whose decoder is not sure of it."""
RESIDUAL_TIMES = 6.0
"""Residual of a pixel under both axes over the usual one of the object, above which the pixel is doubted."""
LEAST_RESIDUAL_PX = 0.5
"""Residual that raises no doubt, however small the usual one is."""
AROUND = 2
"""Distance in pixels up to which neighbours count: where many of them are doubted, so is the pixel. An edge of depth doubts a fifth of
them at most."""
TRUSTED_PART = 0.6
"""Least part of these neighbours that is not doubted."""
DISTRUSTED = {Status.MULTIPATH: 1.0, Status.OUT_OF_RANGE: 1.0, Status.UNDECIDED: 0.5}
"""Weights with which pixels that the decoder refused count as doubted: noise leaves some undecided, light of other ways many of all."""
UNLIT = (Status.UNSOLVED, Status.SHADOWED, Status.LOW_MODULATION, Status.SATURATED)
"""Statuses of pixels that the projector does not light well enough to tell anything."""
SURE_SHARE = 0.5
"""Share of the lit pixels with a depth that can be trusted, below which the whole capture is doubted."""
BY_CHANCE, LEAST_APART = 0.5, 0.1
"""Pixels whose lines of sight meet no light of theirs, over the sure ones of a doubted capture and over the lit ones, from which on the
sure ones meet by chance: twice and half the focal length of a camera or projector left some sure in 36 of 40 simulated captures, and more
than a tenth of them off by more than five deviations in 32."""
ADVICE = {
    Status.MULTIPATH: "light comes by several ways, as in fog or off shiny and translucent surfaces: project a code whose stripes are all "
                      "fine (micro, modulated, xor), and wide enough for the camera to resolve",
    Status.UNDECIDED: "noise, or stripes finer than the camera resolves: use more light, or wider stripes",
    Status.OUT_OF_RANGE: "the code and the geometry contradict each other: check the frames' patterns, projector.camera_from_projector and "
                         "whether the projected image is mirrored",
    Status.OCCLUDED: "the second camera does not see what this one sees: move the cameras closer together, and check that both captures "
                     "are of the same patterns",
    Status.ILL_POSED: "the projected coordinate hardly changes with depth: project columns from beside the camera, rows from above it",
    Status.UNSURE: "neighbours contradict each other, as in mirrors and where frames are declared wrongly: check the frames' patterns",
}
"""The most frequent cause of each status, and what to do about it."""
ENOUGH = 200
"""Number of solved pixels from which a usual residual is taken."""
ALIKE = 9.0
"""Number of neighbours whose errors are counted as one, as those of one stripe are."""
LEAST_PX = 0.1
"""Least systematic distance from the epipolar lines that is one, which good calibrations and uneven stripes do not reach."""
OF_STRIPES, OF_WIDE = 0.25, 1.0
"""The same as a part of the distance that is left. Light that bounces between surfaces moves a ramp, or a wave as wide as half of the
projector, by up to a hundredth of it, alike over whole parts of the image: right ones in corners, on stairs and on waves left up to .66."""


def doubt_pixels(solution: DepthSolution, residual_px: np.ndarray | None, camera: Camera, projector: Projector, device: str) -> np.ndarray:
    """Return the probability of each pixel's depth to be right, and add to σ what texture within the pixels does.
    `residual_px`: [rows, cols] of both axes; None with one axis. Returns [rows, cols] float32, 0…1; 0 where there is no depth."""
    assert solution.sigma is not None and solution.amplitude is not None
    solved = np.isin(solution.status, SOLVED)
    right = np.zeros(solution.depth.shape, np.float32)
    right[solved] = 1
    for status, likely in CONFIDENT.items():
        right[(solution.status == status) & (solution.depth != 0)] = likely
    if camera.projection == "perspective" and solved.any():
        x, y = camera.plane_coordinates()
        found = check_surface(solution.depth, solution.sigma, solution.amplitude, solved, x, y, projector.projector_from_camera(),
                              device=device)
        wrong = ((to_numpy(found.turned) | to_numpy(found.alone) | to_numpy(found.contradicted)) > 0).reshape(right.shape) & solved
        right[wrong] = DOUBTED
        solution.sigma[solved] = np.hypot(solution.sigma, to_numpy(found.deviation).reshape(right.shape))[solved]
        solution.facts["doubted"] = {"facing_away": int(to_numpy(found.turned).sum()), "alone": int(to_numpy(found.alone).sum()),
                                     "lit_twice": int(to_numpy(found.contradicted).sum())}
    if residual_px is not None and solved.sum() >= ENOUGH:
        usual = max(float(np.median(residual_px[solved])), LEAST_RESIDUAL_PX / RESIDUAL_TIMES)
        right[solved & (residual_px > RESIDUAL_TIMES * usual)] = DOUBTED
    return _doubt_around(right, solution.status)


def doubt_coordinates(solution: DecodedSolution) -> np.ndarray:
    """Return the probability of each pixel's projector coordinates to be right, from its decoder and its neighbours alone, [rows, cols]
    float32, 0…1; 0 where there is no coordinate."""
    right = np.zeros(solution.status.shape, np.float32)
    right[solution.solved] = 1
    for status, likely in CONFIDENT.items():
        right[(solution.status == status) & solution.estimated] = likely
    alone = np.logical_or.reduce([stands_alone(axis) for axis in solution.coordinates.axes]) & solution.solved
    right[alone] = DOUBTED
    solution.facts["doubted"] = {"alone": int(alone.sum())}
    return _doubt_around(right, solution.status)


def _doubt_around(right: np.ndarray, status: np.ndarray) -> np.ndarray:
    """Return the probabilities with those of pixels lowered around which many are doubted or refused."""
    solved = np.isin(status, SOLVED)
    trust = (right >= LIKELY).astype(np.float32)
    known = solved.astype(np.float32)
    for code, weight in DISTRUSTED.items():
        known[status == code] = weight
    trusted, counted = (uniform_filter(plane, 2 * AROUND + 1, output=np.float64, mode="constant") for plane in (trust * known, known))
    share = np.where(counted > 1e-6, trusted / np.maximum(counted, 1e-6), 1.0)
    return np.where(solved & (share < TRUSTED_PART), np.minimum(right, DOUBTED + share * (LIKELY - DOUBTED)), right).astype(np.float32)


def conclude(solution: DepthSolution | DecodedSolution, right: np.ndarray, mask: np.ndarray, request: DepthRequest,
             warnings: list[str], advice: Mapping[Status, str] = ADVICE) -> None:
    """Say what does not fit on the whole scene, and let confidence and status follow.

    Args:
        solution: its warnings, confidence and status are changed.
        right: of `doubt_pixels` or `doubt_coordinates`.
        request: where it names a least confidence, that alone decides what counts as solved.
        warnings: what a sample has shown of the frames; where frames are declared wrongly, no depth is believed.
        advice: the most frequent cause of each status, and what to do about it.
    """
    lit = mask & ~np.isin(solution.status, UNLIT)
    if request.near_m is not None or request.far_m is not None:
        lit &= solution.status != Status.OUT_OF_RANGE
    sure = lit & np.isin(solution.status, SOLVED) & (right >= LIKELY)
    share = sure.sum() / max(int(lit.sum()), 1)
    fields = ("frames:", "projector.camera_from_projector:") if isinstance(solution, DepthSolution) else ("frames:",)  # places need no pose
    declared = not any(sentence.startswith(fields) for sentence in warnings)
    if not declared:
        right = np.minimum(right, DOUBTED)
    elif lit.sum() >= ENOUGH and share < SURE_SHARE:
        refused = np.where(lit & ~sure & np.isin(solution.status, SOLVED), int(Status.UNSURE), solution.status)[lit & ~sure]
        most, part = Status(int(np.bincount(refused).argmax())), "most"
        if (refused == Status.OUT_OF_RANGE).sum() > max(BY_CHANCE * sure.sum(), LEAST_APART * lit.sum()):
            part = "most" if most == Status.OUT_OF_RANGE else "many"
            most, right = Status.OUT_OF_RANGE, np.minimum(right, DOUBTED)
        what = "depth" if isinstance(solution, DepthSolution) else "place in the projector"
        warnings = [*warnings, f"frames: {100 * share:.2g} % of the {int(lit.sum())} lit pixels have a {what} that can be trusted; "
                               f"{part} of the others are {most.name.lower().replace('_', ' ')}: {advice[most]}"]
    confidence = solution.confidence_map()
    assert confidence is not None  # it follows from sigma
    solution.confidence = (right * min(1.0, share / SURE_SHARE) * confidence).astype(np.float32)
    solution.warnings += warnings
    if request.least_confidence is None:
        solution.status[np.isin(solution.status, SOLVED) & (right < LIKELY)] = Status.UNSURE


def contradicted(solution: DepthSolution, u: AxisMaps, v: AxisMaps, camera: Camera, projector: Projector,
                 before: Contradiction | None, *, wide: bool) -> Contradiction | None:
    """Return how columns and rows contradict a projector; None where they do not.
    `before`: the contradiction by which the projector was found. `wide`: whether an axis is coded by wide patterns alone."""
    judged = _judged(solution, u, v)
    return contradiction(projector, camera.points(-solution.depth)[judged], np.stack([u.coordinate[judged], v.coordinate[judged]], axis=1),
                         np.stack([u.sigma[judged], v.sigma[judged]], axis=1), least_px=LEAST_PX, alike=ALIKE, before=before,
                         least_part=OF_WIDE if wide else OF_STRIPES)


def widen(solution: DepthSolution, u: AxisMaps, v: AxisMaps, camera: Camera, found: Contradiction, declared: Projector) -> None:
    """Add to σ by how much depths may be off where columns and rows contradict the calibration, and say so.
    `declared`: the projector as it was given; depths may be those of one that was found."""
    judged = _judged(solution, u, v)
    off = found.error(camera.points(-solution.depth)[judged], np.stack([u.sigma[judged], v.sigma[judged]], axis=1),
                      given=declared)
    assert solution.sigma is not None
    more = np.where(np.isin(solution.status, SOLVED), float(np.median(off)), 0.0)
    more[judged] = off
    solution.sigma[:] = np.hypot(solution.sigma, more)
    solution.facts["contradiction_px"] = float(f"{found.size_px:.3g}")
    if found.declared is not declared:
        view = found.declared
        solution.facts["refined_projector"] = view_facts(view, "camera_from_projector", view.camera_from_projector)
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration, {difference(declared, found.declared)}: depths are those of a "
            f"projector that is ({found.noise_px:.2g} px are left), which found.refined_projector in report.json holds, and the standard "
            "deviations hold what this leaves open")
    elif found.aside:
        solution.warnings.append(
            f"projector: columns and rows contradict the calibration by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by "
            f"noise), {places_aside(found, declared, camera)}: check whether it is that of these images, or measure it again with relit "
            "calibrate procam; the standard deviations hold the error that this makes")
    elif not found.plausible:
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by "
            "noise), which no small turn of it and no other focal length explain: its lens, or that of the camera, is not known all over "
            "the image, or something moved while it was calibrated: calibrate again (relit calibrate procam), with boards up to the edges")
    else:
        solution.warnings.append(
            f"projector: columns and rows contradict its calibration by {found.size_px:.2g} px ({found.noise_px:.2g} px are left by "
            f"noise), {difference(declared, found.projector)}: measure it again with relit calibrate procam, or take it as found "
            "(--refine-projector); the standard deviations hold the error that this makes, not that of a principal_px far aside")


def _judged(solution: DepthSolution, u: AxisMaps, v: AxisMaps) -> np.ndarray:
    return np.isin(solution.status, SOLVED) & u.solved & v.solved
