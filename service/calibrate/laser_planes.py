"""Calibration of the planes of a laser from poses of a target on which its stripes are seen: a chessboard, or a step of known height,
which is a right-angled block on a flat base."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.status import Status
from kernels.structured.stripe import KNOWN_REACH, find_stripe
from service.calibrate.results import digits, manifests_to_replace, write_results
from service.calibrate.solvers.charuco import Charuco, charuco_of, find_board
from service.calibrate.solvers.laser_plane import BoardLens, LightPlane, board_plane, fit_light_plane, inside_board, lens_by_boards
from service.calibrate.solvers.laser_step import fit_step
from service.calibrate.solvers.step_stripe import StepStripe, split_stripe
from service.depth.base.triangulation_check import check_perspective
from service.depth.laser.laser import ambient_light
from service.depth.laser.stripes import Signal, stripe_signal
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import LaserPlanesRequest
from stage.capture.camera import Camera, Distortion
from stage.capture.capture import Capture
from stage.capture.light import LaserPlane
from stage.capture.manifest import FILE_NAME, Frame
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import CalibrationError, ManifestError
from stage.patterns.base import UniformPattern
from stage.stack.correction import Correction

LEAST_BOARDS = 2
"""The fewest poses of a board: its stripe in one is a line, through which any plane goes."""
LEAST_LINES = 10
"""The fewest lines of the image on which a board shows a stripe: it counts as much as any other board."""
LEAST_EVEN = 0.02
"""Part of the brightest light of the room below which a pixel says nothing of its albedo."""
LARGEST_RESIDUAL_PX = 1.0
"""Largest root mean square distance of the lines of a stripe on a step from where the planes put them."""

Along = Literal["row", "column"]
ALONG: tuple[Along, ...] = ("row", "column")
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


class _View(NamedTuple):
    """What a capture shows of a board."""

    corners: np.ndarray  # [corners, 2] image coordinates, NaN where one is not seen
    stripes: list[tuple[np.ndarray, np.ndarray]]
    """Image coordinates u and v of the points of each stripe, [n] each, none where it is not seen."""


def laser_planes(request: LaserPlanesRequest, progress: Progress | None = None, *,
                 manifest_paths: Sequence[Path] | None = None) -> LaserPlanes:
    """Measure the plane of each laser frame, and write it to the manifests.
    `manifest_paths`: the manifest to write for each capture, then for each of `apply_to`; None: their own."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    captures = [Capture.open(path) for path in request.captures]
    others = [Capture.open(path) for path in request.apply_to]
    count = len(_laser_frames(captures[0]))
    for capture in (*captures, *others):
        where = f"{capture.folder / FILE_NAME}: "
        check_perspective(capture)
        if len(_laser_frames(capture)) != count:
            raise ManifestError(f"{where}frames: {len(_laser_frames(capture))} have a laser plane, those of {captures[0].folder} {count}: "
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
    camera, frames = captures[0].camera, _laser_frames(captures[0])
    boards: list[dict[str, Any]] = []
    views: dict[str, _View] = {}
    timings.stage("boards", len(captures))
    for number, capture in enumerate(captures, start=1):
        views[str(capture.folder)] = view = _stripes_on_board(capture, request.board, charuco_of(request), device)
        rms = board_plane(view.corners, request.board, request.square_m, camera).rms_px
        boards.append({"capture": str(capture.folder), "rms_px": round(rms, 4), "stripes": sum(u.size > 0 for u, _ in view.stripes)})
        timings.advance(number)
    lens = lens_by_boards([view.corners for view in views.values()], request.board, request.square_m, camera)
    said, other = _other_lens(lens, camera, f"{captures[0].folder / FILE_NAME}: camera.")
    planes: list[MeasuredPlane | CalibrationError] = []
    for index, frame in enumerate(frames):
        try:
            plane = _plane_on_boards(views, index, camera, request)
            beside = plane if other is None else _plane_on_boards(views, index, other, request)
        except CalibrationError as error:
            if not request.drop_failed:
                raise CalibrationError(f"{captures[0].folder}: frames of {frame.image}: {error}; --drop-failed leaves such frames out"
                                       ) from error
            planes.append(error)
            continue
        away = float((plane.point - beside.point) @ beside.normal)
        turned = math.degrees(math.asin(min(float(np.linalg.norm(np.cross(plane.normal, beside.normal))), 1.0)))
        sigma_m, sigma_degrees = math.hypot(plane.sigma_m, away), math.hypot(plane.sigma_degrees, turned)
        planes.append(MeasuredPlane(
            plane.point, plane.normal, sigma_m, sigma_degrees,
            {"residual_m": float(f"{plane.residual_m:.3g}"), "sigma_degrees": float(f"{sigma_degrees:.3g}"), "points": plane.points},
            (f"{1000 * plane.residual_m:.3f} mm", f"{plane.points} points")))
    failed = [plane for plane in planes if isinstance(plane, CalibrationError)]
    if len(failed) == len(planes):
        raise CalibrationError(f"{captures[0].folder}: frames: no plane is told by the boards: {failed[0]}")
    return _OnTarget(planes, {"boards": boards, "focal_by_boards": None if lens is None else digits((lens.focal, lens.focal_sigma)),
                              "k1_by_boards": None if lens is None else digits((lens.k1, lens.k1_sigma))}, said)


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


def _plane_on_boards(views: dict[str, _View], index: int, camera: Camera, request: LaserPlanesRequest) -> LightPlane:
    """Return the plane of a laser frame by its stripes on all boards that show it, as this camera sees them."""
    assert request.board is not None and request.square_m is not None
    points = {name: board_plane(view.corners, request.board, request.square_m, camera).meet(camera, *view.stripes[index])
              for name, view in views.items() if view.stripes[index][0].size}
    return fit_light_plane(list(points.values()), list(points))


def _laser_frames(capture: Capture) -> list[Frame]:
    return [frame for frame in capture.manifest.frames if isinstance(frame.laser, LaserPlane)]


def _stripes_on_board(capture: Capture, board: tuple[int, int], charuco: Charuco | None, device: str) -> _View:
    """Return where a board and the stripes on it are seen."""
    correction = Correction.of(capture)
    grey, black = _even_light(capture, correction), _uniform(capture, correction, "black")
    if grey is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: none shows the board without the laser: add one under a white "
                            'projection, or under the light of the room, {"type": "off"}')
    corners = find_board(grey, board, charuco)
    if isinstance(corners, str):
        raise CalibrationError(f"{capture.folder}: {corners}")
    inside = inside_board(corners, board, grey.shape)
    dark = np.float32(0) if black is None else black
    # squares would shift the middle of a stripe that runs along their edges: it is divided by what the board looks like
    albedo = np.where(inside, np.maximum(grey, 0), 0).astype(np.float32)
    stripes = [_stripes(stripe_signal(correction.apply(frame).pixels - dark, inside), albedo, device) for frame in _laser_frames(capture)]
    longer = [max(pair, key=lambda seen: len(seen.lines)) for pair in _whole(stripes, inside)]
    return _View(corners, [seen.image() if len(seen.lines) >= LEAST_LINES else (np.zeros(0), np.zeros(0)) for seen in longer])


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
        raise CalibrationError(f"frame {_laser_frames(captures[0])[worst].image}: its stripe misses base, riser and top of an upright "
                               f"block by {fit.planes[worst].residual_px:.2g} px: look for light of other surfaces, a base that is not "
                               "flat, or a block that is not right-angled")
    planes = [MeasuredPlane(plane.point, plane.normal, plane.sigma_m, plane.sigma_degrees,
                            {"residual_px": float(f"{plane.residual_px:.3g}"), "sigma_degrees": float(f"{plane.sigma_degrees:.3g}"),
                             "sigma_depth": float(f"{plane.sigma:.3g}"), "poses": plane.stripes},
                            (f"{plane.residual_px:.3f} px", f"{100 * plane.sigma:.2f} % of depth")) for plane in fit.planes]
    return _OnTarget(planes, {"steps": [
        {"capture": str(capture.folder), "stripes": sum(stripe is not None for stripe in found),
         "with_riser": sum(stripe is not None and stripe.riser is not None for stripe in found), "distance_m": float(f"{distance:.5g}")}
        for capture, found, distance in zip(captures, stripes, fit.distances_m, strict=True)]})


