"""The singular value decomposition of a stack by its Gram matrix, and what it leaves."""

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.relight.basis.basis import MAX_CHUNKS, gram, gram_kernel, principal, projection, residual_kernel, squared_residual
from kernels.relight.frames.combine import combine_batch
from tests.kernels.scenes import HALF_ROUNDING, store
from tests.reference.light_basis import truncation


def captured(lights, pixels, rank=None, seed=0):
    """[3, lights padded, pixels] half, of full rank or of a given one but for rounding; not negative."""
    rng = np.random.default_rng(seed)
    if rank is None:
        return store(rng.gamma(1.0, 1.0, (3, lights, pixels)))
    return store(rng.gamma(1.0, 1.0, (3, lights, rank)) @ rng.gamma(1.0, 1.0, (3, rank, pixels)))


def kept(pixels, seed=1):
    return np.random.default_rng(seed).random(pixels) > 0.3


def products(stack, keep):
    inside = stack[:, :, keep].astype(np.float64)
    return np.einsum("clp,cmp->clm", inside, inside)


def full_functions(basis, lights):
    functions = np.zeros((3, lights, basis.matrix.shape[1]))
    functions[:, : basis.matrix.shape[2]] = np.swapaxes(basis.matrix, 1, 2)
    return functions


@pytest.mark.parametrize("pixels", [1, 33, 64 * MAX_CHUNKS + 5])
@pytest.mark.parametrize("lights", [1, 8, 21])
def test_the_gram_matrix_is_the_masked_inner_products(lights, pixels, device):
    stack, keep = captured(lights, pixels), kept(pixels)
    found = gram(packs.upload(stack, device=device), keep)
    assert np.allclose(found, products(stack, keep), rtol=1e-13, atol=0)  # sums of positive doubles


def test_a_mask_that_is_empty_gives_zero(device):
    found = gram(packs.upload(captured(8, 40), device=device), np.zeros(40, dtype=bool))
    assert not found.any()
    assert np.array_equal(principal(found, 3).truncation, np.zeros(3))


