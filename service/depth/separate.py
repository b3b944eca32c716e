"""Separate the direct from the global light of a capture and write separation.exr and report.json.

The way of the data: the frames of one sinusoid in each axis (`choose_sinusoids`) → kernels/structured/separation.py, band by band, which
holds the equations and their source → the mean over the axes → checks of the waves and against the white frame → the files.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.status import OK, Status
from kernels.structured.pattern_frames import saturated_bits, upload
from kernels.structured.separation import separate as separate_band
from service.depth.base.solution import statistics
from service.depth.depth import content_of
from service.depth.wave_check import WaveCheck
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.depth import SeparateRequest
from stage.capture.capture import Capture
from stage.capture.light import OffLight
from stage.capture.manifest import FILE_NAME, Frame
from stage.colour.colour_spaces import linear_space
from stage.colour.radiance import clipping_sentences
from stage.errors import ManifestError
from stage.files import write_text
from stage.formats import exr_rows
from stage.patterns.base import Axis
from stage.patterns.codes import Collected, collect
from stage.patterns.phase import FULL_STEPS, PhaseCode
from stage.results.result_metadata import result_metadata
from stage.stack.correction import Correction, Radiance
from stage.stack.pattern_exposures import JoinedExposures, frames_shown
from stage.stack.planes import frame_planes

SEPARATION_FILE = "separation.exr"
METHOD = "separation"
LONGEST_PX = 64.0
"""The longest period that is used unless the request names one, about a twentieth of a projector's width: light between surfaces follows
longer ones, and would count as direct."""
SUM_TOLERANCE = 0.1
"""Fraction by which direct and global light together may differ from the white frame. The mean of a sinusoid is half of white if the
projector and the camera are linear; a projector of gamma 2.2 without correction differs by 0.3."""
LIT_PART = 0.05
"""Fraction of the light of the brightest pixels (99th percentile) below which noise decides how the light is divided."""
BYTES_PER_PIXEL = 80
"""Memory that separation takes for each pixel, beside the planes."""


class Sinusoid(NamedTuple):
    """The frames of one period along one axis."""

    axis: Axis
    frames: tuple[int, ...]
    """Indices into the frames of patterns, one for each pattern."""
    shifts: tuple[float, ...]
    """The shift of each frame in turns."""


class LightParts(NamedTuple):
    """Both parts of the light under the projector full on; 0 where the status is not OK."""

    direct: np.ndarray  # [rows, cols, 3] float32 linear
    indirect: np.ndarray  # [rows, cols, 3] float32 linear, the global part
    status: np.ndarray  # [rows, cols] uint8: UNSOLVED outside the mask, OK, SATURATED


class SeparationResult(NamedTuple):
    """The files and numbers of a separation that was written."""

    separation_path: Path
    report_path: Path
    period_px: float
    global_share: dict[str, float]
    """Global light over all light at the lit pixels: 5th percentile, median and 95th; empty if none is lit."""
    counts: dict[str, int]
    """Number of pixels of the mask with each status."""
    warnings: tuple[str, ...]


def separate(request: SeparateRequest, progress: Progress | None = None) -> SeparationResult:
    """Separate direct from global light.

    Raises:
        StageError, KernelError: the capture has no frames for it, or they are not what they must be; nothing is written.
        RequestError: a period that the capture does not have, or a black level beside a black frame.
        StorageError: the results cannot be written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    capture = Capture.open(request.capture, request.pixels)
    frames, series = frames_shown(capture)
    try:
        if series is None:
            collect([frame.pattern for frame in capture.manifest.frames])  # so that what is wrong is said with the manifest's numbers
        collected = collect([frame.pattern for frame in frames])
        period_px, sinusoids = choose_sinusoids(collected, request.period_px)
    except ManifestError as error:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: {error}") from error
    if request.black_level and collected.black is not None:
        raise RequestError(f"--black-level {request.black_level:g}: the capture has a black frame, which holds that light already: "
                           "leave the option out")
    joined = None
    if series is not None:
        timings.stage("exposures", len(frames))
        joined = JoinedExposures(capture, series, timings.advance)
    check = WaveCheck(int(np.prod(capture.camera.resolution)))
    light = _separate_frames(capture, frames, joined, collected, sinusoids, period_px, request, device, timings, check)
    mask, solved = capture.mask(), light.status == OK
    counts = {name: int((light.status[mask] == code).sum()) for name, code in (("ok", OK), ("saturated", Status.SATURATED))}
    if not solved.any():
        raise ManifestError(f"{capture.folder}: no pixel is separated ({counts['saturated']} saturated): expose the phase frames for less")
    timings.stage("judge", 1)
    total = (light.direct + light.indirect).sum(axis=-1)
    ratios = _sum_over_white(Correction.of(capture).apply if joined is None else joined.read, frames, collected, total, solved)
    ratio = None if ratios is None else float(np.nanmedian(ratios))
    if ratio is not None and abs(ratio - 1) > SUM_TOLERANCE:
        raise ManifestError(f"{capture.folder}: direct and global light add up to {ratio:.2f} of the white frame: the patterns must be "
                            "linear in light (relit patterns --gamma, color_space), and ambient light needs a black or an off frame")
    warnings = [*clipping_sentences(capture.clipped), *check.faults(ratios)]
    timings.stage("write", len(mask))
    content = content_of(capture)
    path, report_path = request.out / SEPARATION_FILE, request.out / REPORT_FILE
    channels = {f"{name}.{channel}": values[..., c] for name, values in (("direct", light.direct), ("global", light.indirect))
                for c, channel in enumerate("RGB")}
    exr_rows.write(path, {**channels, "mask.Y": solved.astype(np.float16), "status.Y": light.status.astype(np.float16)},
                   color_space=linear_space(capture.manifest.color_space), progress=timings.advance,
                   metadata=result_metadata(capture.camera, metadata(request, capture=capture.name, inputs=content, method=METHOD)))
    lit = _lit(total, solved)
    share = statistics(light.indirect.sum(axis=-1)[lit] / total[lit])
    write_text(report_path, report(
        request,
        inputs={"capture": str(request.capture), "name": capture.name, "content": content, "frames": len(capture.manifest.frames),
                "resolution": list(capture.camera.resolution), "color_space": capture.manifest.color_space},
        method=METHOD,
        found={"period_px": period_px, "axes": [sinusoid.axis for sinusoid in sinusoids],
               "frames": sum(len(sinusoid.frames) for sinusoid in sinusoids), "ambient": _ambient(capture, collected),
               "sum_over_white": None if ratio is None else float(f"{ratio:.5g}"),
               **({} if series is None or joined is None else {"exposures_s": list(series.times_s),
                                                               "pixels_of_exposures": list(joined.counts)})},
        device=devices.describe(device),
        timings_s=timings.close(),
        pixels={"mask": int(mask.sum()), **counts},
        global_share=share,
        warnings=warnings,
        global_below_0=int((light.indirect[solved] < 0).any(axis=-1).sum()),
    ))
    return SeparationResult(path, report_path, period_px, share, counts, tuple(warnings))


