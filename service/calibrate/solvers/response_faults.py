"""What images of uniformly grey projections say against the response that was fitted to them.

Each pixel reads ambient + s · g(level). Where the readings of groups of pixels are no such lines of the response, the readings are not
linear in light, or the exposure was not the same in all images; pixels that the projector does not reach, and that get darker with the
level, tell of the latter. A level whose light is not between what its neighbours suggest is an image of another level; where all levels
are a little off, the lamp or the exposure flickers. Light that no longer rises at the last levels is cut off. A power that no projector has
is that of another encoding of the images.
"""

import numpy as np

from stage.spread import MAD_TO_SIGMA

GROUPS = 24
"""Groups of pixels of equal brightness, and of equal parts of ambient light, whose means have little noise."""
HALF = 8
"""Pixels that choose the group of as many beside them: a group that its own readings choose is one of equal noise."""
BENT, BENT_SIGMAS = 0.0015, 2.0
"""Root mean square misfit of the lines, as a part of full scale and in standard errors, above which they are bent; right
images make .0013, or 1.7 of them."""
FALLING = -0.01
"""Change of a group from the darkest to the brightest level, as a part of full scale, below which it gets darker."""
ALONE = 0.05
"""Light by which a level differs from what the levels beside it suggest, as a part of full scale."""
FLICKER, FLICKER_LEVELS = 0.01, 12
"""Standard deviation of the brightness of single images, as a part of it, above which lamp or exposure flicker, and the least count of
levels between the ends that tell of it: with so many the kinks of video make 0.4 %."""
DARK = 0.01
"""Readings below this part of the brightest tell of no flicker."""
FLAT_LIGHT, FLAT_LEVELS, DARK_LEVELS = 0.998, 0.1, 0.2
"""Light from which on it does not rise, as a part of full scale, and the least part of the levels that have it; 0.06 are white in video.
The same of black, above which the light of the steepest power has risen (level^3.3)."""
GAMMAS = 0.7, 3.3
"""Exponents of projectors: those of their picture modes are 1 to 2.8."""
BETWEEN = 0.02
"""Light, as a part of full scale, to which it is known between the levels, above which more of them are asked for."""
MOST_SPREAD = 0.05
"""Median deviation of the pixels from the response above which it is not sure."""


def response_faults(levels: np.ndarray, readings: np.ndarray, curve: np.ndarray, *, full_scale: float, spread: float, gamma: float,
                    between: float) -> tuple[str, ...]:
    """Return sentences about what is wrong with the images of a response.
    `levels`: [levels] rising from 0 to 1. `readings`: [levels, pixels] linear, beside each other in the image. `curve`: [levels] the light,
    from 0 to 1. `full_scale`: by how much the readings rise. `spread`: median deviation of a pixel from the curve, as a part of full scale.
    `gamma`: exponent of the nearest power. `between`: light to which the curve is known between its levels."""
    design = np.column_stack([np.ones(len(levels)), curve])
    basis = np.linalg.qr(design).Q
    half = max(1, min(HALF, readings.shape[1] // (2 * GROUPS)))
    runs = readings[:, :readings.shape[1] // (2 * half) * 2 * half].reshape(len(levels), -1, 2, half).mean(axis=-1)
    ambient, scale = np.linalg.lstsq(design, runs[..., 0])[0]
    bright = ambient + scale
    groups = [runs[:, group, 1] for key in (bright, ambient / np.maximum(bright, DARK * bright.max()))
              for group in np.array_split(np.argsort(key), min(GROUPS, len(key)))]
    means = np.stack([group.mean(axis=1) for group in groups], axis=1)
    left = means - basis @ (basis.T @ means)
    errors = np.stack([(group - basis @ (basis.T @ group)).std(axis=1) / np.sqrt(group.shape[1]) for group in groups], axis=1)
    bent, noise = (float(np.sqrt(np.mean(part**2))) / full_scale for part in (left, errors))
    faults = []
    if np.linalg.lstsq(design, means)[0][1].min() < min(FALLING, -BENT_SIGMAS * noise) * full_scale:
        faults.append("where the projector does not reach it gets darker with the level, as under an automatic exposure: fix exposure, "
                      "gain and white balance")
    elif bent > BENT and bent > BENT_SIGMAS * noise:
        faults.append(f"readings miss ambient + s · response by {100 * bent:.2g} % of full scale: they are not linear in light, or "
                      "exposure, ambient light or the camera changed: check color_space and saturation, and fix exposure, gain and white "
                      "balance")
    alone = _alone(levels, curve)
    worst = int(np.abs(alone).argmax())
    if abs(alone[worst]) > ALONE:
        faults.append(f"the light of level {levels[worst]:.3g} is {abs(alone[worst]):.2g} of full scale off what the levels beside it "
                      "suggest: check that its image shows this level")
    flicker = _flicker(alone, readings.mean(axis=1), levels, curve)
    if flicker > FLICKER:
        faults.append(f"images are brighter and darker by {100 * flicker:.2g} % from level to level: the lamp or the exposure flickers, "
                      "and the response is as much off: fix the exposure, and take the mean of several images of each level")
    black = levels[np.flatnonzero(curve < 1 - FLAT_LIGHT)[-1]]
    if black > DARK_LEVELS:
        faults.append(f"the light does not rise up to level {black:.3g}: check that its image shows this level, and that of black the same "
                      "exposure")
    elif not GAMMAS[0] < gamma < GAMMAS[1]:
        faults.append(f"the response is nearest to level^{gamma:.2g}, and those of projectors to powers of {GAMMAS[0]:g} to {GAMMAS[1]:g}: "
                      "check color_space, --levels, and the exposures")
    flat = levels[np.flatnonzero(curve < FLAT_LIGHT)[-1] + 1]
    if 1 - flat > FLAT_LEVELS:
        faults.append(f"the light does not rise above level {flat:.3g}: readings saturate there, or the projector shows no more: shorten "
                      "the exposure, or give the saturation of the camera")
    if between > BETWEEN and not faults:
        faults.append(f"between its levels the light is known to {between:.2g} of full scale alone: give images of more levels")
    if spread > MOST_SPREAD:
        faults.append(f"pixels deviate by {spread:.2g} of full scale from the response: give brighter images, without anything that moves")
    return tuple(faults)


def _alone(levels: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Return by how much the light of each level differs from the power of it that the levels beside it suggest; 0 at the ends."""
    off = np.zeros(len(levels))
    inner = np.flatnonzero((curve > 0) & (curve < 1) & (levels > 0) & (levels < 1))
    if len(inner) < 3:
        return off
    exponent = np.log(curve[inner]) / np.log(levels[inner])
    padded = np.concatenate([[2 * exponent[0] - exponent[1]], exponent, [2 * exponent[-1] - exponent[-2]]])
    off[inner] = curve[inner] - levels[inner] ** ((padded[:-2] + padded[2:]) / 2)
    return off


def _flicker(alone: np.ndarray, readings: np.ndarray, levels: np.ndarray, curve: np.ndarray) -> float:
    """Return the standard deviation of the brightness of single images, as a part of it; 0 for too few levels.
    `alone`: what `_alone` says. `readings`: [levels] mean."""
    told = (curve > 0) & (curve < 1) & (levels > 0) & (levels < 1) & (readings > DARK * readings[-1])
    if told.sum() < FLICKER_LEVELS:
        return 0.0
    off = alone[told] * (readings[-1] - readings[0]) / readings[told]
    return MAD_TO_SIGMA * float(np.median(np.abs(np.diff(off)))) / 5**0.5  # each holds four images, by 3/2 and 1/2, twice
