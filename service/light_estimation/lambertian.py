"""A robust Lambertian fit of the readings of a few pixels, with which explanations of the images are compared.

It is no solver: it is fast, it treats every explanation alike, and its misfit is the spread of the readings about n·l.

From it follows which lights the images contradict in direction or strength, while the other lights agree with each other.
"""

from typing import NamedTuple

import numpy as np

from stage.spread import MAD_TO_SIGMA

SHADOW = 0.1
"""A reading below this part of the bright readings of its pixel is in shadow, or grazed, and is not compared."""
BRIGHT_END = 0.9
"""The quantile of the readings of a pixel that stands for its bright ones: a highlight is brighter still."""
ROUNDS = 6
"""Rounds of re-weighting; the weights change by less than a hundredth after five."""
CAUCHY = 1.5
"""Scale of the Cauchy weights in standard deviations of the pixel's residual, as in service.light_estimation.grey_ball."""
LEAST_SPREAD = 0.01
"""Least standard deviation that the weights assume, relative to |b|: half rounding and eight-bit images are below it."""
SPARE = 2
"""Readings above the three unknowns that a pixel needs to have a misfit."""
LEAST_COSINE = 0.25
"""Least n·l of a reading that is compared: below it, shadows and grazing reflection cause misfits that are not the light's fault."""
LEAST_TOWARDS = 0.4
"""Least cosine between a light and the view axis at which the light is judged: lights further round are mirrored by rims and hidden from
most pixels."""
LEAST_PIXELS = 20
"""Least number of these pixels that must see a light for it to be judged."""
SIDE, PLANE = (10.0, 15.0), (3.0, 5.0)
"""Degrees within which normals, or patterns of readings, are those of one side of an object, and beyond which those of another; and of one
plane and another."""
LEAST_APART = 20
"""Number of pixels that face otherwise than most from which on they must agree with what explains the others."""
SUSPECT_OFF, SUSPECT_TIMES = 0.1, 4.0
"""A light is suspect when its median relative misfit is above the first number, and above the second number times the median of all
lights."""
CAST = -0.7
"""A reading that is so far below the level of its pixel, relative to it, lies in a cast shadow, unless most of the light's do."""

FACING, FACING_INSTEAD = 0.8, 0.83
"""Normals of which fewer than the first part face the camera are wrong if at least the second part does with other axes: 0.85 of objects
with metal parts. Bare metal, whose Lambertian normals are poor, has as little as 0.64, but then less than 0.8 in any other direction;
beside metal, what fits Lambert's law faces the camera."""
FITS = 0.1
"""Robust standard deviation of the residuals of a pixel that fits Lambert's law, relative to |b|: metal leaves 0.13 and more."""


class ViewAxis(NamedTuple):
    """An axis of the lights that looks like the one towards the camera."""

    axis: int
    sign: int
    share: float
    """The part of the pixels whose normal faces along it."""


class Fit(NamedTuple):
    """b = level · normal of each pixel, and what it leaves."""

    vector: np.ndarray  # [3, pixels] float64
    residual: np.ndarray  # [lights, pixels] float64, (reading - b·l) / |b|; 0 where not lit
    lit: np.ndarray  # [lights, pixels] bool: readings that are compared

    @property
    def normal(self) -> np.ndarray:
        """The unit normals, [3, pixels]."""
        return self.vector / np.maximum(np.linalg.norm(self.vector, axis=0), 1e-300)

    @property
    def facing(self) -> float:
        """The part of the pixels whose normal has z > 0, as every visible surface has."""
        return float((self.vector[2] > 0).mean())

    @property
    def towards_camera(self) -> ViewAxis | None:
        """The axis along which visible surfaces face where it is not z, as where directions are negated or axes exchanged; else None."""
        fitting = self.vector[2, self.spare & (MAD_TO_SIGMA * median_of(np.abs(self.residual), self.lit) < FITS)]
        if self.facing >= FACING or (len(fitting) >= LEAST_APART and (fitting > 0).mean() >= FACING_INSTEAD):
            return None
        found = max((ViewAxis(axis, sign, float((sign * self.vector[axis] > 0).mean())) for axis in (2, 1, 0) for sign in (1, -1)),
                    key=lambda each: each.share)
        return found if found.share >= FACING_INSTEAD else None

    @property
    def spare(self) -> np.ndarray:
        """Return whether each pixel has more readings than unknowns, [pixels] bool."""
        return np.asarray(self.lit.sum(axis=0) > 2 + SPARE)

    @property
    def apart(self) -> np.ndarray:
        """Return whether each pixel faces otherwise than most, [pixels] bool."""
        return unlike_most(self.vector, SIDE)

    def misfit(self, pixels: np.ndarray | bool = True) -> float:
        """Return the robust standard deviation of the residuals of pixels [pixels] with readings to spare; NaN without any."""
        chosen = self.lit & self.spare & pixels
        return MAD_TO_SIGMA * float(np.median(np.abs(self.residual[chosen]))) if chosen.any() else np.nan


