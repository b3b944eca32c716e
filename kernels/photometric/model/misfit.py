"""Estimate the error of Lambertian normals: noise and the misfit of the model, told apart on pairs of pixels close to each other.

Noise differs between two pixels, and between lights. What the model lacks (highlights, another fall-off than Lambert's, light from other
surfaces, lights that are not where the manifest says) is nearly the same at both pixels, and at lights close to each other. So it
does not average out over many lights, and a fit can follow it without leaving a residual. Here

    share     part of the squared residuals that both pixels of a pair have in common, by the size of the residuals
    excess    variance of the normal that errors with covariance exp(-½ (angle between lights / SMOOTHNESS)²) cause, over that of
              independent errors which leave the same residuals; minus one, per degree of freedom
    level     residual variance of the object's middle pixel

give every pixel the variance

    σ² = across · s² · (1 + share(s²) · excess · freedom),     s² = (PRIOR · level + squares) / (PRIOR + freedom - 2).

s² is the variance of Student's t distribution that a scaled inverse χ² prior of PRIOR degrees of freedom leaves: with few lights a pixel's
own residuals say little about their size, and those of the other pixels say more.

A solver that rejects readings may have fitted a plane of light through a few that contradict the truth, and be sure of it: a highlight of a
metal and two shadows make a normal as three lights on plaster do. How often that happens on an object shows in its readings to spare: the
part of them that contradicts the fits is the chance of one to do so beside a right fit, and CONTRADICTED of it that of a fit to be wrong. A
pixel's own readings to spare then tell right from wrong fits by Bayes' rule, those that agree against those that contradict.

Sources: Kennedy and O'Hagan, "Bayesian calibration of computer models", JRSS B 2001 (the error of a model as a Gaussian process); Smyth,
"Linear models and empirical Bayes methods", 2004 (residual variances moderated by those of other fits); Fischler and Bolles, "Random
sample consensus", 1981, section II (readings that agree with a wrong fit by chance); the chances themselves are measured.
"""

from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.photometric.lambertian.albedo import BEHIND
from kernels.photometric.model.samples import evenly

SMOOTHNESS = np.radians(32.0)
"""Angle between two lights over which what the model lacks changes: the width of a highlight of roughness 0.55. On real and path-traced
objects of every kind, with 5 to 96 lights, 25° to 35° give errors closest to those observed."""
PRIOR = 4.0
"""Degrees of freedom with which the level of the object counts at each pixel: the smallest whole number above 3, below which Student's t
has one error in a hundred beyond five standard deviations."""
UNKNOWN_LEVEL = 0.05**2
"""Residual variance, relative to |b|², where no pixel has a reading to spare, as under three lights: what real materials leave."""
MEDIAN_ERROR = 1.86
"""Standard error of the median of Gaussian values, over their median absolute deviation and the root of their number: 1.4826 · 1.2533."""
GROUPS = 4
"""Groups of pairs, by their residuals, in each of which the share is measured: an object has matt parts and glossy ones."""
LEAST_PAIRS = 32
"""Least number of pairs that tell the share; with fewer all of the residual is taken for misfit."""
SPREAD_PAIRS = 128
"""Number of pairs from which the excess is computed: it depends on the lights more than on the pixel."""
WRONG_FIT = np.radians(38.0)
"""Standard error of a normal from a wrong fit: the root of the mean square of those beyond 15°, on seven objects."""
CONTRADICTED = 0.6
"""Chance of a fit to be wrong, before its own readings to spare are seen, for each part of an object's readings to spare that contradict.
With the next three numbers measured on eight path-traced and real objects under 4 to 43 lights: normals more than 15° off."""
BY_CHANCE = 0.22
"""Chance of a reading to agree with a wrong fit."""
INDEPENDENT = 1.8
"""Readings to spare that are independent of each other. Lights see the same shadow and the same highlight, so that n of them count as
√(1.8 n)."""
LEAST_CONTRADICTING, MOST_CONTRADICTING = 0.05, 0.7
"""Bounds of the chance of a reading to contradict a right fit: pixels of an object differ."""
TURN = 1.3
"""Angle in radians by which light from other surfaces turns a normal, for each part of the albedo that a pixel shines with under lights
behind it: there all light is theirs, and in front of it as much is added. Measured on two path-traced objects with folds."""
LEAST_BEHIND = 0.1
"""Part of the pixels behind which some light must stand for these to speak for the others."""
LARGEST_ERROR = 90.0
"""Degrees: a visible normal that is not known at all is hardly further off."""


