"""Faults of frequencies with three images, which any wave fits: an image that shows nothing or is shown twice, exchanged ones, and one of
another brightness.

The first two show in the images. The others show where several frequencies disagree: the images are read otherwise, and agree.
"""

from collections.abc import Iterator
from itertools import permutations

import numpy as np

from kernels.tof.continuous.continuous import LEAST_PHASES, weights
from service.depth.tof.phase_checks import ENOUGH, Phases
from stage.tof.raw_frames import CorrelationImages

CHANCE, SHOWN = 4.0, 10.0
"""Standard errors within which means and correlations are those of noise, and how many times as large as noise another image of the
frequency must be."""
LEAST_FACTOR, MOST_FACTOR = 1.05, 20.0
"""Factors of the brightness of one image that are tried."""


def lost_images(frames: CorrelationImages, usable: np.ndarray) -> str | None:
    """Return that an image of a frequency with three shows nothing, or what another shows but for noise, as a sentence; None where none
    does, or fewer than ENOUGH pixels tell it. `usable`: [rows · cols] bool."""
    for hz, own in _threes(frames) if usable.sum() >= ENOUGH else ():
        shown = frames.images[own][:, usable].astype(np.float64) * frames.scale[own, None]
        for k, (i, j) in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1))):
            last, one, other = shown[[k, i, j]]
            apart, where = one - other, f"frames[].tof: the image of {hz / 1e6:g} MHz at "
            if np.ptp(last) == 0 < min(np.ptp(one), np.ptp(other)):
                return f"{where}{_degrees(frames, own[k])} has one reading at all pixels: check image; no range is believed"
            if abs(apart.mean()) <= CHANCE * apart.std() / np.sqrt(apart.size) and _noise_beside(
                    apart, last, one + other, float(np.sqrt(((last - one) ** 2).mean()))):
                return (f"{where}{_degrees(frames, own[j])} shows what that at {_degrees(frames, own[i])} shows, but for noise: check "
                        "image and reference_phase_rad; no range is believed")
    return None


def _noise_beside(values: np.ndarray, one: np.ndarray, other: np.ndarray, size: float) -> bool:
    """Return whether values vary by far less than a size, and not with either of two images."""
    spread = float(values.std())
    return SHOWN * spread < size and all(abs(float(((values - values.mean()) * (image - image.mean())).mean()))
                                         <= CHANCE * spread * float(image.std()) / np.sqrt(values.size) for image in (one, other))


def other_images(frames: CorrelationImages, phases: Phases) -> Iterator[tuple[Phases, str]]:
    """Yield other ways to read three images of a frequency, and what to check."""
    rows, frequencies, index = weights(frames.modulation_hz, frames.reference_phase_rad, frames.scale)
    offsets = np.array([rows[index == number, 0] @ frames.images[index == number] for number in range(len(frequencies))])
    for hz, own in _threes(frames):
        number = int(np.searchsorted(frequencies, hz))
        at = ", ".join(_degrees(frames, k) for k in own)
        for order in list(permutations(range(3)))[1:]:
            yield (_decoded(phases, number, rows[own], frames.images[own[list(order)]]),
                   f"the images of {hz / 1e6:g} MHz at {at} are in the order {', '.join(str(k + 1) for k in order)}: check their order")
        others = np.median(np.delete(offsets, number, axis=0), axis=0)
        for k in own:
            part = rows[k, 0] * frames.images[k]
            lit = part > 0
            factor = 1 + float(np.median((others - offsets[number])[lit] / part[lit])) if lit.any() else 1.0
            if LEAST_FACTOR < max(factor, 1 / max(factor, 1e-9)) < MOST_FACTOR:
                images = frames.images[own] * np.where(own == k, factor, 1.0)[:, None]
                yield (_decoded(phases, number, rows[own], images),
                       f"the image of {hz / 1e6:g} MHz at {_degrees(frames, k)} is {1 / factor:.2g} times as bright as the others: check "
                       "its exposure")


def _decoded(phases: Phases, number: int, rows: np.ndarray, images: np.ndarray) -> Phases:
    """Return phases of which those of one frequency are what `rows` of `weights` make of other images, [3, pixels]."""
    _, cosine, sine = rows.T @ images
    phase = phases.phase.copy()
    phase[number] = (np.arctan2(sine, cosine) % (2 * np.pi)).reshape(phase.shape[1:])
    return phases._replace(phase=phase)


def _threes(frames: CorrelationImages) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the frequencies that have three images, and the indices of these."""
    for hz in np.unique(frames.modulation_hz):
        own = np.flatnonzero(frames.modulation_hz == hz)
        if len(own) == LEAST_PHASES:
            yield float(hz), own


def _degrees(frames: CorrelationImages, image: int) -> str:
    return f"{np.degrees(frames.reference_phase_rad[image]) % 360:.3g}°"
