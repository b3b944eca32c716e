"""Checks of a capture under patterns by a sample of its pixels: frames that are declared otherwise than they were shown."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.special import erf

from kernels.device import to_numpy
from kernels.errors import KernelError
from kernels.status import OK, Status
from kernels.structured.decoded import Decoded
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.triangulate import ProjectorModel, triangulate
from service.depth.patterns.codes import choose_decoder
from service.depth.patterns.decoders import AxisDecoder, PatternProjector
from service.depth.patterns.readings import Readings, grey_of
from stage.capture.camera import Camera
from stage.errors import StageError
from stage.patterns.base import Axis, UniformPattern
from stage.patterns.codes import Collected, Pattern, collect
from stage.patterns.kary import KaryCode
from stage.stack.planes import Planes

ROWS = 32
"""Number of image rows in the sample, evenly spread."""
ENOUGH = 300
"""Number of sampled pixels with signal below which nothing is concluded."""
SMOOTH_PART, SMOOTH_SIGMAS = 0.02, 4.0
"""Neighbours agree where their depths differ by less than this part, or this many deviations."""
DOUBTFUL_SHARE = 0.6
"""Share of the pixels with signal that agree with a neighbour, below which other readings of the manifest are tried."""
NOISY_PART = 0.75
"""The same as a part of what the noise of the depths lets agree: ramps in weak light agree at a fifth of the pixels."""
CLEAR_SHARE, CLEAR_TIMES, SURE_SHARE = 0.4, 2.0, 0.9
"""Another reading is named where it makes at least the first share agree, and this many times as many as declared, or the last share:
exchanged levels of a plain code in base 4 leave half of the pixels, as a mirrored image does."""
UNEVEN, LARGEST_STEP = 0.01, 0.05
"""Mean distance of neighbouring pixels in the projector, as a part of its extent, above which other readings are tried, and the distance
that pixels which are farther apart count with."""
MOST_BRIGHTER = 0.9
"""Part of the lit pixels at which black is brighter than white, from which on the two are named as exchanged."""
WHITE_PART = 0.8
"""Least part of the way from the darkest to the brightest reading of a pixel at which white lies: blur dims patterns, and not white."""
AXES: tuple[Axis, Axis] = ("column", "row")
NOT_LIT = (Status.UNSOLVED, Status.SHADOWED, Status.LOW_MODULATION, Status.SATURATED)
"""Statuses of pixels that cannot tell whether the frames are declared rightly."""
FULL_PART = 0.999
"""Part of the largest reading of a sample from which on one may be clipped: corrections of the frames leave clipped ones that even."""
LIT_SIGMAS = 20.0
"""Least difference of the brightest and the darkest reading of a pixel, or of a bit and its inverse, in deviations of a reading, of pixels
that tell whether frames show their patterns."""
LEAST_SIGNAL = 20.0
"""Least white minus black, in deviations of a reading, of pixels whose levels are compared."""


class Sample(NamedTuple):
    """Some rows of the frames."""

    values: np.ndarray  # [frames, channels, pixels] float32
    saturated: np.ndarray | None  # [frames, pixels] bool
    x: np.ndarray  # [rows, cols] float32, line of sight
    y: np.ndarray  # [rows, cols] float32
    mask: np.ndarray  # [rows, cols] bool

    @property
    def grey(self) -> np.ndarray:
        """Return [frames, pixels] float32."""
        return grey_of(self.values)

    def digit_light(self, code: KaryCode) -> np.ndarray:
        """Return [frames, channels, pixels] float32, of what the digits of a code differ in: colours, or one channel of grey."""
        return self.grey[:, None] if code.colors is None else self.values

    @property
    def whole(self) -> np.ndarray:
        """Return [pixels] bool: in the mask and clipped in no frame, neither as marked nor at the largest reading of all: nothing need
        declare where 8-bit files end."""
        bright = self.values.max(axis=(0, 1))
        inside = self.mask.ravel() & (bright < FULL_PART * bright.max(initial=0.0))
        return inside if self.saturated is None else inside & ~self.saturated.any(axis=0)

    def lit(self, grey: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return [pixels] bool: the whole ones that the patterns change by far more than noise, of their readings `grey`."""
        deviation = np.sqrt(noise.variance(grey.max(axis=0)))
        return self.whole & (np.ptp(grey, axis=0) > LIT_SIGMAS * deviation)


def sample_of(planes: Planes, camera: Camera, mask: np.ndarray, rows: np.ndarray | None = None) -> Sample:
    """Return some rows of the frames; None: evenly spread ones."""
    if rows is None:
        rows = np.unique(np.linspace(0, len(mask) - 1, ROWS + 2).astype(int)[1:-1]) if len(mask) > ROWS else np.arange(len(mask))
    x, y = camera.plane_coordinates()
    values = np.concatenate([planes.band(slice(row, row + 1)) for row in rows], axis=2)
    saturated = None if planes.saturated is None else planes.saturated[:, rows].reshape(len(values), -1)
    return Sample(values, saturated, x[rows].astype(np.float32), y[rows].astype(np.float32), mask[rows])