@pytest.mark.parametrize("chunks", [1, 5])
def test_the_kernel_of_cuda(chunks):
    """Packs of four, on the CPU; the lower triangle of tiles."""
    stack, keep = captured(13, 132), kept(132)
    lights = stack.shape[1]
    values = wp.array(stack.reshape(3 * lights, 33, 4), dtype=pack_type(4, wp.float16), device="cpu")
    counts = wp.array(keep.astype(np.float32).reshape(33, 4), dtype=pack_type(4, wp.float32), device="cpu")
    tiles = np.stack(np.tril_indices(lights // 4), axis=1) * 4
    partial = wp.zeros((chunks, 3, lights, lights), dtype=wp.float64, device="cpu")
    devices.launch(gram_kernel(4), chunks * 3 * len(tiles), [values, counts, wp.array(tiles, dtype=wp.vec2i, device="cpu"), chunks],
                   [partial], device="cpu")
    assert np.allclose(np.tril(partial.numpy().sum(axis=0)), np.tril(products(stack, keep)), rtol=1e-13, atol=0)


@pytest.mark.parametrize("count", [1, 4, 20])
def test_the_error_is_that_of_the_singular_values(count, device):
    stack, keep = captured(20, 500), kept(500)
    basis = principal(gram(packs.upload(stack, device=device), keep)[:, :20, :20], count)
    # squares in doubles: 1e-16 of the whole, so 1e-8 of an error that is not small
    assert np.allclose(basis.truncation, truncation(stack[:, :20, keep], count), rtol=1e-7, atol=1e-7)
    assert np.allclose(basis.matrix @ np.swapaxes(basis.matrix, 1, 2), np.eye(count), atol=1e-12)
    assert (np.take_along_axis(basis.matrix, np.abs(basis.matrix).argmax(axis=2)[..., None], axis=2) > 0).all()


@pytest.mark.parametrize("rank", [1, 3, 6])
def test_a_stack_of_known_rank_comes_back(rank, device):
    stack, keep = captured(24, 400, rank), kept(400)
    band = packs.upload(stack, device=device)
    basis = principal(gram(band, keep), rank)
    coefficients = combine_batch(band, projection(basis, np.ones(24, dtype=np.float32))).numpy()[:, :, :400]
    rebuilt = np.einsum("ckl,kcp->clp", basis.matrix, coefficients.astype(np.float64))
    exact = stack.astype(np.float64)
    assert (basis.truncation < HALF_ROUNDING).all()  # the rank is exact but for the rounding of the stack to half
    assert (np.abs(rebuilt - exact)[:, :, keep].max() < 2 * HALF_ROUNDING * exact.max())
    if rank > 1:
        assert (principal(gram(band, keep), rank - 1).truncation > 20 * HALF_ROUNDING).all()


def test_what_is_left_is_what_is_reported(device):
    stack, keep = captured(20, 700), kept(700)
    band = packs.upload(stack, device=device)
    scale = np.where(np.arange(24) < 20, 2.0 ** (np.arange(24) % 5 - 2), 0).astype(np.float32)
    real = scale[:20].astype(np.float64)
    basis = principal(gram(band, keep)[:, :20, :20] * real[:, None] * real, 6)
    coefficients = combine_batch(band, projection(basis, scale)).numpy()
    left = squared_residual(band, np.tile(scale, (3, 1)), coefficients, full_functions(basis, 24)).numpy()[:, :700][:, keep]
    whole = ((stack[:, :20, keep].astype(np.float64) * real[:, None]) ** 2).sum(axis=(1, 2))
    # float differences and sums of 20 squares
    assert np.allclose(np.sqrt(left.sum(axis=1, dtype=np.float64) / whole), basis.truncation, rtol=1e-5)


@pytest.mark.parametrize("low, high", [(-np.inf, np.inf), (0.0, 0.7)])
@pytest.mark.parametrize("pixels", [1, 33, 200])
def test_the_residual_is_the_sum_of_squares(pixels, low, high, device):
    stack = captured(13, pixels)
    band = packs.upload(stack, device=device)
    rng = np.random.default_rng(2)
    gains, functions = rng.random((3, 16)).astype(np.float32), rng.normal(size=(3, 16, 4)).astype(np.float32)
    whole = band.packs * devices.pack_width(device)
    coefficients = np.zeros((4, 3, whole), dtype=np.float32)
    coefficients[:, :, :pixels] = rng.normal(size=(4, 3, pixels))
    found = squared_residual(band, gains, coefficients, functions, low=low, high=high).numpy()[:, :pixels]
    rebuilt = np.clip(np.einsum("clt,tcp->clp", functions.astype(np.float64), coefficients[:, :, :pixels].astype(np.float64)), low, high)
    wanted = ((rebuilt - gains[..., None].astype(np.float64) * stack) ** 2).sum(axis=1)
    assert np.allclose(found, wanted, rtol=1e-5)  # sums of 16 squares in float


def test_the_residual_kernel_of_cuda():
    """Packs of four, on the CPU."""
    stack = captured(8, 20)
    values = wp.array(stack.reshape(24, 5, 4), dtype=pack_type(4, wp.float16), device="cpu")
    ones = wp.array(np.ones((3, 8)), dtype=wp.float32, device="cpu")
    nothing = wp.zeros((1, 3, 5), dtype=pack_type(4, wp.float32), device="cpu")
    squares = wp.zeros((3, 5), dtype=pack_type(4, wp.float32), device="cpu")
    devices.launch(residual_kernel(4), 15, [values, ones, nothing, wp.zeros((3, 8, 1), dtype=wp.float32, device="cpu"),
                                            -np.inf, np.inf], [squares], device="cpu")
    assert np.allclose(squares.numpy().reshape(3, 20), (stack.astype(np.float64) ** 2).sum(axis=1), rtol=1e-5)  # eight squares in float


@pytest.mark.parametrize("count", [0, 9])
def test_a_count_out_of_range_is_refused(count):
    with pytest.raises(ArrayError, match=f"count is {count}: give 1 to 8"):
        principal(np.eye(8)[None].repeat(3, axis=0), count)


def test_what_does_not_fit_is_refused(device):
    band = packs.upload(captured(8, 40), device=device)
    with pytest.raises(ArrayError, match="keep has 41 pixels, the band 40"):
        gram(band, np.ones(41, dtype=bool))
    with pytest.raises(ArrayError, match="not finite"):
        principal(np.full((3, 2, 2), np.nan), 1)
    with pytest.raises(ArrayError, match=r"functions are \(3, 7, 2\), expected \(3, 8, 2\)"):
        squared_residual(band, np.ones((3, 8)), np.zeros((2, 3, band.packs * devices.pack_width(device))), np.zeros((3, 7, 2)))
