"""Bases of a stack or of each tile of an image: in each channel the few images whose sums come closest to all captured ones.

The singular value decomposition of the masked pixels × lights matrix, by way of its lights × lights Gram matrix, which a pass over
the bands accumulates in float64: the memory is that of a band, however many pixels there are. The eigenvalues tell the error of
leaving images out; below about 1e-8 of the whole, where their squares leave double precision, they tell nothing.

Shadows and highlights move over an object with the light, so the images of a whole object have as many independent parts as there are
lights. Those of a small tile have few: a shadow crosses it under few lights. The decomposition is then that of the tile's images, in a norm
that says which light is asked for: pictures that are equally likely count alike, however dark they are.

Source: Eckart and Young, "The approximation of one matrix by another of lower rank", Psychometrika 1, 1936; for images under varying light
    Epstein, Hallinan and Yuille, "5 ± 2 eigenimages suffice", 1995; a basis for each part of an object: Sloan, Hall, Hart and Snyder,
    "Clustered principal components for precomputed radiance transfer", SIGGRAPH 2003, section 4.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, as_packs, pack_type, zeros

TILE = 4
"""Number of lights down and across whose products one thread sums: 16 sums fit into registers, and 4 divides the light padding of 8."""
THREADS = 1 << 16
"""Approximate number of threads in one launch: they fill a large device, and their partial sums take 16 MB."""
MAX_CHUNKS = 64
"""Most pixel ranges that have sums of their own: on the CPU the pixels of one range stay in the cache for all tiles."""
LEAST_ENERGY = 1e-4
"""Least energy of a picture that counts as its own, in parts of the mean: below it, it is the noise of its images."""


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
    """Return [3, lights, lights] float64 inner products of the stored images of a band, padding included; waits for the device on CUDA.

    `keep` is [pixels of the band] bool, the pixels that count.
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
    lower = np.tril(to_numpy(partial).sum(axis=0))
    return lower + np.swapaxes(np.tril(lower, -1), 1, 2)


def principal(products: np.ndarray, count: int) -> Basis:
    """Return the best basis of `count` images, 1 to the number of lights, for each channel.

    Of each image's two signs, the one in which its largest coefficient is positive.

    Args:
        products: [3, lights, lights] Gram matrices, summed over all bands, of radiance and without padding.
    """
    _check_count(count, products.shape[-1])
    _check_finite(products)
    squares, vectors = _eigenvectors(products, count)
    return Basis(np.swapaxes(vectors, 1, 2), np.sqrt(squares))


def _check_count(count: int, lights: int) -> None:
    if not 1 <= count <= lights:
        raise ArrayError(f"count is {count}: give 1 to {lights}, the number of lights")


def _check_finite(products: np.ndarray) -> None:
    if not np.isfinite(products).all():
        raise ArrayError("Gram matrix holds values that are not finite")


def _eigenvectors(products: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all eigenvalues […, lights] of Gram matrices, descending, 0 or above, and the first eigenvectors […, light, term].

    Of each vector's two signs, the one in which its largest part is positive."""
    squares, vectors = np.linalg.eigh(products)
    vectors = vectors[..., ::-1][..., :count]
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=-2)[..., None, :], axis=-2)
    return np.maximum(squares[..., ::-1], 0), vectors * np.where(largest < 0, -1.0, 1.0)


def projection(basis: Basis, scale: np.ndarray) -> np.ndarray:
    """Return [K, 3, lights padded] float32 weights with which combine_batch turns stored images into coefficient images.

    `scale` is [lights padded], the radiance of a stored 1.0.
    """
    channels, count, lights = basis.matrix.shape
    weights = np.zeros((count, channels, len(scale)), dtype=np.float32)
    weights[:, :, :lights] = np.swapaxes(basis.matrix, 0, 1) * scale[:lights]
    return weights


def squared_residual(band: Band, gains: np.ndarray, coefficients: np.ndarray, functions: np.ndarray, *,
                     low: float = -np.inf, high: float = np.inf) -> wp.array:
    """Return [3, pixels padded] float32 Σ over the lights of (image − rebuilt image)²; not synchronised on CUDA.

    Differences are taken in float: below 1e-6 of the image they are rounding.

    Args:
        gains: [3, lights padded] float32; image = gain · stored value. 0 for lights that do not count.
        coefficients: [terms, 3, pixels padded] float32.
        functions: [3, lights padded, terms]; rebuilt image = Σ function · coefficient. 0 for lights that do not count.
        low, high: what a rebuilt value is limited to, as a display does; 0 must lie between.
    """
    band.require_channels(3)
    pack, device = devices.pack_width(band.device), band.device
    terms, pixels = len(coefficients), band.packs * pack
    wanted = {"gains": (gains, (3, band.frame_count)), "coefficients": (coefficients, (terms, 3, pixels)),
              "functions": (functions, (3, band.frame_count, terms))}
    for name, (array, shape) in wanted.items():
        if array.shape != shape:
            raise ArrayError(f"{name} are {array.shape}, expected {shape}")
    on_device = wp.array(coefficients, dtype=wp.float32, device=device)
    small = [wp.array(a, dtype=wp.float32, device=device) for a in (gains, functions)]
    squares = zeros(band.pixel_count, wp.float32, device, rows=3)
    devices.launch(residual_kernel(pack), 3 * band.packs, [band.values, small[0], as_packs(on_device, device), small[1], low, high],
                   [as_packs(squares, device)], device=device)
    return squares


