"""A light meter before a capture: how much of the object several lamps clip, how sharp it is, and the exposure time to take."""

import json
import time
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from service.acquisition.cameras.camera import Camera, NoPictureError, Setup, open_camera
from service.acquisition.capture_files import JOURNAL_FILE
from service.acquisition.checks.judge import FULL_SCALE
from service.acquisition.checks.motion import bands_of
from service.acquisition.checks.picture_sample import TILE_PX, place_of_tile, stride
from service.acquisition.lights.lights import Ask, Lights
from service.acquisition.plans.plan import read_plan
from service.acquisition.plans.shots import Shot, shots_of
from service.errors import RequestError
from service.light_estimation.lit_object import OBJECT_PART
from service.relight.sheet import AS_EVER, BACKGROUND, TILE, display, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.acquire import AcquireRequest
from stage.colour.colour import linearise
from stage.colour.colour_spaces import Review, linear_space
from stage.files import write_text
from stage.importers.layout import color_space_of
from stage.rig.rig import Rig, read_rig

METER_FILE, PICTURE_FILE = "meter.json", "meter.png"
METERED = 9
"""The most lamps that are metered, spread over the dome."""
SHARE = 1e-3
"""The share of the object that the brightest lamp may clip."""
TARGET = 0.9
"""The part of full scale at which the brightest reading of the rest is put: noise adds some."""
STEP = 2 ** (1 / 3)
"""The steps of exposure times, thirds of a stop, as cameras have them."""
ROUNDED = 1.1
"""A time that the camera offers may be longer than a proposed one by this factor, of which TARGET leaves as much: cameras round."""
SHORTER = 1 / 4
"""The exposure over the one before, where the picture clips so much that nothing says how bright the object is."""
MOST_PICTURES = 6
"""The most pictures of one lamp."""
MOST_PIXELS = 1_000_000
"""The most pixels of a picture that are metered, evenly spread."""
STRIPE_PX = 4
BINS = 64


class Reading(NamedTuple):
    """The reading of a picture of one lamp."""

    shot: str
    lamp: str
    exposure_s: float | None
    """None: the camera has not told it."""
    clipped: float
    """The share of the object at full scale."""
    bright: float
    """What all of the object but a thousandth reads at the most, linear, full scale 1."""
    focus: float
    """The contrast of the finest details over that of coarser ones."""


class Metered(NamedTuple):
    """The result of metering."""

    readings: tuple[Reading, ...]
    brightest: Reading
    factor: float
    """The proposed exposure over that of the readings; where the brightest clips and the camera cannot be set, only an upper limit."""
    exposure_s: float | None
    """The proposed exposure time; None: the time of the readings is not known."""
    sure: bool
    """False: the brightest picture clips, and must be metered again with the proposed exposure."""
    clipped: float | None
    """The share of the object that clips at the proposed exposure; None: no picture was taken with it."""
    path: Path
    picture: Path


class _Taken(NamedTuple):
    shot: Shot
    pixels: np.ndarray  # [rows, cols, 3] float32 recorded, thinned out
    tile: np.ndarray  # [rows, cols] float32 linear


def meter(request: AcquireRequest, ask: Ask, progress: Progress | None = None) -> Metered:
    """Take pictures of some lamps, propose an exposure, and write meter.json and meter.png; the lamps are dark at the end.

    A camera whose exposure time can be set, and is known, is left at the proposed one, and a picture with it has been judged.
    Raises RequestError if the plan has no picture under lamps, the capture has begun, or lamps or camera do not answer. Raises StageError
    if the plan or the rig is wrong; names file and field."""
    if (request.out / JOURNAL_FILE).exists():
        raise RequestError(f"--preview: {request.out} has pictures of a capture already: give another folder to --out")
    rig = None if request.rig is None else read_rig(request.rig)
    shots = () if rig is None else _spread(shots_of(read_plan(request.plan), rig, request.projector), rig)
    if rig is None or not shots:
        raise RequestError("--preview: the plan has no picture of the object under lamps: meter one such as olat, with --rig")
    setup = Setup.of(request, None)
    with closing(open_camera(request.camera, setup)) as camera, closing(Lights(request.rig or Path(), rig, ask)) as lights:
        return _Meter(request, rig, camera, lights).run(shots, Timings(progress))


