"""Trust in a model: one for images that are the model, none for images that it does not explain, and the least squares between."""

import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.model.captured import Captured
from kernels.relight.model.guide import LEAST_ALPHA, POOL, compare_model, fit_trust, seen_lobes
from kernels.relight.model.shading import SecondLobe, upload_surface
from service.relight.weights.triangulation import left_out
from tests.kernels.relight.lights import AXES, icosahedron
from tests.kernels.relight.surfaces import LOBE, captured, facing, pack_bytes, scattered_pixels, stored, upload
from tests.kernels.scenes import HALF_ROUNDING, HALF_STEP, colours, store
from tests.reference import shading as reference
from tests.reference.microfacet import distribution
from tests.reference.sampling import lattice

LIGHTS = lattice(24, 180)
NEIGHBOURS, SHARES = left_out(LIGHTS)
IRRADIANCE = 3 * colours(24, seed=4)


def matte(count, seed=0):
    """Scattered pixels without a specular part: what the model says is missing does not depend on the images."""
    return scattered_pixels(count, seed)._replace(roughness=np.zeros(count, np.float32))


def compared(pixels, readings, device, *, visible=None, shares=SHARES):
    """[2, P] of compare_model, and the readings that its band holds."""
    images, held = captured(pixels, readings, LIGHTS, IRRADIANCE, device, visible=visible)
    got = compare_model(images, NEIGHBOURS, shares)
    return got.numpy()[:, : len(pixels.normal)], held


def trusted(pixels, readings, device, *, visible=None, shares=SHARES):
    """β [P] of pixels too far apart for one to count for another, and the readings that the band holds."""
    sums, held = compared(pixels, readings, device, visible=visible, shares=shares)
    count = len(pixels.normal)
    return fit_trust(sums, np.arange(count) * (POOL + 1), (1, (POOL + 1) * count)), held


def wobble(values, error, told, shares=SHARES):
    """[P] how far β moves at most when values [lights, 3, P] are off by `error` of themselves: Σ |told| · |misses move by| / Σ told²."""
    off = error * np.abs(values)
    moved = off + sum(shares[:, k, None, None] * off[NEIGHBOURS[:, k]] for k in range(3))
    return (np.abs(told) * moved).sum(axis=(0, 1)) / (told**2).sum(axis=(0, 1))


def rounded(readings, told, shares=SHARES):
    """[P] how far half rounding moves β: a part of each reading, and below the normal range a step of stored values a tenth of it."""
    return wobble(np.abs(readings) + 10 * HALF_STEP / HALF_ROUNDING, 1.01 * HALF_ROUNDING, told, shares)


def close(got, held, parts, shares=SHARES):
    """Float32: the model's readings are off by LOBE, which moves what is missing times it, and its square twice."""
    expected, missing, told = reference.trust(held, parts, NEIGHBOURS, shares)
    model = np.maximum(parts.sum(axis=0), held)  # a specular part is scaled to the images
    size = np.maximum(np.sqrt((missing**2).sum(axis=(0, 1)) / (told**2).sum(axis=(0, 1))), 1)
    return (np.abs(got - expected) <= 3 * size * wobble(model, LOBE, np.abs(told), shares) + 1e-6).all()


@pytest.mark.parametrize("count", [1, 45, 64])
def test_it_is_the_twin(count, device):
    """Of images half explained by the model, in part hidden."""
    rng = np.random.default_rng(count)
    pixels = scattered_pixels(count, seed=count)
    visible = rng.choice(np.array([0, 255, 90], np.uint8), (len(LIGHTS), count))
    parts = reference.parts(pixels, LIGHTS, visible)
    model = parts.sum(axis=0)
    readings = np.abs(rng.uniform(0.2, 0.8, count) * model + rng.normal(0.2, 0.03, model.shape))
    got, held = trusted(pixels, readings, device, visible=visible)
    assert close(got, held, parts)
    assert count == 1 or np.ptp(got) > 0.1


