"""Depth from frames under projected patterns: decode each axis band by band, then triangulate, where the capture is calibrated."""

from collections.abc import Iterator, Sequence
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.decoded import Decoded, cropped
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.triangulate import ProjectorModel, triangulate
from service.depth.base.epipolar import Contradiction, settled
from service.depth.base.solution import DepthSolution
from service.depth.base.triangulation_check import check_projector, missing_calibration
from service.depth.patterns.agreement import ADVICE, DOUBTED, conclude, contradicted, doubt_coordinates, doubt_pixels, widen
from service.depth.patterns.code_checks import check_codes, check_inverted
from service.depth.patterns.codes import choose_decoder
from service.depth.patterns.coordinates import Coordinates, DecodedSolution
from service.depth.patterns.decoders import AxisDecoder, PatternProjector
from service.depth.patterns.lag import widen_lagging
from service.depth.patterns.levels import check_levels, light_sentence, moved_pixels, uneven_halves
from service.depth.patterns.measured_noise import SAID_NOISIER, with_measured_noise
from service.depth.patterns.missed_frames import check_frames
from service.depth.patterns.mixture import widen_mixed
from service.depth.patterns.pattern_checks import Sample, check_declaration, check_references, check_unevenness, sample_of
from service.depth.patterns.pose_checks import check_pose
from service.depth.patterns.readings import DECODE_BYTES_PER_PIXEL, Readings, full_scale, scene_colour
from service.depth.patterns.response_checks import check_ramps, find_exponent, response_sentence
from service.depth.patterns.shifted_frames import widen_shifted
from service.depth.patterns.unseen_stripes import measured_edge_error, unseen_digits, unseen_sentences
from service.depth.patterns.wave_checks import bent_back, check_waves
from service.depth.patterns.wave_order import check_order
from service.depth.patterns.wave_range import check_range
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Frame
from stage.capture.projector import Projector
from stage.errors import ManifestError
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected, collect
from stage.patterns.kary import KaryCode
from stage.stack.pattern_exposures import JoinedExposures, frames_shown
from stage.stack.planes import Planes, frame_planes


class PatternCodes(NamedTuple):
    """The codes of a capture and the decoder of each axis; None where an axis has no code."""

    collected: Collected
    columns: AxisDecoder | None
    rows: AxisDecoder | None
    unused: tuple[str, ...]
    """Codes that no decoder reads."""
    steady: bool = True
    """False if the light has changed between the frames: waves that contradict each other tell nothing of light below surfaces then."""

    @property
    def method(self) -> str:
        """Return the names of the decoders."""
        return ", ".join(sorted({decoder.name for decoder in (self.columns, self.rows) if decoder is not None}))

    @property
    def colour(self) -> bool:
        """Return whether a decoder needs colour frames."""
        return any(decoder is not None and decoder.colour for decoder in (self.columns, self.rows))


class Checks(NamedTuple):
    """What a sample of the frames says about all of them."""

    warnings: list[str]
    codes: PatternCodes
    """The decoders, by the exponent of the projector where the sample tells one."""
    declared: bool
    """False where the patterns are declared otherwise than they were shown: no other check allows for such errors."""


