"""Stripes of one frame that lie aside of those of the others, as where a camera drifts or shakes while it takes the sequence.

The edges of stripes divide a surface as evenly as the projector's columns do, whichever frame shows them: an edge lies between those beside
it. Where the edges of a frame lie aside of that, over the whole image, the image has shifted, and a place that one frame numbers is another
one in the next. Frames whose stripes are a few pixels wide tell their shifts to a few hundredths of a pixel. Bits with their inverses add
up to the same picture of the scene, whose texture and outlines tell by how much it has shifted, however fine the stripes are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, median_filter, uniform_filter, uniform_filter1d

from kernels.structured.edges import WHOLE, edge_error_of
from service.depth.patterns.coordinates import AxisMaps, Coordinates
from service.depth.patterns.decoders import AxisDecoder
from service.depth.patterns.levels import contrasts
from service.depth.patterns.pattern_checks import FULL_PART
from service.depth.patterns.readings import line_readings
from stage.capture.manifest import Frame
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode
from stage.spread import MAD_TO_SIGMA
from stage.stack.planes import Planes

LINES = 64
"""Number of image rows, or of image columns, whose edges are compared, evenly spread."""
LEAST_WIDTH = 5.0
"""Least width in camera pixels of the stripes of a frame that is compared: in finer ones an edge is within the blur of the next."""
AROUND = 7
"""Length in pixels of the piece of a line whose median place tells which edge is seen: places at shifted edges are wrong by themselves."""
BESIDE = 3
"""Pixels beside decoded ones whose edges are compared too, as places beside a shifted edge may not be decoded."""
OWN_PART = 0.3
"""Largest distance of an edge from where its frame has one, as a part of the stripe's width."""
FARTHEST = 80.0
"""Largest distance in camera pixels between the edges beside an edge: surfaces bend over longer ones."""
BENT = 3.0
"""Largest ratio of the distance of two edges to that of a usual surface, or its inverse: beyond it they lie on two surfaces."""
ENOUGH = 20.0
"""Least number of edges of a frame that is compared."""
LEAST_SPREAD, MOST_SPREAD = 0.02, 0.3
"""Least and largest standard deviation of an edge of a surface in camera pixels."""
FITTING = 0.55
"""Least mean weight of the edges: it is .7 to .84 under cameras that stand still, .64 where they drift by as much as a stripe is wide, and
less where edges are taken for others."""
ROUNDS = 20
"""Number of rounds in which edges at borders of surfaces lose their weight."""
CLEAR_SIGMAS, OTHERS_SIGMAS, CLEAR_PX = 5.0, 3.0, 0.05
"""By how much the frames must differ in standard deviations, all of them and whichever of them is left out, and in camera pixels then: the
finest alone is shifted by light below surfaces, the coarsest by what moves near its edge."""
BLOCKS, SMOOTHED = 16, 5
"""Groups of lines whose shifts are compared, so that a thing that moves is in fewer than half of them, and length in pixels of the mean
along lines, over which a picture is as good as linear."""
PICTURES_PX = 0.25
"""Least shift of these pictures in camera pixels: encoded images, and dark readings that are cut off at zero, look like .12 of a pixel."""
OVER = 15
"""Side in pixels of the square over which the step of places from pixel to pixel is averaged."""


class FrameShifts(NamedTuple):
    """The shifts of the frames of one code across its stripes."""

    shift: np.ndarray  # [compared frames] camera pixels, of mean 0
    deviation: np.ndarray  # [compared frames] camera pixels
    beside_steps: np.ndarray  # [compared frames] the same where edges may lie beside steps of the surface
    time: np.ndarray  # [compared frames] places in the sequence
    pictures: bool = False
    """Whether pictures of the scene tell them: no light below surfaces shifts one of these."""

    @property
    def clear(self) -> bool:
        """Return whether images have shifted, or edges of wide stripes lie beside steps, as on stairs."""
        return self._differ(self.deviation)

    @property
    def sure(self) -> bool:
        """Return whether images have shifted, whatever steps the surface has."""
        return self.clear and self._differ(self.beside_steps)

    def _differ(self, deviation: np.ndarray) -> bool:
        if self.pictures:
            return bool(np.ptp(self.shift) > PICTURES_PX and self._away(deviation, slice(None)) > CLEAR_SIGMAS)
        others = ~np.eye(len(self.shift), dtype=bool)
        return self._away(deviation, slice(None)) > CLEAR_SIGMAS and all(
            np.ptp(self.shift[kept]) > CLEAR_PX and self._away(deviation, kept) > OTHERS_SIGMAS for kept in others)

    def _away(self, deviation: np.ndarray, kept: np.ndarray | slice) -> float:
        """Return by how many standard deviations some of the shifts differ from their mean, all together."""
        shift, weight = self.shift[kept], 1 / deviation[kept] ** 2
        return float(np.sqrt((weight * (shift - np.average(shift, weights=weight)) ** 2).sum()))

    def over(self, frames: int) -> float:
        """Return by how much an image of a sequence of so many frames may lie aside of the first, as a standard deviation in pixels: by
        the whole drift, and by what is no drift."""
        drift = np.polyfit(self.time, self.shift, 1, w=1 / self.deviation)
        rest = self.shift - np.polyval(drift, self.time)
        return float(np.hypot(drift[0] * (frames - 1), np.sqrt((rest**2).sum() / max(len(rest) - 2, 1))))


