"""Depths of consecutive steps, joined at the pixels whose steps agree."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from service.sequences.agreement import Track, advance, agree, begin, noise_share
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps


@dataclass
class DepthJoiner:
    """The recursive mean of depths, step by step."""

    _before: DepthMaps | None = None
    _track: Track | None = None

    def join(self, alone: DepthMaps) -> tuple[DepthMaps, dict[str, Any]]:
        """Return the depth of a step, of which `alone` was found, joined with those before, and what the report says.

        The joined depth has no decoded projector coordinates, which are those of one step.
        """
        sigma = np.zeros_like(alone.depth) if alone.sigma is None else alone.sigma.astype(np.float32)
        valid = alone.mask & (sigma > 0)  # a depth whose deviation is not known agrees with nothing
        values, ones = alone.depth[..., None].astype(np.float32), np.ones_like(sigma)
        if self._before is None or self._track is None:
            self._before, self._track = alone, begin(values, sigma, ones, valid)
            return _without_coordinates(alone), {"joined_pixels": 0, "steps_joined": {"median": 1.0, "most": 1}}
        before = self._before
        earlier = np.zeros_like(sigma) if before.sigma is None else before.sigma.astype(np.float32)
        both = valid & before.mask & (earlier > 0)
        difference = values - before.depth[..., None]
        share = noise_share(difference, sigma**2 + earlier**2, both, 1)
        if (self._track.count[both] == 1).all():  # only now is known how much of the first step is noise
            self._track = begin(before.depth[..., None], earlier, share, before.mask & (earlier > 0))
        new = begin(values, sigma, share, valid)
        rest = agree(new.mean - self._track.mean, new.noise + self._track.noise, both, 1)
        self._track, self._before = advance(self._track, new, rest), alone
        depth = np.where(rest, self._track.mean[..., 0], alone.depth).astype(np.float32)
        ratio = np.where(rest, depth / np.where(alone.depth != 0, alone.depth, 1), 1)
        count = self._track.count[alone.mask]
        joined = replace(_without_coordinates(alone), depth=depth,
                         sigma=None if alone.sigma is None else np.where(rest, self._track.sigma, alone.sigma).astype(np.float32),
                         range=None if alone.range is None else (alone.range * ratio).astype(np.float32))
        return joined, {
            "joined_pixels": int(np.count_nonzero(rest)), "compared_pixels": int(np.count_nonzero(both)),
            "steps_joined": {"median": float(np.median(count)) if len(count) else 0.0, "most": int(count.max(initial=0))},
            "noise_share": {"depth": float(f"{np.median(share[both]):.4g}") if both.any() else 0.0}}


def moved_points(cloud: PointCloud, alone: DepthMaps, joined: DepthMaps) -> PointCloud:
    """Return the points of a step, moved along their lines of sight from its own depth to the joined depth of their pixels."""
    camera = alone.camera
    cols, rows = (np.floor(place).astype(np.int64) for place in camera.image_coordinates(cloud.points))
    inside = (rows >= 0) & (rows < camera.height) & (cols >= 0) & (cols < camera.width)
    rows, cols = np.where(inside, rows, 0), np.where(inside, cols, 0)
    told = inside & alone.mask[rows, cols]
    before, after = alone.depth[rows, cols], joined.depth[rows, cols]
    if camera.projection == "perspective":
        points = cloud.points * np.where(told, after / np.where(told, before, 1), 1)[:, None]
    else:
        points = cloud.points - np.where(told, after - before, 0)[:, None] * np.array([0, 0, 1])
    return cloud._replace(points=points.astype(np.float32))


def _without_coordinates(maps: DepthMaps) -> DepthMaps:
    return replace(maps, projector_u=None, projector_v=None, sigma_u=None, sigma_v=None)
