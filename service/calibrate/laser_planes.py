"""Calibration of the planes of a laser from poses of a target on which its stripes are seen: a chessboard, or a step of known height,
which is a right-angled block on a flat base."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from service.calibrate.results import digits, manifests_to_replace, write_results
from service.calibrate.solvers.board_stripes import BoardView, view_board
from service.calibrate.solvers.boards.bundle import bend_words
from service.calibrate.solvers.charuco import charuco_of
from service.calibrate.solvers.known_lens import BoardLens, lens_by_boards
from service.calibrate.solvers.laser_plane import LightPlane, board_surface, fit_light_plane
from service.calibrate.solvers.laser_step import StepPlane, fit_step
from service.calibrate.solvers.step_stripe import StepStripe, split_stripe
from service.calibrate.solvers.target_stripes import even_light, find_stripes, laser_frames, whole_stripes
from service.depth.base.triangulation_check import check_perspective
from service.depth.laser.laser import ambient_light
from service.depth.laser.stripes import stripe_signal
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import LaserPlanesRequest
from stage.capture.camera import Camera, Distortion
from stage.capture.capture import Capture
from stage.capture.light import LaserPlane
from stage.capture.manifest import FILE_NAME
from stage.errors import CalibrationError, ManifestError
from stage.stack.correction import Correction

LEAST_BOARDS = 2
"""The fewest poses of a board: its stripe in one is a line, through which any plane goes."""
LEAST_EVEN = 0.02
"""Part of the brightest light of the room below which a pixel says nothing of its albedo."""
TOLD_PX = 0.5
"""The least move of a board between the frames of a pose that is said."""
LARGEST_RESIDUAL_PX = 1.0
"""Largest root mean square distance of the lines of a stripe on a step from where the planes put them."""

LENS_SIGMAS, LEAST_FOCAL, LEAST_BENT_PX = 4.0, 0.005, 0.3
"""By how many standard errors the lens by the boards differs from that of the camera to be said, by what part its focal length, and by how
many pixels at the outermost corner its distortion: corners are found to .1."""


class LaserPlanes(NamedTuple):
    """The files that were written, and the planes."""

    manifest_paths: tuple[Path, ...]
    report_path: Path
    """Beside the first manifest; each manifest has one."""
    rows: list[tuple[str, ...]]
    """Frame, tilt and residual of each plane, and its points or how sure depths on it are, the least sure first."""
    warnings: tuple[str, ...]
    """What was left out, and a camera that the boards contradict."""


class MeasuredPlane(NamedTuple):
    """A plane as it is written."""

    point: np.ndarray  # [3] metres
    normal: np.ndarray  # [3] unit
    sigma_m: float
    """Standard error of its place at the point, along the normal."""
    sigma_degrees: float
    facts: dict[str, float]
    """Entries of the report."""
    words: tuple[str, str]


class _OnTarget(NamedTuple):
    """The planes that a target gives, or why it gives none, and what the report says of its poses."""

    planes: Sequence[MeasuredPlane | CalibrationError]
    seen: dict[str, Any]
    said: tuple[str, ...] = ()


def laser_planes(request: LaserPlanesRequest, progress: Progress | None = None, *,
                 manifest_paths: Sequence[Path] | None = None) -> LaserPlanes:
    """Measure the plane of each laser frame, and write it to the manifests.
    `manifest_paths`: the manifest to write for each capture, then for each of `apply_to`; None: their own."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    captures = [Capture.open(path) for path in request.captures]
    others = [Capture.open(path) for path in request.apply_to]
    count = len(laser_frames(captures[0]))
    for capture in (*captures, *others):
        where = f"{capture.folder / FILE_NAME}: "
        check_perspective(capture)
        if len(laser_frames(capture)) != count:
            raise ManifestError(f"{where}frames: {len(laser_frames(capture))} have a laser plane, those of {captures[0].folder} {count}: "
                                "each capture needs the same planes in the same order")
        if capture.camera != captures[0].camera:
            raise ManifestError(f"{where}camera: differs from that of {captures[0].folder}: planes are in the frame of one camera")
    if not count:
        raise ManifestError(f"{captures[0].folder / FILE_NAME}: frames: none has a laser plane: give each a placeholder, such as "
                            '{"type": "plane", "point_m": [0, 0, 0], "normal": [1, 0, 0]}')
    if request.step_m is not None:
        found = _on_steps(captures, request.step_m, device, timings)
    else:
        found = _on_boards(captures, request, device, timings)
    timings.close()
    targets = [*captures, *others]
    return _write(request, targets, manifests_to_replace(targets, manifest_paths), found)


