"""relit solve under near lights: from images on disk to height, against heights in closed form."""


import numpy as np
import pytest

from stage.formats import exr
from tests.scenes import bowl, near_lights
from tests.scenes.captures import angles_degrees, edit_manifest, write_exr
from tests.scenes.near_lights import Lamp, far, lamps

RADII = 1.3
"""Of the sphere about whose centre the lamps stand: 0.3 radii above the surface that they light."""
ORTHOGRAPHIC, PERSPECTIVE = near_lights.dome(), near_lights.dome(perspective=True)
SMALL, SMALL_PERSPECTIVE = near_lights.dome(32), near_lights.dome(32, perspective=True)
"""The same with less than half the pixels, for the solver that works hard on each."""
DOMES = pytest.mark.parametrize("dome", [ORTHOGRAPHIC, PERSPECTIVE], ids=["orthographic", "perspective"])


def solve(relit, folder, method, *options, device="cpu", code=0):
    return relit.solve(folder, "--method", method, "--device", device, *options, code=code)


def height_error(maps, dome) -> np.ndarray:
    """Of the solved pixels, as a part of the relief."""
    return np.abs(maps.height - dome.points[..., 2])[maps.mask] / dome.relief


def assert_solved(maps, dome, *, angle: float, albedo: float):
    assert np.array_equal(maps.mask, dome.mask)
    assert height_error(maps, dome).max() < 0.002  # promised is 0.01; half rounding, SETTLED, chords across ripples: 0.0005
    assert angles_degrees(maps.normal, dome.normal)[dome.mask].max() < angle
    assert (np.abs(maps.diffuse_albedo / dome.albedo - 1)[dome.mask] < albedo).all()


@pytest.mark.long
@pytest.mark.parametrize(("dome", "method"), [(ORTHOGRAPHIC, "robust"), (PERSPECTIVE, "lambert")], ids=["orthographic", "perspective"])
def test_height_at_1_3_radii_where_distant_lights_make_a_bowl(relit, tmp_path, dome, method):
    """The promise: within 1 % of the relief, where the same images taken as distant light are off by more than 10 %."""
    lights = lamps(dome, 32, RADII)
    near_lights.write(tmp_path / "near", dome, lights, cast_steps=60)
    maps, report, _ = solve(relit, tmp_path / "near", method)
    assert_solved(maps, dome, angle=0.06, albedo=0.003)  # half rounding of three to ten readings, and the part not yet settled
    near = report["found"]["near"]
    assert near["settled"] and near["rounds"][method] <= 8 and near["last_change_of_relief"] < 1e-3
    near_lights.write(tmp_path / "far", dome, lights, told=[far(lamp, dome) for lamp in lights], cast_steps=60)
    maps, report, _ = solve(relit, tmp_path / "far", method, code=1)  # contradicted by the images: no pixel counts as solved
    assert "near" not in report["found"]
    assert not maps.mask.any() or np.sqrt((height_error(maps, dome) ** 2).mean()) > 0.1  # left open where it is a bowl


@pytest.mark.long
@pytest.mark.parametrize("dome", [SMALL, SMALL_PERSPECTIVE], ids=["orthographic", "perspective"])
def test_the_general_solver(relit, tmp_path, dome):
    near_lights.write(tmp_path, dome, lamps(dome, 48, RADII))
    maps, report, _ = solve(relit, tmp_path, "svbrdf")
    assert_solved(maps, dome, angle=0.1, albedo=0.02)  # the last ring is 0.2 degrees; a lobe takes a little albedo
    assert report["found"]["near"]["rounds"]["svbrdf"] <= 2


@pytest.mark.long
def test_cast_shadows_end_at_the_lamp(relit, tmp_path):
    """The general solver leaves out what the height hides from a lamp, and no more."""
    near_lights.write(tmp_path, SMALL, lamps(SMALL, 48, RADII, widest=85), cast_steps=200)
    maps, *_ = solve(relit, tmp_path, "svbrdf")
    assert height_error(maps, SMALL).max() < 0.005
    angle = angles_degrees(maps.normal, SMALL.normal)[maps.mask]
    assert angle.mean() < 0.05 and angle.max() < 2  # the rim of a shadow, within its margin of 0.3 pixels


