"""Light that lies over an image and is not that of its pixels: glare of the lens, light of the room, a black level.

What a matt pixel reflects, and what bounces onto it, is its albedo times something. Light that was scattered in the lens is not: it is
about the same all over an image, and grows with all that the image holds (the veiling glare of ISO 9358). It turns the normals of dark
parts, and the fits are none the worse for it: over the lights a constant is nearly a normal that faces them. So each pixel is fitted by
Lambert's law and a part of the mean m of each image, r = b·l + c m, and of the parts c that is taken which pixels of no albedo would have.
Light of the room and a black level are the same in all images: of one m for all, and of its own for each, the surer is taken.
The facets of rough stone bend Lambert's law otherwise under other normals, and are divided out. What else does, as rough paint or bounced
light, goes with albedo, and the sheen of paint does not: where nothing models it, it turns the normals as glare does.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED
from service.solve.base.batches import view_directions
from service.solve.base.solution import AMBIGUOUS_DEGREES, Solution, SolveInput, at_all_pixels
from service.solve.methods.kinds import FACETS
from stage.capture.point_lights import DistantLights
from stage.spread import MAD_TO_SIGMA, between_blocks, tukey_weights

PIXELS, MOST_LIGHTS = 8192, 96
MATT = 0.015
"""Largest F₀ of a pixel that counts as matt: paint, wood and stone have 0.03 and more, and glare shows as a wide lobe of 0.005 to 0.01."""
LEAST_SURE = 0.5
"""Least part of the pixels whose normals are sure: the others, as those of metals, tell nothing."""
LEAST_COSINE = 0.25
LEAST_READINGS, LEAST_PIXELS, MOST_CONDITION = 7, 500, 1e8
FAR, FAR_PART = 4.0, 0.2
"""Standard deviations and part of the reading by which a reading in shadow or in a highlight is off, at the least."""
LEAST_ERRORS, LARGEST_ERROR, MOST = 5.0, 0.02, 0.5
"""Least glare over its standard error, the largest standard error with which it is told, and the largest part of the mean of an image that
is glare: where albedo hardly varies, standard errors are 0.02 to 9."""
LEAST_DEGREES, LEAST_SHARE = 1.0, 0.01
"""What is said turns normals by this angle, in this part of the pixels."""
LEAST_ALBEDO, TINY = 1e-3, 1e-12
ROUNDS = 10
"""Rounds of re-weighting."""


class Veil(NamedTuple):
    """Glare that images hold, and what it makes of normals."""

    part: float
    """Its part of the mean of an image."""
    degrees: np.ndarray  # [pixels of the image] float32; 0 where no normal is estimated

    @property
    def sentence(self) -> str:
        """What is said of it."""
        return (f"the images hold light that does not depend on the albedo of a pixel, {100 * self.part:.1f} % of their mean, as glare of "
                "the lens, light of the room, a black level, or highlights that the method does not model: it turns the normals of dark "
                "parts, and the layer sigma holds how far; a lens hood, an off frame or --method svbrdf take it away")


class _Readings(NamedTuple):
    pixels: np.ndarray  # [n] positions in the image
    toward: np.ndarray  # [lights, 3] unit
    value: np.ndarray  # [lights, n] π radiance over irradiance, mean of the channels
    lit: np.ndarray  # [lights, n] bool, neither in shadow nor in a highlight
    normal: np.ndarray  # [n, 3] as solved


class _Fits(NamedTuple):
    pixels: np.ndarray  # [n] positions in the image
    part: np.ndarray  # [n] c
    error: np.ndarray  # [n] its standard error
    albedo: np.ndarray  # [n] by Lambert's law alone
    turned: np.ndarray  # [n] radians by which light of the mean of an image turns the normal of a pixel of albedo 1


def find_veil(given: SolveInput, lights: DistantLights, solution: Solution) -> Veil | None:
    """Return the glare that the readings of matt pixels show, or None where they show none that turns normals."""
    matt = np.isin(solution.status, ESTIMATED)
    if solution.specular is not None:
        matt &= solution.specular.max(axis=0) < MATT
    pixels = np.flatnonzero(matt)
    sure = solution.standard_error()[pixels] < AMBIGUOUS_DEGREES
    if len(pixels) < LEAST_PIXELS or sure.mean() < LEAST_SURE or not (lights.irradiance > 0).all():
        return None
    facets = solution.facts.get(FACETS, 0.0)
    readings = _read(given, lights, solution.normal, pixels[evenly(len(pixels), PIXELS)], facets)
    mean = readings.value.mean(axis=1)
    found = [(fits, *_without_albedo(fits, given.mask.shape[1])) for over in (np.full_like(mean, mean.mean()), mean)
             if len((fits := _fit(readings, over)).pixels) >= LEAST_PIXELS]
    if not found:
        return None
    fits, part, error = max(found, key=lambda each: each[1] / max(each[2], TINY))
    if not LEAST_ERRORS * error < part < MOST or error > LARGEST_ERROR:
        return None
    albedo = np.maximum(solution.albedo.mean(axis=0, dtype=np.float32), LEAST_ALBEDO)
    turned = at_all_pixels(matt.reshape(given.mask.shape), fits.pixels, fits.turned)
    degrees = np.degrees(np.arctan(part * turned / albedo)).astype(np.float32)
    if np.mean(degrees[matt] > LEAST_DEGREES) < LEAST_SHARE:
        return None
    return Veil(part, degrees)


def _read(given: SolveInput, lights: DistantLights, normal: np.ndarray, pixels: np.ndarray, facets: float) -> _Readings:
    radiance, usable = given.stack.pick_radiance(pixels)
    chosen = evenly(len(radiance), MOST_LIGHTS)
    toward = lights.direction[chosen].astype(np.float64)
    value = np.where(usable[chosen], np.pi * (radiance[chosen] / lights.irradiance[chosen][:, None]).mean(axis=-1), 0)
    cosine = toward @ normal[:, pixels]
    value /= 1 + facets * faceted(cosine, toward, normal[:, pixels], view_directions(given.camera)(pixels).T)
    lit = usable[chosen] & (cosine > LEAST_COSINE)
    albedo = np.where(lit, value * cosine, 0).sum(axis=0) / np.maximum(np.where(lit, cosine**2, 0).sum(axis=0), 1e-12)
    off = np.abs(value - cosine * albedo)
    noise = np.zeros(len(pixels))
    some = lit.any(axis=0)
    noise[some] = MAD_TO_SIGMA * np.nanmedian(np.where(lit, off, np.nan)[:, some], axis=0)
    return _Readings(pixels, toward, value, lit & (off < np.maximum(FAR * noise, FAR_PART * cosine * albedo)), normal[:, pixels].T)


def faceted(cosine: np.ndarray, toward: np.ndarray, normal: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Return microfacet.faceted, [lights, n], of lights [lights, 3] at normals and views [3, n]; `cosine`: of lights and normals."""
    facing = np.maximum((normal * view).sum(axis=0), TINY)
    return np.maximum(toward @ view - cosine * facing, 0) / np.maximum(cosine, facing)


