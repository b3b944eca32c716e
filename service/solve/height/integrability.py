"""Measure how far normals are from those of any surface.

Normals that were solved pixel by pixel are those of a surface only where they are right: an error of the normals is, in general, not the
gradient of any height. So the normals of the integrated height differ from the solved ones by that part of the error which no surface has,
whatever caused it: interreflection, another reflectance than the model's, lights that are off, or modes that tear the surface. Errors that
bend the whole surface alike leave no trace here, and where the surface turns by many degrees from pixel to pixel, or hides a part of
itself, right normals differ too: so a large misfit counts less than it is.

Source: integrability as a constraint on normals, Frankot and Chellappa, "A method for enforcing integrability in shape from shading
algorithms", TPAMI 1988; as a measure of their error it is ours.
"""

import numpy as np

from kernels.photometric.search.certainty import MOST
from stage.capture.camera import Camera

REACH = 4.0
"""Standard deviation, in pixels, of the window over which the misfit is pooled: fewer pixels leave the pooled value to chance."""
REACHES = 3
"""Standard deviations at which the window ends."""
BAND_PIXELS = 1 << 20
"""Number of pixels that are looked at in one piece: it bounds the memory."""
ROOT_OF_MEAN = 1.9
"""Standard deviation of errors over the mean misfit: 1.6 for those without preferred direction, because the mean of a Rayleigh distribution
is 0.886 of its root mean square, and half of the variance of the errors is of a gradient and unseen; errors that neighbours share are more
of a gradient than that."""
LEAST_COUNT = 1e-4
"""Least weight of all pixels around one at which their misfit is looked at."""
STEEP = np.radians(3.0)
"""Change of the normal from pixel to pixel at which a pixel counts half: where it is larger, differences of heights hardly show normals."""
LARGEST_TRACE = 5.0
"""Standard deviation, in degrees, that the misfit tends to where it is large: there it is of a texture of many degrees from pixel to pixel
more than of errors."""
SHARED, NOISE = 1.9, 0.3
"""Standard deviation over a large misfit, and the misfit, in degrees, that counts half of that: small ones are of noise, which each pixel's
own readings tell, and of differences of heights on a curve; large ones of errors that neighbours share, of which most is a gradient."""
PIXEL = 0.03
"""Standard deviation, in degrees, of the surest normals: those of the piece of surface that a pixel sees differ."""
MIXED, MIXED_DEGREES = 2.0, 2.0
"""Factor on the standard deviation of a pixel beside another part, and degrees that are added in quadrature: such a pixel may see both
parts, and its readings tell that only partly. On path-traced scenes a tenth of these pixels are more than 10° to 30° off."""


def doubt(normal: np.ndarray, height: np.ndarray, part: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the standard deviation of normals, in degrees, that their misfit to a surface shows, [rows, cols] float32.
    `normal`: [rows, cols, 3] unit. `height`: [rows, cols] camera-frame z, integrated from them. `part`: [rows, cols] int, the number of
    the part of each pixel that has both, from 1; 0 elsewhere. No surface leads from part to part."""
    found = misfit(normal, height, part, camera)
    found *= SHARED * found / (found + NOISE)
    return np.hypot(found / np.hypot(1, found / LARGEST_TRACE), PIXEL)


def beside_parts(sigma: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the standard deviation of normals, [rows, cols] in degrees, with that of pixels beside another part raised.
    `sigma`: [rows, cols] standard deviation without this. `part`: as for `doubt`."""
    framed, (rows, cols) = np.pad(part, 1), part.shape
    around = [framed[down : down + rows, right : right + cols] for down in range(3) for right in range(3)]
    beside = (part > 0) & np.any([(side > 0) & (side != part) for side in around], axis=0)
    return np.where(beside, np.minimum(np.hypot(MIXED * sigma, MIXED_DEGREES), np.maximum(sigma, MOST)), sigma)


def misfit(normal: np.ndarray, height: np.ndarray, part: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the standard deviation, in degrees, of which the misfit of normals to a surface would be the trace, [rows, cols] float32; 0
    where too few neighbours are solved to say. Parameters are as for `doubt`."""
    found, reach = np.empty(height.shape, dtype=np.float32), int(REACHES * REACH) + 1
    step = max(1, BAND_PIXELS // height.shape[1])
    for first in range(0, len(height), step):
        above = max(first - reach, 0)
        band = slice(above, first + step + reach)
        points = camera.points(height[band], above).astype(np.float64)
        found[first : first + step] = _misfit_of_rows(normal[band], points, part[band])[first - above :][:step]
    return found


def _misfit_of_rows(normal: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return `misfit` of some rows, from camera-frame points; all but the outermost REACHES · REACH + 1 are those of the whole image."""
    right, left, above, below = _sides(points)
    inside = part > 0
    for side in _sides(part[..., None]):
        inside &= side[..., 0] == part
    surface = _unit(np.cross(right - left, above - below))
    given = normal.astype(np.float64)
    sides = _sides(given)
    around = _unit(4 * given + sum(sides))  # over the pixels that the differences of heights span
    angle = np.arccos(np.clip((surface * around).sum(axis=-1), -1, 1))
    turn = (((sides[0] - sides[1]) ** 2).sum(axis=-1) + ((sides[2] - sides[3]) ** 2).sum(axis=-1)) / 4
    weight = inside / (1 + turn / STEEP**2)
    pooled, count = _pool(weight * angle), _pool(weight)
    return (ROOT_OF_MEAN * np.degrees(np.divide(pooled, count, out=np.zeros_like(pooled), where=count > LEAST_COUNT))).astype(np.float32)


def _sides(values: np.ndarray) -> list[np.ndarray]:
    """Return the values of the right, left, upper and lower neighbours of each pixel; 0 outside the image."""
    framed = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    return [framed[1:-1, 2:], framed[1:-1, :-2], framed[:-2, 1:-1], framed[2:, 1:-1]]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _pool(values: np.ndarray) -> np.ndarray:
    """Return the sum of values around each pixel, weighted by a Gaussian of REACH pixels."""
    reach = int(REACHES * REACH)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / REACH) ** 2)
    for axis in (0, 1):
        padded = np.pad(values, [(reach, reach) if other == axis else (0, 0) for other in (0, 1)])
        pooled = np.zeros_like(values)
        for shift, weight in enumerate(kernel / kernel.sum()):
            pooled += weight * (padded[shift : shift + len(values)] if axis == 0 else padded[:, shift : shift + values.shape[1]])
        values = pooled
    return values