def _stripes_on_step(capture: Capture, device: str, pixel: float) -> list[StepStripe | None]:
    """Return the stripe of each laser frame of a capture, along rows or columns, whichever shows more of it."""
    correction, mask, frames = Correction.of(capture), capture.mask(), _laser_frames(capture)
    background, _ = ambient_light(capture, correction, frames, Timings(None))
    albedo = _step_albedo(capture, correction, mask)
    stripes = [_stripes(stripe_signal(correction.apply(frame).pixels - background, mask), albedo, device) for frame in frames]
    found: list[StepStripe | None] = []
    for pair in _whole(stripes, mask):
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
    light = _even_light(capture, correction)
    if light is None:
        return None
    grey = np.where(mask, light, 0)
    least = LEAST_EVEN * float(grey.max())
    return np.maximum(grey, 0) if least > 0 and (grey[mask] > least).all() else None


class _Seen(NamedTuple):
    """The points of a stripe that was looked for along rows or columns, one on each line that shows it."""

    along: Along
    lines: np.ndarray  # [n] number of the line
    centre: np.ndarray  # [n] place on the line
    width: np.ndarray  # [n] standard deviation of the profile, pixels

    def image(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the image coordinates u and v, [n] each."""
        across, down = self.centre.astype(np.float64), self.lines + 0.5
        return (across, down) if self.along == "row" else (down, across)

    def within(self, mask: np.ndarray, width: float) -> "_Seen":
        """Return the points whose profile, of this width, lies in the mask: of one that is cut the middle is elsewhere than of what is
        left."""
        first, end = (np.floor(self.centre + reach * width).astype(int) for reach in (-KNOWN_REACH, KNOWN_REACH))
        before = np.cumsum(np.pad(mask if self.along == "row" else mask.T, ((0, 0), (1, 0))), axis=1)  # pixels of the mask
        most = before.shape[1] - 1
        inside = before[self.lines, np.clip(end + 1, 0, most)] - before[self.lines, np.clip(first, 0, most)]
        kept = inside == end + 1 - first
        return _Seen(self.along, self.lines[kept], self.centre[kept], self.width[kept])


def _stripes(signal: Signal, albedo: np.ndarray | None, device: str) -> list[_Seen]:
    """Return a stripe as it is seen along rows, and along columns."""
    found = []
    for along in ALONG:
        stripe = find_stripe(np.ascontiguousarray(signal.values), along=along, noise=signal.noise, device=device, albedo=albedo)
        lines = np.flatnonzero(to_numpy(stripe.status) == Status.OK)
        found.append(_Seen(along, lines, to_numpy(stripe.centre)[lines], to_numpy(stripe.width)[lines]))
    return found


def _whole(stripes: list[list[_Seen]], mask: np.ndarray) -> list[list[_Seen]]:
    """Return the stripes of all frames without points whose profile leaves the mask."""
    widths = np.concatenate([seen.width for pair in stripes for seen in pair])
    return [[seen.within(mask, float(np.median(widths))) for seen in pair] for pair in stripes] if len(widths) else stripes


def _uniform(capture: Capture, correction: Correction, code: str) -> np.ndarray | None:
    """Return the frame under a white or black projection, [rows, cols, 3] linear; None: there is none."""
    frames = (frame for frame in capture.manifest.frames if isinstance(frame.pattern, UniformPattern) and frame.pattern.code == code)
    frame = next(frames, None)
    return None if frame is None else correction.apply(frame).pixels


def _even_light(capture: Capture, correction: Correction) -> np.ndarray | None:
    """Return the grey of the target, [rows, cols] float32, under a white projection, or else under the light of the room.

    The light of the room is a frame without the laser, or that under a black projection. None: no frame shows the target.
    """
    shown = _uniform(capture, correction, "white")
    if shown is None:
        shown = correction.ambient if correction.ambient is not None else _uniform(capture, correction, "black")
    return None if shown is None else np.asarray(shown @ np.array(GREY_WEIGHTS, np.float32), dtype=np.float32)


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
    named = list(zip([frame.image for frame in _laser_frames(targets[0])], planes, strict=True))
    measured = sorted(((name, plane) for name, plane in named if isinstance(plane, MeasuredPlane)),
                      key=lambda pair: pair[1].sigma_degrees, reverse=True)
    rows: list[tuple[str, ...]] = [(name, f"{plane.sigma_degrees:.3f}°", *plane.words) for name, plane in measured]
    return LaserPlanes(paths, reports[0], rows, (*found.said, *(f"frames of {name}: {plane}; they are left out" for name, plane in named
                                                                if isinstance(plane, CalibrationError))))
