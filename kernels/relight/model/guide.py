"""Limit the correction of the captured images by a model of the surface, pixel by pixel.

Between the lights a picture is predicted from those around: Σ s_k I_k. The model says by how much that is wrong, M - Σ s_k M_k, its gloss
scaled to what the images around show (kernels.relight.model.gloss_ratio); how much of it to believe is what the captured lights tell when
each is left out and predicted from its neighbours: β is the least-squares factor between what was missing and what the model says was
missing, 0 to 1. A model that explains nothing gets 0, and the plain sum stays.

Source: the model as a control variate with regression coefficient, Glasserman, "Monte Carlo Methods in Financial Engineering",
section 4.1; here over lights in place of samples.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from kernels.device import once, worker_count
from kernels.errors import ArrayError
from kernels.microfacet import INVERSE_PI
from kernels.pack_access import pack_load
from kernels.packs import bit_of, channels_type, pack_type
from kernels.relight.model.beyond import spacing
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.gloss_ratio import gloss_ratio, mean_ratio
from kernels.relight.model.shading import lobes

POOL = 2
"""Half-width, in pixels, of the window over which the sums of β are pooled."""
POOLED_ROWS = 64
"""Rows of an image that a thread pools at one time."""
LEAST_ALPHA = 0.15
"""Width α of the narrowest lobe, as a fraction of the angle between neighbouring lights. Between two of them the half vector moves by half
of the angle: one light sees a lobe of a third of that in some pixels, and two in others (docs/relight_methods.md)."""


def seen_lobes(specular: np.ndarray, roughness: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Widen lobes that are narrower than the captured lights can resolve, and return their F0 […, 3] and roughness […], float32.

    The captured lights, unit vectors [lights, 3], see only the tail of a lobe that is much narrower than their spacing, and its strength is
    F0 · α². The wider and fainter lobe that is returned has the same tail.
    """
    alpha = np.asarray(roughness, dtype=np.float32) ** 2
    wider = np.maximum(alpha, np.float32(LEAST_ALPHA * spacing(direction)))
    return specular * ((alpha / wider) ** 2)[..., None], np.where(alpha > 0, np.sqrt(wider), 0)


def compare_model(captured: Captured, neighbours: np.ndarray, shares: np.ndarray) -> wp.array:
    """Compare the model with the captured images, each left out and predicted from its neighbours.

    Args:
        captured: images and model; where one of the four readings of a comparison is clipped, the comparison does not count.
        neighbours, shares: [lights, 3] of triangulation.left_out.

    Returns:
        [2, pixels padded] float32 on the device: Σ over lights and channels of missing · told, and of told².
    """
    count, device = len(captured.direction), captured.surface.device
    if np.shape(neighbours) != (count, 3) or np.shape(shares) != (count, 3):
        raise ArrayError(f"neighbours are {np.shape(neighbours)}, shares {np.shape(shares)}: give {(count, 3)} of both")
    return captured.sums(_compare_kernel, 2, wp.array(neighbours, dtype=wp.vec3i, device=device),
                         wp.array(shares, dtype=wp.vec3, device=device))


def pooled(plane: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the sum of a value [n] over the window of POOL pixels around each of the pixels, over those that are given, row-major."""
    height, width = shape
    given, found = np.zeros(height * width), np.empty(shape)
    given[pixels] = plane
    framed = np.pad(given.reshape(shape), POOL)

    def pool(first: int) -> None:
        rows = framed[first : first + POOLED_ROWS + 2 * POOL]
        across = sum(rows[:, k : k + width] for k in range(2 * POOL + 1))  # no running sums: they would spread a NaN to later pixels
        found[first : first + POOLED_ROWS] = sum(across[k : k + len(rows) - 2 * POOL] for k in range(2 * POOL + 1))

    with ThreadPoolExecutor(worker_count()) as threads:
        list(threads.map(pool, range(0, height, POOLED_ROWS)))
    return np.asarray(found.reshape(-1)[pixels])


def fit_trust(sums: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return β, [n] float32, 0…1, from the sums [2, n] of each pixel and of its neighbours; 0 where the model says nothing.

    A pixel's own lights are few, and a model that is wrong at a pixel is wrong around it too. Pixels are row-major positions in an image of
    this shape.
    """
    top, bottom = (pooled(plane, pixels, shape) for plane in sums)
    return np.clip(np.divide(top, bottom, out=np.zeros(len(pixels)), where=bottom > 1e-12), 0, 1).astype(np.float32)


@once
def _compare_kernel(pack: int) -> Any:
    lane_type, images_struct, channels, evaluate = pack_type(pack, wp.float32), images_type(pack), channels_type(pack), lobes(pack)
    load, load_half, load_byte = (pack_load(pack, kind) for kind in (wp.float32, wp.float16, wp.uint8))

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def compare_kernel(first: int,
                     images: images_struct,
                     neighbours: wp.array(dtype=wp.vec3i),  # [lights]
                     shares: wp.array(dtype=wp.vec3),  # [lights]
                     # outputs
                     sums: wp.array2d(dtype=lane_type)):  # [2, P]
        p = first + wp.tid()
        top, bottom = lane_type(), lane_type()
        for light in range(images.places.shape[0]):
            parts = shares[light]
            if parts[0] + parts[1] + parts[2] > 0.0:
                near = neighbours[light]
                missing, told, shown, shone = channels(), channels(), channels(), channels()
                counts = lane_type(1.0)
                for corner in range(4):  # the light itself last, because its gloss is scaled as that of the others is
                    at = wp.where(corner == 0, near[0], wp.where(corner == 1, near[1], wp.where(corner == 2, near[2], light)))
                    part = wp.where(corner == 0, parts[0], wp.where(corner == 1, parts[1], wp.where(corner == 2, parts[2], -1.0)))
                    facing, gloss, _, _ = evaluate(images.surface, p, images.places[at], wp.vec4())
                    lit = load_byte(images.visible, at, p)
                    bits = load_byte(images.clipped, at / 8, p)
                    for k in range(pack):
                        counts[k] = wp.where(bit_of(bits[k], at) == 1, 0.0, counts[k])
                    for c in range(3):
                        albedo = load(images.surface, 3 + c, p)
                        stored = load_half(images.stored, c * images.padded + at, p)
                        factor = images.factors[at][c]
                        for k in range(pack):
                            seen = float(lit[k]) * wp.static(1.0 / 255.0)
                            reading = factor * float(stored[k])
                            matt = seen * albedo[k] * INVERSE_PI * facing[k]
                            shine = seen * gloss[c, k]
                            ratio = wp.where(corner < 3, gloss_ratio(reading, matt, shine), mean_ratio(shown[c, k], shone[c, k]))
                            missing[c, k] -= part * reading
                            told[c, k] -= part * (matt + ratio * shine)
                            shown[c, k] += part * ratio * shine
                            shone[c, k] += part * shine
                for c in range(3):
                    for k in range(pack):
                        top[k] += counts[k] * missing[c, k] * told[c, k]
                        bottom[k] += counts[k] * told[c, k] * told[c, k]
        sums[0, p] = top
        sums[1, p] = bottom

    return compare_kernel