class TileBases(NamedTuple):
    """The bases of some tiles: captured image l ≈ Σₖ matrix[l, k] · coefficients[k]."""

    matrix: np.ndarray  # [tiles, 3, lights, K] float64
    coefficients: np.ndarray  # [tiles, 3, K, pixels] float32
    squares: np.ndarray  # [tiles, 3, lights] float64, descending: squared norm of each term, also of those that are left out


def light_factor(products: np.ndarray, weights: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the factor F of a norm ‖F X‖² of images X that is their mean squared size in the pictures that may be asked for.

    Half of the pictures are the captured images, and half those of given light. Each counts by its own energy, so that
    ‖F (X − Y)‖² is the mean relative squared error of pictures of Y, where X holds all pixels of the images.

    Args:
        products: [3, lights, lights] Gram matrices of the images over all pixels.
        weights: [pictures, 3, lights] of the images in each picture.
        share: [pictures] how likely each picture is, any scale.

    Returns:
        [3, lights, lights] float64, upper triangular; the identity where all images are black.
    """
    _check_finite(products)
    lights = products.shape[-1]
    alone = np.einsum("cll->l", products)
    if not alone.sum() > 0:
        return np.broadcast_to(np.eye(lights), products.shape).copy()
    least = LEAST_ENERGY * alone.mean()
    energy = np.einsum("ncl,clm,ncm->n", weights, products, weights, optimize=True)
    weighted = weights * np.sqrt(share / share.sum() / np.maximum(energy, LEAST_ENERGY * energy.mean()))[:, None, None]
    moments = np.einsum("ncl,ncm->clm", weighted, weighted, optimize=True) + np.diag(1 / np.maximum(alone, least)) / lights
    return np.swapaxes(np.linalg.cholesky(moments / 2), 1, 2)


def tile_bases(images: np.ndarray, factor: np.ndarray, count: int) -> TileBases:
    """Return the bases of tiles that lose least; of each term's two signs, the one in which its largest coefficient of a light is positive.

    Args:
        images: [tiles, 3, lights, pixels] float32, finite.
        factor: [3, lights, lights] of light_factor, invertible.
        count: terms, 1 to the number of lights.
    """
    _check_count(count, images.shape[2])
    weighted = np.matmul(factor.astype(np.float32), images)
    products = np.matmul(weighted, np.swapaxes(weighted, 2, 3)).astype(np.float64)
    squares, vectors = _eigenvectors(products, count)
    coefficients = np.matmul(np.swapaxes(vectors, 2, 3).astype(np.float32), weighted)
    return TileBases(np.linalg.solve(factor, vectors), coefficients, squares)


@once
def gram_kernel(pack: int) -> Any:
    """Return the kernel, one thread for a tile of light pairs, a channel and a pixel range.

    A product of two half values is exact in float.
    """
    half_pack, float_pack, load = pack_type(pack, wp.float16), pack_type(pack, wp.float32), pack_load(pack, wp.float16)
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
                upper = load(values, row + i, p)
                for k in range(pack):
                    down[i, k] = float(upper[k]) * counts[k]
            for j in range(TILE):
                lower = load(values, column + j, p)
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


@once
def residual_kernel(pack: int) -> Any:
    """Return the kernel: one thread for a pack of one channel."""
    half_pack, float_pack, load = pack_type(pack, wp.float16), pack_type(pack, wp.float32), pack_load(pack, wp.float16)

    @wp.kernel(enable_backward=False, module="unique")
    def residual(first: int,
                 values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                 gains: wp.array2d(dtype=float),  # [3, L]
                 coefficients: wp.array3d(dtype=float_pack),  # [T, 3, P]
                 functions: wp.array3d(dtype=float),  # [3, L, T]
                 low: float,
                 high: float,
                 # outputs
                 squares: wp.array2d(dtype=float_pack)):  # [3, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        channel = thread / packs
        p = thread % packs
        total = float_pack()
        for light in range(gains.shape[1]):
            rebuilt = float_pack()
            for t in range(functions.shape[2]):
                rebuilt += functions[channel, light, t] * coefficients[t, channel, p]
            value = load(values, channel * gains.shape[1] + light, p)
            gain = gains[channel, light]
            for k in range(pack):
                difference = wp.clamp(rebuilt[k], low, high) - gain * float(value[k])
                total[k] += difference * difference
        squares[channel, p] = total

    return residual
