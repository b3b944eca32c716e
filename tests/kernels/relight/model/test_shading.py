"""Shading against its float64 twin, and what follows from light being additive and space having no preferred axis."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.model import shading, sources
from tests.kernels.relight.lights import scattered
from tests.kernels.relight.surfaces import FLOAT, LOBE, facing, pack_bytes, radiance, scattered_pixels, upload
from tests.reference import shading as reference
from tests.reference.microfacet import distribution, smith_lambda


def lights(kind, seed=0):
    rng = np.random.default_rng(seed)
    if kind == "far":
        return sources.far(scattered(20, seed), rng.uniform(-0.5, 2, (20, 3)))
    if kind == "point":
        return sources.point(np.array([0.3, -0.2, 1.5]), np.array([1, 2, 3.0]))
    if kind == "narrow point":
        return sources.point(np.array([0.5, 0.4, 1.2]), np.array([3, 2, 1.0]), np.array([-0.36, -0.48, -0.8]), 7.5)
    if kind == "cosine point":
        return sources.point(np.array([0.5, 0.4, 1.2]), np.array([3, 2, 1.0]), np.array([0, 0, -1.0]), 1.0)
    if kind == "sphere":
        return sources.sphere(np.array([-0.4, 0.5, 1.8]), 0.3, np.array([1, 2, 3.0]), 50)
    return sources.rectangle(np.array([0.2, -0.6, 1.7]), np.array([0.8, 0, 0]), np.array([0, 0.5, 0]), np.array([3, 2, 1.0]), 40)


KINDS = ["far", "point", "narrow point", "cosine point", "sphere", "rectangle"]


def close(got, pixels, given, visible=None):
    """Each sample is off by the rounding of its cosines, some float32 operations, which the lobe raises to LOBE of itself at the worst; a
    light just above the horizon by FLOAT of what it would be overhead; sums by FLOAT of themselves for each sample."""
    size = reference.shade(pixels, given._replace(energy=np.abs(given.energy)), visible)
    strength = sum(reference.arrival(pixels.position.astype(float), place.astype(float), axis.astype(float))[1] * np.abs(energy).max()
                   for place, axis, energy in zip(given.place, given.axis, given.energy, strict=True))
    each = np.array([32 * FLOAT] * 3 + [LOBE] * 3)[:, None]  # 32: of cos^7.5, whose cosine is off by three or four
    bound = (each + given.count * FLOAT) * size + 8 * FLOAT * strength
    return (np.abs(got - reference.shade(pixels, given, visible)) <= bound).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 45, 64])
def test_it_is_the_twin(kind, count, device):
    pixels, given = scattered_pixels(count, seed=count), lights(kind)
    got = radiance(pixels, given, device)
    assert close(got, pixels, given)
    assert np.abs(got[:3]).max() > 0.01 and np.abs(got[3:]).max() > 0.001


def test_the_last_pack_is_filled_with_the_last_pixel(device):
    pixels = scattered_pixels(33)
    got = shading.shade(upload(pixels, device), lights("point")).numpy()
    assert got.shape[1] > 33
    np.testing.assert_array_equal(got[:, 33:], np.repeat(got[:, [32]], got.shape[1] - 33, axis=1))


def test_no_roughness_is_no_lobe(device):
    """Whatever F0; and other pixels of the pack keep theirs."""
    pixels = scattered_pixels(40)
    pixels.roughness[::3] = 0
    got = radiance(pixels, lights("far"), device)
    assert (got[3:, ::3] == 0).all() and (np.abs(got[3:]).max(axis=0)[1::3] > 0).any()
    assert close(got, pixels, lights("far"))


def test_a_lobe_is_never_narrower_than_the_least(device):
    narrow, least = (scattered_pixels(40)._replace(roughness=np.full(40, r, np.float32)) for r in (1e-3, shading.LEAST_ROUGHNESS))
    np.testing.assert_array_equal(radiance(narrow, lights("sphere"), device), radiance(least, lights("sphere"), device))


@pytest.mark.parametrize("kind", KINDS)
def test_two_materials_are_the_mean_of_their_surfaces(kind, device):
    """Shares of two surfaces that differ in their lobe alone; packs without a mixed pixel beside packs that have some."""
    count = 100
    pixels, other, given = scattered_pixels(count, seed=5), scattered_pixels(count, seed=6), lights(kind)
    share = np.where(np.arange(count) < 40, np.random.default_rng(1).uniform(0, 1, count), 0).astype(np.float32)
    share[:40:4] = 0
    second = shading.SecondLobe(other.f0, other.roughness, share)
    got = shading.shade(shading.upload_surface(*pixels, second=second, device=device), given).numpy()[:, :count]
    one, two = (reference.shade(surface, given) for surface in (pixels, pixels._replace(f0=other.f0, roughness=other.roughness)))
    size = np.abs(one) + np.abs(two)
    assert (np.abs(got - (1 - share) * one - share * two) <= 2 * LOBE * size + 64 * FLOAT * np.abs(size).max()).all()
    assert np.abs(one - two)[3:, share > 0.2].max() > 0.01
    np.testing.assert_array_equal(got[:, 64:], radiance(pixels, given, device)[:, 64:])


def test_a_mirror_direction_peaks_as_the_distribution_says(device):
    """Light, normal and viewer in one line: D = 1 / (π α²), masking 1, Fresnel F0, over 4: E F0 / (4 π α²), n·l being n·v."""
    pixels = facing(1)._replace(roughness=np.float32([0.5]), f0=np.float32([[0.04, 0.5, 1]]))
    got = radiance(pixels, sources.far(np.array([[0, 0, 1.0]]), np.array([[2, 2, 2.0]])), device)
    np.testing.assert_allclose(got[3:, 0], 2 * np.array([0.04, 0.5, 1]) / (4 * np.pi * 0.5**4), rtol=LOBE)


@pytest.mark.parametrize("roughness", [shading.LEAST_ROUGHNESS, 0.1, 0.2])
@pytest.mark.parametrize("store", [lambda normal: normal.astype(np.float16), lambda normal: normal * 1.0005], ids=["half", "long"])
def test_normals_not_quite_unit_make_no_fireflies(roughness, store, device):
    """Of normals all about the half vector none is brighter than the peak, F0 / (4 π α² h·v), but for n·l / n·v rounded in half twice."""
    light, rng = np.array([0.6, 0, 0.8]), np.random.default_rng(0)
    half = (light + [0, 0, 1]) / np.linalg.norm(light + [0, 0, 1])
    normal = half + rng.normal(0, 0.7 * roughness**2, (20_000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pixels = facing(20_000)._replace(normal=store(normal).astype(np.float32), roughness=np.full(20_000, roughness, np.float32),
                                     f0=np.full((20_000, 3), 0.04, np.float32))
    got = radiance(pixels, sources.far(light[None], np.ones((1, 3))), device)[3]
    fresnel = 0.04 + 0.96 * (1 - half[2]) ** 5
    peak = fresnel / (4 * np.pi * roughness**4 * half[2])
    assert got.max() == pytest.approx(peak, rel=0.02)


def test_normals_that_look_away_from_the_viewer_count_as_grazing(device):
    """Smith's masking and 1 / n·v of the least cosine; the rest as it is."""
    pixels = scattered_pixels(40)
    turned = np.cross(pixels.view, [0.0, 1, 0]) - 0.05 * pixels.view
    pixels = pixels._replace(normal=(turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32))
    given = sources.far(np.array([[-0.6, 0, 0.8]]), np.ones((1, 3)))
    got = radiance(pixels, given, device)[3:].T
    pixels, direction = pixels.double(), given.place[0, :3].astype(float)
    half = (direction + pixels.view) / np.linalg.norm(direction + pixels.view, axis=1, keepdims=True)
    nl, nh, hv = pixels.normal @ direction, (pixels.normal * half).sum(axis=1), (pixels.view * half).sum(axis=1)
    lit, alpha = nl > 0.1, pixels.roughness**2
    masking = 1 / (1 + smith_lambda(np.where(lit, nl, 1), alpha) + smith_lambda(shading.LEAST_FACING, alpha))
    fresnel = pixels.f0 + (1 - pixels.f0) * (1 - hv)[:, None] ** 5
    expected = (distribution(nh, alpha) * masking / (4 * shading.LEAST_FACING))[:, None] * fresnel
    assert lit.sum() > 10
    np.testing.assert_allclose(got[lit], expected[lit], rtol=2 * LOBE)


