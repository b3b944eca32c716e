"""A lat-long map cut into samples, and rotations of it that share them.

Samples lie at most half a degree apart, so that a coarse map is cut finer than its texels. Nothing is resampled when the map turns:
the lights are turned the other way instead.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError

SAMPLE_PITCH_DEGREES = 0.5
"""Largest width of a sample, degrees: a sample is then so nearly flat that the areas of its parts are off by 3e-5 of its area."""
UNIT_TOLERANCE = 1e-3
"""Largest difference of a light direction's length from one; directions within it are normalised."""
EQUAL_RADIANS = 1e-4
"""Lights closer than this angle in radians, 0.006 degrees, count as one place; the first of them gets the energy."""
BAND_SAMPLES = 1 << 19
"""Number of samples that are summed at one time: it bounds the memory of a large map, and the samples stay in the cache."""

EQUAL_COLUMNS = 1e-6
"""Rotations whose difference is a whole number of columns to within this part of one column, less than a thousandth of a second of arc,
share one split of the samples."""


class SampleGrid(NamedTuple):
    """Rows of samples of a lat-long map; all are equally large in polar angle and azimuth."""

    polar: np.ndarray  # [rows] radians from +y to the middle of each row
    azimuth: np.ndarray  # [cols] radians from the left edge, -z, over +x
    half_polar: float
    """Radians from the middle of a sample to its upper edge."""
    half_azimuth: float
    solid_angle: np.ndarray  # [rows] steradians of one sample
    texel_row: np.ndarray  # [rows] row of the map
    across: int
    """Number of samples side by side in a texel."""

    def bands(self) -> Iterator["SampleGrid"]:
        """Return the same grid, some rows at a time."""
        size = max(1, BAND_SAMPLES // len(self.azimuth))
        for start in range(0, len(self.polar), size):
            rows = slice(start, start + size)
            yield self._replace(polar=self.polar[rows], solid_angle=self.solid_angle[rows], texel_row=self.texel_row[rows])


class Turn(NamedTuple):
    """Frames whose rotated maps differ by a sideways shift alone."""

    rotation: np.ndarray  # [3, 3] float64, of the map before it is moved
    frames: tuple[int, ...]
    columns: tuple[int, ...]
    """For each frame, the number of columns by which the map is shifted before `rotation` turns it: column c is taken from c + columns."""


def cut(rows: int, cols: int) -> SampleGrid:
    """Cut the texels of a lat-long map of this size into samples.

    A texel keeps its solid angle sin(πv) · (π/H) · (2π/W), which its rows of samples share in proportion to their sines.
    """
    across = max(1, math.ceil(360.0 / SAMPLE_PITCH_DEGREES / cols))
    down = max(1, math.ceil(180.0 / SAMPLE_PITCH_DEGREES / rows))
    half_polar, half_azimuth = np.pi / (2 * rows * down), np.pi / (cols * across)
    polar = half_polar * (2 * np.arange(rows * down) + 1)
    azimuth = half_azimuth * (2 * np.arange(cols * across) + 1)
    texel = np.sin(np.pi * (np.arange(rows) + 0.5) / rows) * (np.pi / rows) * (2 * np.pi / cols)
    sines = np.sin(polar).reshape(rows, down)
    solid_angle = sines / sines.sum(axis=1, keepdims=True) / across * texel[:, None]
    return SampleGrid(polar, azimuth, half_polar, half_azimuth, solid_angle.reshape(-1), np.repeat(np.arange(rows), down), across)


def check(environment: np.ndarray, directions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return directions, normalised, and rotations, in float64; refuse what an environment cannot be integrated with.

    Raises:
        ArrayError: shapes that do not fit, directions that are not unit vectors, or radiance that is negative or not finite (counted).
    """
    directions, rotations = np.asarray(directions, dtype=np.float64), np.asarray(rotations, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or len(directions) == 0:
        raise ArrayError(f"directions are {directions.shape}: give [lights, 3], one light or more")
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3):
        raise ArrayError(f"rotations are {rotations.shape}: give [frames, 3, 3]")
    length = np.linalg.norm(directions, axis=1)
    if not (np.abs(length - 1) < UNIT_TOLERANCE).all():
        raise ArrayError(f"direction of light {int(np.argmax(np.abs(length - 1)))} is not a unit vector")
    if environment.ndim != 3 or environment.shape[2] != 3 or min(environment.shape[:2]) < 1:
        raise ArrayError(f"environment is {environment.shape}: give [rows, cols, 3]")
    for name, bad in (("not finite", ~np.isfinite(environment)), ("negative", environment < 0)):
        if bad.any():
            raise ArrayError(f"environment has {int(bad.any(axis=2).sum())} texels that are {name}")
    return directions / length[:, None], rotations


def first_of_equals(directions: np.ndarray) -> np.ndarray:
    """Return the ascending indices of the lights that have no earlier light in the same place."""
    close = directions @ directions.T > 1 - EQUAL_RADIANS**2 / 2
    return np.flatnonzero(~np.tril(close, -1).any(axis=1))


def shared_turns(rotations: np.ndarray, columns: int) -> Iterator[Turn]:
    """Group rotations of a lat-long map that differ by whole columns of samples about its axis.

    Rotations are [frames, 3, 3], turned = rotation @ direction. A spin of 240 frames on a grid of 768 columns, 3.2 columns a frame, has
    five different turns.
    """
    groups: dict[int, list[tuple[int, int]]] = {}
    for frame, rotation in enumerate(rotations):
        if not (rotation[1, 1] == 1 and rotation[0, 0] == rotation[2, 2] and rotation[0, 2] == -rotation[2, 0]):
            yield Turn(rotation, (frame,), (0,))
            continue
        turn = np.arctan2(rotation[0, 2], rotation[0, 0]) / (2 * np.pi) * columns
        whole = int(np.floor(turn + EQUAL_COLUMNS))
        groups.setdefault(round((turn - whole) / EQUAL_COLUMNS), []).append((frame, whole))
    for part, members in groups.items():
        # turned by the part of a column, so that the weights of one frame do not depend on other frames
        angle = part * EQUAL_COLUMNS / columns * 2 * np.pi
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        yield Turn(rotation, tuple(frame for frame, _ in members), tuple(whole for _, whole in members))