def solve_patterns(capture: Capture, mask: np.ndarray, request: DepthRequest, device: str,
                   timings: Timings) -> DepthSolution | DecodedSolution:
    """Decode the projector's columns, rows or both, and intersect them with the lines of sight where the capture is calibrated.
    Returns the depth, OUT_OF_RANGE outside the request's span; or the decoded coordinates alone, where the capture is not calibrated or
    where no decoded pixel has a depth."""
    missing = missing_calibration(capture)
    projector = check_projector(capture) if missing is None else None
    if missing is not None:
        for option in ("near_m", "far_m", "max_sigma", "normals", "refine_projector"):
            if getattr(request, option) not in (None, False):
                raise RequestError(f"--{option.replace('_', '-')}: is about depths, and the patterns are decoded without depth: {missing}")
    frames, series = frames_shown(capture)
    shown = pattern_projector(capture, frames)
    codes = read_codes(capture, frames, shown, refine=request.refine)
    if request.refine_projector and (codes.columns is None or codes.rows is None):
        raise RequestError("--refine-projector: needs patterns of columns and rows, and the frames have a code of one axis alone")
    joined = None
    if series is not None:
        timings.stage("exposures", len(frames))
        joined = JoinedExposures(capture, series, timings.advance)
    timings.stage("frames", len(frames))
    with frame_planes(capture, frames, colour=codes.colour, cache=request.cache, progress=timings.advance, joined=joined) as planes:
        full = full_scale(planes, capture, frames) if joined is None else joined.full_scale
        reads = 1 if series is None else len(series.times_s)
        noise = NoiseModel(request.read_noise * full * reads**0.5, request.photon_gain * full)  # joined frames add up their read noise
        sample = sample_of(planes, capture.camera, mask)
        shown = shown._replace(edge_error_px=measured_edge_error(planes, mask, codes.collected, noise),
                               unseen_digits=unseen_digits(sample, codes.collected, shown, noise))
        codes = read_codes(capture, frames, shown, refine=request.refine)
        measured = with_measured_noise(planes, capture.camera, mask, codes.collected, noise)
        warnings, codes, declared = checked(sample, codes, shown, projector, capture, frames, noise, measured[0], device,
                                            refine=request.refine)
        noisier = 1.0
        if declared:  # else what contradicts the declaration would count as noise
            noise, noisier = measured
        coordinates = Coordinates.empty(mask.shape, columns=codes.columns is not None, rows=codes.rows is not None)
        if projector is None:
            timings.stage("decode", mask.shape[0])
            for band, decoded in decoded_bands(planes, (codes.columns, codes.rows), noise, device):
                coordinates.put(band, mask[band], decoded)
                timings.advance(band.stop)
            if declared:
                warnings += _widen(planes, coordinates, codes, frames, noise)[0]
        else:
            solution, right = _bands(planes, mask, codes, coordinates, projector, capture, frames, noise, device, request,
                                     timings, declared=declared)
        moved, said = moved_pixels(planes, mask, sample, codes.collected, noise, shifted=coordinates.shift_px > 0)
        if planes.exposure is not None:
            coordinates.amplitude /= planes.exposure
    warnings += said + unseen_sentences(codes.collected, shown)
    if noisier >= SAID_NOISIER:
        warnings.append(f"frames[]: readings are {noisier:.2g} times as noisy as --read-noise and --photon-gain say, and decoded as such: "
                        "expose longer, or say how noisy the camera is")
    facts = {"full_scale": float(f"{full:.6g}"), "frames": len(frames) * reads,
             "codes": {decoder.axis: decoder.name for decoder in (codes.columns, codes.rows) if decoder is not None},
             "unused": list(codes.unused)}
    if noisier > 1:
        facts["noise_factor"] = float(f"{noisier:.3g}")
    if coordinates.shift_px:
        facts["image_shift_px"] = float(f"{coordinates.shift_px:.3g}")
    if series is not None and joined is not None:
        facts |= {"exposures_s": list(series.times_s), "pixels_of_exposures": list(joined.counts)}
    spanned = request.near_m is not None or request.far_m is not None  # which may be what refuses all depths
    if projector is not None and (spanned or solution.estimated.any() or not np.isin(coordinates.status(), SOLVED).any()):
        conclude(solution, np.where(moved, np.minimum(right, DOUBTED), right), mask, request, warnings)
        solution.colour = scene_colour(capture, frames, codes.collected, joined)
        solution.facts |= facts
        return solution
    reason = missing or f"no decoded pixel has a depth ({_refused(solution, mask)}"
    decoded_only = DecodedSolution(method=codes.method, coordinates=coordinates, extents=shown.resolution, status=coordinates.status())
    right = doubt_coordinates(decoded_only)
    conclude(decoded_only, np.where(moved, np.minimum(right, DOUBTED), right), mask, request, warnings)
    decoded_only.warnings.insert(0, f"decoded only, without depth: {reason}")
    decoded_only.facts |= facts | {"decoded_only": reason}
    return decoded_only


