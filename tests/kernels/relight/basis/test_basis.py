"""The singular value decomposition of a stack by its Gram matrix, and what it leaves."""

import numpy as np
import pytest

from kernels import device as devices
from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.basis.basis import MAX_CHUNKS, gram, principal, projection, squared_residual
from kernels.relight.basis.rti import HSH_TERMS, biquadratic, fit_weights, hemispherical_harmonics, separate
from kernels.relight.frames.combine import combine_batch
from tests.kernels.scenes import HALF_ROUNDING, shade, store
from tests.reference.light_basis import harmonics, polynomial, relative_rms, truncation
from tests.reference.sampling import lattice


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


LIGHTS = lattice(200, 85)


def test_the_biquadratic_is_in_the_order_of_the_file():
    assert np.allclose(biquadratic(LIGHTS), polynomial(LIGHTS), rtol=1e-14)


@pytest.mark.parametrize("terms", HSH_TERMS)
def test_harmonics_are_legendre_polynomials(terms):
    assert np.allclose(hemispherical_harmonics(LIGHTS, terms), harmonics(LIGHTS, terms), atol=1e-12)


@pytest.mark.parametrize("functions", [biquadratic(LIGHTS), hemispherical_harmonics(LIGHTS, 16)])
def test_what_lies_in_the_functions_is_fitted_exactly(functions):
    coefficients = np.random.default_rng(0).normal(size=(functions.shape[1], 5))
    assert np.allclose(fit_weights(functions) @ (functions @ coefficients), coefficients, atol=1e-10)


@pytest.mark.parametrize(("terms", "limit"), [(None, 0.11), (4, 0.12), (9, 0.08), (16, 0.045)], ids=["ptm", "hsh 4", "hsh 9", "hsh 16"])
def test_a_lambertian_ball_is_close(terms, limit):
    """max(0, n·l) is not in any of the spaces; the limits are the figures of the float64 twin on these normals and lights, rounded up."""
    functions = polynomial(LIGHTS) if terms is None else harmonics(LIGHTS, terms)
    normal = lattice(300, 60)
    radiance = shade(normal, np.ones((300, 3)), LIGHTS, np.ones((200, 3)))[0]
    ours = biquadratic(LIGHTS) if terms is None else hemispherical_harmonics(LIGHTS, terms)
    error = relative_rms(ours @ (fit_weights(ours) @ radiance), radiance)
    wanted = np.linalg.lstsq(functions, radiance, rcond=None)[0]
    assert error == pytest.approx(relative_rms(functions @ wanted, radiance), rel=1e-9)
    assert error < limit


def test_lights_that_determine_nothing_are_refused():
    ring = np.array([[np.cos(a) * 0.6, np.sin(a) * 0.6, 0.8] for a in np.linspace(0, 6, 12)])
    for lights in (ring, LIGHTS[:5]):
        with pytest.raises(ArrayError, match=f"{len(lights)} lights do not determine 6 coefficients"):
            fit_weights(biquadratic(lights))
    with pytest.raises(ArrayError, match="terms are 10"):
        hemispherical_harmonics(LIGHTS, 10)


def test_a_colour_times_a_luminance_is_separated():
    rng = np.random.default_rng(3)
    functions, colour = biquadratic(LIGHTS), rng.uniform(0.1, 0.8, (40, 3))
    colour[7] = 0
    normal = lattice(40, 50)
    values = 255 * shade(normal, colour, LIGHTS, np.full((200, 3), np.pi)).clip(0, 1)
    fitted = np.einsum("tl,clp->tcp", fit_weights(functions), values).astype(np.float32)
    found = separate(fitted, functions)
    shown = np.einsum("lt,tp,cp->clp", functions, found.coefficients, found.colour / 255.0)
    # each byte of the colour is rounded by a half, and the luminance, 255 at the most, follows by (1 + √3)/2 of that at the most
    assert np.abs(shown - np.einsum("lt,tcp->clp", functions, fitted)).max() < 0.5 * (1 + (1 + 3**0.5) / 2)
    assert found.colour.max() <= 255 and not found.colour[:, 7].any() and not found.coefficients[:, 7].any()
    coloured = np.arange(40) != 7
    peaks, length = (functions @ found.coefficients).max(axis=0)[coloured], np.linalg.norm(found.colour, axis=0)[coloured]
    assert (np.abs(peaks / 255 - 1) < 0.5 * 3**0.5 / length).all()  # the rounding of the colour along itself
