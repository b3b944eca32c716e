"""Decoded projector coordinates of a whole image, and the result of a capture whose coordinates cannot be triangulated.

A code is read without any calibration: the projector's column and row that each camera pixel sees are a result of their own, from which
devices are calibrated and images are warped.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.structured.decoded import Decoded
from service.depth.base.solution import PixelSolution, statistics
from service.depth.patterns.decoders import AxisDecoder
from stage.capture.camera import Camera
from stage.model import Resolution
from stage.results.depth_maps import CoordinateMaps

HALF_SURE = 1e-3
"""Standard deviation of a coordinate over the projector's pixels along its axis, at which confidence is one half."""
STEP_TIMES = 1.0
"""Largest distance of a coordinate from those that continue its neighbours, over the usual difference between neighbours: surfaces bend."""
STEP_SIGMAS = 4.0
"""Standard deviations of this distance that are added."""


class AxisMaps(NamedTuple):
    """One decoded coordinate at every pixel of the image; 0 where the decoder has no value."""

    coordinate: np.ndarray  # [rows, cols] float32, projector pixels
    sigma: np.ndarray  # [rows, cols] float32, projector pixels
    status: np.ndarray  # [rows, cols] uint8, of the decoder

    @property
    def solved(self) -> np.ndarray:
        """Return where the decoder is sure, [rows, cols] bool."""
        return np.isin(self.status, SOLVED)

    def widen(self, off: np.ndarray) -> np.ndarray:
        """Add what is no noise, `off` [rows, cols] projector pixels, to the deviations; return by which factor they grow, [rows, cols]."""
        sigma = np.where(self.sigma > 0, np.hypot(self.sigma, off), 0)
        grown = np.maximum(sigma / np.maximum(self.sigma, 1e-12), 1)
        self.sigma[:] = sigma
        return grown


@dataclass
class Coordinates:
    """The projector's column, row or both at every pixel of the image, filled band by band."""

    columns: AxisMaps | None
    rows: AxisMaps | None
    amplitude: np.ndarray  # [rows, cols] float32 of the weaker axis: a pixel is as good as its worse axis
    shift_px: float = 0.0
    """Distance in camera pixels of the images that lie farthest aside of each other, 0 where none clearly does."""

    @classmethod
    def empty(cls, shape: tuple[int, ...], *, columns: bool, rows: bool) -> "Coordinates":
        """Return coordinates that are not decoded yet, for an image of this shape and the axes that have a code."""
        axes = [AxisMaps(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)) if wanted else None
                for wanted in (columns, rows)]
        return cls(axes[0], axes[1], np.zeros(shape, np.float32))

    @property
    def axes(self) -> tuple[AxisMaps, ...]:
        """Return the axes that have a code."""
        return tuple(axis for axis in (self.columns, self.rows) if axis is not None)

    def put(self, band: slice, mask: np.ndarray, decoded: Sequence[Decoded | None]) -> None:
        """Keep the columns and rows of a band of image rows, inside the mask of the band alone."""
        shape = mask.shape
        for axis, found in zip((self.columns, self.rows), decoded, strict=True):
            if axis is None or found is None:
                continue
            coordinate, sigma, _, status = (to_numpy(array)[:mask.size].reshape(shape) for array in found)
            kept = mask & np.isin(status, ESTIMATED) & (sigma > 0)
            axis.coordinate[band] = np.where(kept, coordinate, 0)
            axis.sigma[band] = np.where(kept, sigma, 0)
            axis.status[band] = np.where(mask, status, int(Status.UNSOLVED))
        swings = [to_numpy(found.amplitude)[:mask.size].reshape(shape) for found in decoded if found is not None]
        self.amplitude[band] = np.where(mask, np.minimum.reduce(swings), 0)

    def widen(self, decoders: Sequence[AxisDecoder | None], off: Callable[[AxisMaps, AxisDecoder], np.ndarray | None]) -> np.ndarray:
        """Add what is no noise to the deviations of both axes; return the factor by which that widens the depth's, [rows, cols].
        `decoders`: of columns and of rows. `off`: by how much the places of an axis may be off, [rows, cols] projector pixels, or None."""
        wider = np.ones_like(self.amplitude)
        for decoder, axis in zip(decoders, (self.columns, self.rows), strict=True):
            found = None if decoder is None or axis is None else off(axis, decoder)
            if found is not None and axis is not None:
                wider = np.maximum(wider, axis.widen(found))
        return wider

    def status(self) -> np.ndarray:
        """Return one status for each pixel, [rows, cols] uint8: that of the first axis which is not solved."""
        first, *others = self.axes
        found = first.status.copy()
        for axis in others:
            found = np.where(np.isin(found, SOLVED), axis.status, found)
        return found


