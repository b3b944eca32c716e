"""relit shade: near lights, area lights and environments on maps with a closed form."""

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.results.maps import ALBEDO_SCALE, MAPS_FILE, SurfaceMaps
from tests.reference import microfacet
from tests.scenes.captures import files_in, rgb, write_exr
from tests.scenes.glossy import ALBEDO, PIXEL_M, dome, reflect, write_dome, write_maps

SURFACE = dome()


def text(*numbers):
    return ",".join(f"{number:.9g}" for number in np.ravel(np.concatenate([np.atleast_1d(n) for n in numbers])))


def write_relief(folder, height, **changes):
    """Write maps of matt heights over a square, whose normals look at the viewer unless they are given; returns the folder."""
    folder.mkdir()
    up = np.zeros((*height.shape, 3), np.float32)
    up[..., 2] = 1
    camera = Camera(projection="orthographic", resolution=height.shape, pixel_size_m=PIXEL_M)
    layers = {"normal": up, "diffuse_albedo": up * 0 + 0.5, "height": height, **changes}
    SurfaceMaps(camera=camera, mask=np.ones(height.shape, bool), **layers).write(folder / MAPS_FILE)
    return folder


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    return write_maps(tmp_path_factory.mktemp("shade") / "maps", SURFACE)


def test_a_point_light_is_the_model_pixel_by_pixel(relit, maps, tmp_path):
    """Tolerance: half rounding of F0, albedo and the picture, and float32."""
    place, intensity = np.array([0.01, 0.015, 0.03]), np.array([2e-3, 1e-3, 5e-4])
    outcome = relit("shade", maps, "--light", text(place, intensity), "--out", tmp_path / "p.exr", "--exposure", "1")
    assert (outcome.code, outcome.out, outcome.err) == (0, f"picture  {tmp_path}/p.exr\n", "")
    toward = place - SURFACE.places
    away = np.linalg.norm(toward, axis=-1, keepdims=True)
    wanted = 2 * reflect(SURFACE.normal, toward / away) * intensity / away**2
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[SURFACE.mask], wanted[SURFACE.mask], rtol=4e-3)
    assert (rgb(tmp_path / "p.exr")[~SURFACE.mask] == 0).all()


@pytest.mark.parametrize("light", [("--light", [10, 15, 30], [2e-3] * 3), ("--sphere", [10, 15, 30], [0.01], [5, 4, 3])])
def test_places_in_millimetres_are_named(relit, maps, tmp_path, light):
    """A thousand times as far gives a millionth of the light, which was said only where half floats have no steps for it. The light at its
    place, or with the strength for where it is, is said nothing about."""
    option, place, *rest = light
    outcome = relit("shade", maps, option, text(np.array(place), *rest), "--out", tmp_path / "p.exr", "--exposure", "20")
    assert outcome.code == 0 and "the light at (10.0, 15.0, 30.0) is " in outcome.out and "not millimetres" in outcome.out
    *size, strength = rest
    for far, factor in ((1e-3, 1), (1, 1e5)):
        near = text(np.array(place) * far, *size, np.array(strength) * factor)
        assert "warning" not in relit.done("shade", maps, option, near, "--out", tmp_path / "p.exr").out


def test_an_albedo_of_8_bits_is_named(relit, tmp_path):
    """White paint of .9 is right; as codes it made pictures 255 times too bright without a word."""
    for factor, said in ((1, False), (255, True)):
        albedo = np.full((16, 16, 3), 0.9 * factor, np.float32)
        folder = write_relief(tmp_path / str(factor), np.zeros((16, 16), np.float32), diffuse_albedo=albedo)
        told = relit.done("shade", folder, "--light", text([0, 0, 0.1], [2e-3] * 3), "--out", tmp_path / "p.exr").out
        assert ("layer diffuse_albedo is 230 in the median" in told) == said