class Misfit(NamedTuple):
    """The misfit of an object, measured by its residuals."""

    level: float = UNKNOWN_LEVEL  # residual variance of the middle pixel, in |b|²
    residuals: np.ndarray = np.array([UNKNOWN_LEVEL])  # [groups] ascending, residual variance at which the share is known
    share: np.ndarray = np.array([1.0])  # [groups] 0…1
    excess: float = 0.0  # per degree of freedom
    albedo_excess: float = 0.0  # the same of the albedo under a given normal
    bounced: float = 0.0  # light from elsewhere, of the middle pixel that has a light behind it, relative to |b|
    contradicting: float = 0.0  # part of the readings to spare that contradicts the fits


class PairFits(NamedTuple):
    """Fits of pairs of pixels that are close to each other; the last axis is [first and second pixel, pair]."""

    readings: np.ndarray  # [lights, 2, pairs]
    weights: np.ndarray  # [lights, 2, pairs] of the fit, 0…1
    directions: np.ndarray  # [lights, 3, 2, pairs] unit, from the surface to the light; may be broadcast
    normal: np.ndarray  # [3, 2, pairs] unit
    squares: np.ndarray  # [2, pairs] of a NormalFit
    freedom: np.ndarray  # [2, pairs]
    spare: np.ndarray  # [2, pairs]
    agreeing: np.ndarray  # [2, pairs]


def measure_misfit(pairs: PairFits) -> Misfit:
    """Return what pairs of neighbouring pixels say about the misfit of an object."""
    lights, _, count = pairs.readings.shape
    if pairs.weights.shape != pairs.readings.shape or pairs.directions.shape != (lights, 3, 2, count):
        raise ArrayError(f"readings are {pairs.readings.shape}, weights {pairs.weights.shape}, directions {pairs.directions.shape}: "
                         "give [lights, 2, pairs] twice, and [lights, 3, 2, pairs]")
    against = 1 - float(pairs.agreeing.sum()) / max(float(pairs.spare.sum()), 1e-30) if pairs.spare.any() else 0.0
    spare = (pairs.freedom > 0).all(axis=0)
    if not spare.any():
        return Misfit(contradicting=against)
    pairs = PairFits(*(values[..., spare] for values in pairs))
    variance = pairs.squares / pairs.freedom
    level = float(np.median(variance / _median_of_chi_squared(pairs.freedom)))
    residual = _residuals(pairs)
    common, total = residual.prod(axis=1).sum(axis=0), 0.5 * (residual**2).sum(axis=(0, 1))
    excess = _excess(PairFits(*(values[..., evenly(spare.sum(), SPREAD_PAIRS)] for values in pairs)))
    bounced = _bounced(pairs)
    if len(total) < LEAST_PAIRS:
        return Misfit(level, np.array([level]), np.ones(1), *excess, bounced, against)
    groups = np.array_split(np.argsort(total), GROUPS)
    share = [_share(common[group], total[group]) for group in groups]
    residuals = np.array([np.median(variance.mean(axis=0)[group]) for group in groups])
    return Misfit(level, np.maximum.accumulate(residuals), np.array(share), *excess, bounced, against)


def _share(common: np.ndarray, total: np.ndarray) -> float:
    """Return the median of one over the median of the other, less its standard error, so that noise is not taken for misfit."""
    middle = np.median(common)
    error = MEDIAN_ERROR * np.median(np.abs(common - middle)) / len(common) ** 0.5
    return float(np.clip((middle - error) / max(np.median(total), 1e-30), 0, 1))


