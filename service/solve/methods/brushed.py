"""Brushed surfaces in a solution: pixels that no round lobe explains, and a streak does.

A streak has several ends at which a fit stops, so pixels on a coarse lattice are fitted from starts all over the hemisphere, and the
others from the lobes of pixels nearby that were found to be brushed, level by level, so that a surface without any costs little.
"""

import numpy as np
from scipy.spatial import cKDTree

from kernels.photometric.material.brushed import Brushed, fit_brushed
from kernels.photometric.model.misfit import LARGEST_ERROR
from kernels.photometric.model.samples import Samples
from kernels.photometric.search.hypotheses import LobeShape
from service.reporting.progress import Timings
from service.solve.base.solution import Solution, half
from service.solve.methods.kinds import READ_AT_ONCE, Read

FEWEST_LIGHTS = 12
"""Fewest lights under which streaks are looked for: a pixel has seven unknowns, and fewer lights were not tried."""
UNEXPLAINED = 0.5
"""Least residual of pixels that may be brushed: 45 path-traced things leave at most 0.33 in the median, brushed ones 0.58 to 0.98."""
SURE, SAVED = 0.1, 0.5
"""Parts of the cost of a round lobe to which a streak must lower it: where pixels that are brushed are looked for, and near these. Half to
nine tenths of the pixels of brushed things reach the first, and none of others, which stand in shadow or mirror each other."""
DEGREES_PER_COST = 20.0
"""Standard error of the normal in degrees at a cost of one, beside that of the fit: what is left is light that other parts send, which the
curvature of the cost does not know."""
FIRST, THEN = 8, (8, 4, 2, 1, 1)
"""Step in pixels of the lattice that is fitted first, and of those whose pixels begin from what was found."""
LEAST_SHARE, LEAST_PIXELS = 0.02, 4
"""Least part of the pixels of the first lattice, and number of them, that must be surely brushed."""
NEAREST, REACH = 6, 3.0
"""Brushed pixels nearby whose lobes a pixel begins from, and how far the nearest may lie, in steps of the lattice."""
NORMALS, TANGENTS, WIDTHS = 160, 8, ((0.5, 0.1), (0.25, 0.1), (0.25, 0.05))
"""Normals on the hemisphere, tangents about each, and pairs of widths that the first lattice begins from."""


def place_brushed(solution: Solution, solvable: np.ndarray, shape: tuple[int, ...], read: Read, timings: Timings, *, lobe: LobeShape
                  ) -> np.ndarray:
    """Replace what was found of brushed pixels by the streak that explains them; return their positions, [n].

    Args:
        solution: with residuals, F0 and roughness; changed in place.
        solvable: [n] ascending positions of pixels that are solved.
        shape: rows and columns of the image.
        read: returns the readings of pixels.
        timings: told of the pixels that are done.
        lobe: the shape of the diffuse lobe.
    """
    tried = solvable[solution.residual[solvable] > UNEXPLAINED]
    place = np.stack(np.divmod(tried, shape[1]), axis=1)
    lattices = [np.flatnonzero((place % step == 0).all(axis=1)) for step in (FIRST, *THEN)]
    least = max(LEAST_SHARE * (np.stack(np.divmod(solvable, shape[1])) % FIRST == 0).all(axis=0).sum(), LEAST_PIXELS)
    if len(lattices[0]) < least:
        return np.zeros(0, int)
    count = sum(map(len, lattices))
    timings.stage("brushed", count)
    fits = _Fits(solution, tried, read, timings, lobe)
    brushed = _found(fits, place, lattices, least)
    timings.advance(count)  # those far from all others, or all where none is brushed, need no fit
    if len(brushed) == 0:
        return brushed
    _replace(solution, tried[brushed], Brushed(*(plane[brushed] for plane in fits.streaks)))
    solution.warnings.append(f"method svbrdf: {len(brushed) / len(solvable):.0%} of the pixels are brushed, with streaks for highlights: "
                             "normals follow from the streaks, but the roughness of the maps is that of a round highlight between their "
                             "widths; relight by the images where streaks matter")
    return tried[brushed]