def test_two_materials_of_a_pixel_are_their_mean(relit, tmp_path):
    """Left of the middle a share of another lobe, right of it one material. Tolerance: half rounding of two lobes and the share."""
    place, share = np.array([0.01, 0.015, 0.03]), 0.7
    mixed = np.arange(len(SURFACE.mask)) < 12
    full = np.ones((*SURFACE.mask.shape, 3), np.float32)
    lobes = {"first_specular": 0.9 * full, "first_roughness": 0.5 * full[..., 0], "second_specular": 0.05 * full,
             "second_roughness": 0.55 * full[..., 0], "abundance": share * mixed * full[..., 0]}
    maps = write_maps(tmp_path / "maps", SURFACE, **lobes)
    relit("shade", maps, "--light", text(place, [1e-3] * 3), "--out", tmp_path / "p.exr")
    toward = place - SURFACE.places
    away = np.linalg.norm(toward, axis=-1, keepdims=True)
    one = reflect(SURFACE.normal, toward / away)
    shine = microfacet.specular(SURFACE.normal, toward / away, np.array([0, 0, 1.0]), 0.5**2, 0.9)[..., None]
    matt = ALBEDO * microfacet.diffuse(SURFACE.normal, toward / away, np.array([0, 0, 1.0]))[..., None]
    wanted = np.where(mixed[:, None], share * (matt + shine) + (1 - share) * one, one) * 1e-3 / away**2
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[SURFACE.mask], wanted[SURFACE.mask], rtol=5e-3)


def test_maps_with_the_share_of_a_material_and_not_its_lobe_are_refused(relit, tmp_path):
    maps = write_maps(tmp_path / "maps", SURFACE, abundance=np.full(SURFACE.mask.shape, 0.5, np.float32))
    assert "no layer first_specular" in relit.refused("shade", maps, "--light", "0,0,1,1,1,1", "--out", tmp_path / "p.exr")


def test_lights_add_up(relit, maps, tmp_path):
    """A point with a lobe, a sphere and a rectangle together are the sum of each, to half rounding."""
    lights = [("--light", text([0.01, 0.015, 0.03], [2e-3] * 3, [0, 0, -1], 2)), ("--sphere", text([-0.03, 0.02, 0.03], 0.01, [5, 4, 3])),
              ("--rectangle", text([0, 0.02, 0.05], [0.02, 0, 0], [0, 0.01, 0], [3, 3, 3]))]
    parts = []
    for index, light in enumerate(lights):
        assert relit("shade", maps, *light, "--out", tmp_path / f"{index}.exr").code == 0
        parts.append(rgb(tmp_path / f"{index}.exr"))
    relit("shade", maps, *(word for light in lights for word in light), "--out", tmp_path / "all.exr", "--aov", "diffuse,specular,mask")
    assert all(part[SURFACE.mask].max() > 0 for part in parts)
    np.testing.assert_allclose(rgb(tmp_path / "all.exr"), sum(parts), rtol=2e-3, atol=1e-6)
    both = rgb(tmp_path / "all.exr", "diffuse.") + rgb(tmp_path / "all.exr", "specular.")
    np.testing.assert_allclose(both, rgb(tmp_path / "all.exr"), rtol=2e-3, atol=1e-6)


def test_a_wall_throws_its_shadow(relit, tmp_path):
    """A wall of 6 pixels' height on a plane under a far point light at 45° hides the 6 pixels behind it."""
    size, wall = 32, slice(14, 17)
    height = np.zeros((size, size), np.float32)
    height[:, wall] = 6 * PIXEL_M
    relit("shade", write_relief(tmp_path / "maps", height), "--light", text([-100, 0, 100], [20000] * 3), "--out", tmp_path / "p.exr")
    row = rgb(tmp_path / "p.exr")[16, :, 1]
    lit = 0.5 / np.pi * np.cos(np.pi / 4)
    np.testing.assert_allclose(row[:13], lit, rtol=3e-3)
    assert (row[18:21] == 0).all()
    np.testing.assert_allclose(row[25:], lit, rtol=3e-3)


