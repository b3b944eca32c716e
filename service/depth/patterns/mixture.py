"""Pixels that see two surfaces at once, at thin things and silhouettes: the phase of a wave is a mixture there, of neither.

Stripes of a Gray or binary code tell such pixels. At an edge one bit of a Gray code lies between dark and bright; where the stripes of two
surfaces are mixed, every bit by which their numbers differ does, by the part of the light that comes from either. Several periods
contradict each other there; a single one, numbered by stripes, does not, and its place is off by what the smaller part turns the phase.

At a step that moves places by less than a period no wave contradicts another: the place lies between those to which the surfaces on both
sides lead, and may be off by its distance from the nearer one.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.coordinates import AxisMaps, Coordinates
from service.depth.patterns.decoders import AxisDecoder
from service.depth.patterns.levels import contrasts
from service.depth.patterns.readings import grey_of
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode
from stage.patterns.phase import PhaseCode
from stage.stack.planes import Planes

LEAST_BITS = 3
"""Least number of bits whose stripes are at least half as wide as the period: two of them may differ between the surfaces."""
CLEAR_SIGMAS = 3.0
"""Standard deviations by which a bit must lie below the usual ones, so that a part is not one of noise."""
TURN = 0.9
"""Standard deviation of a phase to which a part f of the light, over the rest, adds another phase, times f / (1 - f): between small parts,
where it is .71, and halves of any two phases, where it is .91."""
STEP_SIGMAS = 4.0
"""Standard deviations of the noise by which the places to which the neighbours on both sides lead must differ, so that there is a step."""
BYTES_PER_PIXEL = 400
"""Memory that this takes for each pixel of a band."""


def widen_mixed(planes: Planes, coordinates: Coordinates, decoders: Sequence[AxisDecoder | None], collected: Collected,
                noise: NoiseModel) -> np.ndarray:
    """Add to the deviations of places what a second surface in the pixel may make; return the factor of `Coordinates.widen`."""
    def off(axis: AxisMaps, decoder: AxisDecoder) -> np.ndarray | None:
        turned = _turned(planes, axis, decoder, collected, noise)
        if all(isinstance(code, BinaryCode | KaryCode) for code in decoder.used):
            return turned
        return np.maximum(0 if turned is None else turned, np.maximum(_between(axis, 0), _between(axis, 1)))

    return coordinates.widen(decoders, off)


def _between(axis: AxisMaps, along: int) -> np.ndarray:
    """Return how far the places of pixels lie from the nearer one to which the neighbours before and behind them along an image axis lead,
    [rows, cols] projector pixels; 0 where they do not lie clearly between."""
    place, off = axis.coordinate, np.zeros_like(axis.coordinate)
    known = np.pad(axis.solved, 3)  # so that the other border of the image is no neighbour

    def led(side: int, near: int) -> np.ndarray:
        first, second = (np.roll(place, side * far, along) for far in (near, near + 1))
        there = known & np.roll(known, side * near, along) & np.roll(known, side * (near + 1), along)
        return np.where(there[3:-3, 3:-3], place - first - near * (first - second), 0)

    for before, behind in product((1, 2), (1, 2)):  # the next pixel may see both surfaces too
        leads = led(1, before), led(-1, behind)
        noise = axis.sigma * np.sqrt(sum((1 + near)**2 + near**2 for near in (before, behind)))
        step = (leads[0] * leads[1] < 0) & (np.abs(leads[0] - leads[1]) > STEP_SIGMAS * noise)
        off = np.maximum(off, np.where(step, np.minimum(np.abs(leads[0]), np.abs(leads[1])), 0))
    return off


def _turned(planes: Planes, axis: AxisMaps, decoder: AxisDecoder, collected: Collected, noise: NoiseModel) -> np.ndarray | None:
    """Return by how much a second surface may turn the place of each pixel, [rows, cols] projector pixels; None where the code cannot
    tell."""
    phase = next((code for code in decoder.used if isinstance(code, PhaseCode)), None)
    stripes = next((code for code in decoder.used if isinstance(code, BinaryCode) and code.name != "xor"), None)
    if phase is None or stripes is None or len(set(phase.periods_px)) > 1:
        return None
    coarse = [bit for bit in range(len(stripes.frames)) if 2 * stripes.stripe_px * 2**bit >= phase.periods_px[0]]
    if len(coarse) < LEAST_BITS or stripes.lacks(collected.white, collected.black) is not None or not axis.solved.any():
        return None
    second, deviation = np.zeros_like(axis.coordinate), np.zeros_like(axis.coordinate)
    for band in planes.bands(BYTES_PER_PIXEL):
        grey = grey_of(planes.band(band))
        second[band], deviation[band] = (each.reshape(-1, second.shape[1]) for each in _second_bit(grey, stripes, coarse, collected, noise))
    usual = float(np.median(second[axis.solved]))
    clear = axis.solved & (usual - second > CLEAR_SIGMAS * deviation)
    part = np.where(clear, np.clip((usual - second) / (2 * max(usual, 1e-6)), 0, 0.5), 0).astype(np.float32)  # of the light, from there
    return np.asarray(TURN * part / (1 - part) * phase.periods_px[0] / (2 * np.pi))


def _second_bit(grey: np.ndarray, stripes: BinaryCode, coarse: Sequence[int], collected: Collected,
                noise: NoiseModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the second-smallest difference of coarse bits over the contrast, and its standard deviation, [pixels], of readings
    [frames, pixels]."""
    bits = grey[[stripes.frames[bit] for bit in coarse]]
    away = np.abs(contrasts(grey, stripes, collected)[list(coarse)])
    contrast, times = (away.max(axis=0), 2.0) if stripes.inverses is not None else (grey[collected.white] - grey[collected.black], 6.0)
    contrast = np.maximum(contrast, 1e-9)
    deviation = np.sqrt(times * noise.variance(bits.max(axis=0))) / contrast
    return np.partition(away, 1, axis=0)[1] / contrast, deviation
