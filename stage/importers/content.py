"""Tells from their pixels alone what the images of a folder show: stripes of a code, waves, masks, an object under changing light.

Images are compared at a few thousand pixels, along rows and columns. Nothing is decoded here: the counts, contrasts and orders of the
images are what `relit import gray` and `photos` ask for.
"""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.formats import images
from stage.importers.folder import tried
from stage.importers.layout import image_resolution

LINES = 48
"""Rows, and columns, of an image that are read for its stripes."""
SAMPLE = 4000
"""Pixels of an image that are compared."""
CONTRAST = 0.08
"""Least difference of the brightest and darkest reading of a pixel, over the brightest of the object, at which a projector lights it."""
INVERSE = -0.8
"""Largest correlation, over the pixels, of an image and its inverse, each less the mean of all."""
TWO_LEVELS = 0.8
"""Least part of the lit pixels, of the middle one of the images of stripes, within a quarter of the range from one of two levels: the
finest stripes of a code are blurred."""
EVEN = 0.05
"""Largest difference of images relative to the range, over the lit pixels, at which one is white or black everywhere."""
SMOOTH = 0.2
"""Largest part of the differences of images of an object under lights that three images do not explain: gloss and shadows leave 0.1."""
LEAST_LIT = 200
"""Least count of pixels that must be lit for stripes to be told."""

BESIDE = 2
"""Pixels on either side of an edge at which other stripes are looked at."""
WIDE = 8
"""Least mean width of the finer stripes, in pixels, that are compared with the coarser ones."""

PAIRED, UNLIKE = 0.15, 0.3
"""Largest difference of the sums of images and their inverses, over their median: encoded images of blurred stripes add up to an eighth
more than those of sharp ones; and least median of their differences over their sums, of projectors that are brighter than the room."""
FEWER_STEPS = 0.7
"""Part of the steps between neighbouring stripes that are left where inverses are taken for the patterns, from which on they are these."""


class Stripes(NamedTuple):
    """A Gray code, or a binary one, in the order of the images."""

    sequence: tuple[str, ...]
    """What the images show: columns, rows, white and black."""
    inverses: str
    """pairs, first, blocks or none, as of `GrayStack`."""
    fine_first: bool
    column_bits: int
    row_bits: int
    binary: bool
    """Whether edges of coarse stripes are edges of all finer ones, as in a binary code; in a Gray code no edges coincide."""


