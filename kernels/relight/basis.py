"""A basis of a stack: in each channel the few images whose sums come closest to all captured ones.

The singular value decomposition of the masked pixels × lights matrix, by way of its lights × lights Gram matrix, which a pass over
the bands accumulates in float64: the memory is that of a band, however many pixels there are. The eigenvalues tell the error of
leaving images out; below about 1e-8 of the whole, where their squares leave double precision, they tell nothing.

Source: Eckart and Young, "The approximation of one matrix by another of lower rank", 1936; for images under varying light Epstein,
    Hallinan and Yuille, "5 ± 2 eigenimages suffice", 1995.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type

TILE = 4
"""Number of lights down and across whose products one thread sums: 16 sums fit into registers, and 4 divides the light padding of 8."""
THREADS = 1 << 16
"""Approximate number of threads in one launch: they fill a large device, and their partial sums take 16 MB."""
MAX_CHUNKS = 64
"""Most pixel ranges that have sums of their own: on the CPU the pixels of one range stay in the cache for all tiles."""


class Basis(NamedTuple):
    """An orthonormal basis of each channel: captured image l ≈ Σₖ matrix[k, l] · (coefficient image k)."""

    matrix: np.ndarray  # [3, K, lights] float64, orthonormal rows: coefficient of each captured image
    singular_values: np.ndarray  # [3, lights] float64, descending: of all, also those that are left out

    @property
    def truncation(self) -> np.ndarray:
        """The [3] relative RMS error of each channel: root of the squared sums left out over those of the images; 0 where dark."""
        squares = self.singular_values**2
        return np.sqrt(squares[:, self.matrix.shape[1] :].sum(axis=1) / np.maximum(squares.sum(axis=1), np.finfo(float).tiny))


def gram(band: Band, keep: np.ndarray) -> np.ndarray:
    """Return the inner products of the stored images of a band over some of its pixels.

    Args:
        band: the stack on the device.
        keep: [pixels of the band] bool, the pixels that count.

    Returns:
        [3, lights, lights] float64, padding included; waits for the device on CUDA.

    Raises:
        ArrayError: the mask is of another length.
    """
    band.require_channels(3)
    if keep.shape != (band.pixel_count,):
        raise ArrayError(f"keep has {keep.size} pixels, the band {band.pixel_count}: give one bool a pixel")
    pack, lights, device = devices.pack_width(band.device), band.frame_count, band.device
    counted = np.zeros(band.packs * pack, dtype=np.float32)
    counted[: keep.size] = keep
    rows, columns = np.tril_indices(lights // TILE)
    tiles = wp.array(np.stack([rows, columns], axis=1) * TILE, dtype=wp.vec2i, device=device)
    chunks = max(1, min(MAX_CHUNKS, band.packs, THREADS // (3 * len(rows))))
    partial = wp.zeros((chunks, 3, lights, lights), dtype=wp.float64, device=device)
    on_device = wp.array(counted, dtype=wp.float32, device=device)
    devices.launch(gram_kernel(pack), chunks * 3 * len(rows), [band.values, as_packs(on_device, device), tiles, chunks], [partial],
                   device=device)
    lower = np.tril(partial.numpy().sum(axis=0))
    return lower + np.swapaxes(np.tril(lower, -1), 1, 2)


def principal(products: np.ndarray, count: int) -> Basis:
    """Return the best basis of `count` images for each channel.

    Args:
        products: [3, lights, lights] Gram matrices, summed over all bands, of radiance and without padding.
        count: coefficient images, 1 to the number of lights.

    Returns:
        The basis. Of each image's two signs, the one in which its largest coefficient is positive.

    Raises:
        ArrayError: the count is out of range, or the products are not finite.
    """
    lights = products.shape[-1]
    if not 1 <= count <= lights:
        raise ArrayError(f"count is {count}: give 1 to {lights}, the number of lights")
    if not np.isfinite(products).all():
        raise ArrayError("Gram matrix holds values that are not finite")
    squares, vectors = np.linalg.eigh(products)
    vectors = np.swapaxes(vectors[:, :, ::-1], 1, 2)  # [3, rank, light], the strongest first
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=2)[..., None], axis=2)
    return Basis((vectors * np.where(largest < 0, -1.0, 1.0))[:, :count], np.sqrt(np.maximum(squares[:, ::-1], 0)))


def projection(basis: Basis, scale: np.ndarray) -> np.ndarray:
    """Return the weights with which batch.combine_batch turns stored images into coefficient images.

    Args:
        basis: of principal.
        scale: [lights padded] radiance of a stored 1.0.

    Returns:
        [K, 3, lights padded] float32.
    """
    channels, count, lights = basis.matrix.shape
    weights = np.zeros((count, channels, len(scale)), dtype=np.float32)
    weights[:, :, :lights] = np.swapaxes(basis.matrix, 0, 1) * scale[:lights]
    return weights


@cache
def gram_kernel(pack: int) -> Any:
    """Return the kernel, one thread for a tile of light pairs, a channel and a pixel range.

    A product of two half values is exact in float.
    """
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)
    side = wp.types.matrix(shape=(TILE, pack), dtype=wp.float32)
    sums = wp.types.matrix(shape=(TILE, TILE), dtype=wp.float64)

    @wp.kernel(enable_backward=False, module="unique")
    def gram_tiles(first: int,
                   values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance; L a multiple of 4
                   keep: wp.array(dtype=float_pack),  # [P] 1 where a pixel counts, else 0
                   tiles: wp.array(dtype=wp.vec2i),  # first lights of the rows and columns of each tile
                   chunks: int,
                   # outputs
                   partial: wp.array4d(dtype=wp.float64)):  # [chunks, 3, L, L]
        thread = first + wp.tid()
        tile = tiles[thread % tiles.shape[0]]
        channel = thread / tiles.shape[0] % 3
        chunk = thread / tiles.shape[0] / 3
        row = channel * partial.shape[2] + tile[0]
        column = channel * partial.shape[2] + tile[1]
        packs = values.shape[1]
        total = sums()
        for p in range(int(wp.int64(packs) * wp.int64(chunk) / wp.int64(chunks)),
                       int(wp.int64(packs) * wp.int64(chunk + 1) / wp.int64(chunks))):
            counts = keep[p]
            down, across = side(), side()
            for i in range(TILE):
                upper = values[row + i, p]
                for k in range(pack):
                    down[i, k] = float(upper[k]) * counts[k]
            for j in range(TILE):
                lower = values[column + j, p]
                for k in range(pack):
                    across[j, k] = float(lower[k])
            for i in range(TILE):
                for j in range(TILE):
                    for k in range(pack):
                        total[i, j] += wp.float64(down[i, k] * across[j, k])
        for i in range(TILE):
            for j in range(TILE):
                partial[chunk, channel, tile[0] + i, tile[1] + j] = total[i, j]

    return gram_tiles