def widen_shifted(planes: Planes, coordinates: Coordinates, decoders: Sequence[AxisDecoder | None], collected: Collected,
                  frames: Sequence[Frame]) -> tuple[list[str], np.ndarray]:
    """Add to the deviations of places what shifts of the images make; return what is said of it, and the factor of `Coordinates.widen`."""
    def off(axis: AxisMaps, decoder: AxisDecoder) -> np.ndarray | None:
        across = _across(axis)
        edges = find_shifts(planes, axis, decoder, collected, frames, across)
        pictures = _shifts_of_pictures(planes, axis, collected, across)
        told = [each for each in (edges, pictures) if each is not None and each.clear]
        if not told:
            return None
        coordinates.shift_px = max(coordinates.shift_px, *(float(np.ptp(each.shift)) for each in told if each.sure), 0.0)
        return max(each.over(len(frames)) for each in told) * _slope(axis, across)

    wider = coordinates.widen(decoders, off)
    if not coordinates.shift_px:
        return [], wider
    return [f"frames[]: the stripes of different frames lie up to {coordinates.shift_px:.2g} camera pixels aside of each other, as where "
            "the camera or the whole scene has moved during the sequence, or in fog: the standard deviations hold about what that makes; "
            "keep both still"], wider


def find_shifts(planes: Planes, axis: AxisMaps, decoder: AxisDecoder, collected: Collected, frames: Sequence[Frame],
                across: int) -> FrameShifts | None:
    """Return the shifts of the frames of an axis that show wide stripes, along image columns (`across` 0) or rows (1); None where fewer
    than two frames tell them."""
    code = next((code for code in decoder.used if isinstance(code, BinaryCode | KaryCode)), None)
    if code is None or (isinstance(code, KaryCode) and code.colors is not None):
        return None
    if code.lacks(collected.white, collected.black) is not None:
        return None
    lines = _on_lines(axis, across)
    grey, clipped = line_readings(planes, _even_lines(axis, across), across)
    inverses = code.inverses if isinstance(code, BinaryCode) else None
    contrast = contrasts(grey, code, collected)
    white = np.abs(contrast).max(axis=0) if inverses is not None else grey[collected.white] - grey[collected.black]
    level = 0.5 + 0.5 * contrast / np.maximum(white, 1e-12)
    known = lines.solved if clipped is None else lines.solved & ~clipped
    seen = binary_dilation(known, np.ones((1, 2 * BESIDE + 1), bool))
    near = median_filter(lines.coordinate, (1, AROUND))
    usual = _usual_step(near, known)
    if not usual > 0:
        return None
    number = np.clip(lines.coordinate[known] / code.stripe_px, 0, code.stripe_count - 1).astype(np.int64)
    centre = (np.arange(code.stripe_count) + 0.5) * code.stripe_px
    edges = []
    for index, row in enumerate(code.frames):
        pattern = frames[row].pattern
        assert pattern is not None
        stripes = pattern.level(centre, np.zeros_like(centre), code.stripe_count)
        stripes = _seen_levels(level[index][known], stripes, number)
        edges.append(_edges(level[index], near, seen, stripes, code.stripe_px, usual, index))
    time = np.array(code.frames) if inverses is None else (np.array(code.frames) + np.array(inverses)) / 2
    return _solve(np.concatenate(edges), usual, time)