def test_a_model_of_two_materials_explains_its_images(device):
    """β is one of images that the twin mixes, and less where the model lacks the second material. Tolerance: as against the twin."""
    pixels, other = scattered_pixels(45, seed=1), scattered_pixels(45, seed=2)
    share = np.full(45, 0.5, np.float32)
    one, two = (reference.parts(surface, LIGHTS) for surface in (pixels, pixels._replace(f0=other.f0, roughness=other.roughness)))
    parts = (one + two) / 2
    model = parts.sum(axis=0)
    stack, scale, held = stored(model, IRRADIANCE)
    visible = pack_bytes(np.full((len(LIGHTS), 45), 255, np.uint8), device)

    def sums(second):
        surface = upload_surface(*pixels, second=second, device=device)
        band = packs.upload(stack, device=device)
        images = Captured.of(band, surface, visible, LIGHTS, IRRADIANCE, scale)
        return compare_model(images, NEIGHBOURS, SHARES).numpy()[:, :45]

    top, bottom = sums(SecondLobe(other.f0, other.roughness, share))
    _, missing, told = reference.trust(held, parts, NEIGHBOURS, SHARES)
    allowed = 3 * wobble(model, LOBE, told) * (told**2).sum(axis=(0, 1))
    assert (np.abs(bottom - (told**2).sum(axis=(0, 1))) <= allowed).all()
    assert (np.abs(top - (missing * told).sum(axis=(0, 1))) <= allowed).all()
    lone_top, lone_bottom = sums(None)
    assert np.abs(lone_top / lone_bottom - 1).mean() > 10 * np.abs(top / bottom - 1).mean()


def image(shape, seed=0, part=0.7):
    """Sums [2, n] of scattered pixels of a picture, with model and images that differ."""
    rng = np.random.default_rng(seed)
    pixels = np.flatnonzero(rng.random(shape) < part)
    bottom = rng.gamma(1, 1, len(pixels))
    return np.stack([bottom * rng.normal(0.5, 0.7, len(pixels)), bottom]).astype(np.float32), pixels


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (7, 3), (30, 41)])
def test_pixels_pool_their_neighbourhood(shape):
    """Sums over the pixels that are there, at most POOL rows and columns away, by all pairs."""
    sums, pixels = image(shape, part=1.0 if max(shape) == 1 else 0.7)
    rows, cols = np.divmod(pixels, shape[1])
    near = (np.abs(rows[:, None] - rows) <= POOL) & (np.abs(cols[:, None] - cols) <= POOL)
    top, bottom = (near @ plane.astype(float) for plane in sums)
    got = fit_trust(sums, pixels, shape)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, np.clip(top / bottom, 0, 1), atol=1e-6)  # float32
    assert max(shape) < 40 or ((got > 0).any() and (got < 1).any())


def test_pixels_that_are_no_numbers_spoil_only_those_beside_them():
    sums, pixels = image((30, 41))
    bad = int(np.argmin(np.abs(pixels - (5 * 41 + 8))))
    spoilt = sums.copy()
    spoilt[0, bad] = np.nan
    near = np.abs(np.array(np.divmod(pixels, 41)) - np.array(np.divmod(pixels[bad], 41))[:, None]).max(axis=0) <= POOL
    np.testing.assert_array_equal(fit_trust(spoilt, pixels, (30, 41))[~near], fit_trust(sums, pixels, (30, 41))[~near])


def test_dim_pixels_have_their_trust_beside_bright_ones():
    """Twelve decades apart in what is told, six in radiance."""
    pixels = np.array([3, 30 * 50 + 40])
    got = fit_trust(np.array([[0.9e6, 0.25e-6], [1e6, 1e-6]], np.float32), pixels, (50, 50))
    np.testing.assert_allclose(got, [0.9, 0.25], rtol=1e-6)  # float32


def test_where_nothing_is_told_nothing_is_trusted():
    """However much is told elsewhere."""
    rng = np.random.default_rng(0)
    bottom = np.zeros((40, 40))
    bottom[:20] = rng.gamma(1, 1e5, (20, 40))
    got = fit_trust(np.stack([bottom, bottom]).reshape(2, -1), np.arange(1600), (40, 40)).reshape(40, 40)
    assert (got[: 20 + POOL] == 1).all() and (got[20 + POOL :] == 0).all()


