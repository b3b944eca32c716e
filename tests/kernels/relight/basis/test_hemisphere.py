"""The functions of PTM and HSH, and how close they come to a Lambertian ball."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.basis.rti import HSH_TERMS, biquadratic, fit_weights, hemispherical_harmonics, separate
from tests.kernels.scenes import cap, shade
from tests.reference.light_basis import harmonics, polynomial, relative_rms

LIGHTS = cap(200, 85)


def test_the_biquadratic_is_in_the_order_of_the_file():
    assert np.allclose(biquadratic(LIGHTS), polynomial(LIGHTS), rtol=1e-14)


@pytest.mark.parametrize("terms", HSH_TERMS)
def test_harmonics_are_legendre_polynomials(terms):
    assert np.allclose(hemispherical_harmonics(LIGHTS, terms), harmonics(LIGHTS, terms), atol=1e-12)


@pytest.mark.parametrize("functions", [biquadratic(LIGHTS), hemispherical_harmonics(LIGHTS, 16)])
def test_what_lies_in_the_functions_is_fitted_exactly(functions):
    coefficients = np.random.default_rng(0).normal(size=(functions.shape[1], 5))
    assert np.allclose(fit_weights(functions) @ (functions @ coefficients), coefficients, atol=1e-10)


@pytest.mark.parametrize(("name", "functions", "limit"), [
    # max(0, n·l) is not in any of the spaces; the figures are those of the float64 twin on these normals and lights, rounded up
    ("ptm", polynomial(LIGHTS), 0.11), ("hsh 4", harmonics(LIGHTS, 4), 0.12), ("hsh 9", harmonics(LIGHTS, 9), 0.08),
    ("hsh 16", harmonics(LIGHTS, 16), 0.045)])
def test_a_lambertian_ball_is_close(name, functions, limit):
    normal = cap(300, 60)
    radiance = shade(normal, np.ones((300, 3)), LIGHTS, np.ones((200, 3)))[0]
    ours = biquadratic(LIGHTS) if name == "ptm" else hemispherical_harmonics(LIGHTS, functions.shape[1])
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
    normal = cap(40, 50)
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