def _on_boards(captures: list[Capture], request: LaserPlanesRequest, device: str, timings: Timings) -> _OnTarget:
    assert request.board is not None and request.square_m is not None
    if len(captures) < LEAST_BOARDS:
        raise CalibrationError(f"{captures[0].folder}: is one pose of the board, which shows a line of each plane: give {LEAST_BOARDS} "
                               "poses or more")
    camera, frames = captures[0].camera, laser_frames(captures[0])
    views: dict[str, BoardView] = {}
    timings.stage("boards", len(captures))
    for number, capture in enumerate(captures, start=1):
        views[str(capture.folder)] = view_board(capture, request.board, charuco_of(request), device)
        timings.advance(number)
    lens = lens_by_boards([view.corners for view in views.values()], request.board, request.square_m, camera)
    bend = None if lens is None else lens.bend
    boards = [{"capture": name, "rms_px": round(board_surface(view.corners, request.board, request.square_m, camera, bend).rms_px, 4),
               "moved_px": round(view.moved_px, 3), "stripes": sum(stripe.u.size > 0 for stripe in view.stripes)}
              for name, view in views.items()]
    said, other = _other_lens(lens, camera, f"{captures[0].folder / FILE_NAME}: camera.")
    height = 0.0 if lens is None else lens.bend_m(request.board)
    planes: list[MeasuredPlane | CalibrationError] = []
    for index, frame in enumerate(frames):
        try:
            plane = _plane_on_boards(views, index, camera, bend, request)
            beside = plane if other is None else _plane_on_boards(views, index, other, bend, request)
        except CalibrationError as error:
            if not request.drop_failed:
                raise CalibrationError(f"{captures[0].folder}: frames of {frame.image}: {error}; --drop-failed leaves such frames out"
                                       ) from error
            planes.append(error)
            continue
        sigma_m, sigma_degrees = _widened(plane, beside.point, beside.normal)
        planes.append(MeasuredPlane(
            plane.point, plane.normal, sigma_m, sigma_degrees,
            {"residual_m": float(f"{plane.residual_m:.3g}"), "sigma_degrees": float(f"{sigma_degrees:.3g}"), "points": plane.points},
            (f"{1000 * plane.residual_m:.3f} mm", f"{plane.points} points")))
    failed = [plane for plane in planes if isinstance(plane, CalibrationError)]
    if len(failed) == len(planes):
        raise CalibrationError(f"{captures[0].folder}: frames: no plane is told by the boards: {failed[0]}")
    length = (max(request.board) - 1) * request.square_m
    lost = [f"{name}: the board moves by {view.moved_px:.2g} pixels between frames; each counts where it is: hold it still"
            for name, view in views.items() if view.moved_px > TOLD_PX]
    lost += [f"{name}: frames {', '.join(frame.image for frame, stripe in zip(frames, view.stripes, strict=True) if stripe.lost == why)}: "
             f"{why}; the board is left out there" for name, view in views.items()
             for why in sorted({stripe.lost for stripe in view.stripes if stripe.lost})]
    return _OnTarget(planes, {"boards": boards, "board_bend_m": digits((height,))[0],
                              "focal_by_boards": None if lens is None else digits((lens.focal, lens.focal_sigma)),
                              "k1_by_boards": None if lens is None else digits((lens.k1, lens.k1_sigma))},
                     (*said, *bend_words(height, length), *lost))


