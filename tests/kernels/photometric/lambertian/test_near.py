"""Near lights in the kernels, against directions and falloffs in float64."""

import numpy as np
import pytest
import warp as wp

from kernels import packs
from kernels.errors import ArrayError
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.near import LEAST_LOBE, NearField, pad_places, see_near
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.model.samples import gather, host_values, to_host
from kernels.photometric.shadows.shadowing import exclude_shadows
from kernels.status import Status
from kernels.surface.shadows import Projection
from tests.kernels.scenes import GREY, angle_degrees, bits, store, unpack

RNG = np.random.default_rng(11)
PIXELS, LIGHTS = 77, 21
POINTS = RNG.uniform(-0.5, 0.5, (PIXELS, 3)) * [1, 1, 0.4]
NORMALS = RNG.normal(size=(PIXELS, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
ALBEDO = RNG.uniform(0.1, 0.9, (PIXELS, 3))
PLACE = np.concatenate([RNG.uniform(-1, 1, (LIGHTS, 3)) * [1.2, 1.2, 0.3] + [0, 0, 1], np.ones((LIGHTS, 1))], axis=1)
PLACE[::5, :3] /= np.linalg.norm(PLACE[::5, :3], axis=1, keepdims=True)
PLACE[::5, 3] = 0  # every fifth is distant
LOBE = np.zeros((LIGHTS, 4))
LOBE[1::3, :3] = -PLACE[1::3, :3] / np.linalg.norm(PLACE[1::3, :3], axis=1, keepdims=True)
LOBE[1::3, 3] = 3
LOBE[PLACE[:, 3] == 0] = 0
STRENGTH = RNG.uniform(0.5, 2, (LIGHTS, 3))


def truth() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions [light, pixel, 3], falloff [light, pixel] and radiance [3, light, pixel], float64."""
    way = PLACE[:, None, :3] - PLACE[:, None, 3:] * POINTS
    length = np.linalg.norm(way, axis=-1)
    direction = way / length[..., None]
    cosine = np.maximum(-(direction * LOBE[:, None, :3]).sum(axis=-1), 0)
    falloff = np.where(PLACE[:, 3:] == 1, cosine ** LOBE[:, 3:] / length**2, 1)
    shading = np.maximum((direction * NORMALS).sum(axis=-1), 0) * falloff
    return direction, falloff, np.moveaxis(ALBEDO / np.pi * STRENGTH[:, None] * shading[..., None], -1, 0)


def field() -> NearField:
    return NearField(pad_places(PLACE, LOBE), POINTS.T.astype(np.float32))


def lights():
    return pad_lights(np.tile([0.0, 0.0, 1.0], (LIGHTS, 1)), STRENGTH)


def test_directions_falloff_and_readings(device):
    direction, falloff, radiance = truth()
    band = packs.upload(store(radiance), device=device)
    readings = grey_readings(band, grey_factors(lights(), GREY))
    near = see_near(band, readings, field())
    for c in range(3):
        row = readings._replace(values=near.toward[c])
        np.testing.assert_allclose(unpack(row, band)[:LIGHTS, :PIXELS], direction[..., c], atol=1e-6)  # float32
    np.testing.assert_allclose(unpack(readings._replace(values=near.falloff), band)[:LIGHTS, :PIXELS], falloff, rtol=1e-5)
    expected = ALBEDO @ GREY / np.pi * np.maximum((direction * NORMALS).sum(axis=-1), 0)
    np.testing.assert_allclose(unpack(readings, band)[:LIGHTS, :PIXELS], expected, rtol=1e-3, atol=1e-6)  # half rounding
    assert np.isfinite(unpack(readings, band)).all()


@pytest.mark.parametrize("solver", [solve_lambert, solve_robust])
def test_normals_and_albedo_at_known_points(solver, device):
    radiance = truth()[2]
    band = packs.upload(store(radiance), device=device)
    readings = grey_readings(band, grey_factors(lights(), GREY))
    near = see_near(band, readings, field())
    fit = solver(band, readings, lights().direction, near)
    albedo = fit_albedo(band, readings, fit, lights(), near).albedo
    assert (fit.status.numpy()[:PIXELS] == Status.OK).all()
    assert angle_degrees(fit.normal.numpy()[:, :PIXELS].T, NORMALS).max() < 0.1  # half rounding of eight readings or more
    np.testing.assert_allclose(albedo.numpy()[:, :PIXELS].T, ALBEDO, rtol=2e-3)


def test_samples_are_the_same_readings(device):
    direction, falloff, radiance = truth()
    saturated = RNG.random((LIGHTS, PIXELS)) < 0.1
    band = packs.upload(store(radiance), bits(saturated), device=device)
    chosen = RNG.permutation(PIXELS)[:41].astype(np.int32)
    view = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(chosen), 1))
    samples = gather(band, chosen, view, lights(), grey_factors(lights(), GREY), LIGHTS, field().at(chosen))
    for c in range(3):
        np.testing.assert_allclose(host_values(samples, samples.toward[c]).T, direction[:, chosen, c], atol=1e-6)
        expected = radiance[c][:, chosen] / STRENGTH[:, c : c + 1] / falloff[:, chosen]
        given = ~saturated[:, chosen]
        colour = host_values(samples, samples.colour[c]).T
        np.testing.assert_allclose(colour[given], expected[given], rtol=1e-3, atol=1e-6)
        assert (colour[~given] == -1).all()
    level = to_host(samples, samples.level)
    assert np.isfinite(level).all() and (level > 0).all()


def test_a_lamp_that_hardly_shines_gives_no_reading(device):
    """Its reading would be noise, raised by the falloff that it is divided by."""
    place = np.array([[0.0, 0.0, 1.0, 1.0]] * 3)
    limit = LEAST_LOBE ** (1 / 2)  # the cosine at which μ = 2 is cut
    angles = np.arccos([limit + 0.01, limit - 0.01, -0.5])
    lobe = np.stack([np.sin(angles), 0 * angles, -np.cos(angles), 0 * angles + 2], axis=1)
    band = packs.upload(store(np.ones((3, 3, 1))), device=device)
    lamps = pad_lights(np.tile([0.0, 0.0, 1.0], (3, 1)), np.ones((3, 3)))
    readings = grey_readings(band, grey_factors(lamps, GREY))
    near = see_near(band, readings, NearField(pad_places(place, lobe), np.zeros((3, 1), np.float32)))
    values = unpack(readings, band)[:3, 0]
    assert values[0] == pytest.approx(1 / (limit + 0.01) ** 2, rel=1e-3) and (values[1:] == 0).all()
    assert (unpack(readings._replace(values=near.falloff), band)[1:3, 0] == 0).all()
    samples = gather(band, np.zeros(1, np.int32), np.array([[0, 0, 1]], np.float32), lamps, grey_factors(lamps, GREY), 3,
                     NearField(pad_places(place, lobe), np.zeros((3, 1), np.float32)))
    grey = samples.grey.numpy().reshape(3, -1)[:, 0]  # one pack, either way round
    assert grey[0] > 0 and (grey[1:] == -1).all()


def test_what_stands_behind_a_lamp_does_not_hide_it(device):
    """A wall eight pixels away: it hides a distant light and a lamp beyond it, and not a lamp before it."""
    height = np.zeros((3, 24), dtype=np.float32)
    height[:, 10:12] = 5
    place = np.array([[1, 0, 0.2, 0], [18 - 12.0, 0, 3.2, 1], [6 - 12.0, 0, 0.8, 1]])
    place[0, :3] /= np.linalg.norm(place[0, :3])
    band = packs.upload(store(np.ones((3, 3, 1))), device=device)
    lamps = pad_lights(np.tile([0.0, 0.0, 1.0], (3, 1)), np.ones((3, 3)))
    points = np.array([[2.5 - 12], [0], [0]], dtype=np.float32)  # of row 1, column 2
    places = pad_places(place, np.zeros((3, 4)))
    samples = gather(band, np.zeros(1, np.int32), np.array([[0, 0, 1]], np.float32), lamps, grey_factors(lamps, GREY), 3,
                     NearField(places, points))
    camera = Projection(False, wp.vec2(1.0, 1.0), wp.vec2(12.0, 1.5))
    exclude_shadows(samples, np.array([24 + 2]), wp.array(height, dtype=float, device=device),
                    wp.array(np.ones((3, 24), np.uint8), device=device), camera, places)
    first = samples.grey.numpy().reshape(3, -1)[:, 0]
    assert (first[:2] == -1).all() and first[2] > 0


def test_what_does_not_fit_is_refused():
    with pytest.raises(ArrayError, match="one row of four per light"):
        pad_places(PLACE[:, :3], LOBE)
    with pytest.raises(ArrayError, match="finite"):
        pad_places(PLACE * np.nan, LOBE)
    with pytest.raises(ArrayError, match="ends in 1 for a point light"):
        pad_places(PLACE * 2, LOBE)
    band = packs.upload(store(truth()[2]), device="cpu")
    readings = grey_readings(band, grey_factors(lights(), GREY))
    with pytest.raises(ArrayError, match=r"\(3, 76\) points, the band has 24 lights and 77 pixels"):
        see_near(band, readings, NearField(field().places, field().points[:, 1:]))
    with pytest.raises(ArrayError, match="points are"):
        gather(band, np.arange(4), np.zeros((4, 3), np.float32), lights(), grey_factors(lights(), GREY), LIGHTS, field())
