"""What images of a covered lens and of cards show that they should not: light in the dark, light that falls across a card, and other things
than the card."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from kernels.photometric.model.samples import evenly
from stage.capture.capture import Capture
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import CalibrationError

FRAMES = 8
"""Frames that a dark image is compared with."""
BELOW, BELOW_SIGMAS = 0.01, 5.0
"""By how much a reading is darker than the dark image: as a part of the brighter readings, and in standard deviations of an image."""
BRIGHT = 95.0
"""Percentile of the readings that stands for the brighter ones."""
MOST_BELOW = 0.02
"""Part of the readings that may be darker."""
CELLS = 48
"""Squares across an image whose means are looked at: their noise is little."""
FALL = 0.15
"""Part by which the light on a card may fall from one side of the image to the other; lenses darken all sides alike."""
OFF_MIDDLE, TRIED = 0.15, 9
"""Largest distance of the middle of a lens from that of the image, in halves of the width, and number of places that are tried along it."""
LENS_TERMS = 5
"""Powers of the square of the distance from its middle, from 0 on, that describe the logarithm of the light of a lens."""
SAME = 0.003
"""By how much more one middle may leave than another (RMS) and not be told from it."""
ROUGH = 0.03
"""Root mean square deviation of a card from an even fall and a lens."""
MIXED = 0.05
"""Standard deviation of the colours within the region of a card, as a part of them."""


def check_dark(dark: np.ndarray, noise: float, capture: Capture) -> None:
    """Refuse a dark image, [rows, cols, 3] linear, that frames of the capture are darker than: it has light, or another exposure.
    `noise`: standard deviation of one image. Raises CalibrationError; it names the frame."""
    mask = capture.mask()
    for path, recorded in _frames(capture):
        read = recorded[mask]
        least = max(BELOW * float(np.percentile(read, BRIGHT)), BELOW_SIGMAS * noise)
        below = float((read < dark[mask] - least).mean())
        if below > MOST_BELOW:
            raise CalibrationError(f"{path}: {100 * below:.0f} % of its readings are darker than the dark image: "
                                   "cover the lens, and take it at the exposure of the frames")


def _frames(capture: Capture) -> Iterator[tuple[Path, np.ndarray]]:
    """Yield the files of some frames of a capture and their linear readings, [rows, cols, 3]."""
    names = [frame.image for frame in capture.manifest.frames if not frame.image.endswith(".npy")]
    for number in evenly(len(names), FRAMES):
        yield capture.file(names[number]), linearise(capture.recorded(names[number]), capture.manifest.color_space)


def brightness(capture: Capture) -> float:
    """Return the brighter readings of the brightest of some frames of a capture, linear."""
    mask = capture.mask()
    return max((float(np.percentile(read[mask], BRIGHT)) for _, read in _frames(capture)), default=np.inf)


def check_alike(paths: Sequence[Path], levels: np.ndarray, light: float) -> None:
    """Refuse dark images of which some have light in them and others none, which the mean of all hides in its noise.
    `levels`: [images] the mean reading of each, linear. `light`: the brighter readings of what is corrected by them. Raises
    CalibrationError; it names the image."""
    over = float(levels.max() - levels.min())
    if over > BELOW * light:
        raise CalibrationError(f"{paths[int(levels.argmax())]}: is brighter than {paths[int(levels.argmin())].name} by "
                               f"{100 * over / light:.1f} % of the light of the frames: cover the lens in all dark images, and take them "
                               "at one exposure")


def card_faults(card: np.ndarray, mask: np.ndarray) -> tuple[str, ...]:
    """Return sentences about a card that should be white everywhere in the mask [rows, cols]: its light falls from one side to the other,
    or something else is seen. `card`: [rows, cols, 3] linear."""
    height, width = mask.shape
    grey = np.where(mask, card @ np.array(GREY_WEIGHTS), 0.0)
    side = max(height, width) / CELLS
    v, u = np.nonzero(mask & (grey > 0))
    cell = (v // side).astype(int) * CELLS + (u // side).astype(int)
    count = np.bincount(cell, minlength=CELLS * CELLS)
    known = np.flatnonzero(count)
    light, x, y = (np.bincount(cell, values, CELLS * CELLS)[known] / count[known]
                   for values in (grey[v, u], 2 * (u + 0.5) / width - 1, 2 * (v + 0.5) / height - 1))
    fits = [_lens_fit(x, y * height / width, middle, np.log(light), count[known]) for middle in _middles()]
    rough = min(fit[1] for fit in fits)
    fall = min(fit[0] for fit in fits if fit[1] <= rough + SAME)
    faults = []
    if fall > FALL:
        faults.append(f"the light on the card falls by {100 * fall:.0f} % from one side of the image to the other, which no lens makes: "
                      "light it evenly, or once from either side, and give both images")
    if rough > ROUGH:
        faults.append(f"the card is uneven by {100 * rough:.1f} % (RMS) beside what a lens makes: let a plain card fill the images, "
                      "without shadows, and out of focus")
    return tuple(faults)


def _middles() -> Iterator[tuple[float, float]]:
    """Yield the places that are tried for the middle of a lens, from that of the image, in halves of its width."""
    for x, y in product(np.linspace(-OFF_MIDDLE, OFF_MIDDLE, TRIED), repeat=2):
        if np.hypot(x, y) <= OFF_MIDDLE + 1e-9:
            yield float(x), float(y)


def _lens_fit(x: np.ndarray, y: np.ndarray, middle: tuple[float, float], level: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return the part by which the light of cells falls across them beside a lens, and the root mean square of what both leave.
    `x, y`: [cells] in halves of the width. `level`: [cells] logarithm of the light. `weight`: [cells] number of pixels."""
    across = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
    design = np.column_stack([x, y, *(across / max(across.max(), 1e-9)) ** np.arange(LENS_TERMS)[:, None]])
    values = np.linalg.lstsq(design * np.sqrt(weight)[:, None], level * np.sqrt(weight))[0]
    rough = float(np.sqrt(np.average((level - design @ values) ** 2, weights=weight)))
    return 1 - float(np.exp(-np.ptp(design[:, :2] @ values[:2]))), rough


def mixed_colours(region: np.ndarray) -> float | None:
    """Return by how much the colours within a region [rows, cols, 3] differ, as a part of them; None if they are those of one card."""
    rows, cols = (max(extent // CELLS, 1) for extent in region.shape[:2])
    cut = region[:region.shape[0] // rows * rows, :region.shape[1] // cols * cols]
    cells = cut.reshape(cut.shape[0] // rows, rows, cut.shape[1] // cols, cols, 3).mean(axis=(1, 3)).reshape(-1, 3)
    lit = cells[(cells > 0).all(axis=1)]
    colours = lit / lit.sum(axis=1, keepdims=True) if len(lit) else np.ones((1, 3))
    spread = float((colours.std(axis=0) / colours.mean(axis=0)).max())
    return spread if spread > MIXED else None
