"""A basis for each tile of an image: the few images whose sums come closest to the tile under the light that may be asked for.

Shadows and highlights move over an object with the light, so the images of a whole object have as many independent parts as there are
lights. Those of a small tile have few: a shadow crosses it under few lights. The singular value decomposition is that of the tile's
images, in a norm that says which light is asked for: pictures that are equally likely count alike, however dark they are.

Source: Sloan, Hall, Hart and Snyder, "Clustered principal components for precomputed radiance transfer", SIGGRAPH 2003, section 4 (a basis
    for each part of an object); Eckart and Young, "The approximation of one matrix by another of lower rank", Psychometrika 1, 1936.
"""

from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError

LEAST_ENERGY = 1e-4
"""Least energy of a picture that counts as its own, in parts of the mean: below it, it is the noise of its images."""


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

    Raises:
        ArrayError: the Gram matrices hold values that are not finite.
    """
    if not np.isfinite(products).all():
        raise ArrayError("Gram matrix holds values that are not finite")
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
    """Return the bases of tiles that lose least.

    Args:
        images: [tiles, 3, lights, pixels] float32, finite.
        factor: [3, lights, lights] of light_factor, invertible.
        count: terms, 1 to the number of lights.

    Returns:
        The bases; of each term's two signs, the one in which its largest coefficient of a light is positive.

    Raises:
        ArrayError: the count is out of range.
    """
    lights = images.shape[2]
    if not 1 <= count <= lights:
        raise ArrayError(f"count is {count}: give 1 to {lights}, the number of lights")
    weighted = np.matmul(factor.astype(np.float32), images)
    products = np.matmul(weighted, np.swapaxes(weighted, 2, 3)).astype(np.float64)
    squares, vectors = np.linalg.eigh(products)
    vectors = vectors[..., ::-1][..., :count]  # [tiles, 3, light, term], the strongest first
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=2)[:, :, None], axis=2)
    vectors = vectors * np.where(largest < 0, -1.0, 1.0)
    coefficients = np.matmul(np.swapaxes(vectors, 2, 3).astype(np.float32), weighted)
    return TileBases(np.linalg.solve(factor, vectors), coefficients, np.maximum(squares[..., ::-1], 0))