class Reading(NamedTuple):
    """One way to understand the frames."""

    words: str
    """The mistake that would explain it, and what to check."""
    patterns: Callable[[list[Pattern]], list[Pattern]]
    """Returns what the frames would show then."""
    mirrored: bool = False
    """True if the coordinates run from the other border."""


def _changed(**fields: Callable[[Any], Any]) -> Callable[[list[Pattern]], list[Pattern]]:
    """Return a function that changes fields of the patterns that have them, each by a function of its pattern."""
    def change(pattern: Pattern) -> Pattern:
        return pattern.model_copy(update={name: value(pattern) for name, value in fields.items() if hasattr(pattern, name)})

    return lambda patterns: [change(pattern) for pattern in patterns]


def _around(patterns: list[Pattern]) -> list[Pattern]:
    """Return patterns with white and black, which end or begin the sequence, at the other end of it."""
    ends, begins = (all(isinstance(pattern, UniformPattern) for pattern in two) for two in (patterns[-2:], patterns[:2]))
    return [*patterns[-2:], *patterns[:-2]] if ends else [*patterns[2:], *patterns[:2]] if begins else patterns


READINGS = (
    Reading("patterns and inverses are exchanged: check inverse in the frames' patterns",
            _changed(inverse=lambda p: not p.inverse)),
    Reading("columns and rows are exchanged: check axis in the frames' patterns",
            _changed(axis=lambda p: "row" if p.axis == "column" else "column")),
    Reading("the order of bits is reversed: check bit in the frames' patterns (bit 0 is the finest)",
            _changed(bit=lambda p: p.bits - 1 - p.bit)),
    Reading("the order of digits is reversed: check digit in the frames' patterns (digit 0 is the finest)",
            _changed(digit=lambda p: p.digits - 1 - p.digit)),
    Reading("bright and dark levels of the digits are exchanged: check levels in the frames' patterns",
            _changed(levels=lambda p: p.levels and p.levels[::-1])),
    Reading("the steps of the phases run backwards: check step in the frames' patterns",
            _changed(step=lambda p: -p.step % p.steps)),
    Reading("the steps 0 and 1 of the phases are exchanged: check step in the frames' patterns",
            _changed(step=lambda p: (1 - p.step) % p.steps)),
    Reading("the steps 0 and 2 of the phases are exchanged: check step in the frames' patterns",
            _changed(step=lambda p: (2 - p.step) % p.steps)),
    Reading("the images are in reverse order: check image in frames", lambda patterns: patterns[::-1]),
    Reading("each image shows the pattern of the next frame: check image in frames", lambda patterns: [*patterns[1:], patterns[0]]),
    Reading("each image shows the pattern of the frame before: check image in frames", lambda patterns: [patterns[-1], *patterns[:-1]]),
    Reading("the images of white and black are at the other end of the sequence: check image in frames", _around),
    Reading("the projected image is mirrored: check the projector's settings and projector.camera_from_projector", list, True),
)


class Agreement(NamedTuple):
    """How many pixels with signal have a depth that agrees with that of the next pixel of the row."""

    share: float
    """Their part; NaN without enough signal."""
    expected: float = 1.0
    """The part that the noise of right depths would leave, by their deviations."""


def agreement(sample: Sample, patterns: list[Pattern], projector: PatternProjector, model: ProjectorModel, noise: NoiseModel,
              device: str, *, mirrored: bool = False) -> Agreement:
    """Return how far the depths of neighbours agree."""
    collected = collect(list(patterns))
    decoders = [choose_decoder(collected, axis, projector)[0] for axis in ("column", "row")]
    shape = sample.mask.shape
    decoded = [None if decoder is None else decode_sample(sample, decoder, noise, device) for decoder in decoders]
    if mirrored:
        decoded = turned_about(decoded, model, device)
    found = triangulate(sample.x.ravel(), sample.y.ravel(), decoded[0], decoded[1], model, near_m=0.0, far_m=np.inf, max_residual_px=4.0,
                        device=device)
    depth, sigma, status = (to_numpy(array)[:sample.mask.size].reshape(shape) for array in (found.depth, found.sigma, found.status))
    lit = sample.mask & ~np.isin(status, NOT_LIT)
    pairs = lit[:, 1:] & lit[:, :-1]
    if pairs.sum() < ENOUGH:
        return Agreement(float("nan"))
    known = (status == OK) & lit
    known = known[:, 1:] & known[:, :-1]
    step, deviation = np.abs(np.diff(depth, axis=1))[known], np.hypot(sigma[:, 1:], sigma[:, :-1])[known]
    far = depth[:, 1:][known]
    limit = np.maximum(SMOOTH_PART * far, np.minimum(SMOOTH_SIGMAS * deviation, 0.1 * far))
    expected = erf(limit / np.maximum(np.sqrt(2) * deviation, 1e-12))
    return Agreement(float((step <= limit).sum() / pairs.sum()), float(expected.mean()) if expected.size else 1.0)


def turned_about(decoded: list[Decoded | None], model: ProjectorModel, device: str) -> list[Decoded | None]:
    """Return what is decoded as if it ran from the other borders of the projector."""
    return [None if axis is None else axis._replace(coordinate=type(axis.coordinate)(extent - to_numpy(axis.coordinate), device=device))
            for axis, extent in zip(decoded, model.size, strict=True)]