def polygon_irradiance(places, corners):
    """Return the irradiance [rows, cols] on planes that face +z under a polygon of radiance 1 (Lambert's formula)."""
    toward = corners - places[..., None, :]
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    after = np.roll(toward, -1, axis=-2)
    normal = np.cross(toward, after)
    angle = np.arctan2(np.linalg.norm(normal, axis=-1), (toward * after).sum(axis=-1))
    return np.abs((angle * normal[..., 2] / np.linalg.norm(normal, axis=-1)).sum(axis=-1)) / 2


@pytest.mark.parametrize("distance, warned", [(8, False), (0.5, False), (0.1, True)])
def test_a_rectangle_close_to_the_surface(relit, tmp_path, distance, warned):
    """A rectangle 16 pixels wide above a plane. Tolerance: 2 % of a sum over samples half as far apart as the light is away,
    and half rounding; a light that is too close for its samples is named, with the part of the plane below it."""
    size, half = 32, 8 * PIXEL_M
    maps = write_relief(tmp_path / "maps", np.zeros((size, size), np.float32))
    rectangle = text([0, 0, distance * PIXEL_M], [2 * half, 0, 0], [0, 2 * half, 0], [1, 1, 1])
    outcome = relit.done("shade", maps, "--rectangle", rectangle, "--out", tmp_path / "p.exr")
    assert ("25.0% of the surface is within" in outcome.out) == warned == ("warning" in outcome.out)
    if warned:
        return
    across = (np.arange(size) + 0.5 - size / 2) * PIXEL_M
    places = np.stack([*np.meshgrid(across, -across), np.zeros((size, size))], axis=-1)
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]) + [0, 0, distance * PIXEL_M]
    wanted = 0.5 / np.pi * polygon_irradiance(places, corners)
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[..., 1], wanted, rtol=0.022, atol=1e-3 * wanted.max())


def test_an_even_environment_is_the_albedo(relit, tmp_path):
    """Radiance 1 from everywhere, no gloss: every pixel has its albedo; 0.5 %: 1024 samples, and shadows of 64 directions at the rim."""
    maps = write_maps(tmp_path / "maps", SURFACE, specular=None, roughness=None)
    write_exr(tmp_path / "even.exr", np.ones((16, 32, 3)))
    relit("shade", maps, "--environment", tmp_path / "even.exr", "--turn-degrees", "30", "--out", tmp_path / "p.exr")
    middle = rgb(tmp_path / "p.exr")[10:14, 10:14]
    np.testing.assert_allclose(middle, np.broadcast_to(ALBEDO, middle.shape), rtol=0.01)


@pytest.mark.parametrize("scale", [1, 2])
def test_a_far_point_light_in_the_place_of_a_captured_one_gives_its_image(relit, tmp_path, scale):
    """With --capture the sum for light from a captured light is that light's image; 1 %: the point is at a finite distance. Under an albedo
    that its solve took as twice that of the declared lights, the lamp was half as bright."""
    directions = write_dome(tmp_path / "cap", SURFACE)
    maps = write_maps(tmp_path / "maps", SURFACE, provenance={ALBEDO_SCALE: f"{scale}"})
    light = int(np.argmax(directions @ [0.3, 0.3, 0.9]))
    far = 1000.0
    relit("shade", maps, "--capture", tmp_path / "cap", "--light", text(directions[light] * far, [2 / scale * far**2] * 3), "--out",
          tmp_path / "p.exr")
    captured = rgb(tmp_path / "cap" / f"{light:03d}.exr")
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[SURFACE.mask], captured[SURFACE.mask], rtol=0.01)


