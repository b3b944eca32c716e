"""Drive a rig: environments and light keys → levels of its lamps, frame by frame.

The light of a frame is shared out over the lamps as `relit relight` weighs captured images (`light`), becomes levels of the primaries,
what is beyond a lamp's limit goes to its neighbours, and levels become steps (all in `levels`).
Each step is continuous in the light, so that nothing flickers under a light that moves.

Source: Debevec et al., "A Lighting Reproduction Approach to Live-Action Compositing", SIGGRAPH 2002.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from service.drive.cue_files import WORTH_SAYING, drive_warnings, report_sections, write_cue_files
from service.drive.judgement import Judgement, far_irradiance, irradiance_of, lamp_irradiance
from service.drive.levels import Dilated, WantedLevels, dilate, levels_for_light, quantise
from service.drive.light import ChartView, collect_light, judge_all, view_chart
from service.errors import RequestError
from service.relight.attributes import FRAMES_PER_SECOND
from service.relight.environments import Environments
from service.relight.far_light import FarLight
from service.relight.schedule import schedule
from service.relight.sheet import BACKGROUND, display, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.drive import DriveRequest
from service.requests.light.frame_range import frame_numbers
from service.requests.light.light_keys import LightKeys
from service.requests.play import TwinRequest
from service.twin.camera import TwinPicture
from stage.colour.colour_spaces import Review
from stage.errors import storage
from stage.rig.chart import read_chart
from stage.rig.rig import Rig, read_rig

MOST_LEFT = 0.01
"""The largest part of the energy of a frame that may find no lamp; more is an error, which says what exposure the rig holds."""
STOPS_STEP = 0.1
"""The exposure that an error proposes is rounded down to a multiple of this."""
PICTURE_FILE = "preview.png"
MOST_ROWS = 3
"""The most frames that are shown; of more, evenly spaced ones are."""
ERROR_SCALE = 10.0
"""The factor on the difference of the matte balls."""
SAMPLE_ROWS = 32
"""The rows of the map that lights the matte ball."""
MAP_ROWS = 128
"""The most rows of the map before it is scaled."""
BALL = 112
"""The side of a ball before it is scaled to the height of the sheet, pixels."""
GREY = 0.5
"""The mean of the matte ball under the environment before the display transform."""
LAMP_COSINE = float(np.cos(np.radians(4.0)))
"""Half the width at which lamps are drawn."""


class DriveResult(NamedTuple):
    """The files of a drive, and what the user should know of them."""

    cues: Path
    picture: Path
    report: Path
    frames: int
    exposure: float
    """Factor on the environment, by which the irradiances of lamps and environment are compared."""
    judgement: Judgement
    warnings: tuple[str, ...]


def drive(request: DriveRequest, progress: Progress | None = None) -> DriveResult:
    """Find the levels of the lamps and write them.
    Raises RequestError for options that do not fit, or an environment beyond all limits of the rig. Raises StageError or KernelError for
    bad input; it names file and field. Raises StorageError if a file cannot be written; nothing half-written is left."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    rig = read_rig(request.rig)
    chart = None if request.chart is None else read_chart(request.chart)
    numbers = frame_numbers(request.frames, 1)
    keys = None if request.keys is None else LightKeys.read(request.keys)
    if keys is not None and keys.captured:
        raise RequestError(f"--keys {request.keys}: has captured images, which lamps cannot show: take them out")
    environments = None if request.environment is None else Environments(request.environment, clip_negative=request.clip_negative,
                                                                         spin_degrees=request.spin_degrees)
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
    warnings = tuple(drive_warnings(rig, light, wanted, dilated, factor, environments, judgement.rms - unrounded.rms))
    rate = request.frames_per_second or (None if keys is None else keys.frames_per_second) or FRAMES_PER_SECOND
    sections = report_sections(light, wanted, dilated, quantised, judgement, unrounded, rig, exposure, numbers, shown)
    timings.stage("files", 1)
    for stale in request.out.glob("predicted.[0-9][0-9][0-9][0-9]*.exr"):  # of an earlier run, whose cues go too
        with storage("remove", stale):
            stale.unlink()
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
    return DriveResult(cues, picture, report, len(numbers), exposure, judgement, warnings)


def _title(number: int, beyond: float, radius: float) -> str:
    """Return the title of a frame in the picture: its number, the part `beyond` of its light, and the `radius` of a dilation in radians."""
    return (f"frame {number}" + (f", {beyond:.0%} from beyond the lamps" if beyond > WORTH_SAYING else "")
            + (f", limits spread by {np.degrees(radius):.0f} degrees" if radius > 0 else ""))