def _refused(solution: DepthSolution, mask: np.ndarray) -> str:
    """Return how many pixels have each status, and what most often is the cause of the commonest that triangulation gives."""
    counts = {Status[name.upper()]: count for name, count in solution.counts(mask).items() if count}
    most = max((Status.OUT_OF_RANGE, Status.ILL_POSED), key=lambda status: counts.get(status, 0))
    listed = ", ".join(f"{count} {status.name.lower()}" for status, count in counts.items() if status != Status.UNSOLVED)
    return f"{listed}): {ADVICE[most]}"


def pattern_projector(capture: Capture, frames: Sequence[Frame]) -> PatternProjector:
    """Return what decoding needs of the projector; where the manifest has none, stripes counted by bits or digits tell its size."""
    projector = capture.manifest.projector
    if projector is not None:
        return PatternProjector(projector.resolution, projector.response, projector.crosstalk)
    codes = collect([frame.pattern for frame in frames]).codes
    size = {"column": 0, "row": 0}
    for code in codes:
        if isinstance(code, BinaryCode | KaryCode):
            size[code.axis] = max(size[code.axis], ceil(code.stripe_count * code.stripe_px))
    for code in codes:
        if not size[code.axis]:
            raise ManifestError(f"{capture.folder / FILE_NAME}: projector: is missing, and a {code.name} code does not tell how many "
                                'pixels it has: give its size at least, as "projector": {"resolution": [1280, 800]}')
    return PatternProjector((size["column"] or 1, size["row"] or 1))  # an axis without a code has no coordinate


def checked(sample: Sample, codes: PatternCodes, shown: PatternProjector, projector: Projector | None, capture: Capture,
            frames: list[Frame], noise: NoiseModel, measured: NoiseModel, device: str, *, refine: bool) -> Checks:
    """Judge the declaration by a sample of the frames. `projector`: None where it is not calibrated. `measured`: the noise that the frames
    show, by which levels and ramps are judged."""
    patterns = [frame.pattern for frame in frames if frame.pattern is not None]
    wrong = check_inverted(sample, codes.collected, noise) or check_references(sample, codes.collected, noise)
    wrong = wrong or check_order(sample, codes.collected, noise) or (
        check_unevenness(sample, patterns, shown, noise, device) if projector is None
        else check_declaration(sample, patterns, shown, projector_model(projector), noise, device))
    wrong = wrong or check_frames(sample, codes.collected, frames, noise)
    changed = light_sentence(sample, codes.collected, shown, measured)
    wrong = wrong or check_codes(sample, codes.collected, shown, noise)
    wrong = wrong or (None if changed is not None else check_levels(sample, codes.collected, shown, measured))
    wrong = wrong or check_ramps(sample, codes.collected, shown, measured)
    waves = check_waves(sample, codes.collected, shown, None if projector is None else projector_model(projector), noise)
    wrong = wrong or waves.wrong
    if wrong is not None:
        return Checks([wrong], codes, False)
    bent = bent_back(sample, codes.collected, shown, noise) or find_exponent(
        sample, codes.collected, shown, noise, steady=changed is None)
    uneven = uneven_halves(sample, codes.collected, measured)
    said = [sentence for sentence in (waves.unconfirmed, changed, uneven) if sentence is not None]
    names = [f"{decoder.axis}s" for decoder in (codes.columns, codes.rows) if decoder is not None]
    if projector is not None and projector.principal_px is None and len(names) == 1:
        said.append("projector.principal_px: is missing, and the middle of its image is taken, which patterns of one axis cannot confirm: "
                    "give it (relit calibrate procam measures it)")
    if bent != shown:
        codes = read_codes(capture, frames, bent, refine=refine)
        said = said if changed is not None and bent.changed else [response_sentence(bent, names), *said]
    codes = codes._replace(steady=changed is None and not bent.changed)
    wrong = check_range(sample, codes.collected, bent, noise) or (
        None if projector is None else check_pose(sample, (codes.columns, codes.rows), projector_model(projector), noise, device))
    return Checks(said, codes, True) if wrong is None else Checks([wrong], codes, False)