class _Fits:
    """The best streak that was found of each pixel, and what a round lobe explains of it."""

    def __init__(self, solution: Solution, pixels: np.ndarray, read: Read, timings: Timings, lobe: LobeShape) -> None:
        self._solution, self._pixels, self._read, self._timings, self._lobe = solution, pixels, read, timings, lobe
        self._done = 0
        self.streaks, self._round = Brushed.unknown(len(pixels)), np.zeros(len(pixels), np.float32)

    def begin(self, here: np.ndarray, starts: np.ndarray) -> None:
        """Fit some of the pixels from starts as of `fit_brushed`, and keep what explains them better."""
        for first in range(0, len(here), READ_AT_ONCE):
            at = here[first:first + READ_AT_ONCE]
            samples = self._read(self._pixels[at])
            found = fit_brushed(samples, starts if starts.shape[1] == 1 else starts[:, first:first + READ_AT_ONCE], shape=self._lobe)
            lower = found.cost < self.streaks.cost[at]
            self._round[at[lower]] = self._round_cost(samples, self._pixels[at], found)[lower]
            for plane, values in zip(self.streaks, found, strict=True):
                plane[at[lower]] = values[lower]
            self._done += len(at)
            self._timings.advance(self._done)

    def below(self, part: float) -> np.ndarray:
        """Return the places of pixels whose streak costs less than this part of a round lobe."""
        return np.flatnonzero(self.streaks.cost < part * self._round)

    def _round_cost(self, samples: Samples, pixels: np.ndarray, found: Brushed) -> np.ndarray:
        """Return the cost of the better of two round lobes: from the streak, and from the normal and roughness of the solution."""
        assert self._solution.roughness is not None
        starts = np.stack([found.starts, found.starts])
        starts[0, :, 6:] = np.sqrt(found.widths.prod(axis=1, keepdims=True))
        starts[1, :, :3], starts[1, :, 6:] = self._solution.normal[:, pixels].T, self._solution.roughness[pixels, None] ** 2
        return fit_brushed(samples, starts, shape=self._lobe, round_lobe=True).cost


def _found(fits: _Fits, place: np.ndarray, lattices: list[np.ndarray], least: float) -> np.ndarray:
    """Return which of the tried pixels, at these rows and columns [m, 2], are brushed; none unless `least` of the first lattice are."""
    fits.begin(lattices[0], first_starts()[:, None])
    brushed = fits.below(SURE)
    if len(brushed) < least:
        return brushed[:0]
    for step, here in zip(THEN, lattices[1:], strict=True):
        away, nearest = cKDTree(place[brushed]).query(place[here], k=range(1, min(NEAREST, len(brushed)) + 1))
        near = away[:, 0] <= REACH * step
        fits.begin(here[near], np.moveaxis(fits.streaks.starts[brushed[nearest[near]]], 1, 0))
        brushed = fits.below(SAVED)
    return brushed


def _replace(solution: Solution, pixels: np.ndarray, found: Brushed) -> None:
    """Replace normal, error and material of some pixels of a solution by their streaks."""
    assert solution.specular is not None and solution.roughness is not None
    assert solution.albedo_own is not None and solution.albedo_tilt is not None
    solution.normal[:, pixels], solution.residual[pixels] = found.normal.T, np.sqrt(found.cost)
    solution.sigma[pixels] = np.minimum(np.hypot(found.sigma, DEGREES_PER_COST * found.cost), LARGEST_ERROR)
    solution.albedo[:, pixels], solution.specular[:, pixels] = half(found.diffuse_albedo.T), found.specular.T
    solution.roughness[pixels] = found.widths.prod(axis=1) ** 0.25
    solution.albedo_own[:, pixels], solution.albedo_tilt[:, pixels] = half(found.albedo_sigma), 0
    solution.brushed, solution.facts["brushed_pixels"] = pixels, len(pixels)


def first_starts() -> np.ndarray:
    """Return lobes all over the hemisphere that faces the camera, [starts, START] of `fit_brushed`."""
    z = 1 - (np.arange(NORMALS) + 0.5) / NORMALS
    azimuth = np.arange(NORMALS) * np.pi * (3 - np.sqrt(5))
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * z], axis=1)
    normal = np.sqrt(1 - z**2)[:, None] * flat + z[:, None] * [0, 0, 1]
    across = np.cross([0, 0, 1], flat)
    down = np.cross(across, normal)
    starts = [np.concatenate([normal, np.cos(turn) * across + np.sin(turn) * down, np.tile(widths, (NORMALS, 1))], axis=1)
              for turn in np.arange(TANGENTS) * np.pi / TANGENTS for widths in WIDTHS]
    return np.concatenate(starts).astype(np.float32)