def test_maps_without_a_scale_are_lit_in_pixels_and_say_so(relit, tmp_path):
    size = 6
    up = np.zeros((size, size, 3), np.float32)
    up[..., 2] = 1
    (tmp_path / "maps").mkdir()
    SurfaceMaps(camera=Camera(projection="orthographic", resolution=(size, size)), mask=np.ones((size, size), bool), normal=up,
                diffuse_albedo=up * 0 + 0.5, height=np.zeros((size, size), np.float32)).write(tmp_path / "maps" / MAPS_FILE)
    outcome = relit("shade", tmp_path / "maps", "--light", text([0.5, 0.5, 10], [100] * 3), "--out", tmp_path / "p.exr")
    assert "places of lights are taken in pixels" in outcome.out
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[2, 3], 0.5 / np.pi, rtol=1e-3)
    sky = write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3)))  # which has no place
    assert "in pixels" not in relit.done("shade", tmp_path / "maps", "--environment", sky, "--out", tmp_path / "s.exr").out


@pytest.mark.parametrize(("options", "words"), [
    ((), "there is no light"),
    (("--light", "1,2,3"), "'1,2,3' is not x,y,z,r,g,b"),
    (("--light", "0,0,1,1,-1,1"), "light is 0 or more"),
    (("--light", "0,0,1,1,1,1,0,0,0,2"), "the axis has no direction"),
    (("--light", "0,0,nan,1,1,1"), "finite"),
    (("--light", "0,0,1,1e40,1,1"), "at the most"),
    (("--sphere", "0,0,1,0,1,1,1"), "greater than 0"),
    (("--rectangle", "0,0,1,1,0,0,1,1,0,1,1,1"), "right angle"),
    (("--environment", "none.exr"), "none.exr"),
    (("--light", "0,0,1,1,1,1", "--out", "p.png"), "OpenEXR"),
    (("--light", "0,0,1,1,1,1", "--capture", "nowhere"), "nowhere"),
    (("--light", "0,0,1,1,1,1", "--aov", "velocity"), "velocity"),
    (("--light", "0,0,1,1,1,1", "--aov", "lights"), "lights is a layer of relit frames"),
])
def test_bad_shades(relit, maps, tmp_path, options, words):
    out = () if "--out" in options else ("--out", tmp_path / "p.exr")
    assert words in relit.refused("shade", maps, *options, *out)
    assert files_in(tmp_path) == set()


def test_a_light_behind_the_object_is_said_to_reach_nothing(relit, maps, tmp_path):
    outcome = relit("shade", maps, "--light", "0,0,-1,1,1,1", "--out", tmp_path / "p.exr")
    assert "every value of the frames is 0: no light that was asked for reaches what the camera sees" in outcome.well()


def test_maps_that_are_not_there(relit, tmp_path):
    assert "run `relit solve` first" in relit.refused("shade", tmp_path / "none", "--light", "0,0,1,1,1,1", "--out", tmp_path / "p.exr")


def test_captured_images_are_not_replaced(relit, maps, tmp_path):
    write_dome(tmp_path / "cap", SURFACE, lights=8)
    before = (tmp_path / "cap" / "003.exr").read_bytes()
    outcome = relit("shade", maps, "--light", "0,0,1,1,1,1", "--capture", tmp_path / "cap", "--out", tmp_path / "cap" / "003.exr")
    assert outcome.code == 2 and "is an input" in outcome.err
    assert (tmp_path / "cap" / "003.exr").read_bytes() == before


