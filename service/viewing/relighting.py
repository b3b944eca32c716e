"""What a browser relights an object with: few coefficient images, and the coefficients of every captured image and direction.

Source: the first K singular vectors give the sums of K images with the least squared error, Eckart and Young 1936 (kernels.relight.basis).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from kernels import packs
from kernels.relight.basis import Basis, gram, principal, projection
from kernels.relight.beyond import reach
from kernels.relight.many_frames import combine_batch
from kernels.relight.residual import squared_residual
from service.reporting.progress import Timings
from service.requests.view import MOST_TERMS
from service.viewing.block_file import BlockFile
from service.viewing.quadrature import write_quadrature
from service.viewing.reduction import plane_means, step_within
from service.viewing.row_bands import row_bands
from service.viewing.transfer import COLS, FULL, ROWS, transfer_of
from stage.ingest import TOP_EXPONENT
from stage.light_basis import numbers
from stage.matte import Matte
from stage.point_lights import DistantLights
from stage.stack import Stack

LEAST_LIGHTS = 4
"""With fewer lights there is nothing to relight with: they do not surround any direction."""
LEAST_TERMS = 32
"""Most coefficient images of a large capture, unless the request says otherwise: it is rather reduced than shown with fewer."""
RELATIVE_RMS = 0.005
"""Error of the captured images, relative to them, that needs no further coefficient image: half a step of an 8-bit display."""
MOST_VALUES = 64_000_000
"""Most values of all coefficient images in a channel, 32 images of 2 megapixels; larger images are reduced. A page keeps them as textures,
in 400 MB."""
HALF_BOUND = 2.0**15
"""Bound of the stored coefficients, which leaves room below the largest half value."""


class Coefficients(NamedTuple):
    """Coefficient images, reduced."""

    images: np.ndarray  # [terms, 3, rows, cols] float16
    relative_rms: float
    """Root mean square of what the stored coefficients leave of the captured images, relative to these."""


def write_relighting(stack: Stack, lights: DistantLights, matte: Matte, file: BlockFile, *, most_terms: int | None,
                     device: str, timings: Timings) -> dict[str, Any]:
    """Write basis, matte, transfer and coefficients of the captured images, and return what view.json says of them.

    Args:
        stack: the captured images.
        lights: of the images, near ones as the object's centre sees them.
        matte: of the object; the coefficient images are premultiplied by its coverage.
        file: for the blocks.
        most_terms: most coefficient images; None: as many as fit without reducing the images, and LEAST_TERMS at least.
        device: where.
        timings: told of every stage.

    Raises:
        ArrayError: a light gives nothing in a channel.
        OSError: the file cannot be written.
    """
    count = stack.light_count
    covered = np.zeros(stack.shape[2], dtype=bool)
    covered[: stack.pixel_count] = (matte.factor > 0).reshape(-1)
    most = most_terms or max(LEAST_TERMS, min(MOST_TERMS, MOST_VALUES // matte.factor.size))
    basis = _basis(stack, covered, most, device, timings)
    largest = float(np.linalg.norm(2.0**TOP_EXPONENT * stack.scale))  # no pixel's radiance over all lights, nor any coefficient, is larger
    scale = 2.0 ** math.ceil(math.log2(largest / HALF_BOUND))
    timings.stage("directions", 1)
    transfer = transfer_of(basis, lights, scale)
    step = step_within(matte.factor.size, MOST_VALUES // basis.matrix.shape[1])
    found = _coefficients(stack, basis, matte, covered, step, scale, device, timings)
    coverage = plane_means(matte.coverage, step)
    captured = np.moveaxis(basis.matrix, 0, -1).swapaxes(0, 1) * scale  # [lights, terms, 3]
    return {
        "terms": len(found.images), "rows": coverage.shape[0], "cols": coverage.shape[1], "step": step,
        "basis": list(file.append_all(iter(found.images))),
        "matte": file.append(np.rint(FULL * np.clip(coverage, 0, 1)).astype(np.uint8)),
        "directions": [COLS, ROWS],
        "transfer": file.append(transfer.coefficients),
        "beyond": file.append(transfer.beyond),
        "quadrature": write_quadrature(lights, file),
        "captured": file.append(captured[:count].astype(np.float32)),
        "relative_rms": numbers(found.relative_rms),
        "beyond_degrees": numbers(float(np.degrees(2 * reach(lights.direction)))),
    }


def _basis(stack: Stack, covered: np.ndarray, most: int, device: str, timings: Timings) -> Basis:
    """Return the basis with as few images as the error allows."""
    count = stack.light_count
    products, scale = np.zeros((3, count, count)), stack.scale[:count].astype(np.float64)
    ranges = list(stack.bands())
    timings.stage("products", len(ranges))
    for done, (start, stop) in enumerate(ranges, start=1):
        if covered[start:stop].any():
            products += gram(packs.upload(stack.band(start, stop), device=device), covered[start:stop])[:, :count, :count]
        timings.advance(done)
    products *= scale[:, None] * scale
    squares = (principal(products, count).singular_values ** 2).sum(axis=0)
    left = np.append(np.cumsum(squares[::-1])[::-1][1:], 0)  # after 1, 2 … images
    enough = left <= RELATIVE_RMS**2 * squares.sum()
    return principal(products, min(int(enough.argmax()) + 1, most, count))


def _coefficients(stack: Stack, basis: Basis, matte: Matte, covered: np.ndarray, step: int, scale: float, device: str,
                  timings: Timings) -> Coefficients:
    """Return the coefficient images, premultiplied and reduced, and the error that half values and the missing images make."""
    rows, cols = matte.factor.shape
    terms, count = basis.matrix.shape[1], stack.light_count
    weights = projection(basis, stack.scale / np.float32(scale))
    gains = np.broadcast_to(stack.scale, (3, stack.shape[1]))
    functions = np.zeros((3, stack.shape[1], terms))
    functions[:, :count] = np.swapaxes(basis.matrix, 1, 2) * scale
    images = np.zeros((terms, 3, -(-rows // step), -(-cols // step)), dtype=np.float16)
    left, whole = 0.0, float((basis.singular_values**2).sum())
    bands = list(row_bands(stack, (rows, cols), step, 3 * 16 * terms))
    timings.stage("basis", len(bands))
    for done, band in enumerate(bands, start=1):
        inside = band.own & covered[band.start : band.stop]
        if inside.any():
            values = packs.upload(stack.band(band.start, band.stop), device=device)
            stored = combine_batch(values, weights).numpy().astype(np.float16).astype(np.float32)
            squares = squared_residual(values, gains, stored, functions).numpy()
            left += float(squares[:, inside].sum(dtype=np.float64))
            planes = stored[:, :, band.own].reshape(3 * terms, -1, cols) * matte.factor[band.rows]
            for index, plane in enumerate(planes):
                images[index // 3, index % 3, band.reduced] = plane_means(plane, step)
        timings.advance(done)
    return Coefficients(images, float(np.sqrt(left / whole)) if whole > 0 else 0.0)