def test_images_that_are_the_model_are_trusted_whole(device):
    pixels = scattered_pixels(45)
    visible = np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (len(LIGHTS), 45))
    parts = reference.parts(pixels, LIGHTS, visible)
    model = parts.sum(axis=0)
    got, held = trusted(pixels, model, device, visible=visible)
    _, _, told = reference.trust(held, parts, NEIGHBOURS, SHARES)
    assert (got <= 1).all()
    assert (1 - got <= rounded(model, told) + wobble(model, 2 * LOBE, told)).all()
    assert got.mean() > 1 - HALF_ROUNDING


def test_every_pixel_has_its_own(device):
    pixels, part = matte(70), np.linspace(0, 1, 70)
    parts = reference.parts(pixels, LIGHTS)
    model = parts.sum(axis=0)
    readings = 0.2 + part * model
    got, held = trusted(pixels, readings, device)
    _, _, told = reference.trust(held, parts, NEIGHBOURS, SHARES)
    assert (np.abs(got - part) <= rounded(readings, told) + wobble(model, 2 * LOBE, told)).all()


def test_images_that_the_model_does_not_explain_are_not_guided(device):
    """The same under every light: nothing is missing."""
    pixels = scattered_pixels(45)
    readings = np.full((len(LIGHTS), 3, 45), 0.3)
    got, held = trusted(pixels, readings, device)
    _, _, told = reference.trust(held, reference.parts(pixels, LIGHTS), NEIGHBOURS, SHARES)
    assert (got <= rounded(readings, told) + wobble(readings, LOBE, told)).all()


def test_noise_is_trusted_as_little_as_chance_has_it(device):
    """β before it is held at none is normal around none, with a spread σ that follows from the shares: then half of the pixels have none,
    and the mean is σ / √2π."""
    count = 4000
    pixels = type(matte(1))(*(np.repeat(plane, count, axis=0) for plane in matte(1, seed=3)))
    one = reference.parts(type(pixels)(*(plane[:1] for plane in pixels)), LIGHTS)
    _, _, told = reference.trust(one.sum(axis=0), one, NEIGHBOURS, SHARES)
    slope = np.where(SHARES.sum(axis=1) > 0, 1, 0)[:, None, None] * told
    for light, (near, share) in enumerate(zip(NEIGHBOURS, SHARES, strict=True)):
        for k in range(3):
            slope[near[k]] -= share[k] * told[light]
    spread = np.linalg.norm(slope) / (told**2).sum()  # of noise of spread one
    noise = np.random.default_rng(0).normal(0, 0.15 / spread, (len(LIGHTS), 3, count))
    got, _ = trusted(pixels, 20 * 0.15 / spread + noise, device)
    # four standard errors of 4000 pixels: of a half, 0.032; of the mean, whose spread is 0.58 σ, 0.037 σ; half rounding is small to noise
    assert np.mean(got == 0) == pytest.approx(0.5, abs=0.035)
    assert got.mean() == pytest.approx(0.15 / np.sqrt(2 * np.pi), abs=0.04 * 0.15)


def test_images_of_the_opposite_are_not_guided_and_those_that_miss_more_are_trusted_whole(device):
    """Darker where the model says brighter; more is missing than is told; and no light has a share in the prediction of another."""
    pixels = scattered_pixels(45)
    model = reference.readings(pixels, LIGHTS)
    for readings, shares, trust in ((model.max() - 0.9 * model, SHARES, 0), (1.5 * model, SHARES, 1), (model, np.zeros_like(SHARES), 0)):
        assert (trusted(pixels, readings, device, shares=shares)[0] == trust).all()


def test_lights_without_shares_say_nothing(device):
    """Of all but one: images that have no part in its prediction may hold anything."""
    pixels = matte(45)
    parts = reference.parts(pixels, LIGHTS)
    model = parts.sum(axis=0)
    light = int(np.argmax(SHARES.sum(axis=1) * LIGHTS[:, 2]))
    shares = np.where(np.arange(len(LIGHTS))[:, None] == light, SHARES, 0).astype(np.float32)
    readings = 0.2 + 0.5 * model
    readings[np.setdiff1d(np.arange(len(LIGHTS)), [light, *NEIGHBOURS[light]])] = 7
    got, held = trusted(pixels, readings, device, shares=shares)
    _, _, told = reference.trust(held, parts, NEIGHBOURS, shares)
    clear = (told**2).sum(axis=(0, 1)) > 1e-4
    assert clear.sum() > 30
    error = rounded(0.2 + 0.5 * model, told, shares) + wobble(model, 2 * LOBE, told, shares)
    assert (np.abs(got - 0.5)[clear] <= error[clear]).all() and error[clear].min() < 0.05


