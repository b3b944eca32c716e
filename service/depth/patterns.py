"""Depth from frames under projected patterns: decode each axis band by band, then triangulate."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.decoded import Decoded
from kernels.structured.frames import NoiseModel, saturated_bits, upload
from kernels.structured.join import cropped
from kernels.structured.triangulate import ProjectorModel, triangulate
from service.depth.agreement import conclude, doubt_pixels
from service.depth.codes import choose_decoder
from service.depth.decoders import AxisDecoder, PatternProjector, Readings
from service.depth.pattern_checks import check_declaration, find_exponent, response_sentence, sample_of
from service.depth.solution import DepthSolution
from service.reporting.progress import Timings
from service.requests.depth import DepthRequest
from stage.capture import Capture
from stage.colour import GREY_WEIGHTS
from stage.colour_spaces import is_linear
from stage.correction import Correction
from stage.errors import ManifestError
from stage.manifest import FILE_NAME, Frame
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected, collect
from stage.planes import Planes, frame_planes
from stage.projector import Projector
from stage.triangulation_check import check_projector

SCALE_PERCENTILE = 99.9
"""Percentile of the brightest frame that is taken for full scale, for images in floating point without a given saturation."""
SCALE_SAMPLE = 500_000
"""Number of pixels of a frame from which full scale is taken."""
DECODE_BYTES_PER_PIXEL = 200
"""Memory that decoding and triangulation take for each pixel, beside the planes."""


class PatternCodes(NamedTuple):
    """The codes of a capture and the decoder of each axis; None where an axis has no code."""

    collected: Collected
    columns: AxisDecoder | None
    rows: AxisDecoder | None
    unused: tuple[str, ...]
    """Codes that no decoder reads."""

    @property
    def colour(self) -> bool:
        """Return whether a decoder needs colour frames."""
        return any(decoder is not None and decoder.colour for decoder in (self.columns, self.rows))


def solve_patterns(capture: Capture, mask: np.ndarray, request: DepthRequest, device: str, timings: Timings) -> DepthSolution:
    """Decode the projector's columns, rows or both, and intersect them with the lines of sight.

    Args:
        capture: with a projector and pattern frames.
        mask: [rows, cols] bool.
        request: its noise, residual and span of depths; depths outside are OUT_OF_RANGE.
        device: where to run.
        timings: told of every stage.

    Raises:
        StageError: no projector, an incomplete code, an unreadable frame.
    """
    projector = check_projector(capture)
    frames = [frame for frame in capture.manifest.frames if frame.pattern is not None]
    shown = PatternProjector(projector.resolution, projector.response, projector.crosstalk)
    codes = read_codes(capture, frames, shown, refine=request.refine)
    timings.stage("frames", len(frames))
    with frame_planes(capture, frames, colour=codes.colour, cache=request.cache, progress=timings.advance) as planes:
        full = full_scale(planes, capture, frames)
        noise = NoiseModel(request.read_noise * full, request.photon_gain * full)
        warnings, codes = _checked(planes, mask, codes, shown, projector, capture, frames, noise, device, request)
        solution, right = _bands(planes, mask, codes, projector, capture, noise, device, request, timings)
    conclude(solution, right, mask, request, warnings)
    solution.colour = scene_colour(capture, frames, codes.collected)
    solution.facts |= {"full_scale": float(f"{full:.6g}"), "frames": len(frames),
                       "codes": {decoder.axis: decoder.name for decoder in (codes.columns, codes.rows) if decoder is not None},
                       "unused": list(codes.unused)}
    return solution


def _checked(planes: Planes, mask: np.ndarray, codes: PatternCodes, shown: PatternProjector, projector: Projector, capture: Capture,
             frames: list[Frame], noise: NoiseModel, device: str, request: DepthRequest) -> tuple[list[str], PatternCodes]:
    """Return what a sample of the frames says about all of them, and the decoders that heed it."""
    sample = sample_of(planes, capture.camera, mask)
    patterns = [frame.pattern for frame in frames if frame.pattern is not None]
    wrong = check_declaration(sample, patterns, shown, projector_model(projector), noise, device)
    if wrong is not None:
        return [wrong], codes
    if projector.response is None:
        exponent = find_exponent(sample, codes.collected, shown, noise, device)
        if exponent != 1.0:
            names = [f"{decoder.axis}s" for decoder in (codes.columns, codes.rows) if decoder is not None]
            return ([response_sentence(exponent, names)],
                    read_codes(capture, frames, shown._replace(exponent=exponent), refine=request.refine))
    return [], codes


def read_codes(capture: Capture, frames: list[Frame], projector: PatternProjector, *, refine: bool = False) -> PatternCodes:
    """Return the codes of a capture and how each axis is decoded.

    Raises:
        ManifestError: a code is incomplete; names the file.
    """
    try:
        collect([frame.pattern for frame in capture.manifest.frames])  # so that what is wrong is said with the manifest's numbers
        collected = collect([frame.pattern for frame in frames])
        columns, unused_columns = choose_decoder(collected, "column", projector, refine=refine)
        rows, unused_rows = choose_decoder(collected, "row", projector, refine=refine)
        return PatternCodes(collected, columns, rows, unused_columns + unused_rows)
    except ManifestError as error:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: {error}") from error


def _bands(planes: Planes, mask: np.ndarray, codes: PatternCodes, projector: Projector, capture: Capture, noise: NoiseModel, device: str,
           request: DepthRequest, timings: Timings) -> tuple[DepthSolution, np.ndarray]:
    """Return the depth of each pixel and its probability to be right."""
    shape = mask.shape
    columns, rows = codes.columns, codes.rows
    model = projector_model(projector)
    x, y = capture.camera.plane_coordinates()
    maps = {name: np.zeros(shape, np.float32) for name in ("depth", "sigma", "residual", "amplitude", "u", "v")}
    status = np.zeros(shape, np.uint8)
    guessed = {name: np.zeros(shape, dtype=bool) for name in "uv"}
    timings.stage("decode", shape[0])
    for band, decoded in decoded_bands(planes, (columns, rows), noise, device):
        found = triangulate(x[band].ravel().astype(np.float32), y[band].ravel().astype(np.float32), decoded[0], decoded[1], model,
                            near_m=request.near_m or 0.0, far_m=request.far_m or np.inf, max_residual_px=request.max_residual_px,
                            device=device)
        part = mask[band]

        def place(name: str, values: np.ndarray, kept: np.ndarray, band: slice = band) -> None:
            flat = values[:kept.size].reshape(kept.shape)
            maps[name][band] = np.where(kept, flat, 0)

        code = found.status.numpy()[:part.size].reshape(part.shape)
        status[band] = np.where(part, code, int(Status.UNSOLVED))
        solved = np.isin(status[band], SOLVED)
        kept = solved | (np.isin(status[band], ESTIMATED) & (found.depth.numpy()[:part.size].reshape(part.shape) > 0))
        for name in ("depth", "sigma", "residual"):
            place(name, getattr(found, name).numpy(), kept)
        place("amplitude", _amplitude(decoded), part)
        for name, axis in zip("uv", decoded, strict=True):
            if axis is not None:
                place(name, axis.coordinate.numpy(), kept)
                sure = np.isin(axis.status.numpy()[:part.size].reshape(part.shape), SOLVED)
                guessed[name][band] = solved & ~sure
        timings.advance(band.stop)
    for index, (name, missing) in enumerate(guessed.items()):
        if missing.any():  # solved from the other axis alone: where the point lies in the projector
            points = capture.camera.points(-maps["depth"])[missing]
            maps[name][missing] = projector.project(points)[0][:, index]
    solved = np.isin(status, SOLVED)
    facts: dict[str, Any] = {}
    both = columns is not None and rows is not None
    if both and solved.any():
        low, high = np.percentile(maps["residual"][solved], [50, 95])
        facts["residual_px"] = {"median": float(f"{low:.4g}"), "p95": float(f"{high:.4g}")}
    names = sorted({decoder.name for decoder in (columns, rows) if decoder is not None})
    solution = DepthSolution(method=", ".join(names), depth=maps["depth"], status=status, sigma=maps["sigma"],
                             projector_u=maps["u"] if columns is not None else None, projector_v=maps["v"] if rows is not None else None,
                             amplitude=maps["amplitude"], facts=facts)
    right = doubt_pixels(solution, maps["residual"] if both else None, capture.camera, projector, device)
    return solution, right


def decoded_bands(planes: Planes, decoders: Sequence[AxisDecoder | None], noise: NoiseModel,
                  device: str) -> Iterator[tuple[slice, list[Decoded | None]]]:
    """Decode the planes band by band.

    Yields:
        A range of rows, and each axis decoded in it; None where an axis has no decoder.
    """
    _, height, _, width = planes.values.shape
    halo = max((decoder.halo for decoder in decoders if decoder is not None), default=0)
    for band in planes.bands(DECODE_BYTES_PER_PIXEL):
        around = slice(max(band.start - halo, 0), min(band.stop + halo, height))
        values = planes.band(around)
        bits = None if planes.saturated is None else saturated_bits(planes.saturated[:, around].reshape(len(values), -1))
        grey = values[:, 0] if values.shape[1] == 1 else np.tensordot(values, np.array(GREY_WEIGHTS, np.float32), ([1], [0]))
        readings = Readings(upload(np.ascontiguousarray(grey), bits, device=device),
                            upload(values, bits, device=device) if values.shape[1] > 1 else None, width)
        decoded = [None if decoder is None else decoder.decode(readings, noise) for decoder in decoders]
        if around != band:
            first, count = (band.start - around.start) * width, (band.stop - band.start) * width
            decoded = [None if axis is None else cropped(axis, first, count, device=device) for axis in decoded]
        yield band, decoded


def _amplitude(decoded: list[Decoded | None]) -> np.ndarray:
    """Return the amplitude of the weaker axis: a pixel is as good as its worse one."""
    return np.minimum.reduce([axis.amplitude.numpy() for axis in decoded if axis is not None])


def projector_model(projector: Projector) -> ProjectorModel:
    """Return the projector as triangulation takes it."""
    width, height = projector.resolution
    lens = projector.distortion
    return ProjectorModel((width, height), projector.focal_px, projector.principal_px or (width / 2, height / 2),
                          lens.k if lens is not None else (0.0, 0.0, 0.0), lens.p if lens is not None else (0.0, 0.0),
                          projector.projector_from_camera())


def full_scale(planes: Planes, capture: Capture, frames: list[Frame]) -> float:
    """Return the largest reading there can be, in the unit of the corrected images."""
    exposure = min((frame.exposure_s for frame in frames if frame.exposure_s is not None), default=1.0)
    manifest = capture.manifest
    integers = all(Path(frame.image).suffix.lower() in (".png", ".jpg", ".jpeg") for frame in frames)
    if integers or not is_linear(manifest.color_space):
        return 1.0 / exposure
    if manifest.saturation is not None:
        return manifest.saturation / exposure
    every = max(1, planes.values[0].size // SCALE_SAMPLE)
    return max(float(max(np.percentile(frame.reshape(-1)[::every], SCALE_PERCENTILE) for frame in planes.values)), 1e-12)


def scene_colour(capture: Capture, frames: list[Frame], collected: Collected) -> np.ndarray | None:
    """Return what the scene looks like, [rows, cols, 3] linear: the white frame, else a bit and its inverse, which add up to even light.

    None if the capture has neither.
    """
    numbers = [collected.white] if collected.white is not None else []
    for code in collected.codes:
        if not numbers and isinstance(code, BinaryCode) and code.inverses is not None:
            numbers = [code.frames[0], code.inverses[0]]
    if not numbers:
        return None
    correction = Correction.of(capture)
    return np.asarray(np.sum([correction.apply(frames[number]).pixels for number in numbers], axis=0))
