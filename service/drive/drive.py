"""Drive a rig: environments and light keys → levels of its lamps, frame by frame.

The light of a frame is shared out over the lamps as `relit relight` weighs captured images (`light`), becomes levels of the
primaries (`primaries`), what is beyond a lamp's limit goes to its neighbours (`dilation`), and levels become steps (`quantisation`).
Each step is continuous in the light, so that nothing flickers under a light that moves.

Source: Debevec et al., "A Lighting Reproduction Approach to Live-Action Compositing", SIGGRAPH 2002.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from service.drive.chart_view import view_chart
from service.drive.cue_files import WORTH_SAYING, drive_warnings, report_sections, write_cue_files
from service.drive.dilation import Dilated, dilate
from service.drive.judgement import Judgement
from service.drive.light import collect_light, judge_all
from service.drive.picture import write_picture
from service.drive.primaries import WantedLevels, levels_for_light
from service.drive.quantisation import quantise
from service.errors import RequestError
from service.relight.attributes import FRAMES_PER_SECOND
from service.relight.environments import Environments
from service.relight.schedule import schedule
from service.reporting.progress import Progress, Timings
from service.requests.drive import DriveRequest
from service.requests.light.frame_range import frame_numbers
from service.requests.light.light_keys import LightKeys
from service.requests.play import TwinRequest
from service.twin.picture import TwinPicture
from stage.rig.chart import read_chart
from stage.rig.rig import Rig, read_rig

MOST_LEFT = 0.01
"""The largest part of the energy of a frame that may find no lamp; more is an error, which says what exposure the rig holds."""
STOPS_STEP = 0.1
"""The exposure that an error proposes is rounded down to a multiple of this."""


class DriveResult(NamedTuple):
    """The files of a drive, and what the user should know of them."""

    cues: Path
    picture: Path
    report: Path
    frames: int
    exposure: float
    """Factor on the environment, by which the irradiances of lamps and environment are compared."""
    judgement: Judgement
    limited: int
    """Number of frames in which a lamp is at its limit."""
    warnings: tuple[str, ...]


def drive(request: DriveRequest, progress: Progress | None = None) -> DriveResult:
    """Find the levels of the lamps and write them.

    Args:
        request: rig, light and where to put the cues.
        progress: told of every stage.

    Raises:
        RequestError: options that do not fit, or an environment beyond all limits of the rig.
        StageError, KernelError: bad input; names file and field.
        StorageError: a file cannot be written; nothing half-written is left.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    rig = read_rig(request.rig)
    chart = None if request.chart is None else read_chart(request.chart)
    numbers = frame_numbers(request.frames, 1)
    keys = None if request.keys is None else LightKeys.read(request.keys)
    if keys is not None and keys.captured:
        raise RequestError(f"--keys {request.keys}: has captured images, which lamps cannot show: take them out")
    environments = None if request.environment is None else Environments(request.environment, clip_negative=request.clip_negative)
    scheduled = schedule(request, numbers, keys, environments)
    if environments is not None:
        environments.check(numbers)
    timings.stage("light", len(scheduled))
    light = collect_light(scheduled, environments, rig, request, device, timings)
    timings.stage("levels", 4)
    wanted = levels_for_light(light.energy * (2.0**light.stops)[:, None, None], rig, chart)
    exposure = 2.0**request.exposure * (_greatest(wanted) if request.auto_exposure else 1.0)
    wanted = WantedLevels(wanted.level * exposure, wanted.out_of_gamut * exposure)
    timings.advance(1)
    dilated = dilate(wanted.level, rig)
    _check_limits(wanted, dilated, rig, request, exposure)
    timings.advance(2)
    quantised = quantise(dilated.level, rig)
    timings.advance(3)
    factor = exposure * 2.0**light.stops
    judgement, unrounded = (judge_all(light, level, rig, factor) for level in (quantised.level, dilated.level))
    timings.advance(4)
    shown = None if chart is None else view_chart(chart, rig, light.far, quantised.level, factor)
    warnings = tuple(drive_warnings(rig, light, wanted, dilated, factor, environments))
    rate = request.frames_per_second or (None if keys is None else keys.frames_per_second) or FRAMES_PER_SECOND
    sections = report_sections(light, wanted, dilated, quantised, judgement, unrounded, rig, exposure, numbers, shown)
    timings.stage("files", 1)
    cues, report = write_cue_files(request, rig, quantised, numbers, rate, sections, warnings, timings)
    titles = [_title(*frame) for frame in zip(numbers, light.beyond, dilated.radius, strict=True)]
    picture = write_picture(request.out, rig, light.far, quantised.level, factor, titles, shown, request.review)
    if request.capture is not None:
        camera = TwinPicture(rig, TwinRequest(rig=request.rig, capture=request.capture, device=device, cache=request.cache), timings)
        warnings += tuple(camera.warnings)
        timings.stage("predicted", len(numbers))
        for index, number in enumerate(numbers):
            camera.write(request.out / f"predicted.{number:04d}.exr", quantised.level[index])
            timings.advance(index + 1)
    timings.close()
    return DriveResult(cues, picture, report, len(numbers), exposure, judgement, int((dilated.radius > 0).sum()), warnings)


def _title(number: int, beyond: float, radius: float) -> str:
    """Return the title of a frame in the picture: its number, the part `beyond` of its light, and the `radius` of a dilation in radians."""
    return (f"frame {number}" + (f", {beyond:.0%} from beyond the lamps" if beyond > WORTH_SAYING else "")
            + (f", limits spread by {np.degrees(radius):.0f} degrees" if radius > 0 else ""))


def _greatest(wanted: WantedLevels) -> float:
    """Return the exposure at which the brightest primary of all frames is at full level.

    Raises:
        RequestError: no lamp gives light.
    """
    most = float(wanted.level.max())
    if most == 0:
        raise RequestError("--auto-exposure: no frame has light")
    return 1 / most


def _check_limits(wanted: WantedLevels, dilated: Dilated, rig: Rig, request: DriveRequest, exposure: float) -> None:
    """Check that the lamps hold the light of every frame.

    Raises:
        RequestError: more than MOST_LEFT of the energy of a frame finds no lamp.
    """
    irradiance = np.array([primary.irradiance for _, primary in rig.emitters])

    def left(level: np.ndarray, rest: np.ndarray) -> np.ndarray:
        return np.asarray(rest.sum(axis=1) / np.maximum((level @ irradiance).sum(axis=1), np.finfo(float).tiny))

    missing = left(wanted.level, dilated.left)
    worst = int(missing.argmax())
    if missing[worst] <= MOST_LEFT:
        return
    low, high = -64.0, 0.0  # stops below the exposure that was asked for
    while high - low > STOPS_STEP / 4:
        stops = (low + high) / 2
        level = wanted.level[worst : worst + 1] * 2**stops
        low, high = (stops, high) if left(level, dilate(level, rig).left)[0] <= MOST_LEFT else (low, stops)
    held = np.floor((np.log2(exposure) + low) / STOPS_STEP) * STOPS_STEP
    raise RequestError(f"--environment {request.environment}: is beyond all limits of the rig {rig.name}: {missing[worst]:.0%} of its "
                       f"light finds no lamp; with --exposure {held:.1f} the lamps hold it")