@pytest.mark.long
def test_a_white_bowl_is_neither_flatter_nor_brighter_than_it_is(relit, tmp_path):
    """Bounced light adds a third to the readings: left in, the albedo is 1.07 for 0.8; taken off once, with that albedo, 0.68."""
    scene = bowl.bowl(20)
    maps, report, _ = solve(relit, bowl.write_near(tmp_path, scene, 32, RADII), "svbrdf")
    error = np.abs(maps.height - scene.points[..., 2])[scene.mask] / np.ptp(scene.points[..., 2][scene.mask])
    assert angles_degrees(maps.normal, scene.normal)[scene.mask].mean() < 0.1  # 0.2 with one search
    assert error.max() < 0.005  # some hundred patches, in the rounds that are left after the surface has changed by a thousandth
    assert np.allclose(np.median(maps.diffuse_albedo[scene.mask], axis=0), bowl.ALBEDO, rtol=0.02)
    assert report["found"]["near"]["rounds"]["svbrdf"] > 1


@pytest.mark.long
def test_a_white_bowl_without_bounced_light_is_as_it_is(relit, tmp_path):
    """Images of direct light alone, of lamps far enough that the rim shades the bowl; with the bounce that they lack taken out, normals are
    5.4° off in the mean, and the albedo is 0.62."""
    scene = bowl.bowl(20)
    maps, report, _ = solve(relit, bowl.write_near(tmp_path, scene, 32, 3.0, bounced=False), "svbrdf")
    assert report["found"]["bounced_light"] == {"shown": 0.0, "taken_out": False}
    assert angles_degrees(maps.normal, scene.normal)[scene.mask].mean() < 0.4  # 0.26: faint gloss instead of a little slope
    assert np.allclose(np.median(maps.diffuse_albedo[scene.mask], axis=0), bowl.ALBEDO, rtol=0.02)


@pytest.mark.long
@pytest.mark.parametrize("exponent", [1.0, 4.0])
def test_lamps_that_shine_forward(relit, tmp_path, exponent):
    """Anisotropy: lamps aimed beside the centre; taken as the same all round, the height is wrong."""
    lights = lamps(ORTHOGRAPHIC, 32, RADII, exponent=exponent)
    maps, *_ = solve(relit, near_lights.write(tmp_path / "aimed", ORTHOGRAPHIC, lights), "lambert")
    assert_solved(maps, ORTHOGRAPHIC, angle=0.15, albedo=0.004)  # half rounding where three lamps at grazing angles are left
    round_about = [lamp._replace(axis=None, exponent=0.0) for lamp in lights]
    folder = near_lights.write(tmp_path / "round", ORTHOGRAPHIC, lights, told=round_about)
    maps, *_ = solve(relit, folder, "lambert", code=int(exponent > 1))
    assert height_error(maps, ORTHOGRAPHIC).max() > 0.02


@pytest.mark.long
@DOMES
def test_near_and_distant_lights_together(relit, tmp_path, dome):
    lights = [far(lamp, dome) if index % 2 else lamp for index, lamp in enumerate(lamps(dome, 32, RADII))]
    maps, *_ = solve(relit, near_lights.write(tmp_path, dome, lights), "lambert")
    assert_solved(maps, dome, angle=0.05, albedo=0.003)


@pytest.mark.long
@pytest.mark.parametrize("method", ["lambert", "robust", "svbrdf"])
def test_lamps_at_a_thousand_radii_are_distant_lights(relit, tmp_path, method):
    """Their directions over the object differ by 0.06 degrees and their irradiance by 0.2 %."""
    lights = lamps(SMALL, 24, 1000.0)
    maps, report, _ = solve(relit, near_lights.write(tmp_path / "near", SMALL, lights), method)
    assert report["found"]["near"]["settled"] and max(report["found"]["near"]["rounds"].values()) <= 2
    told = [far(lamp, SMALL) for lamp in lights]
    distant, *_ = solve(relit, near_lights.write(tmp_path / "far", SMALL, told), method)
    assert np.array_equal(maps.mask, distant.mask)
    assert angles_degrees(maps.normal, distant.normal)[maps.mask].max() < 0.1  # two searches of 0.2 degrees; half rounding 0.02
    assert np.abs(maps.height - distant.height)[maps.mask].max() < 1e-3 * SMALL.relief
    assert np.allclose(maps.diffuse_albedo[maps.mask], distant.diffuse_albedo[maps.mask], rtol=0.01)


