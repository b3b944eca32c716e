"""Wrong manifests end in a sentence that names the cause, and in a low confidence; right ones in neither."""


import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from tests.reference.colour import linear_to_srgb, srgb_to_linear
from tests.scenes.captures import angles_degrees, make_scene, manifest_of, ring, write_capture, write_exr, write_lit
from tests.scenes.ellipsoid import ellipsoid, seen_from_near
from tests.scenes.parts import Part, shoot, sphere_lights

SCENE = ellipsoid()
SURE = 0.3
"""Confidence of the median pixel of a right capture under `robust`: noise and few lights leave two degrees."""
UNSURE = 0.2
"""What a wrong capture's median pixel stays below."""


def solved(tmp_path, scene, method=Method.ROBUST, intensities="chosen", **changes):
    folder = write_capture(tmp_path / "capture", scene, **changes)
    return solve(SolveRequest(capture=folder, out=tmp_path / "out", method=method, intensities=intensities, device="cpu"))


def confidence(result) -> float:
    return float(np.median(result.maps.confidence[result.maps.estimated]))


def alarms(result) -> list[str]:
    """What is said of the manifest; a hollow's walls may be too steep for a height, which is said too."""
    return [sentence for sentence in result.warnings if sentence.startswith(("frames[]", "color_space"))]


def lit_from(matrix, scene=SCENE):
    """The scene with directions that the manifest has multiplied by a matrix."""
    return scene._replace(directions=scene.directions @ np.asarray(matrix, dtype=float).T)


SCALED = SCENE.images / SCENE.images.max()
TURN = np.radians(137)


@pytest.mark.long
@pytest.mark.parametrize("method", [Method.LAMBERT, Method.ROBUST])
@pytest.mark.parametrize("scene", [SCENE, ellipsoid(count=6), ellipsoid(count=4), ellipsoid(largest_degrees=25), ellipsoid(hollow=True),
                                   ellipsoid(count=6, hollow=True), make_scene(size=48, lights=9)],
                         ids=["object", "six lights", "four lights", "frontal", "hollow", "hollow, six lights", "cap"])
def test_a_right_manifest_raises_no_alarm(tmp_path, scene, method):
    assert alarms(solved(tmp_path, scene, method)) == []


def test_a_right_manifest_keeps_its_confidence(tmp_path):
    assert confidence(solved(tmp_path, SCENE)) > SURE


@pytest.mark.long
@pytest.mark.parametrize(("matrix", "words"), [
    (np.diag([1, -1, 1]), "with y negated"),
    (np.diag([-1, 1, 1]), "with x negated"),
    (np.diag([-1, -1, 1]), "with x and y negated"),
    ([[0, 1, 0], [1, 0, 0], [0, 0, 1]], "with x and y swapped"),
    ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], "read as (y, -x, z)"),
    ([[np.cos(TURN), -np.sin(TURN), 0], [np.sin(TURN), np.cos(TURN), 0], [0, 0, 1]], "turned by -137°"),
    ([[1, 0, 0], [0, 0, 1], [0, 1, 0]], "with y and z swapped"),
    ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], "read as (y, z, x)"),
    (np.diag([1, 1, -1]), "all 16 lights are behind the object (z ≤ 0), and yet light"),
    (-np.eye(3), "every direction negated"),
], ids=["y", "x", "x and y", "x for y", "quarter turn", "turned", "y for z", "cycle", "behind", "from the light"])
def test_wrong_axes_are_named_and_doubted(tmp_path, matrix, words):
    result = solved(tmp_path, lit_from(matrix))
    assert "frames[].light.direction: " in alarms(result)[0] and words in alarms(result)[0]
    assert not result.maps.estimated.any() or confidence(result) < UNSURE


@pytest.mark.parametrize(("shift", "words"), [(0, None), (1, "one frame off")], ids=["right", "one frame off"])
def test_a_dark_background_without_a_mask_hides_no_wrong_order(tmp_path, shift, words):
    """The object takes a seventh of the image; the rest is the noise of a camera."""
    small = ellipsoid(size=48)
    scene = small._replace(directions=np.roll(small.directions, shift, 0), irradiance=np.roll(small.irradiance, shift, 0))
    wide = [(0, 0), *[(side, side) for side in scene.mask.shape], (0, 0)]
    images = np.pad(scene.images * scene.mask[..., None], wide)
    noise = np.random.default_rng(5).normal(0, 1e-3 * scene.images.max(), images.shape)
    shown = scene._replace(images=np.maximum(images + noise, 0), mask=np.ones(images.shape[1:3], bool))
    said = alarms(solved(tmp_path, shown, mask=None))
    assert said == [] if words is None else words in " ".join(said)