@pytest.mark.parametrize("black", ["albedo", "hidden"])
def test_a_black_model_is_not_trusted(black, device):
    pixels = facing(40, albedo=0.0) if black == "albedo" else scattered_pixels(40)
    visible = np.full((len(LIGHTS), 40), 255 if black == "albedo" else 0, np.uint8)
    assert (trusted(pixels, np.full((len(LIGHTS), 3, 40), 0.5), device, visible=visible)[0] == 0).all()


def call(device, *, pixels=40, band_pixels=40, seen=(24, 40), stack_lights=24, channels=3, neighbours=NEIGHBOURS, shares=SHARES):
    stack = store(np.ones((channels, stack_lights, band_pixels)))
    images = Captured.of(packs.upload(stack, device=device), upload(scattered_pixels(pixels), device),
                         pack_bytes(np.full(seen, 255, np.uint8), device), LIGHTS, IRRADIANCE, np.ones(24, np.float32))
    return compare_model(images, neighbours, shares)


@pytest.mark.parametrize("change, message", [
    ({"channels": 1}, "the band has 1 channels, expected 3"),
    ({"band_pixels": 200}, "band has .* packs of 24 lights, the surface .*: give the"),
    ({"pixels": 200, "band_pixels": 200}, "give the same pixels and lights"),
    ({"seen": (23, 40)}, "give the same pixels and lights"),
    ({"stack_lights": 16}, "packs of 16 lights, .* directions are 24: give the same"),
    ({"neighbours": NEIGHBOURS[:20]}, r"neighbours are \(20, 3\), shares \(24, 3\): give \(24, 3\)"),
    ({"shares": SHARES[:, :2]}, r"neighbours are \(24, 3\), shares \(24, 2\): give \(24, 3\)"),
])
def test_bad_calls_are_refused(change, message, device):
    call(device)
    with pytest.raises(ArrayError, match=message):
        call(device, **change)


def lobes(roughness, lights):
    specular = np.float32([[0.04, 0.5, 0.9]])
    return specular, *seen_lobes(specular, np.float32([roughness]), lights)


def test_lobes_that_the_lights_can_tell_stay():
    """Lights of an icosahedron are arccos(1 / √5) apart."""
    least = np.sqrt(LEAST_ALPHA * np.arccos(1 / np.sqrt(5)))
    for roughness in (1.01 * least, 1.0):
        specular, f0, kept = lobes(roughness, icosahedron())
        np.testing.assert_allclose(f0, specular, rtol=1e-6)  # float32
        assert kept[0] == pytest.approx(roughness, rel=1e-6)
    assert lobes(0.5 * least, icosahedron())[2][0] == pytest.approx(least, rel=1e-6)


def test_narrower_lobes_become_wide_and_look_the_same_from_afar():
    """F0 · D at 75 degrees from the peak, where D is α² / π sin⁴ up to α² cot²."""
    for roughness in (0.1, 0.2, 0.4):
        specular, f0, wide = lobes(roughness, lattice(60, 180))
        assert wide[0] > 0.25
        far = np.cos(np.radians(75))
        expected = specular * distribution(far, np.float32(roughness) ** 2)
        np.testing.assert_allclose(f0 * distribution(far, wide[0] ** 2), expected, rtol=0.02)
        assert (f0 <= specular).all()


def test_no_lobe_stays_none_and_shapes_stay_too():
    roughness = np.float32([[0, 0.1], [0.9, 0]])
    f0, got = seen_lobes(np.full((2, 2, 3), 0.04, np.float32), roughness, AXES)
    assert f0.shape == (2, 2, 3) and got.shape == (2, 2) and np.isfinite(f0).all()
    np.testing.assert_array_equal(got == 0, roughness == 0)
