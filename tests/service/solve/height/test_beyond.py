"""Light from beyond the image, of a valley of which the image shows one side alone."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from kernels.photometric.lambertian.readings import pad_lights
from service.requests.solve import Method, SolveRequest
from service.solve.height.beyond import LIKELY, MIRRORED, TURNED, light_from_beyond
from service.solve.height.interreflection import arriving_light, patches_of
from service.solve.methods.bounce_evidence import weighed
from service.solve.solve import solve
from stage.capture.camera import Camera
from stage.pixels import Crop
from tests.reference.groove import Trough
from tests.reference.sampling import lattice
from tests.scenes.captures import distant, write_lit

SIDE, DEPTH = 12, 0.4
LIGHTS = np.array([[-0.6, 0, 0.8], [0.6, 0, 0.8], [0, 0.6, 0.8]])
CAMERAS = {"perspective": Camera(projection="perspective", resolution=(SIDE, SIDE), focal_px=(SIDE, SIDE), surface_z_m=-1.0),
           "orthographic": Camera(projection="orthographic", resolution=(SIDE, SIDE), pixel_size_m=1 / SIDE)}


def seen(camera, columns, margin, profile=(np.abs, np.sign)):
    """What both functions take, of some columns of a valley along y; its other three borders are `margin` pixels within the image.
    `profile`: height and slope over the place -1…1 across it."""
    across = ((np.arange(SIDE) + 0.5) / SIDE * 2 - 1)[columns]
    height = np.tile(-1 + DEPTH * profile[0](across), (SIDE, 1)).astype(np.float32)
    slopes = np.stack([-profile[1](across), np.zeros_like(across), np.ones_like(across)]) / 2**0.5
    normal = np.repeat(slopes[:, None], SIDE, axis=1).reshape(3, -1).astype(np.float32)
    readings = np.zeros((8, normal.shape[1]), np.float16)
    readings[:len(LIGHTS)] = np.maximum(LIGHTS @ normal, 0)
    stack = SimpleNamespace(light_count=len(LIGHTS), pick=lambda pixels: (np.tile(readings[:, pixels], (3, 1, 1)), None))
    given = SimpleNamespace(camera=camera.cropped(Crop(x=columns.start, y=0, width=len(across), height=SIDE)), stack=stack, device="cpu")
    solved = np.zeros((SIDE, SIDE), bool)
    solved[margin:SIDE - margin, margin:SIDE - margin] = True
    return given, pad_lights(LIGHTS, np.ones((len(LIGHTS), 3))), normal, wp.array(height, device="cpu"), solved[:, columns]


def beyond_of(given, lights, normal, height, solved):
    patches = patches_of(given, lights, normal, height, solved)
    return light_from_beyond(patches, given.camera, LIGHTS, height, solved)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("columns", [slice(0, SIDE // 2), slice(SIDE // 2, SIDE)], ids=["left", "right"])
def test_what_arrives_from_the_side_that_is_not_seen(camera, columns):
    """A side throws nothing on itself, and what lies beyond is its mirror image under the mirrored lights. Tolerance: patches that
    are grouped, of which the largest difference is 0.3 %."""
    whole = arriving_light(*seen(camera, slice(0, SIDE), margin=1))
    half = seen(camera, columns, margin=1)
    beyond, own = beyond_of(*half), arriving_light(*half)
    wanted = whole.light[whole.numbers[:, columns][own.numbers >= 0]]
    assert beyond.shape[1:] == own.light.shape and own.light.max() < 1e-6 < 0.01 < wanted.max()
    assert not beyond[0].any() and beyond[MIRRORED] == pytest.approx(wanted, rel=5e-3)


def test_what_arrives_from_a_wall_that_goes_on_as_it_does_in_the_image():
    """The image shows the lower half of a wall and the other side of the valley below it. Behind the ridge, which the image does not show
    either, a surface that faces away throws nothing. Tolerance: as above, and .5 % of the most that arrives where the ridge hides all but a
    patch's edge."""
    ridge = (lambda x: np.where(x > 0, np.abs(x - 0.5), 1 - np.abs(x + 0.5)), lambda x: np.where(np.abs(x) < 0.5, -1.0, 1.0))
    whole = arriving_light(*seen(CAMERAS["orthographic"], slice(0, SIDE), 1, ridge))
    half = seen(CAMERAS["orthographic"], slice(SIDE // 2, SIDE), 1, ridge)
    own = arriving_light(*half)
    wanted = whole.light[whole.numbers[:, SIDE // 2:][own.numbers >= 0]] - own.light
    assert wanted.max() > 0.01 and beyond_of(*half)[TURNED] == pytest.approx(wanted, rel=5e-3, abs=5e-3 * float(wanted.max()))


def test_readings_and_shadows_tell_how_a_surface_goes_on():
    """In closed form: a way that costs a twentieth more is less likely by a factor of e, one whose light shadows lack by 3 standard errors
    more than by that of another by one of exp(4)."""
    alike = np.ones(3)
    assert weighed(LIKELY, alike, 0 * alike) == pytest.approx(LIKELY)
    assert weighed(LIKELY, np.array([1.05, 1.05, 1.0]), alike)[2] / LIKELY[2] == pytest.approx(np.e / (np.e * LIKELY[2] + 1 - LIKELY[2]))
    told = weighed(LIKELY, alike, np.array([1.0, 3.0, 3.0]))
    assert told[0] / told[1] == pytest.approx(np.exp(4) * LIKELY[0] / LIKELY[1])


@pytest.mark.long
def test_sigma_holds_light_from_beyond_the_image(tmp_path):
    """The image ends at the floor of a round valley, and most of the bounced light comes from the side that it does not show. Normals are
    5.5° off, at 12 of their standard errors without it (95th percentile). Of the three ways to go on, none is further than √3 of their root
    mean square from what is taken; the other half of the limit is for what else is wrong with a side alone."""
    side, lights = 28, lattice(48, 75.0)
    valley = Trough(side, 1.6)
    images = valley.radiance(lights, 0.8)[0].reshape(-1, side, side)[:, :, :side // 2]
    write_lit(tmp_path, images, [distant(light, 1.0) for light in lights],
              camera={"projection": "orthographic", "resolution": [side // 2, side]})
    maps = solve(SolveRequest(capture=tmp_path, out=tmp_path / "out", device="cpu", method=Method.SVBRDF)).maps
    truth = valley.normals.reshape(side, side, 3)[:, :side // 2]
    error = np.degrees(np.arccos(np.clip((maps.normal * truth).sum(axis=-1), -1, 1)))
    assert np.percentile(error / maps.sigma, 95) < 2 * 3**0.5
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["found"]["bounced_light"]["beyond_image_degrees"] > np.median(error) / 3**0.5
    assert any("goes on beyond the image" in sentence for sentence in report["warnings"])


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_nothing_is_beyond_a_surface_that_ends_within_the_image(camera):
    assert beyond_of(*seen(camera, slice(0, SIDE), margin=1)) is None


def test_a_pixel_at_the_border_is_no_surface_beyond_it(monkeypatch):
    """Patches are of 2 x 2 pixels here, and none that is half solved lies beside it."""
    monkeypatch.setattr("service.solve.height.interreflection.PATCHES", 8)
    given, lights, normal, height, solved = seen(CAMERAS["orthographic"], slice(0, SIDE), margin=3)
    solved[:5] = False
    solved[0, 0] = True
    found = beyond_of(given, lights, normal, height, solved)
    assert found is not None and not found.any()