@pytest.mark.long
def test_every_device_and_a_rim_that_few_lamps_reach(relit, tmp_path, device):
    """Pixels without three lamps stay unsolved, and do not pull the others away."""
    lights = lamps(ORTHOGRAPHIC, 9, RADII, widest=45)
    maps, report, _ = solve(relit, near_lights.write(tmp_path, ORTHOGRAPHIC, lights), "lambert", device=device)
    lit = sum(near_lights.render(ORTHOGRAPHIC, lamp)[..., 1] > 0 for lamp in lights) * ORTHOGRAPHIC.mask
    assert 0 < report["pixels"]["shadowed"] == ((lit < 3) & (lit > 0)).sum()
    assert abs(height_error(maps, ORTHOGRAPHIC)).mean() < 0.02  # the depth of the unlit rim, a ninth of the mask, is guessed


def test_info_says_how_far_the_lamps_are(relit, tmp_path):
    near_lights.write(tmp_path, PERSPECTIVE, lamps(PERSPECTIVE, 6, 2.0))
    outcome = relit("info", tmp_path)
    assert outcome.code == 0 and "6 point light" in outcome.out
    centre = PERSPECTIVE.points[PERSPECTIVE.mask].mean(axis=0)
    distance = [np.linalg.norm(lamp.position - centre) for lamp in lamps(PERSPECTIVE, 6, 2.0)]
    assert f"6, {min(distance):.2g}" in outcome.out


def test_a_camera_without_scale_is_refused_in_one_sentence(relit, tmp_path):
    near_lights.write(tmp_path, PERSPECTIVE, lamps(PERSPECTIVE, 6, RADII))
    edit_manifest(tmp_path, camera=lambda camera: {key: value for key, value in camera.items() if key != "surface_z_m"})
    outcome = relit("basis", tmp_path, "--out", tmp_path / "out.ptm")
    assert outcome.code == 2
    words = "camera.surface_z_m: is missing: near lights need the place"
    assert outcome.err.count(words) == 1
    outcome = relit("info", tmp_path)
    assert outcome.code == 0 and "camera.surface_z_m is missing: relit solve estimates how far" in outcome.out


def test_relight_takes_near_lights_as_the_centre_sees_them_and_says_so(relit, tmp_path):
    lights = lamps(ORTHOGRAPHIC, 8, 4.0)
    centre = ORTHOGRAPHIC.points[ORTHOGRAPHIC.mask].mean(axis=0)
    ways = [lamp.position - centre for lamp in lights]
    told = [Lamp(None, lamp.strength / (way @ way), direction=way) for lamp, way in zip(lights, ways, strict=True)]
    near_lights.write(tmp_path / "near", ORTHOGRAPHIC, lights)
    near_lights.write(tmp_path / "far", ORTHOGRAPHIC, lights, told=told)
    sky = write_exr(tmp_path / "sky.exr", np.linspace(0, 1, 8 * 16 * 3).reshape(8, 16, 3))
    frames = {}
    for name in ("near", "far"):
        outcome = relit.done("relight", tmp_path / name, "--environment", sky, "--out", tmp_path / name / "f.####.exr")
        frames[name], header = exr.read(tmp_path / name / "f.0001.exr")
        said = "8 near lights are taken as distant" in outcome.out, "8 near lights" in header.get("relit:lights", "")
        assert said == (name == "near",) * 2
    for channel in "RGB":  # half rounding, twice; the mean of float32 points
        assert np.allclose(frames["near"][channel], frames["far"][channel], rtol=2e-3, atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("dome", [ORTHOGRAPHIC, PERSPECTIVE], ids=["orthographic", "perspective"])
def test_a_part_of_the_images_is_solved_as_in_the_whole(relit, tmp_path, dome):
    """Lights stay where they are in the camera frame: the rays of the part and its distance are those of the whole."""
    near_lights.write(tmp_path, dome, lamps(dome, 12, 2.0))
    x, y, width, height = 10, 8, 30, 32
    inside = (slice(y, y + height), slice(x, x + width))
    edit_manifest(tmp_path, camera={**dome.camera, "surface_z_m": float(dome.points[inside][dome.mask[inside]][:, 2].mean())})
    maps, *_ = solve(relit, tmp_path, "lambert", "--crop", f"{x},{y},{width},{height}")
    part = dome._replace(points=dome.points[inside], normal=dome.normal[inside], albedo=dome.albedo[inside], mask=dome.mask[inside])
    assert_solved(maps, part, angle=0.06, albedo=0.003)