def standard_error(across: np.ndarray, squares: np.ndarray, freedom: np.ndarray, spare: np.ndarray, agreeing: np.ndarray,
                   misfit: Misfit) -> np.ndarray:
    """Return the standard error of normals in degrees, [pixels] float32, of which the [pixels] of a NormalFit are given."""
    across, squares, freedom, spare, agreeing = (np.asarray(values, dtype=np.float64)
                                                 for values in (across, squares, freedom, spare, agreeing))
    own = across * _variance(squares, freedom, misfit, misfit.excess)
    wrong = _wrong(spare, agreeing, misfit.contradicting)
    sigma = np.degrees(np.sqrt((1 - wrong) * own + wrong * np.maximum(own, WRONG_FIT**2)))
    return np.minimum(sigma, LARGEST_ERROR).astype(np.float32)


def _wrong(spare: np.ndarray, agreeing: np.ndarray, usual: float) -> np.ndarray:
    """Return the probability of fits to be wrong, [pixels], from the numbers of readings to spare and of those that agree.
    `usual`: the part of an object's readings to spare that contradicts."""
    likely, chance = np.clip(usual, LEAST_CONTRADICTING, MOST_CONTRADICTING), CONTRADICTED * max(usual, 1e-9)
    odds = agreeing * np.log(BY_CHANCE / (1 - likely)) + (spare - agreeing) * np.log((1 - BY_CHANCE) / likely)
    odds *= np.sqrt(INDEPENDENT / np.maximum(spare, INDEPENDENT))
    return np.asarray(1 / (1 + (1 - chance) / chance * np.exp(-odds)))


def albedo_error(albedo: np.ndarray, squares: np.ndarray, openness: np.ndarray, bounced: np.ndarray, freedom: np.ndarray,
                 misfit: Misfit) -> np.ndarray:
    """Return the standard deviation of albedo under a given normal, [3, pixels] float32, from the planes of an AlbedoFit and the `freedom`
    of the NormalFit, [pixels]."""
    reading = np.divide(squares, openness, out=np.zeros_like(squares), where=openness > 0)
    variance = openness * _variance(reading, freedom, misfit, misfit.albedo_excess) + _light_from_elsewhere(bounced, misfit) ** 2
    return np.asarray(albedo * np.sqrt(variance), dtype=np.float32)


def with_bounced(sigma: np.ndarray, bounced: np.ndarray, misfit: Misfit) -> np.ndarray:
    """Return the standard error of normals in degrees with that of the light which other surfaces send, `bounced` of an AlbedoFit."""
    turned = np.degrees(TURN * _light_from_elsewhere(bounced, misfit))
    return np.minimum(np.hypot(sigma, turned), LARGEST_ERROR).astype(np.float32)


def _light_from_elsewhere(bounced: np.ndarray, misfit: Misfit) -> np.ndarray:
    """Return what pixels show of it, and what the object's middle pixel shows where no light stands behind one."""
    return np.where(bounced >= 0, bounced, misfit.bounced)


def _variance(squares: np.ndarray, freedom: np.ndarray, misfit: Misfit, excess: float) -> np.ndarray:
    """Return the variance of a reading whose misfit would cause as much error if it were independent between lights, relative to |b|²."""
    level = np.where(freedom > 0, misfit.level, max(misfit.level, UNKNOWN_LEVEL))
    variance = (PRIOR * level + squares) / (PRIOR + freedom)
    share = np.interp(np.log(np.maximum(variance, 1e-30)), np.log(np.maximum(misfit.residuals, 1e-30)), misfit.share)
    return np.asarray(variance * np.maximum(1 + share * excess * freedom, 0.0))


def _median_of_chi_squared(freedom: np.ndarray) -> np.ndarray:
    """Return the median of χ² over its degrees of freedom (Wilson and Hilferty 1931)."""
    return np.maximum(1 - 2 / (9 * np.maximum(freedom, 1.0)), 0.1) ** 3