def _other_lens(lens: BoardLens | None, camera: Camera, where: str) -> tuple[tuple[str, ...], Camera | None]:
    """Return what is said of a camera that the boards contradict, and the camera by them; None: they do not."""
    if lens is None:
        return (), None
    own = Distortion(model="brown_conrady") if camera.distortion is None else camera.distortion
    bent = lens.k1 if abs(lens.k1) > LENS_SIGMAS * lens.k1_sigma and lens.k1_px > LEAST_BENT_PX else 0.0
    ratio, sigma = (lens.bent_focal, lens.bent_focal_sigma) if bent else (lens.focal, lens.focal_sigma)
    ratio = ratio if abs(ratio - 1) > max(LENS_SIGMAS * sigma, LEAST_FOCAL) else 1.0
    missing, best = "is missing, and " if camera.distortion is None else "", "the corners of the boards fit best with"
    said = [] if ratio == 1 else [f"focal_px: {best} {ratio:.3f} times that (σ {sigma:.1g}), as where the camera was refocused since"]
    said += [f"distortion: {missing}{best} k1 = {own.k[0] + bent:.3g} (σ {lens.k1_sigma:.1g}), which moves the outermost by "
             f"{lens.k1_px:.2g} pixels"] if bent else []
    assert camera.focal_px is not None
    focal = (ratio * camera.focal_px[0], ratio * camera.focal_px[1])
    other = camera.model_copy(update={"focal_px": focal, "distortion": own.model_copy(update={"k": (own.k[0] + bent, *own.k[1:])})})
    return tuple(f"{where}{words}: measure the camera again with relit calibrate procam or stereo; the standard errors of the planes hold "
                 "the difference" for words in said), other if said else None