def _spread(shots: tuple[Shot, ...], rig: Rig) -> list[Shot]:
    """Return a shot of each of some lamps: the one next to the camera, the strongest one, and those farthest from all before."""
    alone = list({shot.lamp: shot for shot in reversed(shots) if shot.lamp is not None and not shot.folder}.values())
    if not alone:
        return [shot for shot in shots if shot.levels.any() and not shot.folder][-1:]
    directions = rig.directions[[shot.lamp for shot in alone]]
    power = [float(np.sum([primary.irradiance for primary in rig.lights[shot.lamp or 0].primaries])) for shot in alone]
    chosen = list(dict.fromkeys([int(directions[:, 2].argmax()), int(np.argmax(power))]))
    while len(chosen) < min(METERED, len(alone)):
        nearest = (directions @ directions[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return [alone[index] for index in chosen]


class _Meter:
    def __init__(self, request: AcquireRequest, rig: Rig, camera: Camera, lights: Lights) -> None:
        self._request, self._rig, self._camera, self._lights = request, rig, camera, lights
        self._settle = read_plan(request.plan).settle_s
        self._full = request.saturation or FULL_SCALE
        self._space, self._place = "", (0, 0)

    def run(self, shots: list[Shot], timings: Timings) -> Metered:
        """Meter shots; all of one exposure."""
        first = shots[0].exposure_s or self._camera.exposure_s
        timings.stage("meter", len(shots))
        taken = []
        for number, shot in enumerate(shots, start=1):
            taken.append(self._take(shot, shot.exposure_s))
            timings.advance(number)
        brightest_of_all = np.max([linearise(each.pixels, self._space).max(axis=2) for each in taken], axis=0)
        seen = brightest_of_all > OBJECT_PART * np.quantile(brightest_of_all, 1 - SHARE)
        readings = [self._reading(each, seen, first) for each in taken]
        index = max(range(len(readings)), key=lambda each: (readings[each].clipped >= SHARE, readings[each].clipped, readings[each].bright))
        found, factor, sure, clipped = readings[index], 1.0, True, None
        if found.clipped >= SHARE and first is not None:
            candidates = [each.shot for each, reading in zip(taken, readings, strict=True) if reading.clipped >= SHARE]
            factor, found = min((self._unclipped(shot, seen, first) for shot in candidates), key=lambda each: each[0] / each[1].bright)
        sure = found.clipped < SHARE
        target = TARGET * float(linearise(np.full((1, 1, 3), min(self._full, 1.0), np.float32), self._space).max())
        factor *= _thirds(target / max(found.bright, 1e-6)) if sure else SHORTER
        proposed = None if first is None else self._offered(first * factor)
        if sure and proposed is not None and first is not None:
            shot = next(each.shot for each in taken if each.shot.key == found.shot)
            for _ in range(MOST_PICTURES):
                clipped = self._reading(self._take(shot, proposed), seen, proposed).clipped
                if clipped < SHARE:
                    break
                proposed = self._offered(proposed / STEP)
            factor = proposed / first
        out = self._request.out
        result = Metered(tuple(readings), found, factor, proposed, sure, clipped, out / METER_FILE, out / PICTURE_FILE)
        timings.stage("write", 1)
        self._write(result, taken, seen, index)
        timings.close()
        return result

    def _unclipped(self, shot: Shot, seen: np.ndarray, exposure: float) -> tuple[float, Reading]:
        """Return a reading of a shot that clips no more, and its exposure over the first one."""
        shorter = exposure
        for _ in range(MOST_PICTURES):
            shorter = self._offered(shorter * SHORTER)
            reading = self._reading(self._take(shot, shorter), seen, shorter)
            if reading.clipped < SHARE:
                break
        return shorter / exposure, reading

    def _offered(self, exposure: float) -> float:
        """Return the longest exposure time of the camera that is hardly longer than one, its shortest if all are longer; where it does not
        tell its times, the one itself."""
        times = self._camera.exposures_s
        return max((time for time in times if time <= ROUNDED * exposure), default=min(times, default=exposure))

    def _take(self, shot: Shot, exposure: float | None) -> _Taken:
        self._lights.set(shot.levels)
        time.sleep(self._settle)
        try:
            picture = self._camera.take(exposure)
        except NoPictureError as error:
            raise RequestError(f"--preview: {error}") from error
        if not self._space:
            self._space, self._place = self._request.color_space or color_space_of(picture.path), place_of_tile(picture.pixels)
        row, column = self._place
        step = stride(picture.pixels.shape, MOST_PIXELS)
        tile = linearise(picture.pixels[row:row + TILE_PX, column:column + TILE_PX].astype(np.float32), self._space).mean(axis=2)
        return _Taken(shot, np.ascontiguousarray(picture.pixels[::step, ::step], dtype=np.float32), tile)

    def _reading(self, taken: _Taken, seen: np.ndarray, exposure: float | None) -> Reading:
        recorded = taken.pixels.max(axis=2)[seen]
        bright = float(np.quantile(linearise(taken.pixels, self._space).max(axis=2)[seen], 1 - SHARE))
        lamp = "all" if taken.shot.lamp is None else self._rig.lights[taken.shot.lamp].name
        return Reading(taken.shot.key, lamp, exposure, float((recorded >= self._full).mean()), bright, focus_of(taken.tile))

    def _write(self, result: Metered, taken: list[_Taken], seen: np.ndarray, brightest: int) -> None:
        counts = np.histogram(taken[brightest].pixels.max(axis=2)[seen], bins=BINS, range=(0, 1))[0]
        across = 3
        review = self._request.review
        tiles = [(f"{reading.lamp}: {100 * reading.clipped:.3g} % clipped", zebra(each.pixels, self._space, self._full, review))
                 for each, reading in zip(taken, result.readings, strict=True)]
        tiles.append((f"readings under {result.readings[brightest].lamp}", bars(counts, TILE, 4 * BINS)))
        write_sheet(result.picture, [tiles[begin:begin + across] for begin in range(0, len(tiles), across)])
        proposed = {"factor": result.factor, "exposure_s": result.exposure_s, "sure": result.sure, "clipped": result.clipped}
        write_text(result.path, json.dumps({
            "schema": "relit.meter/1", "proposed": proposed, "brightest": result.brightest._asdict(),
            "histogram": counts.tolist(), "readings": [reading._asdict() for reading in result.readings],
            "camera_settings": self._camera.settings}, indent=1) + "\n")


def zebra(pixels: np.ndarray, space: str, full: float, review: Review = AS_EVER) -> np.ndarray:
    """Return a picture as it is displayed, [rows, cols, 3], with stripes where a channel is at full scale."""
    step = max(1, len(pixels) // TILE)
    clipped = ndimage.maximum_filter(pixels.max(axis=2) >= full, step)[::step, ::step]
    shown = display(linearise(np.ascontiguousarray(pixels[::step, ::step]), space), linear_space(space), review)
    stripe = (np.add(*np.indices(clipped.shape)) // STRIPE_PX) % 2 == 0
    shown[clipped & stripe] = (1.0, 0.1, 0.1)
    return shown


def focus_of(tile: np.ndarray) -> float:
    """Return the contrast of the finest details of a tile, [rows, cols] linear, over that of coarser ones."""
    fine, coarse, _ = (float(band.std()) for band in bands_of(tile))
    return fine / max(coarse, 1e-12)


def _thirds(factor: float) -> float:
    """Return a factor of exposures, rounded down to thirds of a stop."""
    return float(STEP ** np.floor(np.log(factor) / np.log(STEP) + 1e-9))


def bars(counts: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Return a histogram as a picture, [rows, cols, 3], the last bin red; heights are the square roots of counts."""
    bin_of: np.ndarray = np.arange(cols) * len(counts) // cols
    lit = np.arange(rows)[::-1, None] < rows * np.sqrt(counts / max(1, counts.max()))[bin_of]
    shown = np.where(lit[..., None], np.float32(0.8), BACKGROUND)
    shown[lit & (bin_of == len(counts) - 1)] = (1.0, 0.1, 0.1)
    return shown
