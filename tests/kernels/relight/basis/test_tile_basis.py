"""Bases of tiles: the least loss in the norm of the light that is asked for."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.basis.basis import light_factor, tile_bases

FLOAT = 2e-4
"""Products of single floats, summed over the pixels of a tile, and their eigenvalues' square roots."""


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """[tiles, 3, lights, pixels], some lights far darker than others."""
    rng = np.random.default_rng(3)
    return (rng.gamma(1.0, 1.0, (4, 3, 10, 25)) * np.geomspace(1, 0.05, 10)[:, None]).astype(np.float32)


@pytest.fixture(scope="module")
def asked() -> tuple[np.ndarray, np.ndarray]:
    """Weights [pictures, 3, lights] of light that is asked for, and how likely each is."""
    rng = np.random.default_rng(4)
    return rng.gamma(0.3, 1.0, (30, 3, 10)), rng.random(30) + 0.1


def gram(images: np.ndarray) -> np.ndarray:
    return np.einsum("tclp,tcmp->clm", *2 * [images.astype(np.float64)])


def rebuilt(bases) -> np.ndarray:
    return np.matmul(bases.matrix, bases.coefficients)


def mean_relative_error(residual, images, weights, share) -> float:
    """Half the mean squared relative error of the asked pictures, half that of the captured images."""
    def energy(values):
        return (np.einsum("ncl,tclp->ntcp", weights, values) ** 2).sum(axis=(1, 2, 3)), (values**2).sum(axis=(0, 1, 3))
    (left, alone), (whole, each) = energy(residual), energy(images)
    return float((left / whole) @ (share / share.sum()) + (alone / each).mean()) / 2


def test_the_norm_is_the_expected_relative_error(images, asked):
    """For any residual, and so for what a basis leaves: its squared values that are left out."""
    factor = light_factor(gram(images), *asked)
    bases = tile_bases(images, factor, 4)
    residual = images - rebuilt(bases)
    wanted = mean_relative_error(residual, images, *asked)
    assert np.sum(np.einsum("clm,tcmp->tclp", factor, residual) ** 2) == pytest.approx(wanted, rel=FLOAT)
    assert bases.squares[..., 4:].sum() == pytest.approx(wanted, rel=FLOAT)
    assert bases.squares.sum() == pytest.approx(1, rel=FLOAT)  # all of every picture


def test_no_other_images_lose_less(images, asked):
    factor = light_factor(gram(images), *asked)
    best = mean_relative_error(images - rebuilt(tile_bases(images, factor, 4)), images, *asked)
    plain = tile_bases(images, np.broadcast_to(np.eye(10), (3, 10, 10)), 4)
    assert best < 0.95 * mean_relative_error(images - rebuilt(plain), images, *asked)


def test_with_as_many_terms_as_lights_nothing_is_lost(images, asked):
    bases = tile_bases(images, light_factor(gram(images), *asked), 10)
    np.testing.assert_allclose(rebuilt(bases), images, atol=FLOAT * images.max())


def test_black_images_have_a_norm_and_a_black_basis():
    factor = light_factor(np.zeros((3, 5, 5)), np.ones((2, 3, 5)), np.ones(2))
    bases = tile_bases(np.zeros((1, 3, 5, 4), dtype=np.float32), factor, 2)
    assert not rebuilt(bases).any() and not bases.squares.any()


@pytest.mark.parametrize("count", [0, 11])
def test_a_count_that_cannot_be_is_refused(images, count):
    with pytest.raises(ArrayError, match="give 1 to 10"):
        tile_bases(images, np.broadcast_to(np.eye(10), (3, 10, 10)), count)


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(ArrayError, match="not finite"):
        light_factor(np.full((3, 4, 4), np.nan), np.ones((2, 3, 4)), np.ones(2))