def unlike_most(vectors: np.ndarray, degrees: tuple[float, float], count: int = 1) -> np.ndarray:
    """Return which of some vectors [n, pixels], normals or patterns of readings, are not as those of the `count` largest sides or planes,
    within and beyond these `degrees`, [pixels] bool. Highlights of a plane look like other lights to all of its pixels: only those that
    face otherwise tell."""
    alike, beyond = np.cos(np.radians(degrees))
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=0), 1e-300)
    cosines = unit.T @ unit
    apart = np.ones(len(cosines), dtype=bool)
    for _ in range(count):
        commonest = (cosines[:, apart] > alike).sum(axis=1).argmax()
        apart &= cosines[commonest] < beyond
    return apart


def fit_lambertian(
    readings: np.ndarray,  # [lights, pixels] radiance over irradiance
    usable: np.ndarray,  # [lights, pixels] bool, True for unsaturated readings
    directions: np.ndarray,  # [lights, 3] unit, or [lights, n] with what else adds to each reading
    rounds: int = ROUNDS,
) -> Fit:
    """Fit b·l to the readings of each pixel by re-weighted least squares with Cauchy weights; of n columns b has n numbers."""
    lit = usable & (readings > SHADOW * bright_readings(readings, usable)) & (readings > 0)
    weight = lit.astype(np.float64)
    for _ in range(rounds):
        vector = least_squares(readings, weight, directions)
        residual = np.where(lit, readings - directions @ vector, 0) / np.maximum(np.linalg.norm(vector, axis=0), 1e-300)
        spread = MAD_TO_SIGMA * median_of(np.abs(residual), lit) + LEAST_SPREAD
        weight = lit / (1 + (residual / (CAUCHY * spread)) ** 2)
    return Fit(vector, residual, lit)


def normal_equations(weight: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return Σ weight basis basisᵀ of each column, [columns, n, n] of a basis [readings, n]."""
    count = basis.shape[1]
    outer = (basis[:, :, None] * basis[:, None, :]).reshape(-1, count * count)
    return np.asarray((weight.T @ outer).reshape(-1, count, count))


def least_squares(readings: np.ndarray, weight: np.ndarray, basis: np.ndarray, ridge: float = 1e-9) -> np.ndarray:
    """Return the [n, columns] that minimise Σ weight (readings - basis x)² in each column, 0 where no reading has weight.
    `basis`: [readings, n]."""
    gram = normal_equations(weight, basis)
    gram += (ridge * np.trace(gram, axis1=1, axis2=2) + 1e-200)[:, None, None] * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(gram, ((weight * readings).T @ basis)[:, :, None])[:, :, 0].T)


def bright_readings(readings: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return the level of the bright readings of each pixel, [pixels]."""
    return np.asarray(np.quantile(np.where(usable, readings, 0), BRIGHT_END, axis=0))


def median_of(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the lower median of the chosen values of each column, [columns]; 0 where none is chosen."""
    count = chosen.sum(axis=0)
    ordered = np.sort(np.where(chosen, values, np.inf), axis=0)
    return np.where(count > 0, ordered[np.maximum(count - 1, 0) // 2, np.arange(values.shape[1])], 0.0)


def degrees_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angle between unit normals, [3, ...] each, in degrees."""
    return np.asarray(np.degrees(np.arccos(np.clip((one * other).sum(axis=0), -1, 1))))


class Suspect(NamedTuple):
    """A light that disagrees with the others."""

    light: int
    """Index of the light."""
    misfit: float
    """Median over pixels of |reading / (level · n·l) - 1|, the level being the pixel's own median over its lights."""


def suspects(readings: np.ndarray, directions: np.ndarray, normal: np.ndarray) -> list[Suspect]:
    """Return the lights that disagree with the others, worst first; none on metal, of which all do.

    Highlights of the side that most pixels share look like a wrong light: what faces otherwise must disagree too, and where nothing does a
    brighter light is none. Cast shadows are left out.
    `readings`: [lights, pixels] grey radiance over irradiance. `normal`: [3, pixels] unit normals that were found under these lights."""
    cosine = directions @ normal
    seen = (cosine > LEAST_COSINE) & (directions[:, 2:] > LEAST_TOWARDS)
    ratio = np.where(seen, readings / np.maximum(cosine, LEAST_COSINE), np.nan)
    lit = seen.any(axis=0)
    judged = np.flatnonzero(seen[:, lit].sum(axis=1) >= LEAST_PIXELS)
    if not len(judged):
        return []
    level = np.maximum(np.nanmedian(ratio[:, lit], axis=0), 1e-12)
    off = ratio[np.ix_(judged, lit)] / level - 1
    dark = (off < CAST) & (np.nanmedian(off, axis=1, keepdims=True) > CAST)
    off[dark] = np.nan
    misfit = np.nanmedian(np.abs(off), axis=1)
    limit = max(SUSPECT_OFF, SUSPECT_TIMES * float(np.median(misfit)))
    if np.median(misfit) > SUSPECT_OFF:
        return []
    apart = unlike_most(normal[:, lit], SIDE)

    def disagrees(light: np.ndarray) -> bool:
        told = np.abs(light[apart & np.isfinite(light)])
        return bool(np.median(told) > limit if len(told) >= LEAST_APART else np.nanmedian(light) < 0)

    return [Suspect(int(judged[i]), float(misfit[i])) for i in np.argsort(-misfit) if misfit[i] > limit and disagrees(off[i])]