def test_the_standard_error_of_mirrored_normals_is_the_error_that_they_have(tmp_path):
    result = solved(tmp_path, lit_from(np.diag([1, -1, 1])))
    mask = result.maps.estimated
    error = angles_degrees(result.maps.normal[mask], SCENE.normal[mask])
    assert np.median(error / result.maps.sigma[mask]) == pytest.approx(1, abs=0.05)  # noise alone, under two degrees of forty


@pytest.mark.long
@pytest.mark.parametrize(("scene", "changes", "words"), [
    (SCENE._replace(irradiance=np.ones_like(SCENE.irradiance)), {},
     "frames[].light.irradiance: it is missing or wrong (every"),
    (SCENE._replace(images=SCENE.images / SCENE.irradiance[:, None, None, :]), {},
     "frames[].light.irradiance: the images look as if they were"),
    (SCENE._replace(images=linear_to_srgb(SCALED)), {}, "color_space: the images look display-encoded, but lin_rec709"),
    (SCENE._replace(images=srgb_to_linear(linear_to_srgb(SCALED))), {"color_space": "srgb_texture"},
     "color_space: the images look linear, but srgb_texture is"),
    (SCENE._replace(directions=SCENE.directions[::-1], irradiance=SCENE.irradiance[::-1]), {}, "frames[].light: the order looks reversed"),
    (SCENE._replace(directions=np.roll(SCENE.directions, 1, 0), irradiance=np.roll(SCENE.irradiance, 1, 0)), {},
     "frames[].light: the lights look one frame off"),
    (SCENE._replace(directions=SCENE.directions[np.random.default_rng(5).permutation(16)]), {},
     "frames[].light.direction: images and directions do not"),
], ids=["missing", "divided", "encoded", "linear", "reversed", "shifted", "shuffled"])
def test_wrong_brightness_encoding_and_order_are_named_and_doubted(tmp_path, scene, changes, words):
    result = solved(tmp_path, scene, Method.LAMBERT, intensities="declared", **changes)
    assert words in alarms(result)[0]
    assert confidence(result) < UNSURE


@pytest.mark.long
def test_wrong_brightness_that_the_solve_replaces_is_named_and_not_doubted(tmp_path):
    result = solved(tmp_path, SCENE._replace(irradiance=np.ones_like(SCENE.irradiance)), Method.LAMBERT)
    assert "every light is declared alike" in alarms(result)[0] and "the solve has used the brightness" in alarms(result)[0]
    assert confidence(result) > UNSURE
    mask = result.maps.estimated
    assert np.median(angles_degrees(result.maps.normal[mask], SCENE.normal[mask])) < 3  # the noise of the images and a highlight


def test_light_of_the_room_is_named_and_held(tmp_path):
    """Three tenths of a lamp from around, more from above, turn normals towards the middle of the lights."""
    room = 0.3 / np.pi * SCENE.albedo * (0.5 + 0.2 * SCENE.normal[..., 1:2])
    result = solved(tmp_path, SCENE._replace(images=SCENE.images + room * SCENE.irradiance.mean()), Method.LAMBERT)
    assert any(each.startswith("frames: the images look to share light") for each in result.warnings)
    mask = result.maps.estimated
    off = angles_degrees(result.maps.normal[mask], SCENE.normal[mask])
    assert np.median(off) > 5 and 0.5 < np.median(off / result.maps.sigma[mask]) < 1.2  # σ holds the turn, and little beside it


@pytest.mark.long
def test_an_outline_that_points_inwards_is_said_where_nothing_decides(tmp_path):
    """Lights near the view axis cast no shadow in a hollow, so that an object under inverted lights may be one."""
    scene = ellipsoid(largest_degrees=12)
    result = solved(tmp_path, scene._replace(directions=scene.directions * [-1, -1, 1]))
    assert "the object is hollow there, or x and y of the lights are" in alarms(result)[0]


GOLD = {"albedo": (0.0, 0.0, 0.0), "f0": (0.9, 0.7, 0.35), "roughness": 0.3}
OF_PARTS = {
    "a ring before a body": [Part((0.1, 0.1, 0.9), (0.6, 0.6, 0.6), normal=(0.3, 0.2, 0.9327), hole=0.4, **GOLD),
                             Part((0, 0, -0.1), (1, 0.9, 0.5))],
    "islands": [Part((-0.5, 0.5, 0.2), (0.35, 0.3, 0.35), **GOLD), Part((0.5, 0.45, 0), (0.3, 0.4, 0.3)),
                Part((-0.4, -0.5, 0.1), (0.4, 0.25, 0.3), albedo=(0.1, 0.1, 0.1)), Part((0.45, -0.45, 0.3), (0.3, 0.3, 0.3), **GOLD)]}