def read_codes(capture: Capture, frames: list[Frame], projector: PatternProjector, *, refine: bool = False) -> PatternCodes:
    """Return the codes of a capture and how each axis is decoded."""
    try:
        if len(frames) == sum(frame.pattern is not None for frame in capture.manifest.frames):
            collect([frame.pattern for frame in capture.manifest.frames])  # so that what is wrong is said with the manifest's numbers
        collected = collect([frame.pattern for frame in frames])
        collected = collected._replace(codes=tuple(
            code.without(projector.unseen(code)) if isinstance(code, BinaryCode | KaryCode) else code for code in collected.codes))
        columns, unused_columns = choose_decoder(collected, "column", projector, refine=refine)
        rows, unused_rows = choose_decoder(collected, "row", projector, refine=refine)
        return PatternCodes(collected, columns, rows, unused_columns + unused_rows)
    except ManifestError as error:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: {error}") from error


class Measured(NamedTuple):
    """Depths, and each pixel's probability to be right."""

    solution: DepthSolution
    right: np.ndarray  # [rows, cols]


def _bands(planes: Planes, mask: np.ndarray, codes: PatternCodes, coordinates: Coordinates, projector: Projector, capture: Capture,
           frames: list[Frame], noise: NoiseModel, device: str, request: DepthRequest, timings: Timings, *,
           declared: bool) -> Measured:
    """Return the depth of each pixel; fill the coordinates.
    `declared`: whether the frames are what the manifest declares, as far as a sample tells."""
    def measure(view: Projector, before: Contradiction | None) -> tuple[Measured, Contradiction | None]:
        found = _triangulated(planes, mask, codes, coordinates, view, capture, frames, noise, device, request, timings, declared=declared)
        u, v = coordinates.columns, coordinates.rows
        return found, None if u is None or v is None else contradicted(found.solution, u, v, capture.camera, view, before, wide=wide)

    wide = any(axis is not None and axis.wide(size) for axis, size in zip((codes.columns, codes.rows), projector.resolution, strict=True))
    _, found, contradiction = settled(projector, measure, refine=request.refine_projector and declared)
    if contradiction is not None:
        u, v = coordinates.columns, coordinates.rows
        assert u is not None and v is not None  # they contradict it
        widen(found.solution, u, v, capture.camera, contradiction, projector)
    return found


