"""The shares of a small sample of the sphere that lie in the cells of different lights.

In the plane that touches the sphere in the sample's middle, the border between two cells is a straight line, as every great circle
is, and so are the meridians at the sample's sides. Its top and bottom bend a little, by 5e-6 of a radian at the ends of half a
degree, and are taken as straight. The part of a cell is the polygon that its borders with the others leave of the sample.

Source: clipping of convex polygons after Sutherland and Hodgman, "Reentrant polygon clipping", CACM 1974.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

MOST_CELLS = 16
"""Most cells that share one sample; a sample with more is cut in four, because the work grows with the square of the number."""
QUARTERINGS = 4
"""Times that a sample may be cut in four. The rest is then a thirty-second of a degree wide and goes whole to its nearest light."""


class LatLongSamples(NamedTuple):
    """Samples of a lat-long map, a quarter of a degree from the middle to the edges or less."""

    polar: np.ndarray  # [samples] radians from +y to the middle
    azimuth: np.ndarray  # [samples] radians from -z over +x
    half_polar: float
    """Radians from the middle to the upper edge."""
    half_azimuth: float
    """Radians of azimuth from the middle to the right edge."""


class Shares(NamedTuple):
    """Parts of samples that go to lights; the shares of each sample add up to one."""

    sample: np.ndarray | slice  # [n] index of the sample
    light: np.ndarray  # [n]
    share: np.ndarray  # [n] float64


def divide(samples: LatLongSamples, nearest: np.ndarray, lights: np.ndarray, *, quarterings: int = QUARTERINGS) -> Shares:
    """Share samples of a lat-long map out to the cells of the lights by area.

    There is a share for each sample and each light whose cell may touch it; zeros occur.

    Args:
        nearest: [samples] index of the light nearest to the middle, or of one as near but for rounding.
        lights: [lights, 3] unit vectors, all different.
        quarterings: how often a sample may be cut in four where many cells meet.
    """
    frame = _frames(samples)
    sample, rival = _rivals(frame[:, 0], reach(samples.polar, samples.half_polar, samples.half_azimuth), nearest, lights)
    counts = np.bincount(sample, minlength=len(nearest))
    begin = np.cumsum(counts) - counts
    height, width = np.tan(samples.half_polar), np.tan(samples.half_azimuth)
    found = [Shares(np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0))]
    for count in np.unique(counts):
        chosen = np.flatnonzero(counts == count)
        if count == 0 or (count >= MOST_CELLS and quarterings == 0):
            found.append(Shares(chosen, nearest[chosen], np.ones(len(chosen))))
        elif count >= MOST_CELLS:
            found.append(_quarter(samples, chosen, lights, quarterings - 1))
        else:
            cells = np.concatenate([nearest[chosen, None], rival[begin[chosen][:, None] + np.arange(count)]], axis=1)
            axes = np.einsum("ncx,nax->nca", lights[cells], frame[chosen])
            sine, slope = np.sin(samples.polar[chosen]), height * np.cos(samples.polar[chosen])
            share = _areas(axes, width * (sine - slope), width * (sine + slope), height)
            found.append(Shares(np.repeat(chosen, count + 1), cells.reshape(-1), share.reshape(-1)))
    return _join(found)


def reach(polar: np.ndarray, half_polar: float, half_azimuth: float) -> np.ndarray:
    """Return the [samples] distance from the middle to the farthest corner, in the plane that touches the sphere in the middle."""
    height, width = np.tan(half_polar), np.tan(half_azimuth)
    return np.hypot(height, width * (np.sin(polar) + height * np.abs(np.cos(polar))))


def _frames(samples: LatLongSamples) -> np.ndarray:
    """Return [samples, 3, 3] unit vectors to the middle of each sample, and from there east (rightwards) and north."""
    sine, cosine, x, z = np.sin(samples.polar), np.cos(samples.polar), np.sin(samples.azimuth), -np.cos(samples.azimuth)
    return np.stack([np.stack([x * sine, cosine, z * sine], axis=1), np.stack([-z, np.zeros_like(x), x], axis=1),
                     np.stack([-x * cosine, sine, -z * cosine], axis=1)], axis=1)


def _rivals(middle: np.ndarray, radius: np.ndarray, nearest: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of a sample, in ascending order, and a light whose border with the sample's nearest light passes within the radius."""
    order = np.argsort(nearest, kind="stable")
    cells = np.unique(nearest)
    begins, ends = (np.searchsorted(nearest[order], cells, side=side) for side in ("left", "right"))
    pairs = [(np.zeros(0, dtype=int), np.zeros(0, dtype=int))]
    for light, begin, end in zip(cells, begins, ends, strict=True):
        members = order[begin:end]
        to_rival = lights[light] - lights
        apart = np.linalg.norm(to_rival, axis=1)
        # a point of the border is as far from the rival as from the light
        far = np.max(np.linalg.norm(middle[members] - lights[light], axis=1) + radius[members])
        rivals = np.flatnonzero((apart > 0) & (apart <= 2 * far))
        row, col = np.nonzero(middle[members] @ (to_rival[rivals] / apart[rivals, None]).T <= radius[members, None])
        pairs.append((members[row], rivals[col]))
    sample, rival = (np.concatenate(column) for column in zip(*pairs, strict=True))
    order = np.argsort(sample, kind="stable")
    return sample[order], rival[order]