def _fit(readings: _Readings, over: np.ndarray) -> _Fits:
    """Fit Lambert's law and a part of the light `over` [lights] that lies over each image, at pixels that tell both."""
    columns = np.concatenate([readings.toward, over[:, None]], axis=1)
    gram = np.einsum("ln,li,lj->nij", readings.lit.astype(np.float64), columns, columns)
    told = (readings.lit.sum(axis=0) >= LEAST_READINGS) & (np.linalg.cond(gram) < MOST_CONDITION)
    told &= (readings.lit & (readings.value > 0)).any(axis=0)
    value, weight, gram = readings.value[:, told], readings.lit[:, told].astype(np.float64), gram[told]
    sums = np.einsum("ln,li->ni", weight * value, columns)
    inverse = np.linalg.inv(gram)
    found = np.einsum("nij,nj->ni", inverse, sums)
    left = (weight * (value - columns @ found.T) ** 2).sum(axis=0)
    error = np.sqrt(np.maximum(left / (weight.sum(axis=0) - 4) * inverse[:, 3, 3], 1e-16))
    by_law = np.linalg.solve(gram[:, :3, :3], sums[:, :3, None])[..., 0]
    added = np.linalg.solve(gram[:, :3, :3], gram[:, :3, 3:])[..., 0]  # to b, by all of that light
    along = readings.normal[told]
    across = added - (added * along).sum(axis=1, keepdims=True) * along
    return _Fits(readings.pixels[told], found[:, 3], error, np.linalg.norm(by_law, axis=1), np.linalg.norm(across, axis=1))


def _without_albedo(fits: _Fits, width: int) -> tuple[float, float]:
    """Return the glare of pixels without albedo, c = part + slope · albedo by weights that bear pixels that are off, and its standard
    error for what whole parts of the image leave alike."""
    columns = np.stack([np.ones(len(fits.part)), fits.albedo], axis=1)
    weight = 1 / fits.error**2
    for _ in range(ROUNDS):
        weighted = weight[:, None] * columns
        covariance = np.linalg.pinv(columns.T @ weighted)
        off = fits.part - columns @ (covariance @ (weighted.T @ fits.part))
        spread = MAD_TO_SIGMA * np.median(np.abs(off) / fits.albedo)  # of what goes with albedo
        sigma = np.hypot(fits.error, spread * fits.albedo)
        weight = tukey_weights(off, sigma) / sigma**2
    row, col = np.divmod(fits.pixels, width)
    part = (covariance @ (weighted.T @ fits.part))[0]
    return float(part), float(np.sqrt(between_blocks(covariance, weighted * off[:, None], col, row)[0, 0]))
