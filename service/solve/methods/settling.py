"""Interreflection settled: the surface, its albedo and the light that it throws on itself are found again from each other.

Bounced light makes hollows look shallower, so that the first search underestimates form factors, and its albedo contains the bounce. One
pixel of each block is searched again in its direct light; what this changes is carried over to the block, and the arriving light follows
anew. In each round shadows and lit readings say how strong the arriving light is: gloss, which sends most of it where light falls, and
surfaces that the camera does not see add to that of the form factors, and where the scale of the lights is unknown, so is that of albedo,
which shadows alone tell. Where shadows show no bounced light, or none falls and lit readings deny it, none is taken out at all.

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991, section 4: shape and interreflection are corrected in turn.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from kernels.photometric.model.samples import Samples, readings_of
from kernels.photometric.search.hypotheses import LobeShape
from service.light_estimation.lambertian import degrees_between
from service.solve.height.beyond import LIKELY as GOES_ON
from service.solve.height.beyond import light_from_beyond
from service.solve.height.direct_light import DirectLight
from service.solve.height.ground import LIKELY as ON_GROUND
from service.solve.height.ground import Ground
from service.solve.height.height import projection_of
from service.solve.height.interreflection import Patches, patches_of
from service.solve.methods.bounce_evidence import Evidence, is_lit_by_bounces, middles_of
from service.solve.methods.shadow_light import RELATIVE_NOISE, ScaleFit, has_bounced, largest_scale, shown_bounce

ROUNDS = 2
"""Rounds: the third changes the scale of albedo by 1 %."""
UNKNOWN_STRENGTH = 0.5
"""Relative error of the strength where shadows do not tell it: 1.2 to 2.5 times the light of the form factors arrives in glossy folds, and
1.0 to 1.2 times in matt ones."""
TOLD_DEGREES = 3.0
"""Turn by light from beyond the image from which on it is said: it is 1.7 to 8.5° in folds that fill the image."""
NEIGHBOURS = 5
"""Blocks, of which the median tells by how much an unknown strength turns normals: one pixel alone may jump to another normal."""
SHADOW_PART = 0.1
"""Part of the mean of a pixel's readings below which a reading is not lit."""


class Settled(NamedTuple):
    """Interreflection after the rounds, or without them where none is to be taken out or near lights settle it with the surface."""

    light: DirectLight
    shown: float | None
    """What shadows show of it, of `shown_bounce`."""
    rounds: bool = False
    scale: ScaleFit | None = None
    """The fit by shadows of the scale of albedo, or of the light that arrives; None where they do not decide it."""
    degrees: np.ndarray | float = 0.0
    """By how much its unknown strength, and what may arrive from the ground and from beyond the image, turn the normals, [pixels]
    float32."""
    beyond: float | None = None
    """The 95th percentile of the latter alone, degrees; None where the surface reaches no border of the image."""
    from_ground: float | None = None
    """The part of the light taken out that the ground sends; None where the images show none."""

    def report(self, *, relative: bool) -> dict[str, Any]:
        """Return what the report says about bounced light, and, where the lights are `relative`, about the scale of albedo."""
        told: dict[str, Any] = {"taken_out": self.light.arriving is not None}
        if self.shown is not None:
            told["shown"] = round(self.shown, 3)
        if self.rounds:
            told["strength"] = round(self.light.albedo_scale, 3)
        if self.beyond is not None:
            told["beyond_image_degrees"] = round(self.beyond, 2)
        if self.from_ground is not None:
            told["from_ground"] = round(self.from_ground, 3)
        return {"bounced_light": told} | ({"albedo_scale": self._albedo_scale()} if self.rounds and relative else {})

    def warnings(self) -> list[str]:
        """Return what there is to say of light from beyond the image."""
        if self.beyond is None or self.beyond <= TOLD_DEGREES:
            return []
        return [f"the surface goes on beyond the image, and light that bounces there may turn normals by {self.beyond:.0f}°, which sigma "
                "holds: take more of it into the picture"]

    def _albedo_scale(self) -> dict[str, Any]:
        if self.scale is None:
            return {"decided": False, "value": 1.0}
        value = min(self.scale.scale, largest_scale(self.light))
        return {"decided": True, "value": round(value, 4), "sigma": round(max(self.scale.sigma, self.scale.scale - value), 4),
                "from_shadows": round(self.scale.scale, 4), "stray_light": round(self.scale.stray, 5), "readings": self.scale.readings}


def settle(light: DirectLight, normal: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples], *, relative: bool,
           direct: bool) -> Settled:
    """Find the light that an object throws on itself, and gets from the ground that it lies on, from the surface without either.
    `light`: of a first search, with the light that the object throws on itself, as `normal` [3, pixels] is. `pick`: gives the readings of a
    few pixels by their positions. `relative`: whether the scale of the lights, and so of albedo, is unknown. `direct`: whether `light` and
    `normal` are of an earlier solution, whose albedo holds no bounced light."""
    within = middles_of(light, pick)
    told = Evidence(within, normal[:, within.pixels].T, shape, pick, relative)
    patches = patches_of(light.given, light.lights, normal, light.height, within.solved)
    ground = None if patches is None else Ground.of(light.given, light.lights, patches)
    if patches is not None and ground is not None:
        light = light.with_more(_sent_by(ground, light, patches, told).mean)
    shown = shown_bounce(*told.in_shadow(light))
    bounced = is_lit_by_bounces(told.cost_of(light), relative=relative) if shown is None else has_bounced(light, shown)
    if not bounced:
        return Settled(light._replace(arriving=None), shown)
    return _in_rounds(light, normal, told, ground, direct=direct)._replace(shown=shown)