def _widened(plane: LightPlane | StepPlane, point: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """Return the standard errors of a plane, in metres and degrees, which hold how far the plane by another lens differs."""
    away = float((plane.point - point) @ normal)
    turned = math.degrees(math.asin(min(float(np.linalg.norm(np.cross(plane.normal, normal))), 1.0)))
    return math.hypot(plane.sigma_m, away), math.hypot(plane.sigma_degrees, turned)


def _plane_on_boards(views: dict[str, BoardView], index: int, camera: Camera, bend: np.ndarray | None, request: LaserPlanesRequest
                     ) -> LightPlane:
    """Return the plane of a laser frame by its stripes on all boards that show it, as this camera sees them."""
    assert request.board is not None and request.square_m is not None
    seen = {name: view.stripes[index] for name, view in views.items()}
    points = {name: board_surface(stripe.corners, request.board, request.square_m, camera, bend).meet(camera, stripe.u, stripe.v)
              for name, stripe in seen.items() if stripe.u.size}
    try:
        return fit_light_plane(list(points.values()), list(points))
    except CalibrationError as error:
        lost = [f"{name}: {stripe.lost}" for name, stripe in seen.items() if stripe.lost]
        raise CalibrationError("; ".join([str(error), *lost])) from error


def _on_steps(captures: list[Capture], height_m: float, device: str, timings: Timings) -> _OnTarget:
    """Measure the planes on a step, and refuse those whose lines miss it by far more than their noise."""
    camera = captures[0].camera
    assert camera.focal_px is not None
    pixel = 2 / sum(camera.focal_px)
    stripes = []
    timings.stage("steps", len(captures))
    for number, capture in enumerate(captures, start=1):
        stripes.append(_stripes_on_step(capture, device, pixel))
        timings.advance(number)
    fit = fit_step(stripes, height_m, pixel)
    worst = max(range(len(fit.planes)), key=lambda number: fit.planes[number].residual_px)
    if fit.planes[worst].residual_px > LARGEST_RESIDUAL_PX:
        raise CalibrationError(f"frame {laser_frames(captures[0])[worst].image}: its stripe misses base, riser and top of an upright "
                               f"block by {fit.planes[worst].residual_px:.2g} px: look for light of other surfaces, a base that is not "
                               "flat, or a block that is not right-angled")
    said: tuple[str, ...] = ()
    sigmas = [(plane.sigma_m, plane.sigma_degrees) for plane in fit.planes]
    if fit.focal is not None and abs(fit.focal[0] - 1) > max(LENS_SIGMAS * fit.focal[1], LEAST_FOCAL):
        said = (f"{captures[0].folder / FILE_NAME}: camera: the stripes of all poses fit best with {fit.focal[0]:.3f} times focal_px "
                f"(σ {fit.focal[1]:.1g}), as where the camera was refocused, its distortion is missing, or the block leans: measure the "
                "camera again, and the block; the standard errors of the planes hold the difference",)
        sigmas = [_widened(plane, *other) for plane, other in zip(fit.planes, fit.beside, strict=True)]
    planes = [MeasuredPlane(plane.point, plane.normal, sigma_m, sigma_degrees,
                            {"residual_px": float(f"{plane.residual_px:.3g}"), "sigma_degrees": float(f"{sigma_degrees:.3g}"),
                             "sigma_depth": float(f"{plane.sigma:.3g}"), "poses": plane.stripes},
                            (f"{plane.residual_px:.3f} px", f"{100 * plane.sigma:.2f} % of depth"))
              for plane, (sigma_m, sigma_degrees) in zip(fit.planes, sigmas, strict=True)]
    return _OnTarget(planes, {"steps": [
        {"capture": str(capture.folder), "stripes": sum(stripe is not None for stripe in found),
         "with_riser": sum(stripe is not None and stripe.riser is not None for stripe in found), "distance_m": float(f"{distance:.5g}")}
        for capture, found, distance in zip(captures, stripes, fit.distances_m, strict=True)],
        "focal_by_steps": None if fit.focal is None else digits(fit.focal)}, said)


def _stripes_on_step(capture: Capture, device: str, pixel: float) -> list[StepStripe | None]:
    """Return the stripe of each laser frame of a capture, along rows or columns, whichever shows more of it."""
    correction, mask, frames = Correction.of(capture), capture.mask(), laser_frames(capture)
    background, _ = ambient_light(capture, correction, frames, Timings(None))
    albedo = _step_albedo(capture, correction, mask)
    stripes = [find_stripes(stripe_signal(correction.apply(frame).pixels - background, mask), albedo, device) for frame in frames]
    found: list[StepStripe | None] = []
    for pair in whole_stripes(stripes, [mask] * len(stripes)):
        best: StepStripe | None = None
        most = 0
        for seen in pair:
            parts = split_stripe(*capture.camera.plane_at(*seen.image()), seen.lines, pixel)
            if parts is not None and len(seen.lines) > most:
                best, most = parts, len(seen.lines)
        found.append(best)
    return found


def _step_albedo(capture: Capture, correction: Correction, mask: np.ndarray) -> np.ndarray | None:
    """Return how bright the scene is under even light, by which stripes are divided; None: none shows it, or parts are too dark."""
    light = even_light(capture, correction)
    if light is None:
        return None
    grey = np.where(mask, light, 0)
    least = LEAST_EVEN * float(grey.max())
    return np.maximum(grey, 0) if least > 0 and (grey[mask] > least).all() else None


def _write(request: LaserPlanesRequest, targets: list[Capture], paths: tuple[Path, ...], found: _OnTarget) -> LaserPlanes:
    planes = found.planes
    entries = [{"dropped": str(plane)} if isinstance(plane, CalibrationError) else
               {"point_m": digits(plane.point), "normal": digits(plane.normal), **plane.facts} for plane in planes]
    reports = []
    for target, path in zip(targets, paths, strict=True):
        waiting = iter(planes)
        frames = []
        for frame in target.manifest.frames:
            if isinstance(frame.laser, LaserPlane):
                plane = next(waiting)
                if isinstance(plane, CalibrationError):
                    continue
                (px, py, pz), (nx, ny, nz) = digits(plane.point), digits(plane.normal)
                laser = LaserPlane(type="plane", point_m=(px, py, pz), normal=(nx, ny, nz),
                                   accuracy_deg=float(f"{plane.sigma_degrees:.3g}"), accuracy_m=float(f"{plane.sigma_m:.3g}"))
                frame = frame.model_copy(update={"laser": laser})
            frames.append(frame)
        reports.append(write_results("laser-planes", request, target.manifest.model_copy(update={"frames": tuple(frames)}),
                                     path, {**found.seen, "planes": entries}))
    named = list(zip([frame.image for frame in laser_frames(targets[0])], planes, strict=True))
    measured = sorted(((name, plane) for name, plane in named if isinstance(plane, MeasuredPlane)),
                      key=lambda pair: pair[1].sigma_degrees, reverse=True)
    rows: list[tuple[str, ...]] = [(name, f"{plane.sigma_degrees:.3f}°", *plane.words) for name, plane in measured]
    return LaserPlanes(paths, reports[0], rows, (*found.said, *(f"frames of {name}: {plane}; they are left out" for name, plane in named
                                                                if isinstance(plane, CalibrationError))))