def _shifts_of_pictures(planes: Planes, axis: AxisMaps, collected: Collected, across: int) -> FrameShifts | None:
    """Return the shifts along lines of what bits and their inverses show together, from its slopes by least squares (Lucas and Kanade,
    1981) beside its brightness, stripes that a lamp leaves which flickers, and their squares, which a camera leaves that is not linear; the
    median over groups of lines. None with too few pixels."""
    pairs = [pair for code in collected.codes if isinstance(code, BinaryCode) and code.inverses is not None
             for pair in zip(code.frames, code.inverses, strict=True)]
    if len(pairs) < 2:
        return None
    grey, clipped = line_readings(planes, _even_lines(axis, across), across)
    full = grey.max(axis=0) >= FULL_PART * grey.max()
    known = ~binary_dilation(full if clipped is None else full | clipped, np.ones((1, SMOOTHED + 2), bool))
    sums, stripes = (uniform_filter1d(np.array([grey[bit] + sign * grey[inverse] for bit, inverse in pairs]), SMOOTHED, axis=2)
                     for sign in (1, -1))
    mean = sums.mean(axis=0)
    slope, square = np.gradient(mean, axis=1), stripes**2 / np.maximum(mean, 1e-9)
    square -= square.mean(axis=0)
    shift = []
    for block in np.array_split(np.arange(len(known)), BLOCKS):
        seen = known[block]
        if seen.sum() >= ENOUGH:
            terms = [np.stack([-slope[block][seen], mean[block][seen], *each], axis=1)
                     for each in zip(stripes[:, block][:, seen], square[:, block][:, seen], strict=True)]
            shift.append([np.linalg.lstsq(term, light - mean[block][seen], rcond=None)[0][0]
                          for term, light in zip(terms, sums[:, block][:, seen], strict=True)])
    if 2 * len(shift) < BLOCKS:
        return None
    middle = np.median(shift, axis=0)
    spread = 1.25 * MAD_TO_SIGMA * float(np.median(np.abs(shift - middle))) / len(shift) ** 0.5  # of a median
    deviation = np.full(len(pairs), max(spread, 1e-6))
    return FrameShifts(middle - middle.mean(), deviation, deviation, np.mean(pairs, axis=1), pictures=True)


def _even_lines(axis: AxisMaps, across: int) -> np.ndarray:
    """Return the numbers of the image columns (`across` 0) or rows (1) that are compared."""
    return np.unique(np.linspace(0, axis.coordinate.shape[1 - across] - 1, LINES + 2).astype(int)[1:-1])


def _on_lines(axis: AxisMaps, across: int) -> AxisMaps:
    """Return the maps of these lines, [lines, length]."""
    lines = _even_lines(axis, across)
    return AxisMaps(*(each[lines] if across == 1 else each[:, lines].T for each in axis))


def _across(axis: AxisMaps) -> int:
    """Return the image axis along which the places change more: 0 along columns, 1 along rows."""
    lines = [_on_lines(axis, across) for across in (0, 1)]
    return int(np.argmax([_usual_step(each.coordinate, each.solved) for each in lines]))


def _usual_step(place: np.ndarray, known: np.ndarray) -> float:
    """Return the usual change of places from pixel to pixel along lines, over a length that single wrong ones do not change much."""
    both = known[:, AROUND:] & known[:, :-AROUND]
    return float(np.median(np.abs(place[:, AROUND:] - place[:, :-AROUND])[both])) / AROUND if both.any() else 0.0


def _slope(axis: AxisMaps, across: int) -> np.ndarray:
    """Return by how many projector pixels places change at a camera pixel, averaged over the pixels around, [rows, cols]."""
    both = axis.solved[1:] & axis.solved[:-1] if across == 0 else axis.solved[:, 1:] & axis.solved[:, :-1]
    step = np.where(both, np.diff(axis.coordinate, axis=across), 0)
    usual = float(np.median(np.abs(step[both])))
    summed, count = (uniform_filter(np.pad(each.astype(np.float32), [(0, 1 - across), (0, across)]), OVER) for each in (step, both))
    return np.where(count > 0.1, np.abs(summed) / np.maximum(count, 0.1), usual)


def _seen_levels(level: np.ndarray, expected: np.ndarray, stripe: np.ndarray) -> np.ndarray:
    """Return the light of each stripe as it is usually seen, in place of that `expected` [stripes]: a projector may bend it, and other
    light be added to it. `level` and `stripe`: of pixels [n]."""
    seen = expected.copy()
    for value in np.unique(expected):
        own = expected[stripe] == value
        if own.any():
            seen[expected == value] = np.median(level[own])
    return seen


