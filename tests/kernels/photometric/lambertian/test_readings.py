import numpy as np
import pytest

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from tests.kernels.scenes import GREY, bits, colours, store, unpack
from tests.reference import photometric as reference
from tests.reference.sampling import lattice

PIXEL_COUNTS = [1, 31, 33, 4097]
"""One pixel; one below and one above the CPU pack of 32; one above many packs."""
FLOAT32 = 2.0**-23 * 4
"""Relative: three products and two sums in float32."""


def read(radiance, irradiance, device, saturated=None):
    lights = pad_lights(lattice(len(irradiance), 70), irradiance)
    band = packs.upload(store(radiance), None if saturated is None else bits(saturated), device=device)
    return unpack(grey_readings(band, grey_factors(lights, GREY)), band), band


@pytest.mark.parametrize("pixels", PIXEL_COUNTS)
def test_readings_are_those_of_the_twin(pixels, device):
    rng = np.random.default_rng(pixels)
    radiance = rng.normal(0.5, 0.5, (3, 11, pixels)).astype(np.float16)
    saturated = rng.random((11, pixels)) < 0.2
    irradiance = 3 * colours(11)
    got, _ = read(radiance, irradiance, device, saturated)
    expected = reference.grey_readings(radiance.astype(float), irradiance, GREY, saturated)
    np.testing.assert_allclose(got[:11, :pixels], expected, rtol=FLOAT32, atol=FLOAT32)
    assert (got[11:] == 0).all() and (got[:, pixels:] == 0).all()  # padding reads nothing


def test_what_is_no_measurement_reads_zero(device):
    radiance = np.ones((3, 8, 1))
    radiance[:, 0] = -1
    radiance[:, 1] = np.nan
    radiance[1, 2] = np.nan  # one channel is enough
    radiance[:, 3] = np.inf
    radiance[:, 4] = -np.inf
    radiance[0, 5], radiance[1, 5] = np.inf, -np.inf
    got, _ = read(radiance, np.ones((8, 3)), device)
    np.testing.assert_array_equal(got[:, 0] > 0, [False] * 6 + [True] * 2)
    assert np.isfinite(got).all()


def test_every_light_reads_the_same_grey_whatever_its_colour_and_scale(device):
    irradiance, scale = 5 * colours(9), 2.0 ** np.arange(-4, 5)
    lights = pad_lights(lattice(9, 70), irradiance, scale)
    stored = irradiance.T[:, :, None] / scale[None, :, None]  # a white surface that faces every light
    band = packs.upload(store(stored), device=device)
    got = unpack(grey_readings(band, grey_factors(lights, GREY)), band)[:9, 0]
    np.testing.assert_allclose(got, 1, rtol=2.0**-11 + FLOAT32)  # half rounding


def test_only_channels_that_every_light_has_are_read():
    irradiance = np.array([[1, 2, 0], [2, 4, 1]], dtype=np.float32)
    factors = grey_factors(pad_lights(lattice(2, 40), irradiance), GREY)
    np.testing.assert_allclose((factors[:2, :2] * irradiance[:, :2]).sum(axis=1), 1, rtol=FLOAT32)
    assert (factors[:, 2] == 0).all() and (factors[2:] == 0).all()


def test_no_common_channel_is_refused():
    with pytest.raises(ArrayError, match="no channel is lit by every light"):
        grey_factors(pad_lights(lattice(3, 40), np.eye(3)), GREY)


def test_scale_may_be_padded_already():
    assert pad_lights(lattice(3, 40), np.ones((3, 3)), [1, 2, 4, 0, 0, 0, 0, 0]).scale.tolist() == [1, 2, 4, 0, 0, 0, 0, 0]
    assert pad_lights(lattice(3, 40), np.ones((3, 3)), [1, 2, 4]).scale.tolist() == [1, 2, 4, 0, 0, 0, 0, 0]


UP = [[0.0, 0.0, 1.0]] * 2
WHITE = [[1.0, 1.0, 1.0]] * 2


@pytest.mark.parametrize("direction, irradiance, scale, message", [
    (UP, WHITE[:1], None, r"direction is \(2, 3\), irradiance \(1, 3\): give one row of"),
    (np.zeros((0, 3)), np.zeros((0, 3)), None, r"direction is \(0, 3\)"),
    ([[0, 1.0]], [[1.0, 1.0]], None, r"direction is \(1, 2\)"),
    ([UP[0], [0, 0, 1.01]], WHITE, None, "direction of light 1 is not a unit vector"),
    ([UP[0], [0, 0, np.nan]], WHITE, None, "direction of light 1 is not a unit vector"),
    (UP, [[1, 1, 1], [0, 0, 0]], None, "irradiance must be finite, not negative, and above 0"),
    (UP, [[1, 1, 1], [1, -1, 1]], None, "irradiance must be finite, not negative"),
    (UP, [[1, 1, 1], [1, np.nan, 1]], None, "irradiance must be finite"),
    (UP, WHITE, [1.0], r"scale is \(1,\) for 2 lights: give one per light, or per"),
    (UP, WHITE, [1.0, np.nan], "scale must be finite and not negative"),
    (UP, WHITE, [1.0, -1.0], "scale must be finite and not negative"),
])
def test_bad_lights_are_refused(direction, irradiance, scale, message):
    with pytest.raises(ArrayError, match=message):
        pad_lights(direction, irradiance, scale)


def test_a_band_of_another_capture_is_refused(device):
    band = packs.upload(np.zeros((3, 16, 4), dtype=np.float16), device=device)
    with pytest.raises(ArrayError, match=r"factors are \(8, 3\), the band has 16 lights"):
        grey_readings(band, np.zeros((8, 3), dtype=np.float32))
    grey = packs.upload(np.zeros((1, 8, 4), dtype=np.float16), device=device)
    with pytest.raises(ArrayError, match="the band has 1 channels, expected 3"):
        grey_readings(grey, np.zeros((8, 3), dtype=np.float32))