def choose_sinusoids(collected: Collected, wanted_px: float | None) -> tuple[float, tuple[Sinusoid, ...]]:
    """Choose the period to separate with, and return its frames along each axis.
    `wanted_px`: the period that was asked for; None: the shortest. Raises ManifestError: no period has three shifts, or the shortest is
    longer than LONGEST_PX. Raises RequestError: no such period."""
    found: dict[float, list[Sinusoid]] = {}
    for code in (code for code in collected.codes if isinstance(code, PhaseCode)):
        for period, frames, shifts in code.waves:
            if len(set(shifts)) >= FULL_STEPS:
                found.setdefault(period, []).append(Sinusoid(code.axis, frames, shifts))
    if not found:
        raise ManifestError("no period of a phase pattern has three shifts or more: relit separate needs such frames "
                            "(relit patterns phase, or gray-phase)")
    if wanted_px is not None and wanted_px not in found:
        raise RequestError(f"--period-px {wanted_px:g}: the phase frames have periods of {', '.join(f'{px:g}' for px in sorted(found))} px")
    period_px = min(found) if wanted_px is None else wanted_px
    if wanted_px is None and period_px > LONGEST_PX:
        raise ManifestError(f"the shortest period is {period_px:g} px, which light between surfaces follows: project one of "
                            f"{LONGEST_PX:g} px or less, or name it with --period-px")
    return period_px, tuple(found[period_px])


