"""A map's samples: its energy, its directions by the contract, and that they light a surface as the map does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels.relight.model import sources
from kernels.relight.weights.environment_sources import BROAD_SAMPLES, MOST_SMALL, SAMPLES, sample_environment, split_environment
from tests.kernels.relight.lights import SUM, sun
from tests.kernels.relight.surfaces import facing, radiance
from tests.kernels.scenes import angle_degrees
from tests.reference.relight import texel_directions, texel_solid_angles
from tests.reference.sampling import lattice


def noise(rows, cols, seed=0):
    """A few bright texels among dim ones, coloured."""
    return np.random.default_rng(seed).gamma(0.1, 1.0, (rows, cols, 3))


def whole(environment):
    """[3] ∫ L dω by the contract's solid angles."""
    return (environment * texel_solid_angles(*environment.shape[:2])[..., None]).sum(axis=(0, 1))


@settings(max_examples=25, deadline=None)
@given(rows=st.integers(1, 40), cols=st.integers(1, 70), count=st.integers(2, 300), seed=st.integers(0, 99))
def test_samples_have_the_energy_of_the_map(rows, cols, count, seed):
    environment = noise(rows, cols, seed)
    got = sample_environment(environment, count)
    assert len(got.energy) == len(got.direction) == len(got.radius) <= count
    np.testing.assert_allclose(got.energy.sum(axis=0), whole(environment), rtol=SUM)
    assert got.energy.min() >= 0 and (got.energy.sum(axis=1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(got.direction, axis=1), 1, rtol=SUM)


def test_half_maps_sum_in_double():
    environment = noise(64, 128).astype(np.float16)
    np.testing.assert_allclose(sample_environment(environment).energy.sum(axis=0), whole(environment.astype(float)), rtol=SUM)


@pytest.mark.parametrize("count", [1, 7, 100, SAMPLES])
def test_as_many_as_asked_for(count):
    assert len(sample_environment(noise(64, 128) + 0.01, count).energy) == count


def test_no_more_than_there_are_texels():
    """Each is a sample then, where it is."""
    environment = noise(6, 12) + 0.01
    got = sample_environment(environment)
    assert len(got.energy) == 72
    directions = texel_directions(6, 12).reshape(-1, 3)
    order = np.argmax(got.direction @ directions.T, axis=1)
    assert sorted(order) == list(range(72))
    np.testing.assert_allclose(got.direction, directions[order], atol=SUM)
    np.testing.assert_allclose(got.energy, (environment * texel_solid_angles(6, 12)[..., None]).reshape(-1, 3)[order], rtol=SUM)


@pytest.mark.parametrize("count", [2, 100, SAMPLES])
def test_a_black_map_has_no_samples(count):
    got = sample_environment(np.zeros((16, 32, 3)), count)
    assert got.direction.shape == got.energy.shape == (0, 3) and got.radius.shape == (0,)


@pytest.mark.parametrize("row, col", [(0, 0), (15, 31), (7, 20), (8, 0), (3, 16)])
@pytest.mark.parametrize("count", [2, 9, SAMPLES])
def test_a_sun_of_one_texel_is_one_sample(row, col, count):
    got = sample_environment(sun(16, 32, row, col, 1e4), count)
    assert len(got.energy) == 1
    np.testing.assert_allclose(got.energy[0], 1e4 * texel_solid_angles(16, 32)[row, col], rtol=SUM)
    np.testing.assert_allclose(got.direction[0], texel_directions(16, 32)[row, col], atol=SUM)


def test_a_sun_in_a_sky_is_cut_out_of_it():
    """Most of the energy, of the size of its texel."""
    environment = np.ones((64, 128, 3)) + sun(64, 128, 20, 50, 1e5)
    got = sample_environment(environment, 200)
    brightest = got.energy.sum(axis=1).argmax()
    np.testing.assert_allclose(got.energy[brightest], (1e5 + 1) * texel_solid_angles(64, 128)[20, 50], rtol=SUM)
    assert angle_degrees(got.direction[brightest], texel_directions(64, 128)[20, 50]) < 1e-6
    assert got.radius[brightest] == pytest.approx(np.pi / 128)
    assert got.radius.max() < np.radians(15)  # and the sky is not left in one piece: 15 degrees of 200 boxes of 14 on average


def test_what_is_dim_is_cut_too():
    """A half of a millionth of the other's radiance counts as 1/8 of all to the other's 9/8. Cuts even out that density times the fourth
    power of the side: sides are 9^¼ apart and numbers as 1 to 3, 50 of 200; boxes are halved, so that either may be off by a good part."""
    environment = np.ones((64, 128, 3))
    environment[:, :64] = 1e-6
    got = sample_environment(environment, 200)
    dim = got.energy[:, 0] < 1e-5
    assert 35 < dim.sum() < 65 and got.radius[dim].max() < np.radians(18)
    assert got.radius[~dim].max() < np.radians(12)


@pytest.mark.parametrize("row, col, direction", [
    (0, slice(None), (0, 1, 0)), (179, slice(None), (0, -1, 0)), (slice(89, 91), slice(179, 181), (0, 0, 1)),
    (slice(89, 91), slice(89, 91), (1, 0, 0)), (slice(89, 91), slice(269, 271), (-1, 0, 0)), (slice(89, 91), 0, (0, 0, -1)),
], ids=["top", "bottom", "centre", "quarter", "three quarters", "left edge"])
def test_directions_are_those_of_the_contract(row, col, direction):
    """+y up and the top row, the centre +z, a quarter from the left +x: to half a texel, half a degree, where one side has it."""
    environment = np.zeros((180, 360, 3))
    environment[row, col] = 1
    got = sample_environment(environment, 4000)
    assert len(got.energy) > 1
    mean = (got.direction * got.energy).sum(axis=0)
    assert angle_degrees(mean / np.linalg.norm(mean), np.array(direction, dtype=float)) < 0.75


@pytest.mark.parametrize("rows", [64, 180])
def test_a_white_map_lights_a_matt_pixel_by_its_albedo(rows, device):
    """π of irradiance. Tolerance: a box 0.11 radians wide is put at one direction, whose cosine is 1 / (1 - 0.11² / 12) of its mean: 0.1 %;
    the solid angles of the contract are too large by (π / rows)² / 24; and boxes that the horizon cuts are taken for one side's."""
    got = sample_environment(np.ones((rows, 2 * rows, 3)))
    given = sources.far(got.direction, got.energy)
    for normal in lattice(12, 180):
        lit = radiance(facing(1, normal=normal, albedo=0.6), given, device)[:3, 0]
        np.testing.assert_allclose(lit, 0.6, rtol=1.5e-3)


def test_samples_light_a_pixel_as_the_map_does(device):
    """Of every colour and any orientation. Tolerance: the three colours of a box share one direction, some 0.03 radians from that of each,
    and errors of so uneven a map's few hundred bright boxes add up as their root: 0.03 / √100, 0.3 %; twice that."""
    environment = noise(48, 96)
    got = sample_environment(environment)
    given = sources.far(got.direction, got.energy)
    directions, amount = texel_directions(48, 96).reshape(-1, 3), (environment * texel_solid_angles(48, 96)[..., None]).reshape(-1, 3)
    for normal in lattice(12, 180):
        lit = radiance(facing(1, normal=normal), given, device)[:3, 0]
        np.testing.assert_allclose(lit, np.maximum(directions @ normal, 0) @ amount / np.pi, rtol=6e-3)


def test_small_bright_places_and_the_rest_are_the_whole_map():
    environment = np.ones((64, 128, 3)) + sun(64, 128, 20, 50, 1e4) + sun(64, 128, 40, 90, 5e3)
    small, broad = split_environment(environment, np.radians(2))
    np.testing.assert_allclose(small.energy.sum(axis=0) + broad.energy.sum(axis=0), whole(environment), rtol=SUM)
    assert len(small.energy) >= 2 and small.radius.max() < np.radians(2)
    for row, col in ((20, 50), (40, 90)):
        assert angle_degrees(small.direction, texel_directions(64, 128)[row, col]).min() < 1e-5
        rest = angle_degrees(broad.direction, texel_directions(64, 128)[row, col]) < 1
        assert broad.energy[rest].sum() < 0.01 * small.energy.sum()


def test_of_very_many_small_places_the_brightest_stay_apart():
    """A window of 45° by 45°, with most of the energy and so of the samples."""
    environment = np.full((128, 256, 3), 0.01)
    environment[40:72, 100:132] = 10 + noise(32, 32)
    small, broad = split_environment(environment, np.radians(2))
    every = sample_environment(environment)
    assert (every.radius < np.radians(2)).sum() > MOST_SMALL == len(small.energy)
    np.testing.assert_allclose(np.sort(small.energy.sum(axis=1)),
                               np.sort(every.energy[every.radius < np.radians(2)].sum(axis=1))[-MOST_SMALL:], rtol=SUM)
    np.testing.assert_allclose(small.energy.sum(axis=0) + broad.energy.sum(axis=0), whole(environment), rtol=SUM)


def test_a_sky_without_a_sun_is_all_broad():
    small, broad = split_environment(np.ones((64, 128, 3)), np.radians(2))
    assert len(small.energy) == 0 and len(broad.energy) == BROAD_SAMPLES