class _Sent(NamedTuple):
    """The light of surfaces of which the images do not say where they are."""

    ways: np.ndarray
    """[ways, patches, 3, lights] as of `ArrivingLight`."""
    likely: np.ndarray
    """[ways], the likelihood of each."""

    @property
    def mean(self) -> np.ndarray:
        """The light that is expected, [patches, 3, lights]."""
        return np.tensordot(self.likely, self.ways, 1)


def _sent_by(ground: Ground, light: DirectLight, patches: Patches, told: Evidence) -> _Sent:
    """Return the light of the ground."""
    ways = ground.light_on(patches, light.height)
    return _Sent(ways, told.likelihoods(light, ways, ON_GROUND))


def _sent_from_beyond(light: DirectLight, patches: Patches, told: Evidence) -> _Sent | None:
    """Return the light of what lies beyond the image, or None where the surface ends within."""
    directions = light.lights.direction[:light.given.stack.light_count]
    ways = light_from_beyond(patches, light.given.camera, directions, light.height, told.within.solved)
    return None if ways is None else _Sent(ways, told.likelihoods(light, ways, GOES_ON))


def _in_rounds(light: DirectLight, first: np.ndarray, told: Evidence, ground: Ground | None, *, direct: bool) -> Settled:
    """Return the light after the rounds. `first`: [3, pixels], the normals before them, of which `told` is. `direct` as of `settle`."""
    solved, block, middles, whole = told.within
    pixels, albedo, start, camera = np.flatnonzero(solved), light.albedo, told.normal, light.given.camera
    for _ in range(ROUNDS):
        light, _ = told.with_strength(light, told.cost_of(light))
        samples, turned = told._replace(normal=start).searched(light)
        told = told._replace(normal=turned)
        again, dimmed = first.copy(), albedo.copy()
        again[:, pixels] = _turn(first[:, pixels].T, start[block], turned[block]).T
        if not direct:
            dimmed[:, pixels] = albedo[:, pixels] * _direct_part(readings_of(samples), whole)[block]
        patches = patches_of(light.given, light.lights, again, light.height, solved)
        assert patches is not None  # what is solved, and so is a patch, stays the same
        light = light._replace(arriving=patches.arriving(light.height, projection_of(camera)), albedo=dimmed)
        below = None if ground is None else _sent_by(ground, light, patches, told)
        light = light if below is None else light.with_more(below.mean)
        beyond = _sent_from_beyond(light, patches, told)
        light = light if beyond is None else light.with_more(beyond.mean)
    settled, fit = told.with_strength(light, told.cost_of(light))
    unknown = UNKNOWN_STRENGTH if fit is None else math.hypot(RELATIVE_NOISE, fit.sigma / fit.scale, settled.albedo_scale / fit.scale - 1)
    places = np.stack(np.divmod(middles, camera.width), axis=1)
    nearest = cKDTree(places).query(places, k=range(1, min(NEIGHBOURS, len(places)) + 1))[1]
    _, now = told.searched(settled)

    def turn(other: DirectLight) -> np.ndarray:
        return np.median(degrees_between(now.T, told.searched(other)[1].T)[nearest], axis=1)

    def turn_by(sent: _Sent | None, weights: np.ndarray | None) -> np.ndarray:
        """Return the root of the weighted mean square, over the ways, of the turn by the light of each."""
        if sent is None:
            return np.zeros(len(middles))
        return np.sqrt(np.average([turn(settled.with_more(way - sent.mean))**2 for way in sent.ways], axis=0, weights=weights))

    goes_on = turn_by(beyond, None)
    parts = [turn(settled._replace(albedo_scale=(1 + unknown) * settled.albedo_scale)), goes_on,
             turn_by(below, None if below is None else below.likely)]
    degrees = np.zeros(solved.size, np.float32)
    degrees[pixels] = np.linalg.norm(parts, axis=0)[block]
    assert settled.arriving is not None
    return Settled(settled, None, True, fit, degrees, None if beyond is None else float(np.percentile(goes_on, 95)),
                   None if below is None else float(below.mean.sum() / max(settled.arriving.light.sum(), 1e-12)))


def _turn(normals: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return normals [n, 3], each turned by the least rotation that takes one unit vector to another; Rodrigues' formula."""
    axis, cosine = np.cross(before, after), (before * after).sum(axis=1, keepdims=True)
    along = axis * ((axis * normals).sum(axis=1, keepdims=True) / (1 + cosine))
    return normals * cosine + np.cross(axis, normals) + along


def _direct_part(direct: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return [n] the part of the lit readings [n, lights] that is direct light."""
    lit = (direct > 0) & (whole > SHADOW_PART * whole.mean(axis=1, keepdims=True))
    return np.where(lit, direct, 0).sum(axis=1) / np.maximum(np.where(lit, whole, 0).sum(axis=1), 1e-12)