def _separate_frames(capture: Capture, frames: list[Frame], joined: JoinedExposures | None, collected: Collected,
                     sinusoids: tuple[Sinusoid, ...], period_px: float, request: SeparateRequest, device: str,
                     timings: Timings, check: WaveCheck) -> LightParts:
    """Read the frames and separate them band by band; the parts are the mean over the axes."""
    black = () if collected.black is None else (collected.black,)
    used = [*(number for sinusoid in sinusoids for number in sinusoid.frames), *black]
    place = {number: index for index, number in enumerate(used)}
    mask = capture.mask()
    light = LightParts(np.zeros((*mask.shape, 3), np.float32), np.zeros((*mask.shape, 3), np.float32), np.zeros(mask.shape, np.uint8))
    timings.stage("frames", len(used))
    with frame_planes(capture, [frames[number] for number in used], colour=True, cache=request.cache, progress=timings.advance,
                      joined=joined) as planes:
        timings.stage("separate", len(mask))
        for band in planes.bands(BYTES_PER_PIXEL):
            bits = None if planes.saturated is None else saturated_bits(planes.saturated[:, band].reshape(len(used), -1))
            values = planes.band(band)
            usable = mask[band].reshape(-1)
            if planes.saturated is not None:
                usable = usable & ~planes.saturated[:, band].reshape(len(used), -1).any(axis=0)
            check.add(values, usable, [([place[number] for number in sinusoid.frames], sinusoid.shifts) for sinusoid in sinusoids],
                      first=band.start * mask.shape[1])
            readings = upload(values, bits, device=device)
            parts = [separate_band(readings, [place[number] for number in sinusoid.frames], sinusoid.shifts, period_px=period_px,
                                   black=place[black[0]] if black else None, leak=request.black_level) for sinusoid in sinusoids]
            shape = mask[band].shape
            pixels = mask[band].size
            worst = np.maximum.reduce([to_numpy(part.status)[:pixels] for part in parts]).reshape(shape)
            light.status[band] = np.where(mask[band], worst, int(Status.UNSOLVED))
            for whole, arrays in ((light.direct, [part.direct for part in parts]), (light.indirect, [part.indirect for part in parts])):
                mean = np.mean([to_numpy(array)[:, :pixels] for array in arrays], axis=0).reshape(3, *shape)
                if planes.exposure is not None:
                    mean /= planes.exposure[band]
                whole[band] = np.where((light.status[band] == OK)[..., None], np.moveaxis(mean, 0, -1), 0)
            timings.advance(band.stop)
    if check.copies is not None:
        one, other = (frames[used[number]].image for number in check.copies)
        raise ManifestError(f"{capture.folder}: {other} is an exact copy of {one}, where another shift is declared: record it again")
    return light


def _sum_over_white(read: Callable[[Frame], Radiance], frames: list[Frame], collected: Collected, total: np.ndarray,
                    solved: np.ndarray) -> np.ndarray | None:
    """Return direct and global light together over the white frame, [pixels], NaN where it is not lit; None without one, or if nothing is
    lit."""
    if collected.white is None:
        return None
    white = read(frames[collected.white])
    light = white.pixels
    if collected.black is not None:
        light = light - read(frames[collected.black]).pixels
    lit = _lit(light.sum(axis=-1), solved if white.saturated is None else solved & ~white.saturated)
    return np.divide(total, light.sum(axis=-1), out=np.full(total.shape, np.nan), where=lit).reshape(-1) if lit.any() else None


def _lit(light: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return which pixels are lit well enough to compare parts of their light, [rows, cols] bool."""
    if not usable.any():
        return usable
    return usable & (light > max(LIT_PART * float(np.percentile(light[usable], 99.0)), 0.0))


def _ambient(capture: Capture, collected: Collected) -> str:
    """Return where the ambient light is known from, in words."""
    if collected.black is not None:
        return "black frame"
    return "off frames" if capture.lit_by(OffLight) else "none"