def decode_sample(sample: Sample, decoder: AxisDecoder, noise: NoiseModel, device: str) -> Decoded:
    """Decode the rows of a sample."""
    return decoder.decode(Readings.of(sample.values, sample.saturated, sample.mask.shape[1], decoder.made, device=device), noise)


def _other_readings(patterns: list[Pattern], score: Callable[[list[Pattern], bool], float]) -> Iterator[tuple[float, Reading]]:
    """Yield the score of each other reading of the frames that is one; `score` takes what they would show, and whether it is mirrored."""
    for reading in READINGS:
        try:
            other = reading.patterns(patterns)
            if reading.mirrored or other != patterns:
                found = score(other, reading.mirrored)
                if not np.isnan(found):
                    yield found, reading
        except (StageError, KernelError, ValueError):  # the frames cannot be a code in that reading
            continue


def check_references(sample: Sample, collected: Collected, noise: NoiseModel) -> str | None:
    """Return a sentence if the frame of black is as bright as any and that of white as dark as any, at most of the pixels that any frame
    lights: of images that are a frame late one of the two shows a pattern."""
    if collected.white is None or collected.black is None:
        return None
    low, top = sample.grey.min(axis=0), sample.grey.max(axis=0)
    white, black = ((sample.grey[number] - low) / np.maximum(top - low, 1e-12) for number in (collected.white, collected.black))
    brighter = ((black > WHITE_PART) & (white < 1 - WHITE_PART))[sample.lit(sample.grey, noise)]
    if len(brighter) < ENOUGH or brighter.mean() < MOST_BRIGHTER:
        return None
    return (f"frames: black is brighter than white at {100 * brighter.mean():.0f} % of the lit pixels: exchange the images of the frames "
            "white and black, or, where all images are one frame off, give each its own pattern")


def check_declaration(sample: Sample, patterns: list[Pattern], projector: PatternProjector, model: ProjectorModel, noise: NoiseModel,
                      device: str) -> str | None:
    """Return a sentence if the frames make much more sense when they are understood in another way than the manifest declares."""
    share, expected = agreement(sample, patterns, projector, model, noise, device)
    share = 0.0 if np.isnan(share) else share  # no pixel has signal as declared, as where black and white show patterns
    if share >= min(DOUBTFUL_SHARE, NOISY_PART * expected):
        return None
    readings = _other_readings(patterns, lambda other, mirrored: agreement(sample, other, projector, model, noise, device,
                                                                           mirrored=mirrored).share)
    best, chosen = max(readings, key=lambda found: found[0], default=(0.0, None))
    if chosen is None or best < min(max(CLEAR_SHARE, CLEAR_TIMES * share), SURE_SHARE):
        return None
    return (f"frames: as declared, {100 * share:.0f} % of the pixels with signal agree with their neighbours; {100 * best:.0f} % do if "
            f"{chosen.words}")


def check_unevenness(sample: Sample, patterns: list[Pattern], projector: PatternProjector, noise: NoiseModel, device: str) -> str | None:
    """Return a sentence if the coordinates are far more even when the frames are understood in another way than the manifest declares.

    This tells without any calibration what `check_declaration` tells with it, but for exchanged axes and mirrored images: they are as
    even.
    """
    declared = unevenness(sample, patterns, projector, noise, device)
    if not declared > UNEVEN:
        return None
    readings = _other_readings(patterns, lambda other, mirrored: float("nan") if mirrored else
                               unevenness(sample, other, projector, noise, device))
    best, chosen = min(readings, key=lambda found: found[0], default=(declared, None))
    if chosen is None or best > declared / CLEAR_TIMES:
        return None
    return (f"frames: as declared, neighbouring pixels lie {100 * declared:.2g} % of the projector apart on average; {100 * best:.2g} % if "
            f"{chosen.words}")


def unevenness(sample: Sample, patterns: list[Pattern], projector: PatternProjector, noise: NoiseModel, device: str) -> float:
    """Return how far apart neighbouring pixels of a row lie in the projector, on average, as a part of its extent.

    Pairs that are far apart or not decoded count as LARGEST_STEP, as do pairs without light. NaN without enough of them.
    """
    collected = collect(list(patterns))
    steps = []
    for axis, extent in zip(AXES, projector.resolution, strict=True):
        decoder, _ = choose_decoder(collected, axis, projector)
        if decoder is None:
            continue
        decoded = decode_sample(sample, decoder, noise, device)
        u, status = (to_numpy(array)[:sample.mask.size].reshape(sample.mask.shape) for array in (decoded.coordinate, decoded.status))
        sure = (status == OK)[:, 1:] & (status == OK)[:, :-1]
        pairs = sample.mask[:, 1:] & sample.mask[:, :-1]
        step = np.where(sure, np.minimum(np.abs(np.diff(u, axis=1)) / extent, LARGEST_STEP), LARGEST_STEP)[pairs]
        steps.append(float(step.mean()) if step.size >= ENOUGH else float("nan"))
    return max(steps, default=float("nan"))