def test_a_highlight_narrower_than_a_pixel_is_the_mean_over_the_pixel(relit, tmp_path):
    """A polished dome under a near lamp: the picture is that of a camera, whose pixels are 15 × 15 places of the sphere here.

    Within 3 %, of which nine places leave 1.7; the middles of pixels alone are off by more than 15 %."""
    roughness, place, intensity = 0.25, np.array([0.004, 0.006, 0.03]), 1e-3
    bare = np.zeros((*SURFACE.mask.shape, 3), np.float32)
    maps = write_maps(tmp_path / "maps", SURFACE, diffuse_albedo=bare, specular=bare + 0.9, roughness=bare[..., 0] + roughness)
    relit("shade", maps, "--light", text(place, [intensity] * 3), "--out", tmp_path / "p.exr")
    radius = len(SURFACE.mask) / 2 / np.sin(np.radians(50.0)) * PIXEL_M
    sphere = SURFACE.places - radius * SURFACE.normal  # the centre, at each pixel
    offsets = ((np.arange(15) + 0.5) / 15 - 0.5) * PIXEL_M

    def lit(along, down):
        x, y = SURFACE.places[..., 0] + along, SURFACE.places[..., 1] - down
        off = np.stack([x - sphere[..., 0], y - sphere[..., 1]], axis=-1)
        z = np.sqrt(np.maximum(radius**2 - (off**2).sum(axis=-1), 0))
        normal = np.concatenate([off, z[..., None]], axis=-1) / radius
        toward = place - np.stack([x, y, sphere[..., 2] + z], axis=-1)
        away = np.linalg.norm(toward, axis=-1)
        return intensity / away**2 * microfacet.specular(normal, toward / away[..., None], np.array([0, 0, 1.0]), roughness**2, 0.9)

    seen = np.mean([lit(along, down) for along in offsets for down in offsets], axis=0)
    assert SURFACE.off(rgb(tmp_path / "p.exr")[..., 0], seen) < 0.03 < 0.15 < SURFACE.off(lit(0, 0), seen)


@pytest.mark.parametrize("apart", [True, False])
def test_light_passes_behind_another_part(relit, tmp_path, apart):
    """A plate 12 pixels before a wall, and a lamp that stands level with the gap: the wall beyond the plate is lit through the gap.

    Where the maps know of no parts, the plate is a block that reaches back to the wall, and its shadow is there."""
    size, plate = 32, slice(14, 18)
    height, part = np.zeros((size, size), np.float32), np.ones((size, size), np.uint8)
    height[:, plate], part[:, plate] = 12 * PIXEL_M, 2
    maps = write_relief(tmp_path / "maps", height, part=part if apart else None)
    relit("shade", maps, "--light", text([-100, 0, 15], [20000] * 3), "--out", tmp_path / "p.exr")
    row = rgb(tmp_path / "p.exr")[16, :, 1]
    assert (row[20:30] > 0).all() if apart else (row[20:30] == 0).all()


@pytest.mark.parametrize("elevation", [35.0, 45.0, 60.0])
def test_a_part_has_a_back(relit, tmp_path, elevation):
    """A ball before a wall hides the lamp where the line to it meets the ball, also where that is behind what the camera sees of it.

    The share of wrong pixels beside those of the true shadow is 6 to 30 %, all along its edge: surface must stand a pixel above a line to
    hide it, and the outline is one of whole pixels. It is a half to two thirds of what a block makes that reaches back to the wall."""
    size, radius, centre = 72, 11.0, np.array([-14.0, 3.0, 26.0])
    across = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(across, -across)
    inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
    front = np.sqrt(np.maximum(radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2, 0))
    normal = np.where(inside[..., None], np.stack([x - centre[0], y - centre[1], front], axis=-1) / radius, [0, 0, 1])
    height = np.where(inside, centre[2] + front, 0) * PIXEL_M
    toward = np.array([-np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))])
    wall = np.stack([x, y, np.zeros_like(x)], axis=-1) - centre
    hidden = np.linalg.norm(wall - (wall @ toward)[..., None] * toward, axis=-1) < radius
    wrong = []
    for part in ((1 + inside).astype(np.uint8), None):
        maps = write_relief(tmp_path / f"maps{len(wrong)}", height.astype(np.float32), normal=normal.astype(np.float32), part=part)
        (tmp_path / "p.exr").unlink(missing_ok=True)
        relit("shade", maps, "--light", text(toward * 100, [20000] * 3), "--out", tmp_path / "p.exr")
        wrong.append(((rgb(tmp_path / "p.exr")[..., 1] == 0) != hidden)[~inside].sum() / hidden[~inside].sum())
    assert wrong[0] < 0.4 and wrong[0] < 0.8 * wrong[1]
