"""Solved maps or depths of consecutive steps, joined: normals, albedo, lobes and heights of pixels whose steps agree."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import ndimage

from service.sequences.agreement import Track, advance, agree, begin, noise_share, steady
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from stage.spread import MAD_TO_SIGMA

LEAST_ALBEDO = 0.02
"""Reflectance below which the noise of albedo is that of this reflectance."""
ALBEDO_NOISE = 2.0
"""Relative noise of albedo over that of the normals, in radians, up to which differences between neighbours count as noise."""
LARGEST_GAIN = 0.25
"""Change of the brightness of all lights between two steps, as a logarithm, up to which it is taken out; a larger one is said."""
GAIN_SHARE, GAIN_TEXTURE = 0.5, 0.35
"""Part of the pixels of both steps at which the normals must agree, and largest range of the changes of nine tenths of the albedo over that
of the albedo, for a larger one to be said: another subject has another texture, wet skin is darker by no one factor, and walls without
texture tell nothing. Of 350 other pairs of steps none is told so, and 30 of 50 whose exposure is wrong."""
GAIN_SPREAD = 0.5
"""Largest spread of the changes of albedo over their median at which they count as a change of the brightness of all lights."""
GAIN_SIGMAS = 4.0
"""Least change of the brightness in its standard errors."""
LEAST_GAIN_PIXELS = 256
"""Least number of pixels at rest that tell of the brightness of all lights."""
LAYERS = (("specular", 0.004), ("roughness", 0.01))
"""Further layers that are joined, each where it agrees too, with its least standard deviation: the step of its fit."""


@dataclass
class MapsJoiner:
    """The recursive mean of solved maps, step by step."""

    anchored: bool
    """True if the height has no place of its own, as under distant lights: the part at rest then keeps its height."""
    _before: SurfaceMaps | None = None
    _gain: float = 1.0
    _normal: Track | None = None
    _albedo: Track | None = None
    _height: Track | None = None
    _others: dict[str, Track] = field(default_factory=dict)

    def join(self, alone: SurfaceMaps) -> tuple[SurfaceMaps, dict[str, Any]]:
        """Return the maps of a step, of which `alone` was found, joined with those before, and what the report says."""
        assert alone.normal is not None and alone.sigma is not None
        sigma = np.radians(alone.sigma.astype(np.float32))
        if self._before is None or self._normal is None:
            self._begin(alone, sigma, np.ones_like(sigma))
            self._before = alone
            return alone, {"joined_pixels": 0, "steps_joined": {"median": 1.0, "most": 1}}
        before = self._before
        both = alone.mask & before.mask & (self._normal.count > 0)
        assert before.normal is not None and before.sigma is not None
        declared = sigma**2 + np.radians(before.sigma.astype(np.float32)) ** 2
        share = noise_share(alone.normal - before.normal, declared, both, 2)
        if (self._normal.count[both] == 1).all():  # only now is known how much of the first step is noise
            self._begin(before, np.radians(before.sigma.astype(np.float32)), share)
        new = begin(alone.normal, sigma, share, alone.mask)
        rest = agree(new.mean - self._normal.mean, new.noise + self._normal.noise, both, 2)
        rest &= steady(self._normal, new, rest, 2, unit=True)
        gain, apart_by = self._gain_of(alone, rest, both)
        albedo, shares = self._albedo_of(alone, before, both, new.noise, gain)
        if albedo is not None and self._albedo is not None:
            for channel in range(3):  # what a light does to all channels is in the noise of each
                apart = (albedo.mean - self._albedo.mean)[..., channel : channel + 1]
                rest = agree(apart, (albedo.noise + self._albedo.noise) / 3, both & rest, 1)
            rest &= steady(self._albedo, albedo, rest, 3)
            self._albedo = advance(self._albedo, albedo, rest)
        self._normal = advance(self._normal, new, rest, unit=True)
        changed: dict[str, Any] = {"normal": self._normal.mean, "sigma": np.degrees(self._normal.sigma)}
        if self._albedo is not None:
            changed["diffuse_albedo"] = self._albedo.mean
        for name, least in LAYERS:
            if (layer := self._layer(name, least, alone, before, rest)) is not None:
                changed[name] = layer
        height, offset = self._height_of(alone, rest)
        if height is not None:
            changed["height"] = height
        self._before, self._gain = alone, gain
        kept = alone.mask
        joined = replace(alone, **{name: np.where(kept if values.ndim == 2 else kept[..., None], values, getattr(alone, name))
                                   for name, values in changed.items() if getattr(alone, name) is not None})
        count = self._normal.count[kept]
        return joined, {
            "joined_pixels": int(np.count_nonzero(rest)), "compared_pixels": int(np.count_nonzero(both)),
            "steps_joined": {"median": float(np.median(count)) if len(count) else 0.0, "most": int(count.max(initial=0))},
            "noise_share": {"normal": _middle(share, both), **shares}, "brightness": round(gain, 5),
            **({} if apart_by is None else {"brightness_apart": round(apart_by, 3)}),
            **({} if offset is None else {"height_offset": float(f"{offset:.6g}")})}

    def _begin(self, maps: SurfaceMaps, sigma: np.ndarray, share: np.ndarray) -> None:
        assert maps.normal is not None
        self._normal = begin(maps.normal, sigma, share, maps.mask)
        if maps.diffuse_albedo is not None:
            relative = np.sqrt(self._normal.noise / 2)
            self._albedo = begin(maps.diffuse_albedo, relative * _level(maps), np.ones_like(sigma), maps.mask)
        if maps.height is not None:
            self._height = begin(maps.height[..., None], sigma, np.ones_like(sigma), maps.mask)
        for name, least in LAYERS:
            values = getattr(maps, name)
            if values is not None:
                self._others[name] = begin(_deep(values), np.full(sigma.shape, least, np.float32), np.ones_like(sigma), maps.mask)

    def _gain_of(self, alone: SurfaceMaps, rest: np.ndarray, both: np.ndarray) -> tuple[float, float | None]:
        """Return the brightness of all lights over that of the first step, 1 where nothing tells that it has changed, and by which factor
        the albedo is another, if it is by more than is taken out; None: it is not."""
        if alone.diffuse_albedo is None or self._albedo is None or np.count_nonzero(rest) < LEAST_GAIN_PIXELS:
            return 1.0, None
        now, then = (values[rest].mean(axis=-1).astype(np.float64) for values in (alone.diffuse_albedo, self._albedo.mean))
        told = then > LEAST_ALBEDO
        if np.count_nonzero(told) < LEAST_GAIN_PIXELS:
            return 1.0, None
        change = np.log(np.maximum(now[told], 1e-6) / then[told])
        middle = float(np.median(change))
        spread = MAD_TO_SIGMA * float(np.median(np.abs(change - middle)))
        sure = abs(middle) > GAIN_SIGMAS * spread / np.sqrt(len(change)) and spread < GAIN_SPREAD * abs(middle)
        if not sure or abs(middle) < LARGEST_GAIN:
            return (float(np.exp(middle)) if sure else 1.0), None
        changes, texture = (float(np.subtract(*np.percentile(values, (95, 5)))) for values in (change, np.log(then[told])))
        same = len(change) > GAIN_SHARE * np.count_nonzero(both) and changes < GAIN_TEXTURE * texture
        return 1.0, float(np.exp(middle)) if same else None

    def _albedo_of(self, alone: SurfaceMaps, before: SurfaceMaps, both: np.ndarray, noise: np.ndarray,
                   gain: float) -> tuple[Track | None, dict[str, float]]:
        """Return the albedo of the step at the brightness of the steps before, with the noise that neighbours tell."""
        if alone.diffuse_albedo is None or before.diffuse_albedo is None or self._albedo is None:
            return None, {}
        values, earlier = alone.diffuse_albedo / gain, before.diffuse_albedo / self._gain
        level = _level(alone)
        share = noise_share(values - earlier, 2 * level**2, both, 3)
        most = ALBEDO_NOISE**2 * float(np.median(noise[both])) / 2 if both.any() else 1.0
        share = np.minimum(share, max(most, 1e-8))
        if (self._albedo.count[both] == 1).all():
            self._albedo = begin(earlier, _level(before), share, before.mask)
        new = begin(values, level, share, alone.mask)
        return replace(new, constant=np.zeros_like(new.constant)), {"albedo_relative": _middle(np.sqrt(share), both)}

    def _layer(self, name: str, least: float, alone: SurfaceMaps, before: SurfaceMaps, rest: np.ndarray) -> np.ndarray | None:
        """Return a further layer, joined where it agrees too."""
        now, earlier, track = getattr(alone, name), getattr(before, name), self._others.get(name)
        if now is None or earlier is None or track is None:
            return None
        values = _deep(now)
        spread = np.abs(values - _deep(earlier)).max(axis=-1)[rest]
        sigma = max(least, MAD_TO_SIGMA * float(np.median(spread)) / np.sqrt(2)) if len(spread) else least
        new = begin(values, np.full(rest.shape, sigma, np.float32), np.ones(rest.shape, np.float32), alone.mask)
        same = rest & (np.abs(values - track.mean).max(axis=-1) <= 3 * np.sqrt(new.noise + np.maximum(track.noise, least**2)))
        self._others[name] = advance(replace(track, noise=np.maximum(track.noise, sigma**2 / np.maximum(track.count, 1))), new, same)
        mean = self._others[name].mean
        return mean if now.ndim == 3 else mean[..., 0]

    def _height_of(self, alone: SurfaceMaps, rest: np.ndarray) -> tuple[np.ndarray | None, float | None]:
        """Return the height, joined with that of the steps before; under distant lights in the place of the part at rest."""
        if alone.height is None or self._height is None or not self.anchored:
            return None, None
        offset = float(np.median(alone.height[rest] - self._height.mean[rest][:, 0])) if rest.any() else 0.0
        height = np.where(alone.mask, alone.height - offset, 0)
        flat = np.ones(rest.shape, np.float32)
        new = begin(height[..., None], flat, flat, alone.mask)  # as often joined as the normals, so that every step weighs the same
        self._height = advance(replace(self._height, noise=1 / np.maximum(self._height.count, 1).astype(np.float32)), new, rest)
        return self._height.mean[..., 0], offset


def _level(maps: SurfaceMaps) -> np.ndarray:
    """Return [rows, cols] the length of albedo and F0, at least LEAST_ALBEDO, to which the noise of albedo is relative: that of a metal is
    what its lobe leaves."""
    both = [np.linalg.norm(layer.astype(np.float32), axis=-1) for layer in (maps.diffuse_albedo, maps.specular) if layer is not None]
    return np.asarray(np.maximum(sum(both), LEAST_ALBEDO))


def _deep(values: np.ndarray) -> np.ndarray:
    """Return [rows, cols, k] of a layer with or without channels."""
    return np.asarray((values if values.ndim == 3 else values[..., None]).astype(np.float32))


def _middle(values: np.ndarray, where: np.ndarray) -> float:
    """Return the median of some pixels, with four digits."""
    return float(f"{np.median(values[where]):.4g}") if where.any() else 0.0


UNUSUAL, AROUND = 2.0, 9
"""Most times that the deviation of a depth that is joined may have of the median in a window with this side: a far wider one is that of a
pixel that may see two surfaces, as at a silhouette, and agrees with either."""


def _usual(sigma: np.ndarray) -> np.ndarray:
    """Return where deviations, [rows, cols], are those of the pixels around, [rows, cols] bool."""
    return np.asarray(sigma <= UNUSUAL * ndimage.median_filter(sigma, AROUND))


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
        both = valid & before.mask & (earlier > 0) & _usual(sigma) & _usual(earlier)
        difference = values - before.depth[..., None]
        share = noise_share(difference, sigma**2 + earlier**2, both, 1)
        if (self._track.count[both] == 1).all():  # only now is known how much of the first step is noise
            self._track = begin(before.depth[..., None], earlier, share, before.mask & (earlier > 0))
        new = begin(values, sigma, share, valid)
        rest = agree(new.mean - self._track.mean, new.noise + self._track.noise, both, 1)
        rest &= steady(self._track, new, rest, 1)
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
            "noise_share": {"depth": _middle(share, both)}}


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
