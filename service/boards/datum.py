"""Where the layers of a board lie in what was measured: by round marks, holes or fiducials, or else by the paste itself.

First the whole board is laid on the openings, to a pixel, where its heights correlate best with them. The place of a mark is that at which
its disc differs most from the ring around it; what is not measured counts as deep, as holes are.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import fftconvolve

from service.boards.stitching.form import fit_form
from service.boards.stitching.grid import HeightMap, robust_sigma
from stage.errors import BoardError
from stage.spread import tukey_weights

LEAST_CORRELATION = 0.5
"""The least correlation of the heights of a board with its openings."""
ALIKE = 0.97
"""Places fit alike whose correlation is this part of the best one."""
RING = 1.4
"""Radius of the ring around a mark, in radii of the mark."""
LEAST_EXPLAINED = 0.5
"""The part of the variance of heights within the ring that the disc must explain."""
COARSE_PX, FINE_PX = 0.5, 0.05
ROUNDS = 10
LEAST_SIGMA_PX = 0.1
"""The least standard deviation of the place of a mark, pixels."""


class Datum(NamedTuple):
    """A small motion of the layers against the board: of their places, metres, x and y after a turn about the middle of the marks."""

    shift_m: np.ndarray  # [2]
    turn: float
    """Radians, counter-clockwise."""
    middle_m: np.ndarray  # [2]
    covariance: np.ndarray  # [3, 3] of shift and turn

    def at(self, place_m: np.ndarray) -> np.ndarray:
        """Return how far the layers lie off at a place, [2] metres."""
        return np.asarray(_rows(place_m - self.middle_m) @ [*self.shift_m, self.turn])

    def variance(self, place_m: np.ndarray) -> np.ndarray:
        """Return the variance of that, [2] m²."""
        rows = _rows(place_m - self.middle_m)
        return np.asarray(np.diag(rows @ self.covariance @ rows.T))


def _rows(away: np.ndarray) -> np.ndarray:
    return np.array([[1, 0, -away[1]], [0, 1, away[0]]])


def lay(heights: HeightMap, openings: np.ndarray, *, stencil_m: float, search_px: int, apart_px: float) -> np.ndarray:
    """Return by how much a board must be moved for its paste to lie in its openings, [rows, cols] bool, to a pixel: x and y in metres.
    `apart_px`: places so far from each other are not the same. Raises BoardError where none fits, or several do."""
    search_px = min(search_px, *(length - 1 for length in openings.shape))
    flat = heights.height - fit_form(heights.grid, heights.height, quadratic=True).over(heights.grid)
    paste = np.where(heights.measured, np.clip(flat / stencil_m, 0, 1), 0)
    found = _correlation(paste, heights.measured, openings, search_px)
    best = float(found.max())
    if best < LEAST_CORRELATION:
        mirrored, turned = (float(_correlation(paste, heights.measured, other, search_px).max())
                            for other in (openings[:, ::-1], openings[::-1, ::-1]))
        raise BoardError(f"the paste on the board does not lie as the openings do (correlation {best:.2f}), " + (
            f"and does if they are mirrored ({mirrored:.2f}): it is the other --side" if mirrored >= LEAST_CORRELATION else
            f"and does if they are turned by 180° ({turned:.2f}): turn the board in its fixture" if turned >= LEAST_CORRELATION else
            "within the error of its place: give --origin-m, or a larger --placement-m"))
    down, right = np.mgrid[-search_px : search_px + 1, -search_px : search_px + 1]
    row, col = (at.ravel()[found.argmax()] for at in (down, right))
    away = np.hypot(down - row, right - col)
    if (found[away > apart_px] > ALIKE * best).any():
        other = away[(away > apart_px) & (found > ALIKE * best)].min() * heights.grid.pixel_m
        raise BoardError(f"places of the board that differ by {other:.3g} m fit its openings alike: give --placement-m if its fixture is "
                         "more exact")
    return np.array([-col, row]) * heights.grid.pixel_m


def _correlation(values: np.ndarray, known: np.ndarray, openings: np.ndarray, search: int) -> np.ndarray:
    """Return the correlation of values, 0 where they are not known, with openings moved by up to `search` rows and columns, over what is
    known: [2 search + 1, 2 search + 1]."""
    turned = openings[::-1, ::-1].astype(np.float64)
    rows, cols = (slice(length - 1 - search, length + search) for length in values.shape)

    def moved(image: np.ndarray) -> np.ndarray:
        return np.asarray(fftconvolve(image, turned)[rows, cols])

    count, whole = float(known.sum()), moved(known.astype(np.float64)) / known.sum()
    mean, square = values.sum() / count, (values**2).sum() / count
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num((moved(values) / count - whole * mean) / np.sqrt((whole - whole**2) * (square - mean**2)))


def fit_datum(places_m: np.ndarray, offsets_m: np.ndarray, *, pixel_m: float) -> Datum:
    """Fit shift and turn to offsets at places, both [n, 2] metres, two or more, by Tukey's weights."""
    middle = places_m.mean(axis=0)
    rows = np.concatenate([_rows(place - middle) for place in places_m])
    wanted, weight = offsets_m.ravel(), np.ones(2 * len(places_m))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], wanted * root, rcond=None)[0]
        left = wanted - rows @ found
        scale = max(robust_sigma(left), LEAST_SIGMA_PX * pixel_m)
        weight = tukey_weights(left, scale)
    return Datum(found[:2], float(found[2]), middle, scale**2 * np.linalg.pinv((rows * weight[:, None]).T @ rows))


def find_mark(heights: HeightMap, place_m: np.ndarray, diameter_m: float, *, deep_m: float, search_m: float) -> np.ndarray | None:
    """Return how far a mark lies from its place, [2] metres; None where nothing round of its size stands out.
    `deep_m`: heights beyond this, up and down, count as this much."""
    grid, radius = heights.grid, diameter_m / 2 / heights.grid.pixel_m
    search = max(search_m / grid.pixel_m, 1.0)
    row, col = (float(value) for value in grid.place(*place_m))
    reach = int(np.ceil(RING * radius + search)) + 1
    box = tuple(slice(round(at) - reach, round(at) + reach + 1) for at in (row, col))
    if min(box[0].start, box[1].start) < 0 or box[0].stop > grid.rows or box[1].stop > grid.cols:
        return None
    seen = heights.height[box]
    if np.isfinite(seen).sum() < seen.size / 10:
        return None
    values = np.clip(np.nan_to_num(seen - np.nanmedian(seen), nan=-deep_m), -deep_m, deep_m)
    down, right = np.mgrid[box]

    def explained(off: tuple[float, float]) -> float:
        distance = np.hypot(right - col - off[0], down - row - off[1])
        disc, ring = np.clip(radius - distance + 0.5, 0, 1), np.clip(RING * radius - distance + 0.5, 0, 1)
        rest = ring - disc
        inner, outer, middle = (float((weight * values).sum() / weight.sum()) for weight in (disc, rest, ring))
        whole = float((ring * (values - middle) ** 2).sum())
        return (disc.sum() * (inner - middle) ** 2 + rest.sum() * (outer - middle) ** 2) / whole if whole > 0 else 0.0

    best = (0.0, 0.0)
    for step, wide in ((COARSE_PX, search), (FINE_PX, COARSE_PX)):
        steps = step * np.arange(-round(wide / step), round(wide / step) + 1)
        best = max(((best[0] + across, best[1] + along) for across in steps for along in steps), key=explained)
    if explained(best) < LEAST_EXPLAINED or max(np.abs(best)) > search - COARSE_PX / 2:
        return None
    return np.array([best[0], -best[1]]) * grid.pixel_m