def _triangulated(planes: Planes, mask: np.ndarray, codes: PatternCodes, coordinates: Coordinates, projector: Projector, capture: Capture,
                  frames: list[Frame], noise: NoiseModel, device: str, request: DepthRequest, timings: Timings, *,
                  declared: bool) -> Measured:
    """Return the depth of each pixel with one projector; fill the coordinates."""
    shape = mask.shape
    columns, rows = codes.columns, codes.rows
    model = projector_model(projector)
    x, y = capture.camera.plane_coordinates()
    maps = {name: np.zeros(shape, np.float32) for name in ("depth", "sigma", "residual")}
    status = np.zeros(shape, np.uint8)
    timings.stage("decode", shape[0])
    for band, decoded in decoded_bands(planes, (columns, rows), noise, device):
        found = triangulate(x[band].ravel().astype(np.float32), y[band].ravel().astype(np.float32), decoded[0], decoded[1], model,
                            near_m=request.near_m or 0.0, far_m=request.far_m or np.inf, max_residual_px=request.max_residual_px,
                            device=device)
        part = mask[band]
        coordinates.put(band, part, decoded)
        code = to_numpy(found.status)[:part.size].reshape(part.shape)
        status[band] = np.where(part, code, int(Status.UNSOLVED))
        solved = np.isin(status[band], SOLVED)
        kept = solved | (np.isin(status[band], ESTIMATED) & (to_numpy(found.depth)[:part.size].reshape(part.shape) > 0))
        for name in maps:
            maps[name][band] = np.where(kept, to_numpy(getattr(found, name))[:part.size].reshape(part.shape), 0)
        timings.advance(band.stop)
    widened: list[str] = []
    if declared:
        widened, wider = _widen(planes, coordinates, codes, frames, noise)
        maps["sigma"] *= wider
    for index, axis in enumerate((coordinates.columns, coordinates.rows)):
        if axis is not None:
            missing = np.isin(status, SOLVED) & ~axis.solved  # solved from the other axis alone: where the point lies in the projector
            axis.coordinate[missing] = projector.project(capture.camera.points(-maps["depth"])[missing])[0][:, index]
            axis.sigma[missing] = 0
    solved = np.isin(status, SOLVED)
    facts: dict[str, Any] = {}
    both = columns is not None and rows is not None
    if both and solved.any():
        low, high = np.percentile(maps["residual"][solved], [50, 95])
        facts["residual_px"] = {"median": float(f"{low:.4g}"), "p95": float(f"{high:.4g}")}
    u, v = coordinates.columns, coordinates.rows
    solution = DepthSolution(method=codes.method, depth=maps["depth"], status=status, sigma=maps["sigma"],
                             projector_u=None if u is None else u.coordinate, projector_v=None if v is None else v.coordinate,
                             sigma_u=None if u is None else u.sigma, sigma_v=None if v is None else v.sigma,
                             amplitude=coordinates.amplitude, facts=facts)
    solution.warnings += widened
    return Measured(solution, doubt_pixels(solution, maps["residual"] if both else None, capture.camera, projector, device))


def _widen(planes: Planes, coordinates: Coordinates, codes: PatternCodes, frames: list[Frame],
           noise: NoiseModel) -> tuple[list[str], np.ndarray]:
    """Add to the deviations of places what is no noise; return what is said of it, and the factor by which it widens the depth's."""
    decoders = codes.columns, codes.rows
    lagging, wider = widen_lagging(planes, coordinates, decoders, codes.collected, noise)
    shifted, more = widen_shifted(planes, coordinates, decoders, codes.collected, frames)
    return (lagging if codes.steady else []) + shifted, wider * more * widen_mixed(planes, coordinates, decoders, codes.collected, noise)


def decoded_bands(planes: Planes, decoders: Sequence[AxisDecoder | None], noise: NoiseModel,
                  device: str) -> Iterator[tuple[slice, list[Decoded | None]]]:
    """Yield ranges of rows and each axis decoded in them, None where an axis has no decoder."""
    _, height, _, width = planes.values.shape
    made = next((decoder.made for decoder in decoders if decoder is not None and decoder.made is not None), None)
    halo = max((decoder.halo for decoder in decoders if decoder is not None), default=0)
    for band in planes.bands(DECODE_BYTES_PER_PIXEL):
        around = slice(max(band.start - halo, 0), min(band.stop + halo, height))
        values = planes.band(around)
        saturated = None if planes.saturated is None else planes.saturated[:, around].reshape(len(values), -1)
        exposure = None if planes.exposure is None else planes.exposure[around].reshape(-1)
        readings = Readings.of(values, saturated, width, made, device=device, exposure=exposure)
        decoded = [None if decoder is None else decoder.decode(readings, noise) for decoder in decoders]
        if around != band:
            first, count = (band.start - around.start) * width, (band.stop - band.start) * width
            decoded = [None if axis is None else cropped(axis, first, count, device=device) for axis in decoded]
        yield band, decoded


def projector_model(projector: Projector) -> ProjectorModel:
    """Return the projector as triangulation takes it."""
    width, height = projector.resolution
    lens = projector.distortion
    return ProjectorModel((width, height), projector.focal_px, projector.principal_px or (width / 2, height / 2),
                          lens.k if lens is not None else (0.0, 0.0, 0.0), lens.p if lens is not None else (0.0, 0.0),
                          projector.projector_from_camera())