class Pictures:
    """The images of a folder that have one size, at a sample of their pixels."""

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        """Read the headers; pixels are read when they are asked for."""
        sizes = {name: tried(partial(image_resolution, folder / name)) for name in names}
        known = [size for size in sizes.values() if size is not None]
        self.size = max(set(known), key=lambda size: (known.count(size), size)) if known else None
        """Width and height of most images; of as many small ones, as previews are, and large ones those of the latter."""
        self.names = tuple(name for name in names if self.size is not None and sizes[name] == self.size)
        self.others = tuple(name for name in names if name not in self.names)
        """Images of another size, or that cannot be read."""
        self._folder = folder
        self._read: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def _lines(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return some whole rows [images, lines, cols], some whole columns [images, lines, rows] and a sample [images, pixels]."""
        if self._read is None:
            across, down, sample = [], [], []
            for name in self.names:
                grey = images.read_pixels(self._folder / name).astype(np.float32).mean(axis=-1)
                rows, cols = (np.linspace(0, side - 1, min(side, LINES + 2)).astype(int)[1:-1] for side in grey.shape)
                across.append(grey[rows])
                down.append(grey[:, cols].T)
                sample.append(grey.ravel()[:: max(1, grey.size // SAMPLE)])
            self._read = np.stack(across), np.stack(down), np.stack(sample)
        return self._read

    def steady_sums(self, names: Sequence[str], count: int, part: float) -> bool:
        """Return whether the sums of each so many of these images are alike, to a part of their median, over more than one of them."""
        at = [self.names.index(name) for name in names if name in self.names]
        if len(at) < 2 * count:
            return False
        sample = self._lines()[2][at]
        sums = sample[: len(at) // count * count].reshape(-1, count, sample.shape[1]).sum(axis=1)
        lit = self._lit()
        sums = sums[..., lit] if lit.sum() >= LEAST_LIT else sums
        scale = float(np.median(sums[0]))
        return scale > 0 and bool((np.median(np.abs(sums[1:] - sums[0]), axis=1) <= part * scale).all())

    def inverses_in_pairs(self, names: Sequence[str]) -> bool:
        """Return whether each second of these images looks like the inverse of the one before: their sums are alike, and they are not."""
        if len(names) < 4 or not self.steady_sums(names, 2, PAIRED):
            return False
        sample = self._lines()[2][[self.names.index(name) for name in names]][:, self._lit()]
        one, other = sample[: len(names) // 2 * 2 : 2], sample[1::2]
        return float(np.median(np.abs(one - other) / np.maximum(one + other, 1e-12))) > UNLIKE

    def _lit(self) -> np.ndarray:
        """Return where the images change by far more than noise, [pixels] of the sample, bool."""
        sample = self._lines()[2]
        top = sample.max(axis=0)
        return np.asarray(top - sample.min(axis=0) > CONTRAST * np.percentile(top, 99))

    def inverse_first(self, columns: Sequence[tuple[int, int]], rows: Sequence[tuple[int, int]]) -> bool:
        """Return whether the second images of pairs are the patterns of a Gray code, and the first ones their inverses: neighbouring
        stripes then follow each other. `columns`, `rows`: the images of each pair, from coarse to fine."""
        steps = np.zeros(2)
        for lines, pairs in zip(self._lines()[:2], (columns, rows), strict=True):
            steps += _steps(lines, pairs, float(lines.max()) * CONTRAST)
        return bool(steps[1] < FEWER_STEPS * steps[0])

    def brighter(self, first: str, second: str) -> bool:
        """Return whether one image is brighter than another over what is lit."""
        one, other = (self._lines()[2][self.names.index(name)][self._lit()] for name in (first, second))
        return float(one.sum()) > float(other.sum())

    def bright_sides(self) -> np.ndarray:
        """Return the centre of the light in each image, x to the right and y up, [images, 2]."""
        across, down, _ = self._lines()
        columns, rows = (lines.sum(axis=1) for lines in (across, down))
        x, y = np.arange(columns.shape[1]), -np.arange(rows.shape[1])
        return np.stack([columns @ x / np.maximum(columns.sum(axis=1), 1e-12), rows @ y / np.maximum(rows.sum(axis=1), 1e-12)], axis=1)

    def two_valued(self) -> bool:
        """Return whether every image has two values, as masks have."""
        return bool(self.names) and all(len(np.unique(one)) <= 2 for one in self._lines()[2])

    def unexplained_by_lights(self) -> float:
        """Return what no three images explain of how the images differ, as a part of the squares; a matt object under far lights has 0."""
        sample = self._lines()[2].astype(np.float64)
        values = np.linalg.svd(sample @ sample.T, compute_uv=False)
        return float(values[3:].sum() / max(values[1:].sum(), 1e-300))

    def waves(self, names: Sequence[str], steps: int) -> tuple[str, float]:
        """Return the axis, column or row, along which steps of one wave change, and how many periods an image shows of it."""
        at = [self.names.index(name) for name in names]
        shift = np.exp(-2j * np.pi * np.arange(steps) / steps)
        turns = []
        for lines in self._lines()[:2]:
            phasor = np.einsum("ilp,i->lp", lines[at], shift)
            step = phasor[:, 1:] * phasor[:, :-1].conj()
            turns.append(float(np.abs(np.angle(step).sum(axis=1)).mean() / (2 * np.pi)))
        return ("column", turns[0]) if turns[0] >= turns[1] else ("row", turns[1])

    def stripes(self) -> Stripes | None:
        """Return the Gray code that the images show, or None."""
        if len(self.names) < 4:
            return None
        across, down, sample = self._lines()
        top, low, lit = sample.max(axis=0), sample.min(axis=0), self._lit()
        if lit.sum() < LEAST_LIT:
            return None
        shown = (sample - low)[:, lit] / (top - low)[lit]
        level = shown.mean(axis=1)
        white, black = (tuple(map(int, np.flatnonzero(found))) for found in (level > 1 - EVEN, level < EVEN))
        if len(white) > 1 or len(black) > 1:
            return None
        plain = [index for index in range(len(level)) if index not in (*white, *black)]
        bits = shown[plain] > 0.5
        centred = shown[plain] - shown[plain].mean(axis=1, keepdims=True)
        if (np.ptp(shown[plain], axis=1) == 0).any():
            return None
        pairs = len(plain) % 2 == 0 and all(np.corrcoef(centred[k], centred[k + 1])[0, 1] < INVERSE for k in range(0, len(plain), 2))
        counts = np.array([_flips(lines[plain], (top.max() * CONTRAST)) for lines in (across, down)])
        if not pairs and np.median(np.mean(np.minimum(shown, 1 - shown) < 0.25, axis=1)) < TWO_LEVELS:
            return None
        codes = list(range(0, len(plain), 2)) if pairs else list(range(len(plain)))
        inverses = "pairs" if pairs else "none"
        of_columns = counts[0] > counts[1]
        runs = [(axis, [k for k in codes if of_columns[k] == axis]) for axis in (True, False)]
        if not pairs and all(len(run) % 2 == 0 and all(np.corrcoef(bits[run[k]], bits[run[k + len(run) // 2]])[0, 1] < INVERSE
                                                       for k in range(len(run) // 2)) for _, run in runs if run):
            inverses, runs = "blocks", [(axis, run[: len(run) // 2]) for axis, run in runs]
        if any(run and run != list(range(run[0], run[0] + len(run) * (2 if pairs else 1), 2 if pairs else 1)) for _, run in runs):
            return None
        fine = [_rises(counts[0 if axis else 1][run]) for axis, run in runs if len(run) > 1]
        if not fine or any(one is None for one in fine) or len(set(fine)) > 1:
            return None
        starts = [("columns" if axis else "rows", plain[run[0]]) for axis, run in runs if run]
        starts += [("white", index) for index in white] + [("black", index) for index in black]
        lengths = {axis: len(run) for axis, run in runs}
        together = [_together((across if axis else down)[plain], run if fine[0] else run[::-1], top.max() * CONTRAST) for axis, run in runs]
        if pairs and self.inverse_first(*([(plain[k], plain[k + 1]) for k in (run if fine[0] else run[::-1])] for _, run in runs)):
            inverses = "first"
        return Stripes(tuple(name for name, _ in sorted(starts, key=lambda start: start[1])), inverses, not fine[0],
                       lengths.get(True, 0), lengths.get(False, 0), max(together) > 0.5)


def _flips(lines: np.ndarray, least: float) -> np.ndarray:
    """Return how often images [images, lines, pixels] change between light and dark along a line, on average."""
    top, low = lines.max(axis=0), lines.min(axis=0)
    found = np.zeros(len(lines))
    for line in range(lines.shape[1]):
        seen = top[line] - low[line] > least
        bits = lines[:, line, seen] > (top + low)[line, seen] / 2
        found += (bits[:, 1:] != bits[:, :-1]).sum(axis=1)
    return found / lines.shape[1]


def _steps(lines: np.ndarray, pairs: Sequence[tuple[int, int]], least: float) -> np.ndarray:
    """Return how far the stripes of neighbouring pixels lie apart in all, with the first images of pairs as the patterns of a Gray code and
    with the second; `pairs` are the images from coarse to fine."""
    seen = np.ptp(lines, axis=0) > least
    both = seen[:, 1:] & seen[:, :-1]
    wide: list[np.ndarray] = []
    for first, second in pairs:
        bits = lines[first] > lines[second]
        if ((bits[:, 1:] != bits[:, :-1]) & both).sum() * WIDE > both.sum():
            break
        wide.append(bits)
    if not wide:
        return np.zeros(2)
    steps = []
    for bits in (np.stack(wide), ~np.stack(wide)):
        numbers = np.tensordot(1 << np.arange(len(wide))[::-1], np.logical_xor.accumulate(bits, axis=0), 1)
        steps.append(np.abs(np.diff(numbers, axis=1))[both].sum())
    return np.array(steps, dtype=np.float64)


def _together(lines: np.ndarray, run: list[int], least: float) -> float:
    """Return at what part of the edges of stripes the next finer ones have an edge too; `run` is the images from coarse to fine."""
    top, low = lines.max(axis=0), lines.min(axis=0)
    found, count = 0, 0
    for coarse, fine in pairwise(run):
        for line in range(lines.shape[1]):
            bits = lines[:, line] > (top + low)[line] / 2
            if (bits[fine, 1:] != bits[fine, :-1]).sum() * WIDE > bits.shape[1]:
                continue
            edge = np.flatnonzero(bits[coarse, 1:] != bits[coarse, :-1])
            edge = edge[(edge >= BESIDE) & (edge + 1 + BESIDE < bits.shape[1])]
            clear = (top - low)[line][edge[:, None] + np.arange(-BESIDE, BESIDE + 2)].min(axis=1) > least
            before, after = (bits[fine, edge[clear] + shift] for shift in (-BESIDE, 1 + BESIDE))
            found, count = found + int((before != after).sum()), count + int(clear.sum())
    return found / max(count, 1)


def _rises(counts: np.ndarray) -> bool | None:
    """Return whether the stripes of a code become finer from image to image; None where they do neither."""
    steps = np.log2(np.maximum(counts[1:], 0.5) / np.maximum(counts[:-1], 0.5))
    steps = steps[np.maximum(counts[1:], counts[:-1]) > 2]
    if not len(steps):
        return None
    rising = float((steps > 0.3).mean())
    return True if rising > 0.7 else False if rising < 0.3 and float((steps < -0.3).mean()) > 0.7 else None