def _greatest(wanted: WantedLevels) -> float:
    """Return the exposure at which the brightest primary of all frames is at full level. Raises RequestError if no lamp gives light."""
    most = float(wanted.level.max())
    if most == 0:
        raise RequestError("--auto-exposure: no frame has light")
    return 1 / most


def _check_limits(wanted: WantedLevels, dilated: Dilated, rig: Rig, request: DriveRequest, exposure: float) -> None:
    """Check that the lamps hold the light of every frame.
    Raises RequestError if more than MOST_LEFT of the energy of a frame finds no lamp."""
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


def write_picture(folder: Path, rig: Rig, far: Sequence[FarLight], level: np.ndarray, exposure: np.ndarray, titles: Sequence[str],
                  chart: ChartView | None, review: Review) -> Path:
    """Write the picture into a folder and return its path.
    `level`: [frames, emitters] of `rig.emitters`, 0…1. `exposure`: [frames] factor on the light."""
    shown = np.linspace(0, len(far), min(MOST_ROWS, len(far)), endpoint=False).astype(int)
    rows = [_row(rig, far[index], level[index], exposure[index], titles[index], None if chart is None else chart.picture(index),
                 review)
            for index in shown]
    path = folder / PICTURE_FILE
    write_sheet(path, rows)
    return path


def _row(rig: Rig, light: FarLight, level: np.ndarray, exposure: float, title: str,
         chart: np.ndarray | None, review: Review) -> list[tuple[str, np.ndarray]]:
    energy = lamp_irradiance(level[None], rig)[0]
    normal, on_ball = _ball()
    wanted = far_irradiance(light, normal, SAMPLE_ROWS) * exposure
    given = irradiance_of(rig.directions, energy, normal)
    scale = GREY / max(float(wanted.mean()), np.finfo(float).tiny)
    reflected = 2 * normal[:, 2:] * normal - np.array([0.0, 0.0, 1.0])
    mirrored = np.zeros((len(normal), 3)) if light.environment is None else _looked_up(light, reflected) * exposure
    lamps = np.zeros((len(normal), 3))
    cosine = reflected @ rig.directions.T
    nearest = cosine.argmax(axis=1)
    seen = cosine.max(axis=1) >= LAMP_COSINE
    lamps[seen] = energy[nearest[seen]] / (2 * np.pi * (1 - LAMP_COSINE))

    def ball(values: np.ndarray) -> np.ndarray:
        picture = np.tile(BACKGROUND, (BALL, BALL, 1))
        picture[on_ball] = display((values * scale)[None].astype(np.float32), rig.color_space, review)[0]
        return picture

    tiles = [("mirror ball: environment", ball(mirrored * np.pi)), ("mirror ball: lamps", ball(lamps * np.pi)),
             ("matte ball: environment", ball(wanted)), ("matte ball: lamps", ball(given)),
             (f"{ERROR_SCALE:.0f} x difference", ball(np.abs(given - wanted) * ERROR_SCALE))]
    if chart is not None:
        tiles.append(("chart: environment, within it lamps", display((chart * scale).astype(np.float32), rig.color_space, review)))
    if light.environment is not None:
        step = -(-len(light.environment.radiance) // MAP_ROWS)
        shown = light.environment.radiance[::step, ::step] * (light.gain * exposure * scale * np.pi)
        tiles.insert(0, ("map", display(shown.astype(np.float32), rig.color_space, review)))
    return [(f"{title}: {tiles[0][0]}", tiles[0][1]), *tiles[1:]]


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Return the normals [pixels, 3] of a ball seen from +z, and the pixels [BALL, BALL] bool that show it."""
    across = (2 * np.arange(BALL) + 1) / BALL - 1
    x, y = np.meshgrid(across, -across)
    on_ball = x * x + y * y < 1
    return np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)[on_ball], on_ball


def _looked_up(light: FarLight, towards: np.ndarray) -> np.ndarray:
    """Return the radiance [n, 3] of the turned environment in directions [n, 3]."""
    assert light.environment is not None
    x, y, z = (towards @ light.rotation).T
    rows, columns = light.environment.radiance.shape[:2]
    column = (np.arctan2(x, -z) / (2 * np.pi) % 1 * columns).astype(int) % columns
    row = np.minimum((np.arccos(np.clip(y, -1, 1)) / np.pi * rows).astype(int), rows - 1)
    return light.environment.radiance[row, column].astype(np.float64) * light.gain
