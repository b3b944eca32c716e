"""Measure how far normals are from those of any surface.

Normals that were solved pixel by pixel are those of a surface only where they are right: an error of the normals is, in general, not the
gradient of any height. So the normals of the integrated height differ from the solved ones by that part of the error which no surface has,
whatever caused it: interreflection, another reflectance than the model's, lights that are off, or modes that tear the surface. Errors that
bend the whole surface alike leave no trace here, and where the surface turns by many degrees from pixel to pixel, or hides a part of
itself, right normals differ too: so a large misfit counts less than it is.

Source: integrability as a constraint on normals, Frankot and Chellappa, "A method for enforcing integrability in shape from shading
algorithms", TPAMI 1988; as a measure of their error it is ours.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from kernels.device import worker_count
from kernels.photometric.search.certainty import MOST
from kernels.surface.slopes import STEEPEST
from stage.capture.camera import Camera

REACH = 2.0
"""Standard deviation, in pixels, of the window over which the misfit is pooled: fewer pixels leave the pooled value to chance, more of them
lend the errors of some to others."""
REACHES = 3
"""Standard deviations at which the window ends."""
BAND_PIXELS = 1 << 19
"""Number of pixels that are looked at in one piece: it bounds the memory."""
MOST_BANDS = 4
"""Most pieces at one time, of which each takes some hundred MB."""
BENT = 11.0
"""Standard deviation of normals over their mean misfit, less 1, for each share of the residuals that neighbouring pixels have in common:
errors that neighbours share bend a surface, and are mostly those of another surface. Measured on path-traced scenes and real objects."""
LEAST_COUNT = 1e-4
"""Least weight of all pixels around one at which their misfit is looked at."""
STEEP = np.radians(3.0)
"""Change of the normal from pixel to pixel at which a pixel counts half: where it is larger, differences of heights hardly show normals."""
LARGEST_TRACE = 8.0
"""Standard deviation, in degrees, that the misfit tends to where it is large: there it is of a texture of many degrees from pixel to pixel
more than of errors."""
PIXEL = 0.03
"""Standard deviation, in degrees, of the surest normals: those of the piece of surface that a pixel sees differ."""
MIXED, MIXED_DEGREES = 2.0, 2.0
"""Factor on the standard deviation of a pixel beside another part, and degrees that are added in quadrature: such a pixel may see both
parts, and its readings tell that only partly. On path-traced scenes a tenth of these pixels are more than 10° to 30° off."""


def doubt(normal: np.ndarray, height: np.ndarray, part: np.ndarray, camera: Camera, *, shared: float) -> np.ndarray:
    """Return the standard deviation of normals, in degrees, that their misfit to a surface shows, [rows, cols] float32.
    `normal`: [rows, cols, 3] unit. `height`: [rows, cols] camera-frame z, integrated from them. `part`: [rows, cols] int, the number of
    the part of each pixel that has both, from 1; 0 elsewhere. No surface leads from part to part. `shared`: 0…1, share of the residuals
    of the readings that neighbouring pixels have in common."""
    found = (1 + BENT * shared) * misfit(normal, height, part, camera)
    return np.hypot(found / np.hypot(1, found / LARGEST_TRACE), PIXEL)


def beside_parts(sigma: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return the standard deviation of normals, [rows, cols] in degrees, with that of pixels beside another part raised.
    `sigma`: [rows, cols] standard deviation without this. `part`: as for `doubt`."""
    framed, (rows, cols) = np.pad(part, 1), part.shape
    around = [framed[down : down + rows, right : right + cols] for down in range(3) for right in range(3)]
    beside = (part > 0) & np.any([(side > 0) & (side != part) for side in around], axis=0)
    return np.where(beside, np.minimum(np.hypot(MIXED * sigma, MIXED_DEGREES), np.maximum(sigma, MOST)), sigma)


def misfit(normal: np.ndarray, height: np.ndarray, part: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mean angle, in degrees, from normals to those of the surface around each pixel, [rows, cols] float32; 0 where too few
    neighbours are solved to say. Parameters are as for `doubt`."""
    found, reach = np.zeros(height.shape, dtype=np.float32), int(REACHES * REACH) + 1
    step = max(1, BAND_PIXELS // height.shape[1])

    def judge(first: int) -> None:
        above = max(first - reach, 0)
        band = slice(above, first + step + reach)
        if not part[band].any():
            return
        points, sight = (camera.points(z, above).astype(np.float64) for z in (height[band], np.ones_like(height[band])))
        if camera.projection == "orthographic":
            sight[..., :2] = 0
        found[first : first + step] = _misfit_of_rows(normal[band].astype(np.float64), points, sight, part[band])[first - above :][:step]

    with ThreadPoolExecutor(min(worker_count(), MOST_BANDS)) as pool:
        list(pool.map(judge, range(0, len(height), step)))
    return found


def _misfit_of_rows(normal: np.ndarray, points: np.ndarray, sight: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return `misfit` of some rows, from camera-frame points; all but the outermost REACHES · REACH + 1 are those of the whole image.
    `sight`: [rows, cols, 3] change of the points for each unit of height."""
    inside = part > 0
    for side in _sides(part[..., None]):
        inside &= side[..., 0] == part
    middle = (normal, points, sight)
    right, left, above, below = zip(*(_sides(values) for values in middle), strict=True)
    steps, planes = [], []
    for one, other in ((right, left), (above, below)):
        steps.append(one[1] - other[1])
        planes.append(steps[-1] - (_excess(middle, one) - _excess(middle, other))[..., None] * sight)
    surface, given = (_unit(np.cross(*two)) for two in (steps, planes))
    angle = np.degrees(np.arccos(np.clip(np.vecdot(surface, given), -1, 1)))
    turn = sum(np.vecdot(bend, bend) for bend in (right[0] - left[0], above[0] - below[0])) / 4
    weight = inside / (1 + turn / STEEP**2)
    pooled, count = _pool(weight * angle), _pool(weight)
    return np.divide(pooled, count, out=np.zeros_like(pooled), where=count > LEAST_COUNT).astype(np.float32)


def _excess(here: tuple[np.ndarray, ...], there: tuple[np.ndarray, ...]) -> np.ndarray:
    """Return how much farther, in height, the surface steps from one pixel to another than the mean slope of both normals says.
    `here`, `there`: normal, point and sight of both, [rows, cols, 3]. This is the residual of the integration: differences over two pixels
    against the normal between them would show a curve for an error."""
    (n, point, sight), (other_n, other_point, other_sight) = here, there
    step = other_point - point
    return np.asarray(0.5 * sum(np.vecdot(a, step) / np.maximum(np.vecdot(a, b), STEEPEST)
                                for a, b in ((n, other_sight), (other_n, sight))))


def _sides(values: np.ndarray) -> list[np.ndarray]:
    """Return the values of the right, left, upper and lower neighbours of each pixel; 0 outside the image."""
    framed = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    return [framed[1:-1, 2:], framed[1:-1, :-2], framed[:-2, 1:-1], framed[2:, 1:-1]]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.sqrt(np.vecdot(vectors, vectors))[..., None], 1e-12)


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