def _edges(level: np.ndarray, place: np.ndarray, seen: np.ndarray, expected: np.ndarray, stripe_px: float, usual: float,
           frame: int) -> np.ndarray:
    """Return the edges of one frame whose stripes are wide enough, [edges, 5]: the line, the camera pixel, the projector's, `frame`, and
    whether both pixels at the edge see one stripe alone.

    `level`: light between black (0) and white (1), [lines, length]. `expected`: that of each stripe. `usual`: usual step of places.
    """
    edge = np.flatnonzero(np.diff(expected)) + 1
    gap = np.diff(np.concatenate([[-np.inf], edge * stripe_px, [np.inf]]))
    width = np.minimum(gap[1:], gap[:-1])
    middle, half = (expected[edge] + expected[edge - 1]) / 2, np.abs(expected[edge] - expected[edge - 1]) / 2
    wide = width >= LEAST_WIDTH * usual
    found = [np.zeros((0, 5))]
    for value in np.unique(middle[wide]):
        of = wide & (middle == value)
        at, limit = edge[of] * stripe_px, OWN_PART * np.minimum(width[of], 1e9)
        away = level - value
        line, pixel = np.nonzero((away[:, 1:] * away[:, :-1] < 0) & seen[:, 1:] & seen[:, :-1])
        before, after = away[line, pixel], away[line, pixel + 1]
        there = (place[line, pixel] + place[line, pixel + 1]) / 2
        nearest = np.abs(there[:, None] - at).argmin(axis=1)
        own = np.abs(there - at[nearest]) < limit[nearest]
        whole = np.minimum(np.abs(before), np.abs(after)) >= WHOLE * half[of][nearest]
        found.append(np.stack([line, pixel + before / (before - after), at[nearest], np.full(len(line), frame), whole], axis=1)[own])
    return np.concatenate(found)


def _solve(edges: np.ndarray, usual: float, time: np.ndarray) -> FrameShifts | None:
    """Return the shifts that edges tell, each against those before and after it on its line, by least squares whose weights fall with
    the residual as a Cauchy distribution's (Holland and Welsch, 1977); None where they tell fewer than two, or do not lie on surfaces."""
    edges = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    line, pixel, at, frame, whole_pixels = edges.T
    if len(edges) < 3:
        return None
    run, long = at[2:] - at[:-2], pixel[2:] - pixel[:-2]
    part = np.divide(at[1:-1] - at[:-2], run, out=np.full(len(run), -1.0), where=run != 0)
    straight = long * usual
    even = ((line[2:] == line[:-2]) & (part >= 0) & (part <= 1) & (long < FARTHEST)
            & (straight > np.abs(run) / BENT) & (straight < np.abs(run) * BENT))
    part, long = part[even], long[even]
    here = frame.astype(int)
    design = np.zeros((len(part), len(time) + 1))
    each = np.arange(len(part))
    for place, weight in ((here[1:-1], np.ones_like(part)), (here[:-2], part - 1), (here[2:], -part)):
        np.add.at(design, (each, place[even]), weight)
    design[:, -1] = part * (1 - part) * (long / FARTHEST) ** 2  # a surface that bends
    aside = pixel[1:-1][even] - (1 - part) * pixel[:-2][even] - part * pixel[2:][even]
    told = np.abs(design[:, :-1]).sum(axis=0) >= ENOUGH
    whole = ~design[:, :-1][:, ~told].any(axis=1)
    if told.sum() < 2 or not whole.any():
        return None
    design, aside = design[whole][:, [*np.flatnonzero(told), len(time)]], aside[whole]
    weight, spread, shift = np.ones(len(aside)), LEAST_SPREAD, np.zeros(design.shape[1])
    for _ in range(ROUNDS):
        shift = np.linalg.lstsq(np.sqrt(weight)[:, None] * design, np.sqrt(weight) * aside, rcond=None)[0]
        rest = aside - design @ shift
        spread = float(np.clip(MAD_TO_SIGMA * np.median(np.abs(rest)), LEAST_SPREAD, MOST_SPREAD))
        weight = 1 / (1 + (rest / (2 * spread)) ** 2)
    if weight.mean() < FITTING:
        return None
    deviation = spread * np.sqrt(np.diag(np.linalg.pinv(design.T @ (weight[:, None] * design))))[:-1]
    # an edge of the projector seems to lie elsewhere by where it lies between the pixels, and beside a step or a crease of the surface, and
    # alike on every line that crosses both
    edge, group = np.unique(np.stack([here[1:-1][even][whole], at[1:-1][even][whole]]), axis=1, return_inverse=True)
    places = np.maximum(np.bincount(edge[0].astype(int), minlength=len(time))[told], 1)
    several = np.bincount(group, weight)
    off = np.bincount(group, weight * rest) / several
    beside = np.sqrt(max(float(np.mean(off**2 - spread**2 / several)), 0.0) / places)
    deviation = np.hypot(deviation, edge_error_of(whole_pixels.mean()) / np.sqrt(places))
    return FrameShifts(shift[:-1] - shift[:-1].mean(), deviation, np.hypot(deviation, beside), time[told])