@dataclass(kw_only=True)
class DecodedSolution(PixelSolution):
    """Projector coordinates without depth: the result of a capture that is decoded and not triangulated. Solved is where every coded axis
    is decoded."""

    coordinates: Coordinates
    extents: Resolution
    """Projector pixels along columns and rows."""

    @property
    def estimated(self) -> np.ndarray:
        """Return where there is a coordinate, however unsure, [rows, cols] bool."""
        return np.logical_or.reduce([axis.sigma > 0 for axis in self.coordinates.axes])

    def confidence_map(self) -> np.ndarray:
        """Return confidence 0…1, [rows, cols]: 1 / (1 + σ / (extent / 1000)) of the less certain axis, unless it is known better."""
        if self.confidence is not None:
            return self.confidence
        each = [np.where(axis.sigma > 0, 1 / (1 + axis.sigma / (HALF_SURE * extent)), 0)
                for axis, extent in zip((self.coordinates.columns, self.coordinates.rows), self.extents, strict=True) if axis is not None]
        return np.minimum.reduce(each).astype(np.float32)

    def statistics(self) -> dict[str, dict[str, float]]:
        """Return the spread of the deviations of the solved pixels' coordinates, for the report."""
        return {f"sigma_{name}_px": statistics(axis.sigma[self.solved])
                for name, axis in (("u", self.coordinates.columns), ("v", self.coordinates.rows)) if axis is not None}

    def maps(self, camera: Camera, provenance: dict[str, str]) -> CoordinateMaps:
        """Return the layers of depth.exr, which has none of depth."""
        u, v = self.coordinates.columns, self.coordinates.rows
        return CoordinateMaps(
            camera=camera, mask=self.solved,
            projector_u=None if u is None else u.coordinate, projector_v=None if v is None else v.coordinate,
            sigma_u=None if u is None else u.sigma, sigma_v=None if v is None else v.sigma, amplitude=self.coordinates.amplitude,
            confidence=self.confidence_map(), status=self.status, provenance=provenance)


def stands_alone(axis: AxisMaps) -> np.ndarray:
    """Return the pixels, [rows, cols] bool, whose coordinate continues neither side of their row, or neither of their column.

    A pixel of a surface lies between its two neighbours, or on the line through the two neighbours of one side. A wrong digit does not.
    Pixels without such neighbours are not judged.
    """
    return (_leaves_line(axis.coordinate, axis.sigma, axis.solved)
            | _leaves_line(axis.coordinate.T, axis.sigma.T, axis.solved.T).T)


def _leaves_line(value: np.ndarray, sigma: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the same for rows alone."""
    pairs = known[:, 1:] & known[:, :-1]
    steps = np.abs(np.diff(value, axis=1))[pairs]
    slack = STEP_TIMES * float(np.median(steps)) if steps.size else 0.0
    width = value.shape[1]
    judged, fits = np.zeros(value.shape, bool), np.zeros(value.shape, bool)
    for one, other in ((-1, 1), (-1, -2), (1, 2)):
        first, last = max(0, -one, -other), width - max(0, one, other)
        if last <= first:
            continue
        here = slice(first, last)
        near, far = slice(first + one, last + one), slice(first + other, last + other)
        there = known[:, here] & known[:, near] & known[:, far]
        if one == -other:  # between its neighbours
            low, high = np.minimum(value[:, near], value[:, far]), np.maximum(value[:, near], value[:, far])
            spread = np.sqrt(sigma[:, here]**2 + np.maximum(sigma[:, near], sigma[:, far])**2)
        else:
            low = high = 2 * value[:, near] - value[:, far]
            spread = np.sqrt(sigma[:, here]**2 + 4 * sigma[:, near]**2 + sigma[:, far]**2)
        limit = slack + STEP_SIGMAS * spread
        judged[:, here] |= there
        fits[:, here] |= there & (value[:, here] >= low - limit) & (value[:, here] <= high + limit)
    return judged & ~fits