"""Objects whose Lambertian normals are poor on metal, and whose heights have false steps between parts."""


@pytest.mark.long
@pytest.mark.parametrize("parts", OF_PARTS.values(), ids=OF_PARTS)
@pytest.mark.parametrize(("matrix", "words"), [(np.eye(3), None), (np.diag([-1, -1, 1]), "the surface looks inverted"),
                                               ([[1, 0, 0], [0, 0, 1], [0, 1, 0]], "with y and z swapped")],
                         ids=["right", "turned", "exchanged"])
def test_axes_of_an_object_of_parts_with_metal(tmp_path, parts, matrix, words):
    shot = shoot(parts, sphere_lights(48, least_z=0.1), side=64, across=2.4, noise=0.01)
    result = solved(tmp_path, lit_from(matrix, shot.scene), camera=shot.camera)
    said = [sentence for sentence in alarms(result) if "direction" in sentence]
    assert said == [] if words is None else words in said[0]
    mask = result.maps.mask & shot.scene.mask
    error = angles_degrees(result.maps.normal[mask], shot.scene.normal[mask])
    assert (error > 5 * np.maximum(result.maps.sigma[mask], 1)).sum() < 0.02 * shot.scene.mask.sum()


@pytest.mark.long
def test_mirrored_axes_of_a_relief_that_fills_the_image_leave_two_choices(tmp_path):
    size, flat = 64, ring(7)
    y, x = np.mgrid[:size, :size] / size * 4
    slope_x, slope_y = 0.5 * np.cos(3 * x + y), 0.5 * np.sin(2 * y - 1) + 0.5 / 3 * np.cos(3 * x + y)
    normal = np.stack([-slope_x, slope_y, np.ones_like(x)], axis=-1)  # rows go down
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    images = np.maximum(np.einsum("rcx,lx->lrc", normal, flat), 0)[..., None] * np.ones(3)
    scene = make_scene(size=size, lights=7)._replace(normal=normal, mask=np.ones((size, size), bool), directions=flat,
                                                     irradiance=np.full((7, 3), np.pi), images=images)
    assert alarms(solved(tmp_path / "right", scene)) == []
    wrong = solved(tmp_path / "wrong", scene._replace(directions=flat * [1, -1, 1]))
    assert "with y negated, or x negated" in alarms(wrong)[0] or "with x negated, or y negated" in alarms(wrong)[0]
    assert confidence(wrong) < UNSURE


@pytest.mark.long
def test_a_perspective_camera_sees_wrong_axes_too(tmp_path):
    scene, camera = seen_from_near(size=112)
    assert alarms(solved(tmp_path / "right", scene, camera=camera)) == []
    for name, matrix, words in (("both", [-1, -1, 1], "with x and y negated"), ("behind", [1, 1, -1], "with z negated")):
        result = solved(tmp_path / name, scene._replace(directions=scene.directions * matrix), camera=camera)
        assert words in alarms(result)[0]


def test_the_axes_of_gradients_are_examined(tmp_path):
    """A convex Lambertian surface under (1 ± axis)/2 has radiance albedo/2 · (1 ± ⅔ n)."""
    for name, wrong in (("right", ""), ("wrong", "y")):
        images, lights = [], []
        for axis in "xyz":
            for sign in (1, -1):
                shade = (1 + sign * 2 / 3 * SCENE.normal[..., "xyz".index(axis)]) / 2
                images.append(SCENE.albedo * shade[..., None])
                lights.append({"type": "gradient", "axis": axis, "sign": -sign if axis == wrong else sign, "polarization": "cross"})
        write_lit(tmp_path / name, images, lights, camera=manifest_of(SCENE)["camera"], mask=SCENE.mask)
        result = solve(SolveRequest(capture=tmp_path / name, out=tmp_path / name / "out", device="cpu"))
        assert bool(alarms(result)) == bool(wrong)
    assert "frames[].light.axis and sign: " in alarms(result)[0] and "with y negated" in alarms(result)[0]
    assert confidence(result) < UNSURE


def test_a_solve_without_a_solved_pixel_says_so_and_exits_1(relit, tmp_path):
    folder = write_capture(tmp_path / "capture", make_scene(size=16, lights=6))
    for index in range(6):
        write_exr(folder / f"{index:03d}.exr", np.zeros((16, 16, 3)))
    _, report, said = relit.solve(folder, code=1)
    assert "warning  no pixel is solved: 100 % of the mask have the" in said
    assert any("no pixel is solved" in sentence for sentence in report["warnings"])