def test_behind_its_back_a_narrow_point_sends_nothing(device):
    given = sources.point(np.array([0, 0, 1.0]), np.ones(3), np.array([0, 0, 1.0]), 2.0)
    assert (radiance(scattered_pixels(40), given, device) == 0).all()


def test_light_below_the_horizon_lights_nothing(device):
    pixels = scattered_pixels(40)
    below = sources.far(-pixels.normal[:1].astype(float) + [[1e-3, 0, 0]], np.ones((1, 3)))
    assert (radiance(pixels, below, device)[:, 0] == 0).all()


@pytest.fixture
def rows():
    """[6, 45]: all seen, none seen, and mixtures."""
    rng = np.random.default_rng(8)
    values = rng.integers(0, 256, (6, 45)).astype(np.uint8)
    values[0], values[1] = 255, 0
    values[2] = np.where(rng.random(45) < 0.5, 0, 255)
    return values


def occluded(seed=0):
    rng = np.random.default_rng(seed)
    given = sources.join([lights("far"), lights("narrow point"), lights("rectangle")])
    share = rng.dirichlet(np.ones(3), given.count)
    return given._replace(occluder=rng.integers(-1, 6, (given.count, 3)).astype(np.int32), share=share.astype(np.float32))


def test_visibility_is_the_twin(rows, device):
    pixels, given = scattered_pixels(45), occluded()
    assert (given.occluder.max(axis=1) >= 0).any() and (given.occluder < 0).any()
    assert close(radiance(pixels, given, device, rows), pixels, given, rows)