def _quarter(samples: LatLongSamples, chosen: np.ndarray, lights: np.ndarray, quarterings: int) -> Shares:
    down, right = samples.half_polar / 2, samples.half_azimuth / 2
    polar = samples.polar[chosen, None] + down * np.array([-1, -1, 1, 1])
    azimuth = samples.azimuth[chosen, None] + right * np.array([-1, 1, -1, 1])
    quarters = LatLongSamples(polar.reshape(-1), azimuth.reshape(-1), down, right)
    nearest = np.argmax(_frames(quarters)[:, 0] @ lights.T, axis=1)
    part = divide(quarters, nearest, lights, quarterings=quarterings)
    solid_angle = np.sin(polar) / np.sin(polar).sum(axis=1, keepdims=True)
    return Shares(chosen[part.sample // 4], part.light, part.share * solid_angle.reshape(-1)[part.sample])


def _areas(axes: np.ndarray, top: np.ndarray, bottom: np.ndarray, height: float) -> np.ndarray:
    """Return the [samples, cells] share of each trapezoid that is nearest to each light.

    Args:
        axes: [samples, cells, 3] of each light along the middle, east and north.
        top, bottom: [samples] half widths of the trapezoid.
        height: half of its height.
    """
    level = np.full_like(top, height)
    trapezoid = np.stack([np.stack(corner, axis=1) for corner in
                          ((-bottom, -level), (bottom, -level), (top, level), (-top, level))], axis=1)
    area = np.zeros(axes.shape[:2])
    for cell in range(axes.shape[1] - 1):
        polygon = trapezoid
        for other in range(axes.shape[1]):
            if other != cell:
                polygon = _clip(polygon, axes[:, cell] - axes[:, other])
        x, y = polygon[:, :, 0], polygon[:, :, 1]
        area[:, cell] = np.maximum(0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1), 0)
    area[:, -1] = np.maximum(2 * height * (top + bottom) - area.sum(axis=1), 0)
    return area / area.sum(axis=1, keepdims=True)


def _clip(polygon: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Cut convex polygons [n, corners, 2] along lines [n, 3]: what stays has line · (1, x, y) ≥ 0.

    A polygon with fewer corners repeats its last corner; a polygon that is cut away whole shrinks to a point."""
    here = line[:, None, 0] + np.einsum("nkx,nx->nk", polygon, line[:, 1:])
    there = np.roll(here, -1, axis=1)
    inside, crossed = here >= 0, (here >= 0) != (there >= 0)
    along = np.where(crossed, here / np.where(crossed, here - there, 1), 0)
    corners = np.stack([polygon, polygon + along[..., None] * (np.roll(polygon, -1, axis=1) - polygon)], axis=2)
    kept = np.stack([inside, crossed], axis=2).reshape(len(polygon), -1)
    order = np.argsort(~kept, axis=1, kind="stable")
    last = np.maximum(kept.sum(axis=1) - 1, 0)
    order = np.take_along_axis(order, np.minimum(np.arange(polygon.shape[1] + 1), last[:, None]), axis=1)
    return np.take_along_axis(corners.reshape(len(polygon), -1, 2), order[..., None], axis=1)


def _join(found: Sequence[Shares]) -> Shares:
    return Shares(*(np.concatenate(column) for column in zip(*found, strict=True)))