def _bounced(pairs: PairFits) -> float:
    """Return the median of the mean readings under lights behind the surface, in |b|; 0 where few pixels have one: those of a rim alone,
    where light and neighbours mix, do not speak for the object."""
    relative, cosine = _relative(pairs)
    behind = cosine < BEHIND
    count = behind.sum(axis=0)
    if np.count_nonzero(count) <= LEAST_BEHIND * count.size:
        return 0.0
    return float(np.median((relative * behind).sum(axis=0)[count > 0] / count[count > 0]))


def _residuals(pairs: PairFits) -> np.ndarray:
    """Return [lights, 2, pairs] the residuals of the fits, in |b|, times the roots of their weights."""
    relative, cosine = _relative(pairs)
    return np.sqrt(pairs.weights) * (relative - cosine)


def _relative(pairs: PairFits) -> tuple[np.ndarray, np.ndarray]:
    """Return [lights, 2, pairs] the readings in |b|, and the cosines that would be those of Lambert's law."""
    cosine = np.einsum("lcsp,csp->lsp", pairs.directions, pairs.normal)
    scale = (pairs.weights * pairs.readings * cosine).sum(axis=0) / np.maximum((pairs.weights * cosine**2).sum(axis=0), 1e-30)
    return pairs.readings / np.maximum(scale, 1e-30), cosine


def _excess(pairs: PairFits) -> tuple[float, float]:
    """Return the excess variance of the normal and of the albedo per degree of freedom, from the first pixel of each pair.

    The products of the pair's residuals are matched, in the least squares sense, by those that two kinds of errors would leave: one
    independent between lights, as wrong strengths of lights are, and one smooth over them. The first kind averages out.
    """
    gram, target, more, freedom = np.zeros((2, 2)), np.zeros(2), np.zeros(2), 0.0
    residual = _residuals(pairs)
    for p in range(pairs.freedom.shape[1]):
        used = pairs.weights[:, 0, p] > 0
        if used.sum() <= 3:
            continue
        w, light, n = pairs.weights[used, 0, p], pairs.directions[used, :, 0, p], pairs.normal[:, 0, p]
        gain = np.linalg.pinv((w[:, None] * light).T @ light) @ (w[:, None] * light).T  # [3, lights]: from readings to b
        across = gain - np.outer(n, n @ gain)
        along = (w * (light @ n))[None]  # [1, lights]: from readings to the albedo under the normal n, but for a factor
        smooth = np.exp(-0.5 * (np.arccos(np.clip(light @ light.T, -1, 1)) / SMOOTHNESS) ** 2)
        kinds = np.stack([_left(np.eye(len(w)), light, gain), _left(smooth, light, gain)]) * np.sqrt(np.outer(w, w))
        seen = np.trace(kinds, axis1=1, axis2=2)
        if seen.min() < 1e-6:
            continue
        kinds /= seen[:, None, None]
        product = np.outer(*residual[used][:, :, p].T)
        gram += np.einsum("aij,bij->ab", kinds, kinds)
        target += np.einsum("aij,ij->a", kinds, product) / max(0.5 * (residual[:, :, p] ** 2).sum(), 1e-30)
        more += [seen[0] * ((map_ @ smooth) * map_).sum() / seen[1] / max((map_**2).sum(), 1e-30) - 1 for map_ in (across, along)]
        freedom += pairs.freedom[0, p]
    if freedom == 0:
        return 0.0, 0.0
    part = np.linalg.lstsq(gram, target, rcond=None)[0]
    if part[0] < 0:  # least squares with parts of at least 0
        part = np.array([0.0, 1.0])
    share = np.clip(part[1], 0, None) / max(np.clip(part, 0, None).sum(), 1e-30)
    normal, albedo = np.maximum(share * more / freedom, 0.0)
    return float(normal), float(albedo)


def _left(errors: np.ndarray, light: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Return the covariance of the residuals of a fit, from that of the errors of its readings, both [lights, lights].

    The fit takes `light @ gain` of the errors out, [lights, 3] directions and [3, lights] from readings to b. As products with three
    columns that is a tenth of the work of whole matrices, which BLAS would divide among threads that wait for each other.
    """
    rest = errors - light @ (gain @ errors)
    return rest - (rest @ gain.T) @ light.T