def test_what_nothing_hides_needs_no_shares(rows, device):
    given = lights("far")._replace(share=np.zeros((20, 3), np.float32))
    pixels = scattered_pixels(45)
    np.testing.assert_array_equal(radiance(pixels, given, device, rows), radiance(pixels, lights("far"), device))


def test_no_light_is_black(device):
    nothing = sources.far(np.zeros((0, 3)), np.zeros((0, 3)))
    assert (radiance(scattered_pixels(3), nothing, device) == 0).all()


@pytest.mark.parametrize("change, message", [
    ({"normal": np.zeros((0, 3))}, "surface has 0 pixels"),
    ({"albedo": np.zeros((4, 1))}, r"1, 3, 3, 3, 1, 3, 1, 1, 3\] values: give \[3, 3, 3, 3, 3, 1"),
    ({"roughness": np.zeros((4, 3))}, r"\[3, 3, 3, 3, 3, 3, 3, 1, 1, 3\]"),
])
def test_bad_surfaces_are_refused(change, message, device):
    pixels = scattered_pixels(4)._replace(**change)
    if len(pixels.normal) == 0:
        pixels = reference.Pixels(*(plane[:0] for plane in pixels))
    with pytest.raises(ArrayError, match=message):
        upload(pixels, device)


def test_rows_that_are_not_there_are_refused(rows, device):
    surface, given = upload(scattered_pixels(45), device), lights("point")
    asking = given._replace(occluder=np.array([[-1, 6, -1]], np.int32))
    with pytest.raises(ArrayError, match="sources ask for row 6 of visibility, there are 6"):
        shading.shade(surface, asking, pack_bytes(rows, device))
    with pytest.raises(ArrayError, match="sources ask for row 6 of visibility, there are 0"):
        shading.shade(surface, asking)


def test_visibility_of_other_pixels_is_refused(rows, device):
    surface = upload(scattered_pixels(200), device)
    with pytest.raises(ArrayError, match=r"visibility has .* packs, the surface"):
        shading.shade(surface, lights("point"), pack_bytes(rows, device))
